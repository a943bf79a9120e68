"""Clocks: the units of timestamps, and the time by which the truth of some runs is early or late."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import optimize

from consistency.referee.diagnostics import distributions
from consistency.referee.diagnostics.whitening import whiten
from consistency.referee.errors import InputError
from consistency.referee.readers.runs_to_record import unchanging
from consistency.referee.readers.truth_matching import Poses, evenly, finite_rows, submatrices
from consistency.referee.types import Array

REACH = 1.0  # s, the largest offset that is looked for
STEP = 1e-3  # s, over which the motion of the truth is taken
MOST = 4000  # estimates that are looked at, of all runs together
RUNS = 60  # runs that are looked at: their offset adds less than 1 / 60 to the NEES of a whole run
PARTS = 12  # that a single run is cut into
CAP = 100.0  # NEES over its degrees of freedom beyond which an estimate does not count: a broken one decides nothing
GROSS = 4.0  # mean NEES over its degrees of freedom that a right single run hardly has
SHIFTS = np.geomspace(0.004, REACH, 12)
GRID = np.concatenate([-SHIFTS[::-1], [0.0], SHIFTS])  # s, offsets of which the best is refined
CLOCK_ROUNDS = 5  # of clocks and frames in turn
SETTLED = 1e-4  # s, change of the offset that ends them
RATE = 1e-4  # probability that an offset is named where there is none
SHOWN = 5e-4  # probability that a right filter's estimates show an offset of the sign that is looked for
LEAST = 0.01  # share of the NEES that it makes, at least
UNIT_NAMES = {1: "seconds", 10**3: "milliseconds", 10**6: "microseconds", 10**9: "nanoseconds"}
EPOCHS = ((1e17, 10**9), (1e14, 10**6), (1e11, 10**3))  # times since 1970 are larger than this in ns, us and ms


@dataclass(frozen=True)
class Offset:
    """Time to add to the timestamps of the estimates, with its 95 % interval."""

    value: float  # s
    low: float
    high: float
    p_value: float  # of no offset, by the spread between runs, or between parts of a single run
    explained: float  # share of the sum of the NEES that goes with it
    alone: bool = False  # of a single run, whose own error along the path may look the same

    @property
    def found(self) -> bool:
        return self.p_value <= RATE and self.explained >= LEAST and not self.alone

    def __str__(self) -> str:
        return f"{self.value:.4g} s [{self.low:.4g}, {self.high:.4g}]"


@dataclass(frozen=True)
class ClockSample:
    """Estimates of a run by which clocks are compared, N of them, in some components of their error."""

    poses: Poses
    axes: Sequence[int]  # n of them
    factors: Array  # (N, n, n), inverse Cholesky factors of their covariances; NaN where one is not positive definite

    def whitened(self, error: Array) -> Array:
        """Errors (N, all components) of these components in units of their covariance, (N, n)."""
        return np.asarray(np.einsum("kij,kj->ki", self.factors, error[:, list(self.axes)]))

    def squares(self, shift: float) -> Array:
        """NEES over its degrees of freedom with the truth ``shift`` s later, (N,); NaN where there is none."""
        return np.asarray(np.square(self.whitened(self.poses.errors(shift))).mean(axis=1))

    def some(self, most: int) -> ClockSample:
        """At most ``most`` estimates, evenly chosen."""
        rows = evenly(len(self.factors), most)
        return replace(self, poses=self.poses.of_rows(rows), factors=self.factors[rows])


def clock_sample(poses: Poses, axes: Sequence[int]) -> ClockSample:
    """The finite estimates of a run, with the factors of their covariances."""
    poses = poses.sound()
    P = submatrices(poses.own.covariance, axes)
    factors = np.empty(P.shape)  # filled column by column: a second copy of a million of them is 300 MB
    for j, unit in enumerate(np.eye(len(axes))):
        factors[..., j] = whiten(np.broadcast_to(unit, P.shape[:2]), P)
    return ClockSample(poses, axes, factors)


def samples_of(runs: Sequence[Poses], judged: Sequence[int] | None = None) -> list[ClockSample]:
    """At most ``RUNS`` runs, evenly chosen, in the judged components that change in their estimates.

    A component that never changes, as the height of a robot in the plane, says nothing about time, and its error may be
    far beyond its variance.
    """
    if judged is None:
        judged = range(runs[0].own.covariance.shape[-1])
    idle = unchanging(runs, [p.own.estimate for p in runs])
    axes = [i for i in judged if not idle[i]] or list(judged)
    return [clock_sample(runs[k], axes) for k in evenly(len(runs), RUNS)]


def clock_shift(
    name: str, runs: Sequence[Poses], wanted: float | str | None, judged: Sequence[int] | None = None
) -> tuple[float, list[str]]:
    """Time to add to the timestamps of the estimates, s, and notes on it.

    Parameters
    ----------
    wanted : seconds to add; "estimate"; or None, which adds nothing but reports an offset if one is found
    judged : components of the error that are judged; None for all

    Raises
    ------
    InputError
        The offset cannot be estimated.
    """
    if isinstance(wanted, float):
        return wanted, [f"{name}: {wanted:g} s are added to the timestamps of the estimates"] if wanted else []
    samples = samples_of(runs, judged)
    found = offset_of(samples)
    if wanted is None:
        if found is None or not found.found or not shows_in_estimates(samples, found.value):
            return 0.0, []
        share = f"{100.0 * found.explained:.0f} % of the NEES; if so, add --time-offset {found.value:.4g}"
        return 0.0, [f"{name}: the clocks of estimates and truth seem to differ by {found}, which makes {share}"]
    if found is None:
        raise InputError(f"--time-offset estimate: nothing moves in {name}, so that the clocks cannot be compared")
    return found.value, [
        f"{name}: the clocks differ by {found}; so much is added to the timestamps of the estimates, which takes "
        f"{100.0 * found.explained:.0f} % of the NEES away"
    ]


def offset_of(samples: Sequence[ClockSample]) -> Offset | None:
    """The offset of the clocks that fits best; None where nothing moves, or the data are too few.

    The offset minimises the NEES (capped) within a second; one Gauss-Newton step in each run, or in each of
    ``PARTS`` parts of a single one, tells how far runs agree on it (Student's t).
    """
    most = max(MOST // len(samples), 50)
    some = []
    judged = []
    for sample in (each.some(most) for each in samples):
        known = np.isfinite(sample.squares(0.0))
        if known.any():
            some.append(sample)
            judged.append(known)
    if not some:
        return None
    weights = np.concatenate([np.full(known.sum(), 1.0 / known.sum()) for known in judged]) / len(some)

    def squares(shift: float) -> Array:
        return np.concatenate([each.squares(shift)[known] for each, known in zip(some, judged, strict=True)])

    def size(values: Array) -> float:
        """Mean of the runs, capped, as an estimate is without a truth."""
        return float(weights @ np.minimum(np.where(np.isfinite(values), values, np.inf), cap))

    on_grid = list(map(squares, GRID))
    cap = min(map(cap_of, on_grid))
    sizes = np.array(list(map(size, on_grid)))
    at_rest = size(squares(0.0))
    if not np.ptp(sizes) > 1e-9 or not at_rest > 0.0:  # nothing moves, or no error is there to explain
        return None
    value = refined(lambda shift: size(squares(shift)), sizes, 1e-5)
    parts = 1 if len(some) > 1 else PARTS
    each = np.concatenate([time_steps(sample, value, parts) for sample in some])
    each = value + each[np.isfinite(each)]
    if len(each) < 3:
        return None
    spread = each.std(ddof=1) / np.sqrt(len(each))
    reach = float(distributions.t.ppf(0.975, len(each) - 1) * spread)
    p = float(value == 0.0)
    if spread > 0:
        ratio = abs(each.mean()) / spread
        p = 2.0 * float(distributions.t.sf(ratio, len(each) - 1))
    left = size(squares(value))
    is_gross = at_rest > GROSS and left < 0.5 * at_rest
    alone = len(some) == 1 and not is_gross
    return Offset(value, value - reach, value + reach, p, 1.0 - left / at_rest, alone)


def cap_of(squares: Array) -> float:
    """Size beyond which an estimate does not count: ``CAP`` times what is usual, which is at least 1."""
    finite = squares[np.isfinite(squares)]
    return CAP * max(1.0, float(np.median(finite))) if len(finite) else np.inf


def refined(size: Callable[[float], float], sizes: Array, tolerance: float) -> float:
    """The offset with the smallest size, near the best one of ``GRID``, with ``sizes`` there."""
    best = int(np.nanargmin(sizes))
    bounds = GRID[max(best - 1, 0)], GRID[min(best + 1, len(GRID) - 1)]
    found = optimize.minimize_scalar(size, bounds=bounds, method="bounded", options={"xatol": tolerance})
    return float(found.x if found.fun < sizes[best] else GRID[best])


def shows_in_estimates(samples: Sequence[ClockSample], value: float) -> bool:
    """Whether the motion of the estimates, in place of that of the truth, tells of an offset of the same sign.

    A right filter's error is correlated with the true motion, which may look like an offset, and with no earlier
    estimate. Errors of odometry and of single fixes are correlated with estimates and not with the true motion. Only an
    offset shows in both.

    The motion between the two rows before is the instrumental variable of a linear regression. Its standard error is
    found by leaving out each run in turn, or each part of a single one (jackknife); Student's t.
    """
    parts = 1 if len(samples) > 1 else PARTS
    sums = np.concatenate([_estimate_sums(sample, parts) for sample in samples])
    with np.errstate(divide="ignore", invalid="ignore"):  # where nothing moves, or in one run alone
        top, bottom = sums.sum(axis=0)
        without_one = (sums[:, 0] - top) / (bottom - sums[:, 1])
        error = np.sqrt((len(sums) - 1) * without_one.var())
        least = distributions.t.ppf(1.0 - SHOWN, len(sums) - 1) * error
        return bool(np.sign(-value) * top / bottom > least)


def time_steps(sample: ClockSample, shift: float, parts: int) -> Array:
    """Gauss-Newton step from ``shift`` in each part, s; NaN where nothing moves."""
    e, v = _errors_and_motion(sample, shift)
    sums = _sums_of_parts(v, e, v, parts)
    return np.array([-top / bottom if bottom > 0 else np.nan for top, bottom in sums])


def _estimate_sums(sample: ClockSample, parts: int) -> Array:
    """Sums as in :func:`_sums_of_parts`, along the motion of the estimates between the two rows before."""
    e, v = _errors_and_motion(sample, 0.0)
    poses = sample.poses
    rows = np.arange(len(e) - 2)
    before = np.full(poses.own.covariance.shape[:2], np.nan)
    before[2:] = poses.error_of(rows, poses.own.estimate[1:-1])
    return _sums_of_parts(sample.whitened(before), e, v, parts)


def _errors_and_motion(sample: ClockSample, shift: float) -> tuple[Array, Array]:
    """Errors at ``shift`` and their derivative by it, both whitened, (N, n)."""
    errors = sample.poses.errors
    moved = (errors(shift + STEP) - errors(shift - STEP)) / (2.0 * STEP)
    return sample.whitened(errors(shift)), sample.whitened(moved)


def _sums_of_parts(along: Array, e: Array, v: Array, parts: int) -> Array:
    """Sums of the products of ``along`` with errors ``e`` and with their motion ``v``, each (N, n), (parts, 2)."""
    of_errors = (along * e).sum(axis=1)
    of_motion = (along * v).sum(axis=1)
    products = np.column_stack([of_errors, of_motion])
    squares = np.square(e).mean(axis=1)
    fine = finite_rows(products) & (squares < cap_of(squares))
    groups = np.array_split(np.flatnonzero(fine), parts)
    return np.array([products[rows].sum(axis=0) for rows in groups])


def time_unit(t: Array, unit: int | None = None) -> int:
    """How many units of times are a second: what their name says, or what times since 1970 are large enough for."""
    if unit is not None:
        return unit
    middle = float(np.median(np.abs(t))) if len(t) else 0.0
    return next((each for least, each in EPOCHS if middle > least), 1)


def unit_apart(t: Array, other_t: Array, names: Sequence[Path | str]) -> str:
    """Which of two files seems to have times in another unit than seconds, as the end of a sentence; "" of neither."""
    units = time_unit(t), time_unit(other_t)
    for unit in sorted(UNIT_NAMES, reverse=True):  # the smallest that makes them overlap, 1 where they do
        if _overlap(t / unit, other_t):
            units = unit, 1
        elif _overlap(t, other_t / unit):
            units = 1, unit
    if units[0] == units[1]:
        return ""
    return f"; {names[units[0] < units[1]]} seems to be in {UNIT_NAMES[max(units)]}, and has to be in seconds"


def _overlap(t: Array, other_t: Array) -> bool:
    return bool(t[0] <= other_t[-1] and t[-1] >= other_t[0])


def nothing_near(
    files: Sequence[Path | str], t: Array, other_t: Array, tolerance: float, what: str, of: str
) -> InputError:
    """Message that no time ``t`` of one file is near one of the other."""
    own, other = (f"{each[0]:.15g} to {each[-1]:.15g}" for each in (t, other_t))
    where = f"t is {own}, but {other} in {files[1]}{unit_apart(t, other_t, files)}"
    return InputError(f"{files[0]}: no {what} has a {of} within {tolerance:g} s (--max-dt): {where}")
