"""Factors on noises by the log density that a filter gives to its innovations, and how well they are known.

Intervals of log factors are those of the profile of a score that need not be a true likelihood.

Let d_r be the fall of unit r from the best setting to another one, W = 2 sum d_r, and V the variance of sum d_r by the
scatter of its n terms. To first order W is lambda times a chi-square number of one degree of freedom, with lambda =
(H^-1 J H^-1)_ii / (H^-1)_ii, H the curvature of the score and J the spread of its slopes (Kent 1982, Biometrika 69(1)),
and V / W tends to lambda, for both grow as the square of the distance. A setting is outside if W exceeds the quantile
of chi-square, which would do if the likelihood were true, and W / (V / W) the square of Student's. An interval reaches
as far as any setting that is not outside.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from scipy import stats
from scipy.optimize import NonlinearConstraint, minimize

from consistency.bench.filters.compiled import one_blas_thread
from consistency.bench.protocols import Filter, name_of, rejects
from consistency.bench.runs.isolation import Isolation
from consistency.bench.runs.run_outcome import compile_all, outcome_of
from consistency.bench.runs.workers import worker_count
from consistency.bench.scenario import Belief
from consistency.bench.types import Estimates, Trial
from consistency.referee.defaults import CONFIDENCE
from consistency.referee.errors import InputError
from consistency.referee.system import say
from consistency.referee.types import Array

LIMIT = float(np.log(1e4))  # factors that are tried lie within 1e-4 and 1e4
RADII = 0.7, 0.01  # of the trust region in log factors: a factor of 2 at first, 1 % at the end
MOST_SETTINGS = 150  # of a search, which takes some 30 for two factors
STEP = 0.05  # in log factors, for differences
UNITS = 20  # independent parts that an interval needs at least; fewer runs are cut into blocks of steps
WEAK = 1.0  # least curvature: a log factor is then known to a standard deviation of a factor of e
LARGEST_STEP = 1.0  # of a log factor, in which a quadratic model of the score is believed
END_RADII = 0.3, 0.02  # of the trust region, first and last, in half widths of the intervals
END_SETTINGS = 60  # at most for one end of an interval; some 15 do
AT_LIMIT = 0.05  # in log factors from a limit
NORMAL = float(stats.norm.ppf(0.5 + CONFIDENCE / 2.0))
Scoring = Callable[[Array], Array | None]  # of log factors (p,): log densities (R, T), None where a run failed
EVERY = 5.0  # seconds between lines of progress
MOTION = ("v", "omega")  # channels of Q
CHANNELS = {  # of R, by model of the sensor
    "uvd": ("u", "v", "d"),
    "xyz": ("x", "y", "z"),
    "linear": ("x", "y", "z"),
    "relative-xy": ("dx", "dy"),
    "range-bearing": ("range", "bearing"),
}
DIGITS = 6  # of a tuned standard deviation, so that what is judged is what is written


@dataclass(frozen=True)
class FactorFit:
    """Natural logarithms of p factors."""

    log_factors: Array  # (p,)
    interval: Array  # (p, 2), 95 %; infinite on a side on which the data do not bound it
    edge: tuple[int, ...]  # of each factor: -1 or 1 where it lies at the lower or upper limit of what is tried, or 0
    settings: int  # that were tried


def fit_log_factors(score: Scoring, starts: Sequence[Array]) -> FactorFit | None:
    """Return the setting of greatest total score, searched from the first start at which no run fails; None without.

    The search is COBYQA (Ragonneau & Zhang 2025; SciPy), a trust region on quadratic models without derivatives, and
    one Newton step at its end. The score is smooth, for all settings see the same trials. Intervals are those of the
    profile (see the top of this module).
    """
    scores = KnownScores(score)
    start = next((start for start in starts if np.isfinite(scores.total(start))), None)
    if start is None:
        return None
    densities = scores(start).size
    search_options: dict[str, Any] = {"method": "COBYQA", "bounds": [(-LIMIT, LIMIT)] * len(start)}
    search_options["options"] = _search_options(RADII, MOST_SETTINGS)

    def loss(x: Array) -> float:
        return -scores.total(x) / densities

    search_result: Any = minimize(loss, start, **search_options)
    best = np.clip(search_result.x, -LIMIT, LIMIT)
    edge = np.where(np.abs(best) > LIMIT - AT_LIMIT, np.sign(best), 0.0).astype(int)
    free = np.flatnonzero(edge == 0)
    slope, curvature = score_derivatives(scores, best, free)
    best = _after_newton_step(scores, best, free, slope, curvature)
    interval = profile_intervals(scores, best, np.nan_to_num(curvature), LIMIT)
    return FactorFit(best, interval, tuple(edge.tolist()), scores.settings)


class KnownScores:
    """Scores of settings, each computed once."""

    def __init__(self, score: Scoring) -> None:
        self.score = score
        self._known: dict[bytes, Array | None] = {}
        self._shape: tuple[int, ...] = (1, 1)

    def __call__(self, x: Array) -> Array:
        """Return log densities (R, T); NaN where a run failed."""
        key = np.asarray(x, float).tobytes()
        if key not in self._known:
            self._known[key] = self.score(np.asarray(x, float))
        density = self._known[key]
        if density is None:
            return np.full(self._shape, np.nan)
        self._shape = density.shape
        return density

    def total(self, x: Array) -> float:
        """Return the total log density; minus infinity where a run failed."""
        total_log_density = float(self(x).sum())
        return total_log_density if np.isfinite(total_log_density) else -np.inf

    @property
    def settings(self) -> int:
        """Number of settings that were tried."""
        return len(self._known)


def score_derivatives(scores: KnownScores, x: Array, free: Sequence[int] | Array) -> tuple[Array, Array]:
    """Return slope (p,) and curvature (p, p) of the total by the ``free`` log factors, 0 by the others."""
    step = STEP * np.eye(len(x))

    def total(at: Array) -> float:
        return float(scores(at).sum())

    at_point, slope, curvature = total(x), np.zeros(len(x)), np.zeros((len(x), len(x)))
    for i in free:
        ahead, behind = total(x + step[i]), total(x - step[i])
        slope[i] = (ahead - behind) / (2.0 * STEP)
        curvature[i, i] = (ahead - 2.0 * at_point + behind) / STEP**2
    for i, j in combinations(free, 2):
        ahead, behind = total(x + step[i] + step[j]), total(x - step[i] - step[j])
        along_both = (ahead - 2.0 * at_point + behind) / STEP**2
        curvature[i, j] = (along_both - curvature[i, i] - curvature[j, j]) / 2.0
        curvature[j, i] = curvature[i, j]
    return slope, curvature


def _after_newton_step(scores: KnownScores, x: Array, free: Array, slope: Array, curvature: Array) -> Array:
    """Return the top of the parabola through ``x``, where there is one and the score is greater there."""
    bend = -curvature[np.ix_(free, free)]
    if not len(free) or not np.isfinite(bend).all() or np.linalg.eigvalsh(bend)[0] <= 0.0:
        return x
    moved = x.copy()
    moved[free] += np.clip(np.linalg.solve(bend, slope[free]), -STEP, STEP)
    return moved if scores.total(moved) > scores.total(x) else x


# --- intervals --------------------------------------------------------------------------------------


def profile_intervals(score: Callable[[Array], Array], best: Array, curvature: Array, limit: float) -> Array:
    """Return the interval of each log factor (p, 2), infinite on a side on which the data do not bound it.

    Parameters
    ----------
    score : log densities (R, T) at log factors (p,), NaN where a run failed
    best : the setting of greatest score (p,)
    curvature : second derivatives of the total score there (p, p); 0 where they are not known
    limit : log factors lie within it on both sides
    """
    eigenvalues, eigenvectors = np.linalg.eigh(-curvature)
    covariance = (eigenvectors / np.maximum(eigenvalues, WEAK)) @ eigenvectors.T
    half_widths = NORMAL * np.sqrt(np.diag(covariance))
    unit = np.minimum(half_widths, LARGEST_STEP)
    at_best = independent_sums(score(best))

    def depth(u: Array) -> float:
        here = independent_sums(score(np.clip(best + unit * u, -limit, limit)))
        if not np.isfinite(here).all():
            return 1.0 + float(np.linalg.norm(u))  # outside, and the more so the further away
        return depth_of(at_best, here, len(best))

    low, high = (-limit - best) / unit, (limit - best) / unit
    intervals = np.empty((len(best), 2))
    for i in range(len(best)):
        towards_end = covariance[:, i] / covariance[i, i] * unit[i] / unit
        for column, side in enumerate((-1.0, 1.0)):
            guess = np.clip(side * towards_end, low, high)
            end = best[i] + unit[i] * _farthest(i, side, depth, guess, low, high)
            is_open = side * end > limit - AT_LIMIT
            intervals[i, column] = side * np.inf if is_open else end
    return intervals


def _search_options(radii: tuple[float, float], settings: int) -> dict[str, Any]:
    """Options of COBYQA for a trust region between two radii and so many settings at most."""
    return {"initial_tr_radius": radii[0], "final_tr_radius": radii[1], "maxfev": settings, "scale": False}


def _farthest(i: int, side: float, depth: Callable[[Any], Any], guess: Array, low: Array, high: Array) -> float:
    """Return the largest (``side`` 1) or smallest (-1) coordinate ``i`` of the points at a depth of 1 at most."""
    search_options: dict[str, Any] = {"method": "COBYQA", "bounds": list(zip(low, high, strict=True))}
    search_options["constraints"] = NonlinearConstraint(depth, -np.inf, 1.0)
    search_options["options"] = _search_options(END_RADII, END_SETTINGS)

    def nearness(u: Array) -> float:
        return float(-side * u[i])

    search_result: Any = minimize(nearness, guess, **search_options)
    return float(search_result.x[i])


def independent_sums(density: Array) -> Array:
    """Sum (R, T) over what is taken to be independent: runs, or blocks of steps of few runs."""
    blocks = -(-UNITS // len(density))
    block_sums = [part.sum(axis=1) for part in np.array_split(density, blocks, axis=1)]
    return np.concatenate(block_sums)


def depth_of(at_best: Array, here: Array, factors: int) -> float:
    """Return how far a setting is from the best one: 0 there, 1 at the end of an interval.

    The depth is linear in the distance where the score is quadratic.

    Parameters
    ----------
    at_best, here : sums of log densities of independent units (n,) at the best setting and at this one
    factors : number of factors that were fitted
    """
    fall = at_best - here
    n, W = len(fall), 2.0 * float(fall.sum())
    if W <= 0.0:
        return 0.0
    V = n / (n - factors) * float(((fall - fall.mean()) ** 2).sum())
    student = float(stats.t.ppf(0.5 + CONFIDENCE / 2.0, n - factors))
    return float(W / max(NORMAL * np.sqrt(W), student * np.sqrt(V)))


class RunScore(NamedTuple):
    """Score of one run of T steps."""

    log_density: Array  # (T,), 0 in a step without an innovation
    nis: float  # sum over the steps,
    dof: float  # which has this expectation if the covariances are right
    failure: str  # why the run failed, or nothing


def require_scorable(filter_: Filter) -> None:
    """Refuse a filter that leaves observations out: the likelihood of those it keeps prefers a small noise.

    Raises
    ------
    InputError
        It has a gate or a guard.
    """
    if rejects(filter_) or getattr(filter_, "guard", None) is not None:
        raise InputError(
            f"filter '{name_of(filter_)}' leaves observations out, so that its innovations say too little of the "
            "noise; tune the filter without its guard"
        )


def score_of_run_by_innovations(trial: Trial, estimates: Estimates) -> RunScore:
    """Return the likelihood of the observations of a run (Schweppe 1965, IEEE Trans. Inf. Theory 11(1), eq. 9).

    The observation that begins a landmark is left out, as in a diffuse likelihood: no density is stated for it.

    Raises
    ------
    InputError
        The filter reports no innovations.
    """
    outcome = outcome_of(trial, [replace(estimates, map=None)])
    failure = "".join(f"step {failure.step}: {failure.reason}" for failure in outcome.failures)
    nis, dof, log_det = estimates.nis, estimates.nis_dof.astype(float), estimates.log_det
    if log_det is None or not np.isfinite(log_det).any():
        if not failure:
            raise InputError(
                f"filter '{estimates.filter}' reports no innovations: its update must return an Info with innovation "
                "and S"
            )
        log_det = np.full(len(nis), np.nan)
    has_innovation = np.isfinite(nis) & np.isfinite(log_det) & (dof > 0)
    density = np.where(has_innovation, -0.5 * (nis + log_det + dof * np.log(2.0 * np.pi)), 0.0)
    return RunScore(density, float(nis[has_innovation].sum()), float(dof[has_innovation].sum()), failure)


@dataclass(frozen=True)
class Scores:
    """Scores of R runs of up to T steps at one setting."""

    log_density: Array  # (R, T), 0 in steps that a run does not have
    ratio: float  # total NIS over its degrees of freedom
    failures: tuple[str, ...]  # of runs that failed


class BeliefScorer:
    """Scores a filter on trials under any belief; to be used in a ``with``, whose end kills what still works.

    A filter that is not compiled keeps its processes from one setting to the next, with the modules that it imports.

    Parameters
    ----------
    belief : that a fit begins with
    timeout : seconds a trial of a filter that is not compiled
    """

    def __init__(
        self, filter_: Filter, trials: Sequence[Trial], belief: Belief, jobs: int = -1, timeout: float | None = None
    ) -> None:
        self.filter, self.trials = filter_, list(trials)
        self.settings, self.began = 0, time.monotonic()
        self._told = self.began
        # kernels release the GIL; other filters run in processes
        self._pool = ThreadPoolExecutor(min(worker_count(jobs), len(self.trials)))
        self._isolation = Isolation([filter_], belief, timeout)

    def __enter__(self) -> BeliefScorer:
        self._isolation.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._isolation.__exit__()
        self._pool.shutdown(cancel_futures=True)

    def compile(self) -> None:
        """Compile the filter, so that its first setting takes no longer than others."""
        compile_all([(self.filter, self.trials[0], self._isolation.belief)])

    def __call__(self, belief: Belief) -> Scores:
        """Return the scores of all runs.

        Raises
        ------
        InputError
            The filter reports no innovations, or needs what a trial does not have.
        """
        with one_blas_thread():
            scores = list(self._pool.map(lambda trial: self._score(trial, belief), self.trials))
        self.settings += 1
        now = time.monotonic()
        if now - self._told >= EVERY:
            self._told = now
            where = f"{self.settings} settings on each of {len(self.trials)} runs"
            say(f"fitting {name_of(self.filter)}: {where}, {now - self.began:.0f} s")
        density = np.zeros((len(scores), max(trial.steps for trial in self.trials)))
        failures = []
        for row, trial, score in zip(density, self.trials, scores, strict=True):
            row[: len(score.log_density)] = score.log_density
            if score.failure:
                failures.append(f"run {trial.run}, {score.failure}")
        dof = sum(score.dof for score in scores)
        ratio = sum(score.nis for score in scores) / dof if dof else np.nan
        return Scores(density, ratio, tuple(failures))

    def _score(self, trial: Trial, belief: Belief) -> RunScore:
        [estimates] = self._isolation.run(trial, belief)
        return score_of_run_by_innovations(trial, estimates)


class NoiseGroup(NamedTuple):
    """Channels whose variances have one factor, such as ``Q.v``; ``name`` is what the user calls them."""

    name: str
    channels: tuple[str, ...]


def noise_groups_of(text: str, belief: Belief) -> tuple[NoiseGroup, ...]:
    """Groups as the option ``--groups`` has them: "Q,R", "Q.v,Q.omega,R" or "Q,R.u+R.v,R.d".

    ``Q`` and ``R`` stand for all their channels with a noise. Channels that no group names stay as they are.

    Raises
    ------
    InputError
        An unknown channel, one that is named twice, or one whose noise is zero and stays so whatever its factor.
    """
    sigma, channels_by_name = sigma_by_channel(belief), dict[str, list[str]]()
    for noise in ("Q", "R"):
        members = [channel for channel in sigma if channel.startswith(noise)]
        channels_by_name[noise] = [channel for channel in members if sigma[channel] > 0.0]
        channels_by_name |= {channel: [channel] for channel in members}
    groups, seen = [], set[str]()
    for name in (part.strip() for part in text.split(",")):
        channels: list[str] = []
        for member in (part.strip() for part in name.split("+")):
            if member not in channels_by_name:
                raise InputError(f"--groups {text}: unknown noise '{member}'; there are {', '.join(channels_by_name)}")
            if not any(sigma[channel] for channel in channels_by_name[member]):
                raise InputError(
                    f"--groups {text}: '{member}' is believed to be zero, which no factor changes; believe in a noise, "
                    "or leave it out"
                )
            channels += channels_by_name[member]
        for channel in channels:
            if channel in seen:
                raise InputError(f"--groups {text}: '{channel}' is named twice; it has one factor")
            seen.add(channel)
        groups.append(NoiseGroup(name, tuple(channels)))
    return tuple(groups)


def scaled(belief: Belief, groups: Sequence[NoiseGroup], log_factors: Array) -> Belief:
    """The belief with the variances of each group times its factor; ``log_factors`` (groups,)."""
    sigma = sigma_by_channel(belief)
    for group, log_factor in zip(groups, log_factors, strict=True):
        for channel in group.channels:
            sigma[channel] *= float(np.exp(log_factor / 2.0))
    return _with_sigma(belief, sigma)


def rounded(belief: Belief) -> Belief:
    """The belief with the digits that are written of its standard deviations."""
    sigma = sigma_by_channel(belief)
    for channel, value in sigma.items():
        sigma[channel] = float(f"{value:.{DIGITS}g}")
    return _with_sigma(belief, sigma)


def sigma_by_channel(belief: Belief) -> dict[str, float]:
    """Standard deviation of each channel, SI units and px."""
    values = (belief.motion.sigma_v, belief.motion.sigma_omega, *belief.sensor.sigma)
    names = (*(f"Q.{name}" for name in MOTION), *(f"R.{name}" for name in CHANNELS[belief.sensor.model]))
    return dict(zip(names, values, strict=True))


def _with_sigma(belief: Belief, sigma: dict[str, float]) -> Belief:
    sigma_v, sigma_omega, *sensor_sigmas = sigma.values()
    motion = belief.motion.model_copy(update={"sigma_v": sigma_v, "sigma_omega": sigma_omega})
    return belief.model_copy(
        update={"motion": motion, "sensor": belief.sensor.model_copy(update={"sigma": tuple(sensor_sigmas)})}
    )
