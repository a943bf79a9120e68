"""Mix-ups that are named, from which factor on, and honest logs that get a hint.

    python benchmarks/hints.py                # 1,200 honest logs, 20 logs a cell
    python benchmarks/hints.py --logs 200 --cells 5
    python benchmarks/hints.py --logs 0 --cells 0 --gross 10   # 13 kinds of mix-ups x 3 scales x 10 logs

A mix-up is made worse step by step; the first column has the smallest factor (of the variance of one axis to that of
another, or of a variance to 1 in its unit) from which on at least 9 of 10 logs are told so. Honest logs are of filters
that are right, and of filters that are wrong: a covariance 1/4 to 4 times as large in all axes or in one, a bias, heavy
tails, a drift. Several kinds of state, sizes, units, numbers of runs, and correlations of neighbouring steps.

Gross mix-ups are of logs of all these sizes and correlations, of a filter that is right, or whose covariance is 4 times
too large or too small: only draws count whose NEES falls by 10 or more with the mix-up undone. Slow logs are single
drifts whose covariance is a number that nobody estimated. Plain faults are factors of 2 to 30 on errors or deviations:
at the start, in the middle, in some runs, of one axis or at random; and drifts and biases as large. Their covariances
have any size, shape and course.

Exit status 1 if more than 6 of 1,200 honest logs, or of the slow ones, or 4 of 400 plain faults get a hint (as large a
share of another number), or if fewer than 80 % of a kind of gross mix-up, or 90 % of all, are named.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from calibration_gates import stationary
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from script_options import options_of

from consistency.referee.geometry import matrices, vectors, wrap
from consistency.referee.readers.alignment import WorldTransform, moved, skew
from consistency.referee.readers.mix_ups.hints import hints
from consistency.referee.readers.places import Places
from consistency.referee.readers.truth_matching import Poses, make_poses
from consistency.referee.types import Array

AXES = {
    "spatial": ("x", "y", "z", "roll", "pitch", "yaw"), "planar": ("x", "y", "heading"),
    "vector": ("a", "b", "c", "d"), "scalar": ("a",),
}  # fmt: skip
STATES = list(AXES)  # of logs without a mix-up
AXES["place"] = ("x", "y", "z")
SIZES = ((1, 200), (1, 1500), (5, 100), (20, 50), (40, 30))  # runs, steps
MEMORY = (0.0, 0.5, 0.9, 0.98, 0.999)
WRONG = ("right", "all", "axis", "bias", "tails", "drift")
PROMISE = 6 / 1200
W_FIRST = [0, 1, 2, 6, 3, 4, 5]  # numbers of a pose whose quaternion begins with w
OF_PLAIN = 4 / 400
SPREAD = 4.0  # of variances among axes of one kind, at most, where a log does not say otherwise
Mess = Callable[[Poses], Poses]


def log(
    rng: np.random.Generator, kind: str, runs: int, steps: int, rho: float, wrong: str = "right",
    sigma: Array | None = None, convention: str | None = None, correlated: bool = True,
) -> list[Poses]:  # fmt: skip
    """Runs of an estimator whose errors have the stated covariance, but for what is ``wrong``.

    Parameters
    ----------
    sigma : (n,), standard deviations; drawn where None
    rho : correlation of the errors of neighbouring steps
    """
    n = len(AXES[kind])
    convention = convention or {"spatial": "so3", "planar": "so2"}.get(kind, "vector")
    P = covariance(rng, sizes(rng, kind) if sigma is None else sigma, correlated)
    L, factor, bias = np.linalg.cholesky(P), np.ones(n), np.zeros(n)
    odd = rng.integers(n)
    if wrong in ("all", "axis"):
        factor[slice(None) if wrong == "all" else odd] = np.exp(rng.uniform(-np.log(4.0), np.log(4.0)))
    if wrong == "bias":
        bias[odd] = rng.uniform(0.5, 3.0)
    found = []
    for _ in range(runs):
        w = noise(rng, steps, n, rho, wrong == "tails")
        if wrong == "drift":
            w = w * np.sqrt(np.linspace(0.3, 4.0, steps))[:, None]
        grown = np.exp(0.5 * np.sin(np.linspace(0.0, rng.uniform(1.0, 9.0), steps)))
        e = (w @ L.T * np.sqrt(factor) + bias * np.sqrt(np.diag(P))) * grown[:, None]
        found.append(run_of(rng, kind, convention, e, P * np.square(grown)[:, None, None]))
    return found


def sizes(rng: np.random.Generator, kind: str) -> Array:
    """Standard deviations: positions 1 mm to 10 m, angles 0.05 to 5 degrees, states of any unit."""

    def block(n: int, low: float, high: float) -> Array:
        return np.asarray(
            np.exp(rng.uniform(np.log(low), np.log(high)) + rng.uniform(-0.5, 0.5, n) * 0.5 * np.log(SPREAD))
        )

    if kind == "spatial":
        return np.concatenate([block(3, 1e-3, 10.0), block(3, 1e-3, 0.1)])
    if kind == "planar":
        return np.concatenate([block(2, 1e-3, 10.0), block(1, 1e-3, 0.1)])
    return np.concatenate([block(1, 1e-3, 30.0) for _ in AXES[kind]])


def covariance(rng: np.random.Generator, sigma: Array, correlated: bool) -> Array:
    n = len(sigma)
    root = np.eye(n) + (0.3 * rng.normal(size=(n, n)) if correlated else 0.0)
    R = root @ root.T
    scale = sigma / np.sqrt(np.diag(R))
    return np.asarray(R * np.outer(scale, scale))


def noise(rng: np.random.Generator, steps: int, n: int, rho: float, tails: bool) -> Array:
    w = rng.standard_t(4, (steps, n)) / np.sqrt(2.0) if tails else rng.normal(size=(steps, n))
    return stationary(w, rho)


def run_of(rng: np.random.Generator, kind: str, convention: str, e: Array, P: Array) -> Poses:
    """A drive, or states, whose truth is the estimate and the error ``e`` (steps, n)."""
    steps, n = e.shape
    t = 0.1 * np.arange(steps)
    heading = rng.uniform(-3.0, 3.0) + np.cumsum(rng.normal(0.0, 0.1, steps))
    at = np.cumsum(0.5 * np.column_stack([np.cos(heading), np.sin(heading), 0.1 * np.sin(t)]), axis=0)
    manifold = kind
    if kind == "spatial":
        turn = Rotation.from_euler("ZYX", np.column_stack([heading, 0.1 * np.sin(t), 0.1 * np.cos(2 * t)]))
        own = np.hstack([at, turn.as_quat()])
        small = Rotation.from_rotvec(e[:, 3:])
        truth = np.hstack([at + e[:, :3], (turn * small if convention == "so3-body" else small * turn).as_quat()])
    elif kind == "planar":
        own = np.column_stack([at[:, :2], wrap(heading)])
        truth = own + e
        truth[:, 2] = wrap(truth[:, 2])
    else:
        manifold = "vector"
        own = at if kind == "place" else np.cumsum(rng.normal(size=(steps, n)), axis=0)
        truth = own + e
    if convention == "left":
        truth = vectors(matrices(own) @ motions(e))
    if convention == "right":
        truth = vectors(motions(e) @ matrices(own))
    rows = Places("line {}".format, np.arange(steps))
    return make_poses(rows, t, own, P, np.ones(steps, bool), t, truth, manifold, convention, 0.01)  # type: ignore[arg-type]


def motions(twists: Array) -> Array:
    """Exp of SE(2) or SE(3) of twists (steps, 3) or (steps, 6), as matrices."""
    d = 2 if twists.shape[1] == 3 else 3
    hat = np.zeros((len(twists), d + 1, d + 1))
    hat[:, :d, d] = twists[:, :d]
    if d == 2:
        hat[:, 1, 0], hat[:, 0, 1] = twists[:, 2], -twists[:, 2]
    else:
        hat[:, :3, :3] = skew(twists[:, 3:])
    return np.asarray(expm(hat))


def honest(rng: np.random.Generator, number: int) -> tuple[str, list[str]]:
    """What is wrong with a log, and the hints that it gets."""
    kind, wrong = STATES[number % len(STATES)], WRONG[number // len(STATES) % len(WRONG)]
    runs, steps = SIZES[rng.integers(len(SIZES))]
    poses = log(rng, kind, runs, steps, MEMORY[rng.integers(len(MEMORY))], wrong)
    return f"{kind}, {wrong}", hints("est", AXES[kind], poses)


# --- plain faults -----------------------------------------------------------------------------------

PLAIN = ("start", "middle", "drift", "bias", "scale", "axis", "outliers", "runs")
COURSES = ("constant", "growing", "two qualities", "wandering", "turning")
MOST_WRONG = 30.0  # of errors, or of standard deviations


def plain(rng: np.random.Generator, number: int) -> tuple[str, list[str]]:
    """The fault of a filter whose files are not mixed up, and the hints that it gets."""
    kind = STATES[rng.integers(len(STATES))]
    n = len(AXES[kind])
    runs, steps = SIZES[rng.integers(len(SIZES))]
    convention = {"spatial": "so3", "planar": "so2"}.get(kind, "vector")
    P = stated(rng, kind, steps)
    L = np.linalg.cholesky(P)
    wrong = PLAIN[number % len(PLAIN)]
    rho = (0.0, 0.0, 0.5, 0.9)[rng.integers(4)]
    factor = np.exp(rng.uniform(np.log(2.0), np.log(MOST_WRONG)))
    factors = factor_of(rng, wrong, runs, steps, n, factor)
    of_P = wrong not in ("drift", "bias") and rng.random() < 0.5
    if of_P and rng.random() < 0.3:
        factors = 1.0 / factors
    offset = np.zeros(n)
    if wrong == "bias":
        offset = rng.normal(size=n) * factor / 3.0
        factors = np.ones_like(factors)
    found = []
    for scale in factors:
        e = np.einsum("kij,kj->ki", L, noise(rng, steps, n, rho, False))
        e += offset * np.sqrt(np.diagonal(P, axis1=1, axis2=2))
        own = P
        if of_P:
            own = P / (scale[:, :, None] * scale[:, None, :])
        else:
            e = e * scale
        found.append(run_of(rng, kind, convention, e, own))
    return f"{kind}, {wrong}{' of P' * of_P}", hints("est", AXES[kind], found)


def stated(rng: np.random.Generator, kind: str, steps: int) -> Array:
    """Covariances (steps, n, n) of any size and shape: alike or unlike axes, correlated or not, in any course."""
    n = len(AXES[kind])
    near_one = rng.random() < 0.5
    sigma = np.full(n, 10.0 ** (rng.uniform(-0.35, 0.35) if near_one else rng.uniform(-3.0, 1.5)))
    shape = max(int(rng.integers(-2, 3)), 0)
    if kind in ("spatial", "planar"):
        sigma[{"spatial": 3, "planar": 2}[kind] :] = 10.0 ** rng.uniform(-3.0, -1.0)
    if shape:
        sigma = sigma * np.exp(rng.uniform(-1.5, 1.5, n))
    P = covariance(rng, sigma, shape == 2)
    time = np.linspace(0.0, 1.0, steps)
    course = COURSES[max(int(rng.integers(-2, len(COURSES))), 0)]
    size = np.ones(steps)
    if course == "growing":
        size = 0.01 + time
    if course == "two qualities":
        size = np.where(np.sin(rng.uniform(10.0, 60.0) * time) > rng.uniform(-0.8, 0.8), 1.0, 10.0 ** rng.uniform(0, 2))
    if course == "wandering":
        size = np.exp(np.cumsum(rng.normal(size=steps)) * 2.0 / np.sqrt(steps))
    if course == "turning" and n > 1:
        angles = rng.uniform(1.0, 9.0) * time
        turn = np.tile(np.eye(n), (steps, 1, 1))
        turn[:, :2, :2] = Rotation.from_rotvec(angles[:, None] * [0.0, 0.0, 1.0]).as_matrix()[:, :2, :2]
        return np.asarray(turn @ P @ np.swapaxes(turn, 1, 2))
    return np.asarray(P * size[:, None, None])


def factor_of(rng: np.random.Generator, wrong: str, runs: int, steps: int, n: int, factor: float) -> Array:
    """Factors (runs, steps, n) on errors, where the fault is."""
    out = np.ones((runs, steps, n))
    part = np.ones(n, bool)
    if rng.random() < 0.3 or wrong == "axis":
        part = rng.permutation(n) == 0
    begin, end = 0, steps
    if wrong == "start":
        end = int(np.ceil(rng.uniform(0.02, 0.5) * steps))
    if wrong == "middle":
        begin, end = np.sort(rng.integers(0, steps + 1, 2))
    where = np.zeros((runs, steps), bool)
    where[:, begin:end] = True
    if wrong == "runs":
        where &= (rng.random(runs) < rng.uniform(0.05, 0.5))[:, None]
    if wrong == "outliers":
        where = rng.random((runs, steps)) < rng.uniform(0.005, 0.2)
    strength = np.full((runs, steps), factor)
    if wrong == "drift":
        strength = np.tile(np.geomspace(1.0, factor, steps), (runs, 1))
    out[where[:, :, None] & part] = (strength[:, :, None] * part)[where[:, :, None] & part]
    return out


# --- mix-ups ----------------------------------------------------------------------------------------


def reordered(order: list[int]) -> Mess:
    return lambda p: p.with_values(covariance=p.own.covariance[:, order][:, :, order])


def states_reordered(order: list[int]) -> Mess:
    return lambda p: reordered(order)(p).with_values(estimate=p.own.estimate[:, order])


def read_as(convention: str) -> Mess:
    return lambda p: p.with_values(convention=convention)


def deviations(p: Poses) -> Poses:
    sigma = np.sqrt(np.diagonal(p.own.covariance, axis1=1, axis2=2))
    return p.with_values(covariance=sigma[:, :, None] * np.eye(sigma.shape[1]))


def information(p: Poses) -> Poses:
    return p.with_values(covariance=np.linalg.inv(p.own.covariance))


def alone(p: Poses) -> Poses:
    return p.with_values(true_t=p.own.t, truth=p.own.estimate.copy())


def one_axis(kind: str, axis: int, base: float = 0.05) -> Callable[[float], Array]:
    """One standard deviation larger than the others by the root of a factor."""
    return lambda factor: base * np.sqrt(np.where(np.arange(len(AXES[kind])) == axis, factor, 1.0))


def all_axes(kind: str) -> Callable[[float], Array]:
    """All variances smaller than 1 by a factor, alike."""
    return lambda factor: np.full(len(AXES[kind]), factor**-0.5)


def unlike_axes(kind: str) -> Callable[[float], Array]:
    """Variances from 1 down to a factor below it."""
    return lambda factor: np.geomspace(1.0, factor**-0.5, len(AXES[kind]))


SMALL, LARGE = (1.2, 1.5, 2.0, 3.0, 5.0), (4.0, 8.0, 12.0, 20.0, 50.0, 100.0, 200.0)
# name: kind, true convention, sizes by factor, mix-up, factors, what the hint says
MIXED: dict[str, tuple[str, str | None, Callable[[float], Array], Mess, tuple[float, ...], str]] = {
    "covariance x, y swapped (planar)": (
        "planar", None, one_axis("planar", 0), reordered([1, 0, 2]), SMALL, "order y, x",
    ),
    "covariance heading first (planar)": (
        "planar", None, one_axis("planar", 2), reordered([2, 0, 1]), SMALL, "components of the covariance",
    ),
    "covariance a, b swapped (state)": (
        "vector", None, one_axis("vector", 0), reordered([1, 0, 2, 3]), SMALL, "components of the covariance",
    ),
    "covariance x, y swapped (space)": (
        "spatial", None, one_axis("spatial", 0), reordered([1, 0, 2, 4, 3, 5]), SMALL, "order y, x, z",
    ),
    "blocks in the other order": (
        "spatial", None, lambda f: 0.05 * np.repeat([np.sqrt(f), 1.0], 3), reordered([3, 4, 5, 0, 1, 2]), SMALL,
        "--covariance-order",
    ),
    "so3-body read as so3": (
        "spatial", "so3-body", one_axis("spatial", 3), read_as("so3"), SMALL, "--error so3-body",
    ),
    "so3 read as so3-body": ("spatial", "so3", one_axis("spatial", 4), read_as("so3-body"), SMALL, "(--error so3)"),
    "states in another order": (
        "vector", None, lambda _: np.full(4, 0.05), states_reordered([1, 0, 2, 3]), (1.0,),
        "components of the estimates",
    ),
    "deviations, axes alike (planar)": ("planar", None, all_axes("planar"), deviations, LARGE, "standard deviations"),
    "deviations, axes unlike (planar)": (
        "planar", None, unlike_axes("planar"), deviations, LARGE, "standard deviations",
    ),
    "deviations, axes unlike (space)": (
        "spatial", None, unlike_axes("spatial"), deviations, LARGE, "standard deviations",
    ),
    "information, axes alike (planar)": ("planar", None, all_axes("planar"), information, LARGE, "information"),
    "information, axes unlike (state)": ("vector", None, unlike_axes("vector"), information, LARGE, "information"),
    "truth and estimates one file": ("spatial", None, lambda _: np.full(6, 0.05), alone, (1.0,), "the same file"),
}  # fmt: skip


def named(
    rng: np.random.Generator, name: str, factor: float, runs: int = 10, steps: int = 60, rho: float = 0.5
) -> bool:
    """Whether a log with this mix-up is told so."""
    kind, convention, sigma, mess, _, words = MIXED[name]
    plain = name.startswith("deviations")
    right = log(rng, kind, runs, steps, rho, sigma=sigma(factor), convention=convention, correlated=not plain)
    return any(words in hint for hint in hints("est", AXES[kind], [mess(p) for p in right]))


def smallest(rng: np.random.Generator, name: str, cells: int) -> str:
    shares = {f: sum(named(rng, name, f) for _ in range(cells)) / cells for f in MIXED[name][4]}
    least = next((f for f in shares if all(shares[g] >= 0.9 for g in shares if g >= f)), None)
    text = ", ".join(f"x{f:g} {100 * share:.0f} %" for f, share in shares.items())
    return f"{'-' if least is None else f'x{least:g}':>6}  {text}"


# --- gross mix-ups ----------------------------------------------------------------------------------


def inverse(p: Poses) -> Poses:
    turn = Rotation.from_quat(p.own.estimate[:, 3:]).inv()
    return p.with_values(estimate=np.hstack([-turn.apply(p.own.estimate[:, :3]), turn.as_quat()]))


def north(p: Poses) -> Poses:
    """Estimates in a world of x north, y east, z down."""
    turn = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return moved(p, WorldTransform(turn, np.zeros(3)))


def degrees(p: Poses) -> Poses:
    """Variances of angles in deg^2."""
    scale = np.ones(p.own.covariance.shape[-1])
    scale[2 if len(scale) == 3 else slice(3, 6)] = 180.0 / np.pi
    return p.with_values(covariance=p.own.covariance * np.outer(scale, scale))


def heading_degrees(p: Poses) -> Poses:
    return p.with_values(estimate=p.own.estimate * [1.0, 1.0, 180.0 / np.pi])


def correlations(p: Poses) -> Poses:
    """Deviations on the diagonal, correlations beside them."""
    sigma = np.sqrt(np.diagonal(p.own.covariance, axis1=1, axis2=2))
    R = p.own.covariance / (sigma[:, :, None] * sigma[:, None, :])
    return p.with_values(covariance=np.where(np.eye(sigma.shape[1]) > 0, sigma[:, :, None], R))


def turned(axes: Callable[[Poses], Array]) -> Mess:
    """Covariances of positions in other axes, the columns of matrices (steps, d, d)."""

    def mess(p: Poses) -> Poses:
        R = axes(p)
        T = np.tile(np.eye(p.own.covariance.shape[-1]), (len(R), 1, 1))
        T[:, : R.shape[1], : R.shape[1]] = np.swapaxes(R, 1, 2)
        return p.with_values(covariance=T @ p.own.covariance @ np.swapaxes(T, 1, 2))

    return mess


def along(p: Poses) -> Array:
    """Along the true path over ground, to its left, and up."""
    velocity = np.gradient(p.true.values[:, :3], axis=0) * [1.0, 1.0, 0.0]
    forward = velocity / np.linalg.norm(velocity, axis=1, keepdims=True)
    up = np.broadcast_to([0.0, 0.0, 1.0], forward.shape)
    return np.stack([forward, np.cross(up, forward), up], axis=-1)


def orbital(p: Poses) -> Array:
    """Along the radius, the track and the normal of both."""
    radius = p.true.values[:, :3] / np.linalg.norm(p.true.values[:, :3], axis=1, keepdims=True)
    normal = np.cross(radius, np.gradient(p.true.values[:, :3], axis=0))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.stack([radius, np.cross(normal, radius), normal], axis=-1)


def twice_the_heading(p: Poses) -> Array:
    """What is turned by -heading is right when it is turned by twice the heading."""
    heading = p.own.estimate[:, 2]
    if p.manifold == "spatial":
        heading = Rotation.from_quat(p.own.estimate[:, 3:]).as_euler("ZYX")[:, 0]
    return Rotation.from_rotvec(2.0 * heading[:, None] * [0.0, 0.0, 1.0]).as_matrix()[:, :2, :2]


def unlike(rng: np.random.Generator, kind: str) -> Array:
    """Standard deviations of which those of a block differ by up to a factor of 30, as along and across the way."""
    factors = np.exp(rng.uniform(-1.0, 1.0, len(AXES[kind])) * 0.5 * np.log(30.0))
    return np.asarray(sizes(rng, kind) * factors)


def large(rng: np.random.Generator, kind: str) -> Array:
    """The same, with positions up to a km, so that the NEES of standard deviations read as variances is too large."""
    sigma = unlike(rng, kind)
    sigma[: {"spatial": 3, "planar": 2}.get(kind, 0)] *= 100.0
    return sigma


# kind of mix-up: variants of kind of state, true convention, sizes, mix-up, words of the hint
GROSS: dict[str, list[tuple[str, str | None, Callable[[np.random.Generator, str], Array], Mess, tuple[str, ...]]]] = {
    "quaternion order": [
        ("spatial", None, sizes, lambda p: p.with_values(estimate=p.own.estimate[:, W_FIRST]), ("w x y z",)),
    ],
    "left / right error": [
        ("spatial", "left", sizes, read_as("right"), ("'left'",)),
        ("spatial", "right", sizes, read_as("left"), ("'right'",)),
        ("spatial", "right", sizes, read_as("so3"), ("'right'",)),
    ],
    "block order": [("spatial", None, sizes, reordered([3, 4, 5, 0, 1, 2]), ("--covariance-order",))],
    "body frame of P": [
        ("spatial", "left", unlike, read_as("so3"), ("'left'",)),
        ("planar", "left", unlike, read_as("so2"), ("'left'",)),
    ],
    "NED / ENU": [("spatial", None, sizes, north, ("x north",))],
    "inverse pose": [("spatial", None, sizes, inverse, ("are inverse",))],
    "unaligned world": [
        ("spatial", None, sizes, read_as("so3"), ("world", "--align")),
        ("planar", None, sizes, read_as("so2"), ("world", "--align")),
    ],
    "degrees": [
        ("planar", None, sizes, heading_degrees, ("estimates are in degrees",)),
        ("planar", None, sizes, lambda p: degrees(heading_degrees(p)), ("in degrees",)),
    ],
    "deviations, axes unlike": [
        (kind, None, large, deviations, ("standard deviations",)) for kind in ("spatial", "planar", "vector")
    ],
    "information, axes unlike": [
        (kind, None, sizes, information, ("information",)) for kind in ("spatial", "planar", "vector")
    ],
    "rotations of P reordered": [
        ("spatial", None, unlike, reordered([0, 1, 2, 5, 4, 3]), ("the rotations", "yaw, pitch, roll")),
        ("spatial", None, unlike, reordered([0, 1, 2, 4, 3, 5]), ("the rotations", "pitch, roll, yaw")),
    ],
    "P along the motion": [
        ("place", None, unlike, turned(along), ("along and across the motion",)),
        ("place", None, unlike, turned(orbital), ("radius, track and normal",)),
    ],
    "P turned by -heading": [
        ("planar", None, unlike, turned(twice_the_heading), ("negative heading",)),
        ("spatial", None, unlike, turned(twice_the_heading), ("negative heading",)),
    ],
}  # fmt: skip


def gross(rng: np.random.Generator, name: str, number: int, scale: float) -> tuple[bool, list[str]]:
    """Whether a log with this mix-up, its true covariance ``scale`` times too large, is told so, and its hints."""
    variants = GROSS[name]
    kind, convention, size, mess, words = variants[number % len(variants)]
    for _ in range(1000):
        runs, steps = SIZES[rng.integers(len(SIZES))]
        rho = MEMORY[rng.integers(len(MEMORY))]
        plain = name.startswith("deviations")
        right = log(rng, kind, runs, steps, rho, sigma=size(rng, kind), convention=convention, correlated=not plain)
        right = [p.with_values(covariance=p.own.covariance * scale) for p in right]
        if name == "unaligned world":
            frame = WorldTransform.about_z(rng.uniform(-3.0, 3.0), rng.normal(0.0, 10.0, 3 if kind == "spatial" else 2))
            mixed = [moved(p, frame) for p in right]
        else:
            mixed = [mess(p) for p in right]
        if median_nees(mixed) >= 10.0 * median_nees(right):
            break
    else:
        raise RuntimeError(f"{name}, {kind}: no draw is gross")
    said = hints("est", AXES[kind], mixed)
    return any(all(word in hint for word in words) for hint in said), said


def median_nees(runs: list[Poses]) -> float:
    """The median, infinite where a covariance is not positive definite."""
    found = []
    for p in runs:
        if (np.linalg.eigvalsh(p.own.covariance) <= 0).any():
            return np.inf
        with np.errstate(all="ignore"):
            found.append(np.einsum("ki,kij,kj->k", e := p.errors(), np.linalg.inv(p.own.covariance), e))
    return float(np.median(np.concatenate(found)))


def slow(rng: np.random.Generator, number: int) -> list[str]:
    """The hints of a single drifting log, whose covariance is a constant number of its components."""
    kind = STATES[number % len(STATES)]
    n, steps = len(AXES[kind]), int(rng.integers(200, 2000))
    e = np.cumsum(rng.normal(size=(steps, n)), axis=0) * sizes(rng, kind) / np.sqrt(steps)
    P = np.tile(10.0 ** rng.uniform(-6.0, 3.0) * np.eye(n), (steps, 1, 1))
    convention = {"spatial": "so3", "planar": "so2"}.get(kind, "vector")
    return hints("est", AXES[kind], [run_of(rng, kind, convention, e, P)])


def print_gross(seed: int, logs: int) -> bool:
    """Print how many gross mix-ups are named; whether that is enough of each kind and of all."""
    shares = []
    for k, name in enumerate(GROSS):
        found = []
        for at, scale in enumerate((1.0, 0.25, 4.0)):
            rng = np.random.default_rng((seed, 7, k, at))
            named_so = [gross(rng, name, number, scale) for number in range(logs)]
            found.append(sum(ok for ok, _ in named_so))
            for ok, said in named_so:
                if not ok:
                    print(f"  {name}, P x{scale:g}: {said[0] if said else 'no hint'}", flush=True)
        shares.append(sum(found) / (3 * logs))
        print(f"{name:<36} right {found[0]}, P/4 {found[1]}, Px4 {found[2]} of {logs} each", flush=True)
    print(f"gross mix-ups named: {100 * np.mean(shares):.1f} % of {3 * len(GROSS) * logs}")
    return min(shares) >= 0.8 and float(np.mean(shares)) >= 0.9


def main() -> int:
    given = options_of(
        __doc__.splitlines()[0] if __doc__ else "",
        logs=(1200, "Honest logs."),
        cells=(20, "Logs of each mix-up and factor; 0 for none."),
        plain=(400, "Logs with a plain fault of any size."),
        gross=(10, "Logs of each gross mix-up and scale; 0 for none."),
        slow=(200, "Slow logs."),
        seed=(5, None),
    )
    for number, name in enumerate(MIXED if given.cells else ()):
        print(f"{name:<36} {smallest(np.random.default_rng((given.seed, number)), name, given.cells)}", flush=True)
    found: dict[str, int] = dict.fromkeys((f"{k}, {w}" for k, w in itertools.product(STATES, WRONG)), 0)
    for number in range(given.logs):
        label, said = honest(np.random.default_rng((given.seed, 99, number)), number)
        found[label] += bool(said)
        for hint in said:
            print(f"  honest ({label}): {hint}", flush=True)
    total = sum(found.values())
    print(f"honest logs with a hint: {total} of {given.logs}")
    plainly = 0
    for number in range(given.plain):
        label, said = plain(np.random.default_rng((given.seed, 97, number)), number)
        plainly += bool(said)
        for hint in said:
            print(f"  plain ({label}): {hint}", flush=True)
    print(f"plain faults with a hint: {plainly} of {given.plain}")
    drifts = [
        hint for number in range(given.slow) for hint in slow(np.random.default_rng((given.seed, 98, number)), number)
    ]
    for hint in drifts:
        print(f"  slow: {hint}", flush=True)
    print(f"slow logs with a hint: {len(drifts)} of {given.slow}")
    enough = not given.gross or print_gross(given.seed, given.gross)
    many = total > PROMISE * given.logs or plainly > OF_PLAIN * given.plain or len(drifts) > PROMISE * given.slow
    return int(many or not enough)


if __name__ == "__main__":
    raise SystemExit(main())
