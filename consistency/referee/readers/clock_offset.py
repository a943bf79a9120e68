"""Clocks that differ: the time by which the truth of some runs is early or late, from their errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from consistency.referee.diagnostics.records.whitening import whiten
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.errors import InputError
from consistency.referee.readers.truth_matching import Poses, finite_rows
from consistency.referee.types import Array

REACH = 1.0  # s, the largest offset that is looked for
STEP = 1e-3  # s, over which the motion of the truth is taken
MOST = 4000  # estimates that are looked at, of all runs together
PARTS = 12  # that a single run is cut into
CAP = 100.0  # NEES over its degrees of freedom, beyond which an estimate counts no more: a broken one decides nothing
GROSS = 4.0  # mean NEES over its degrees of freedom that a right single run hardly has
SHIFTS = np.geomspace(0.004, REACH, 12)
GRID = np.concatenate([-SHIFTS[::-1], [0.0], SHIFTS])  # s, offsets of which the best is refined
ROUNDS = 5  # of clocks and frames in turn
SETTLED = 1e-4  # s, change of the offset that ends them
RATE = 1e-4  # probability that an offset is named where there is none
SHOWN = 5e-4  # probability that a right filter's estimates show an offset of the sign that is looked for
LEAST = 0.01  # share of the NEES that it makes, at least


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


def clock_shift(name: str, runs: Sequence[Poses], wanted: float | str | None) -> tuple[float, list[str]]:
    """Time to add to the timestamps of the estimates, s, and notes on it.

    Parameters
    ----------
    wanted : seconds to add; "estimate"; or None, which adds nothing but reports an offset if one is found

    Raises
    ------
    InputError
        The offset cannot be estimated.
    """
    if isinstance(wanted, float):
        return wanted, [f"{name}: {wanted:g} s are added to the timestamps of the estimates"] if wanted else []
    found = offset_of(runs)
    if wanted is None:
        if found is None or not found.found or not shows_in_estimates(runs, found.value):
            return 0.0, []
        share = f"{100.0 * found.explained:.0f} % of the NEES; if so, add --time-offset {found.value:.4g}"
        return 0.0, [f"{name}: the clocks of estimates and truth seem to differ by {found}, which makes {share}"]
    if found is None:
        raise InputError(f"--time-offset estimate: nothing moves in {name}, so that the clocks cannot be compared")
    return found.value, [
        f"{name}: the clocks differ by {found}; so much is added to the timestamps of the estimates, which takes "
        f"{100.0 * found.explained:.0f} % of the NEES away"
    ]


def offset_of(runs: Sequence[Poses]) -> Offset | None:
    """The offset of the clocks that fits best; None where nothing moves, or the data are too few.

    The offset minimises the NEES (capped) within a second; one Gauss-Newton step in each run, or in each of
    ``PARTS`` parts of a single one, tells how far runs agree on it (Student's t).
    """
    some = []
    judged = []
    for poses in runs:
        poses = poses.some(max(MOST // len(runs), 50)).sound()
        if len(poses.t):
            some.append(poses)
            whitened = whiten(poses.errors(), poses.covariance)
            judged.append(np.isfinite(np.square(whitened).sum(axis=1)))
    if not some:
        return None

    def size(shift: float) -> float:
        sizes = [_size(poses, shift, those) for poses, those in zip(some, judged, strict=True)]
        return float(np.mean(sizes))

    sizes = np.array([size(shift) for shift in GRID])
    at_rest = size(0.0)
    moves = np.isfinite(sizes).any() and np.nanmax(sizes) - np.nanmin(sizes) > 1e-9
    if not moves or not at_rest > 0.0:  # or no error is there to explain
        return None
    value = refined(size, sizes, 1e-5)
    parts = 1 if len(some) > 1 else PARTS
    each = np.concatenate([steps_of(poses, value, parts) for poses in some])
    each = value + each[np.isfinite(each)]
    if len(each) < 3:
        return None
    spread = each.std(ddof=1) / np.sqrt(len(each))
    reach = float(distributions.t.ppf(0.975, len(each) - 1) * spread)
    p = float(value == 0.0)
    if spread > 0:
        ratio = abs(each.mean()) / spread
        p = 2.0 * float(distributions.t.sf(ratio, len(each) - 1))
    left = size(value)
    is_gross = at_rest > GROSS and left < 0.5 * at_rest
    alone = len(some) == 1 and not is_gross
    return Offset(value, value - reach, value + reach, p, 1.0 - left / at_rest, alone)


def refined(size: Callable[[float], float], sizes: Array, tolerance: float) -> float:
    """The offset with the smallest size, near the best one of ``GRID``, with ``sizes`` there."""
    best = int(np.nanargmin(sizes))
    bounds = GRID[max(best - 1, 0)], GRID[min(best + 1, len(GRID) - 1)]
    found = optimize.minimize_scalar(size, bounds=bounds, method="bounded", options={"xatol": tolerance})
    return float(found.x if found.fun < sizes[best] else GRID[best])


def shows_in_estimates(runs: Sequence[Poses], value: float) -> bool:
    """Whether the motion of the estimates, in place of that of the truth, tells of an offset of the same sign.

    A right filter's error is correlated with the true motion, which may look like an offset, and with no earlier
    estimate. Errors of odometry and of single fixes are correlated with estimates and not with the true motion. Only an
    offset shows in both.

    The motion between the two rows before is the instrumental variable of a linear regression. Its standard error is
    found by leaving out each run in turn, or each part of a single one (jackknife); Student's t.
    """
    parts = 1 if len(runs) > 1 else PARTS
    sums = np.concatenate([_estimate_sums(poses.sound(), parts) for poses in runs])
    with np.errstate(divide="ignore", invalid="ignore"):  # where nothing moves, or in one run alone
        top, bottom = sums.sum(axis=0)
        without_one = (sums[:, 0] - top) / (bottom - sums[:, 1])
        error = np.sqrt((len(sums) - 1) * without_one.var())
        least = distributions.t.ppf(1.0 - SHOWN, len(sums) - 1) * error
        return bool(np.sign(-value) * top / bottom > least)


def _size(poses: Poses, shift: float, judged: Array) -> float:
    """Mean NEES of ``judged`` over its degrees of freedom, capped, as it is where there is no truth then."""
    if not judged.any():
        return np.nan
    w = whiten(poses.errors(shift), poses.covariance)
    nees = np.square(w).sum(axis=1) / w.shape[1]
    capped = np.minimum(np.where(np.isfinite(nees), nees, CAP), CAP)
    return float(capped[judged].mean())


def steps_of(poses: Poses, shift: float, parts: int) -> Array:
    """Gauss-Newton step from ``shift`` in each part, s; NaN where nothing moves."""
    e, v = _errors_and_motion(poses, shift)
    sums = _sums_of_parts(v, e, v, parts)
    return np.array([-top / bottom if bottom > 0 else np.nan for top, bottom in sums])


def _estimate_sums(poses: Poses, parts: int) -> Array:
    """Sums as in :func:`_sums_of_parts`, along the motion of the estimates between the two rows before."""
    e, v = _errors_and_motion(poses, 0.0)
    before = np.full_like(e, np.nan)
    rows = np.arange(len(e) - 2)
    before[2:] = poses.error_of(rows, poses.estimate[1:-1])
    along = whiten(before, poses.covariance)
    return _sums_of_parts(along, e, v, parts)


def _errors_and_motion(poses: Poses, shift: float) -> tuple[Array, Array]:
    """Errors at ``shift`` and their derivative by it, both whitened, (N, n)."""
    later = poses.errors(shift + STEP)
    earlier = poses.errors(shift - STEP)
    moved = (later - earlier) / (2.0 * STEP)
    return whiten(poses.errors(shift), poses.covariance), whiten(moved, poses.covariance)


def _sums_of_parts(along: Array, e: Array, v: Array, parts: int) -> Array:
    """Sums of the products of ``along`` with errors ``e`` and with their motion ``v``, each (N, n), (parts, 2)."""
    of_errors = (along * e).sum(axis=1)
    of_motion = (along * v).sum(axis=1)
    products = np.column_stack([of_errors, of_motion])
    fine = finite_rows(products) & (np.square(e).mean(axis=1) < CAP)
    groups = np.array_split(np.flatnonzero(fine), parts)
    return np.array([products[rows].sum(axis=0) for rows in groups])
