"""Beginning, end and place of a fault. Nothing here decides whether there is one: the answers have."""

from __future__ import annotations

import numpy as np

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.questions.anees_band import Band
from consistency.referee.diagnostics.questions.sample import Sample
from consistency.referee.diagnostics.questions.scale import pointwise_band, ratio_interval, run_means
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.diagnostics.statistics.nees import anees
from consistency.referee.diagnostics.verdict.answers import BIAS, MAIN, SCALE, STEP
from consistency.referee.diagnostics.verdict.parts import Location, Until
from consistency.referee.types import Array, Indices

FEWEST = 8  # runs; with fewer the axes are not told apart
SURE = 0.04  # false-alarm rate of naming an axis, or a beginning, that does not stand out


def from_step(since: int | None) -> slice:
    """Steps from ``since`` (1..T) on; all where it is None."""
    if since is None:
        return slice(0, None)
    return slice(since - 1, None)


def location_of(sample: Sample, band: Band, faults: set[str], ordered: bool, detect: float) -> Location:
    """Steps outside the band, beginning or end of the fault, and its axes.

    Parameters
    ----------
    faults : questions that found one
    ordered : steps follow each other; otherwise a fault has no beginning or end
    detect : that of the settings, as a factor above 1
    """
    first_outside = first_step = since = subset = last = None
    lasting = False
    if band.outside.any():
        first = int(np.argmax(band.outside))
        first_outside = first + 1
        if STEP in faults:
            first_step = first_outside
            if ordered:
                lasting = _is_lasting(sample, band, first)
            if lasting and _absent_before(sample, first, band.above[first]):
                since = first_step
    if sample.whitened is not None and faults & set(SCALE):
        subset = chief_axes(sample, from_step(since), MAIN in faults)
    if ordered and faults & {*SCALE, *BIAS}:
        last = until(sample, band, detect)
    return Location(
        simultaneous=np.stack([band.low, band.high], axis=-1),
        steps_above=int(band.above.sum()),
        steps_below=int(band.below.sum()),
        first_outside=first_outside,
        first_step=first_step,
        since=since,
        lasting=lasting,
        subset=subset,
        until=last,
    )


def _is_lasting(sample: Sample, band: Band, first: int) -> bool:
    """Whether most steps from ``first`` on are outside their own interval, on the side of the first."""
    curve = anees(sample.nees)[first:]
    low, high = pointwise_band(sample.counted.sum(axis=0), sample.dof)[first:].T
    beyond = curve < low
    if band.above[first]:
        beyond = curve > high
    return bool(beyond[np.isfinite(curve)].mean() > 0.5)


def _absent_before(sample: Sample, first: int, above: bool) -> bool:
    """Whether the steps before ``first`` are shown to have less than half of the fault, on the logarithm.

    One-sided Student's t of the log mean before, with the standard error of the runs.
    """
    early = sample.means(slice(0, first))
    late = sample.means(slice(first, None))
    if len(early) < FEWEST or not early.mean() > 0 or not late.mean() > 0:
        return False
    log_early = np.log(early.mean())
    log_late = np.log(late.mean())
    if not above:
        log_early = -log_early
        log_late = -log_late
    error = float(early.std(ddof=1) / (early.mean() * np.sqrt(len(early))))
    upper = log_early + float(distributions.t.isf(1.0 - CONFIDENCE, len(early) - 1)) * error
    return bool(upper < 0.5 * log_late)


def until(sample: Sample, band: Band, detect: float) -> Until | None:
    """The first steps that alone carry the fault, or None.

    They are 1, 2, 4, ... steps from the first judged one on, at most half of all. With the means a_i over them and b_i
    over the others of run i, the fault of the others is shown to be less than half of theirs, on the logarithm:
    D_i = b_i / mean b - a_i / (2 mean a) has the standard error of log mean b - log(mean a) / 2 to first order;
    Student's t over runs, Bonferroni over the numbers of steps and both signs. A fault that is the same in all steps
    is said to be in the first ones with probability ``SURE`` at most. Nothing is left of the fault afterwards: the
    interval of the ratio holds 1 or lies within [1 / detect, detect], and no step is outside the band on that side.
    """
    ends, early, late = _splits(sample)
    if len(early) < FEWEST or not len(ends):
        return None
    bar = float(distributions.t.isf(SURE / (2.0 * len(ends)), len(early) - 1)) / np.sqrt(len(early))
    for end, a, b in zip(ends, early.T, late.T, strict=True):
        if not a.mean() > 0 or not b.mean() > 0:
            continue
        sign = -1.0
        outside = band.below
        if a.mean() > 1.0:
            sign = 1.0
            outside = band.above
        left = sign * (np.log(b.mean()) - 0.5 * np.log(a.mean()))
        error = float((b / b.mean() - 0.5 * a / a.mean()).std(ddof=1))
        if left + bar * error >= 0.0 or outside[end:].any():
            continue
        rest = ratio_interval(b, sample.dof, CONFIDENCE)
        if rest.holds(1.0) or (rest.low >= 1.0 / detect and rest.high <= detect):
            return Until(int(end), float(a.mean()), rest)
    return None


def _splits(sample: Sample) -> tuple[Indices, Array, Array]:
    """Ends (K,) of the first steps, and mean NEES over dof before and after each, (runs, K), of runs with both."""
    judged = np.flatnonzero(sample.counted.any(axis=0))
    ends = judged[2 ** np.arange((len(judged) // 2).bit_length()) - 1] + 1
    means = []
    counts = []
    for piece in np.split(sample.nees, ends, axis=1):
        of_runs, steps = run_means(piece)
        means.append(of_runs)
        counts.append(steps)
    count = np.stack(counts, axis=-1)
    sums = np.where(count > 0, np.stack(means, axis=-1) * count, 0.0)
    sum_before = np.cumsum(sums, axis=1)[:, :-1]
    count_before = np.cumsum(count, axis=1)[:, :-1]
    sum_after = sums.sum(axis=1)[:, None] - sum_before
    count_after = count.sum(axis=1)[:, None] - count_before
    both = (count_before > 0).all(axis=1) & (count[:, -1] > 0)
    before = sum_before[both] / count_before[both] / sample.dof
    after = sum_after[both] / count_after[both] / sample.dof
    return ends, before, after


def chief_axes(sample: Sample, steps: slice, as_whole: bool) -> str | None:
    """Axes that carry the fault: those farther from 1 than the others together, beyond chance.

    With Y_ij the mean NEES of axis j alone in run i and O_ij that of the other axes, each over its mean over runs,
    D_i = Y_ij - O_ij has the standard error of log mean Y_j - log mean O_j to first order; Student's t, two-sided,
    Bonferroni over axes. None where no axis stands out, or all do, or with fewer than 8 runs. Where the whole is at
    fault (``as_whole``), an axis that errs in the other direction does not carry it.
    """
    names = sample.names
    n = sample.dof
    if n == 1 or np.isfinite(sample.nees[:, steps]).any(axis=1).sum() < FEWEST:
        return None
    Y = np.stack([sample.group_means([j], steps) for j in range(n)], axis=-1)
    mean = Y.mean(axis=0)
    chief = mean == 0.0  # axes without any error
    if not chief.any():
        others = (Y.sum(axis=1, keepdims=True) - Y) / (n - 1)
        for j in range(n):
            chief[j] = _stands_out(Y[:, j], others[:, j], n)
    if chief.all():
        return None
    if as_whole:
        chief &= (mean > 1.0) == (sample.means(steps).mean() > 1.0)
    return ", ".join(np.array(names)[chief]) or None


def _stands_out(own: Array, others: Array, axes: int) -> bool:
    if others.mean() <= 0.0:  # beside it they are below rounding
        return True
    gap = float(np.log(own.mean()) - np.log(others.mean()))
    error = float((own / own.mean() - others / others.mean()).std(ddof=1) / np.sqrt(len(own)))
    if abs(np.log(own.mean())) <= abs(np.log(others.mean())):
        return False
    if error == 0.0:
        return gap != 0.0
    return bool(2.0 * axes * distributions.t.sf(abs(gap) / error, len(own) - 1) <= SURE)
