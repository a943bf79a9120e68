"""Worlds in which a right filter's errors depend on each other in every way that the referee has to bear.

In each world the error of every step is exactly N(0, P), so that any fault that is found is a false alarm. Runs are
independent. A world is a function that draws the runs of one gate: :class:`Draw` -> :class:`Gate`.
"""

from __future__ import annotations

from functools import lru_cache, partial

import numpy as np
from calibration_gates import (
    DOF,
    SEED,
    Draw,
    Gate,
    World,
    first_order,
    headings,
    random_walk_filter,
    roots,
    rotation,
    shared,
    standard,
    turned,
    with_innovations,
)
from scipy import special

from consistency.diagnostics import Record
from consistency.referee.geometry import planar_error
from consistency.referee.readers.formats.archives import steps_of
from consistency.referee.readers.runs_to_record import Track, assemble, symmetric
from consistency.referee.types import Array

AXES = ("x", "y", "heading")
SLOW = "{} % of the runs have one error in all steps, the others independent steps"
TAILS = "independent steps of {}, with the stated covariance"
POOL: dict[str, tuple[Array, Array]] = {}  # runs of built-in scenarios, which are drawn once and shared


# --- errors of the same dependence in every run -------------------------------------------------------------


def independent(draw: Draw) -> Gate:
    """NEES values alone."""
    return Gate(nees=draw.rng.chisquare(DOF, (draw.runs, draw.steps)), dof=DOF)


def autoregressive(draw: Draw, correlation: float) -> Gate:
    """Stationary first-order errors, seen through a root of the covariance of each step."""
    root = roots(draw.steps)
    error = (root @ first_order(draw, np.float64(correlation), DOF)[..., None])[..., 0]
    return Gate(error, shared(root @ np.swapaxes(root, -1, -2), error))


def fully_dependent(draw: Draw, n: int) -> Gate:
    """One error in all steps of a run."""
    return standard(np.repeat(draw.rng.standard_normal((draw.runs, 1, n)), draw.steps, axis=1))


def one_slow_axis(draw: Draw) -> Gate:
    """One error in all steps in the first axis, independent steps in the others."""
    error = draw.rng.standard_normal((draw.runs, draw.steps, DOF))
    error[..., 0] = error[:, :1, 0]
    return standard(error)


def random_walk(draw: Draw) -> Gate:
    """Partial sums of white noise, each over its own standard deviation."""
    sums = draw.rng.standard_normal((draw.runs, draw.steps, DOF)).cumsum(axis=1)
    return standard(sums / np.sqrt(np.arange(1.0, draw.steps + 1.0))[:, None])


def linear_gaussian(draw: Draw) -> Gate:
    """All runs of the pool before any is taken again, then again in another order."""
    pool, covariance = POOL["linear-gaussian"]
    turn, place = np.divmod(draw.first + np.arange(draw.runs), len(pool))
    error = np.concatenate([pool[_order(len(pool), int(t))[place[turn == t]]] for t in np.unique(turn)])
    return Gate(error, shared(covariance, error))


@lru_cache(maxsize=4)
def _order(size: int, turn: int) -> Array:
    return np.random.default_rng((SEED, turn)).permutation(size)


# --- dependence that differs from run to run ----------------------------------------------------------------


def run_specific_period(draw: Draw) -> Gate:
    """a cos(wk) + b sin(wk) with a, b standard normal: unit variance in every step."""
    w = draw.rng.uniform(0.0, np.pi, (draw.runs, 1, 1))
    a, b = draw.rng.standard_normal((2, draw.runs, 1, DOF))
    phase = w * np.arange(draw.steps)[:, None]
    return standard(a * np.cos(phase) + b * np.sin(phase))


def run_specific_correlation(draw: Draw) -> Gate:
    """First-order errors, with a correlation of its own for each run."""
    return standard(first_order(draw, draw.rng.uniform(0.0, 0.999, (draw.runs, 1)), DOF))


def slow_share(draw: Draw, share: float, n: int) -> Gate:
    """Each run has one error in all steps with probability ``share``, else independent steps."""
    error = draw.rng.standard_normal((draw.runs, draw.steps, n))
    slow = draw.rng.random(draw.runs) < share
    error[slow] = error[slow, :1]
    return standard(error)


def body_frame(draw: Draw) -> Gate:
    """Errors of a Kalman filter turned into the body frame; its gain is near 0.01, so that they change slowly."""
    error, variance = random_walk_filter(draw, start=1.0, process=1e-4, noise=100.0, n=2)
    return Gate(*turned(error, variance, headings(draw)))


def left_invariant(draw: Draw) -> Gate:
    """Errors and covariances as ``analyse --error left`` works them out of planar poses."""
    recording = recorded(*left_poses(draw))
    return Gate(recording.errors.error, np.asarray(recording.errors.covariance))


def ragged(draw: Draw) -> Gate:
    """AR(.95) in runs of different lengths."""
    gate = autoregressive(draw, 0.95)
    lengths = draw.rng.integers(1, draw.steps + 1, draw.runs)
    assert gate.error is not None
    gate.error[np.arange(draw.steps) >= lengths[:, None]] = np.nan
    return gate


# --- innovations --------------------------------------------------------------------------------------------


def innovations_alone(draw: Draw) -> Gate:
    """White innovations of 0, 1, 2 or 3 landmarks of two coordinates in each step, as an optimal gain has them."""
    dof = 2 * draw.rng.integers(0, 4, (draw.runs, draw.steps))
    nis = np.where(dof > 0, draw.rng.chisquare(np.maximum(dof, 1)), np.nan)
    return Gate(nis=nis, nis_dof=dof, optimal_gain=True)


def schmidt_kalman(draw: Draw) -> Gate:
    """z = x + b + v with a bias b that is considered and never estimated; two axes, alike.

    With P and C the variance of the error of x and its covariance with b, S = P + 2C + B + R is exactly the
    variance of the innovation, K = (P + C) / S; but innovations share b, and are not white.
    """
    rng, shape, B, R, q = draw.rng, (draw.runs, 2), 1.0, 1.0, 0.01
    bias, e = rng.standard_normal((2, *shape)) * np.sqrt([[[B]], [[1.0]]])
    P, C, rows = 1.0, 0.0, []
    for _ in range(draw.steps):
        P, e = P + q, e + np.sqrt(q) * rng.standard_normal(shape)
        S = P + 2.0 * C + B + R
        innovation = e + bias + np.sqrt(R) * rng.standard_normal(shape)
        K = (P + C) / S
        e, P, C = e - K * innovation, P - K * (P + C), C - K * (C + B)
        rows.append((e, P, innovation, S))
    return with_innovations(rows)


def fixed_gain(draw: Draw) -> Gate:
    """A random walk tracked with a gain of 0.1 where 0.27 is optimal; P in Joseph's form is exact for any gain."""
    rng, shape, q, R, K = draw.rng, (draw.runs, 2), 0.1, 1.0, 0.1
    P, rows = 1.0, []
    e = np.sqrt(P) * rng.standard_normal(shape)
    for _ in range(draw.steps):
        P, e = P + q, e + np.sqrt(q) * rng.standard_normal(shape)
        innovation, S = e + np.sqrt(R) * rng.standard_normal(shape), P + R
        e, P = e - K * innovation, (1.0 - K) ** 2 * P + K**2 * R
        rows.append((e, P, innovation, S))
    return with_innovations(rows)


# --- errors that are not Gaussian ---------------------------------------------------------------------------


def student(draw: Draw, nu: float, correlation: float = 0.0) -> Gate:
    """Components of Student's t distribution, of unit variance; ``correlation`` is that of their normal scores."""
    score = first_order(draw, np.float64(correlation), DOF)
    tail = special.stdtrit(nu, special.ndtr(-np.abs(score)))
    return standard(-np.sign(score) * tail * np.sqrt((nu - 2.0) / nu))


def student_of_all(draw: Draw, nu: float) -> Gate:
    """Multivariate t distribution: all components of a step are large together."""
    scale = np.sqrt((nu - 2.0) / draw.rng.chisquare(nu, (draw.runs, draw.steps, 1)))
    return standard(scale * draw.rng.standard_normal((draw.runs, draw.steps, DOF)))


def laplace(draw: Draw, correlation: float = 0.0) -> Gate:
    """Components of Laplace's distribution, of unit variance; ``correlation`` is that of their normal scores."""
    score = first_order(draw, np.float64(correlation), DOF)
    return standard(-np.sign(score) * np.log(2.0 * special.ndtr(-np.abs(score))) / np.sqrt(2.0))


# --- planar poses -------------------------------------------------------------------------------------------


def left_poses(draw: Draw) -> tuple[Array, Array, Array]:
    """True and estimated poses (R, T, 3) and covariances (R, T, 3, 3) of a robot that drives 1 m a step.

    Its heading wanders 0.5 rad a step and is known from a compass, again in each step; the position comes from a Kalman
    filter, whose errors change slowly in the world and fast in the body. Log(estimate^-1 truth) is exactly N(0, P).
    """
    heading = headings(draw)
    pace = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    truth = np.concatenate([pace.cumsum(axis=1), heading[..., None]], axis=-1)
    compass = 0.05  # rad: errors stay far from half a turn
    error, covariance = np.zeros((*heading.shape, 3)), np.zeros((*heading.shape, 3, 3))
    slow = random_walk_filter(draw, start=0.01, process=1e-6, noise=1.0, n=2)
    error[..., :2], covariance[..., :2, :2] = turned(*slow, heading)
    error[..., 2], covariance[..., 2, 2] = compass * draw.rng.standard_normal(heading.shape), compass**2
    return truth, _composed(truth, _se2_exp(-error)), covariance


def recorded(truth: Array, estimate: Array, covariance: Array) -> Record:
    """What ``analyse --error left`` makes of poses, without the way through a file."""
    error, columns = planar_error(truth, estimate, "left"), np.arange(truth.shape[1])
    tracks = []
    for run, P in enumerate(covariance):
        place = steps_of("memory", run, columns)
        tracks.append(Track(run, columns, place, error[run], symmetric(P, place.__getitem__)))
    return assemble("left", tracks, columns * 1.0, AXES, "memory", "left")


def _se2_exp(tangent: Array) -> Array:
    """Exp of SE(2), (..., 3) -> (..., 3), Solà, Deray & Atchuthan (2018) eq. 156 and 158."""
    h = tangent[..., 2]
    s = np.sinc(h / np.pi)
    c = np.sin(0.5 * h) * np.sinc(0.5 * h / np.pi)  # (1 - cos h) / h
    x, y = tangent[..., 0], tangent[..., 1]
    return np.stack([s * x - c * y, c * x + s * y, h], axis=-1)


def _composed(pose: Array, motion: Array) -> Array:
    """Planar poses followed by motions in their own frames, (..., 3) each."""
    shift = (rotation(pose[..., 2]) @ motion[..., :2, None])[..., 0]
    return np.concatenate([pose[..., :2] + shift, pose[..., 2:] + motion[..., 2:]], axis=-1)


# --- tables -------------------------------------------------------------------------------------------------

WORLDS = {
    "independent": World(independent, "NEES values alone, independent over steps"),
    "AR(.95)": World(
        partial(autoregressive, correlation=0.95),
        "errors of neighbouring steps correlate by 0.95; the covariance changes from step to step",
    ),
    "AR(.99)": World(partial(autoregressive, correlation=0.99), "errors of neighbouring steps correlate by 0.99"),
    "linear-gaussian": World(linear_gaussian, "the Kalman filter (`kf`) of that scenario"),
    "fully dependent": World(
        partial(fully_dependent, n=DOF), "one error in all steps of a run: the worst case that `plan` counts on"
    ),
    "fully dependent, n = 1": World(partial(fully_dependent, n=1), "fully dependent with one state", 1),
    "one axis slow": World(one_slow_axis, "one axis has one error in all steps, the other two independent steps"),
    "random walk": World(random_walk, "partial sums of white noise, scaled to unit variance in each step"),
    "body frame": World(
        body_frame, "slow errors of a Kalman filter, seen from a robot that turns another way in each run", 2
    ),
    "poses, left": World(left_invariant, "planar poses with such errors, as `analyse --error left` takes them"),
    "period of the run": World(
        run_specific_period, "errors swing with a period of 2 steps or more, another in each run"
    ),
    "AR(.) of the run": World(
        run_specific_correlation, "neighbours correlate by 0 to 0.999, another value in each run"
    ),
    "5 % slow": World(partial(slow_share, share=0.05, n=DOF), SLOW.format(5)),
    "5 % slow, n = 1": World(partial(slow_share, share=0.05, n=1), f"{SLOW.format(5)}; one state", 1),
    "20 % slow": World(partial(slow_share, share=0.2, n=DOF), SLOW.format(20)),
    "20 % slow, n = 1": World(partial(slow_share, share=0.2, n=1), f"{SLOW.format(20)}; one state", 1),
    "ragged": World(ragged, "AR(.95) in runs of 1 to 100 steps"),
    "NIS alone": World(innovations_alone, "white innovations of 0 to 6 degrees of freedom a step, no truth", None),
    "Schmidt-Kalman": World(
        schmidt_kalman, "errors and innovations of a filter that considers a bias and does not estimate it", 2
    ),
    "fixed gain": World(fixed_gain, "errors and innovations of a filter with a gain that is not optimal", 2),
}

LOGS = {"one log": World(partial(autoregressive, correlation=0.95), "AR(.95), a single run of 1,000 steps")}

# right covariances of errors that are not Gaussian: the promise on false alarms does not cover them
HEAVY = {
    "t5": World(partial(student, nu=5.0), TAILS.format("Student's t with 5 degrees of freedom")),
    "t5, all axes": World(partial(student_of_all, nu=5.0), TAILS.format("multivariate t with 5 degrees of freedom")),
    "t10": World(partial(student, nu=10.0), TAILS.format("Student's t with 10 degrees of freedom")),
    "Laplace": World(laplace, TAILS.format("Laplace's distribution")),
    "t5, AR(.95)": World(partial(student, nu=5.0, correlation=0.95), "t5 whose normal scores are AR(.95)"),
    "t10, AR(.95)": World(partial(student, nu=10.0, correlation=0.95), "t10 whose normal scores are AR(.95)"),
    "Laplace, AR(.95)": World(partial(laplace, correlation=0.95), "Laplace whose normal scores are AR(.95)"),
}
