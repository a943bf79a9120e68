"""Beginning, end and place of a fault. Nothing here decides whether there is one: the answers have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics import distributions
from consistency.referee.diagnostics.nees import Band, anees, pointwise_band
from consistency.referee.diagnostics.sample import Sample
from consistency.referee.diagnostics.scale import ratio_interval, run_means
from consistency.referee.diagnostics.verdict_parts import BIAS, MAIN, SCALE, STEP, TINY, Interval, Location, Until
from consistency.referee.types import Array, Indices

FEWEST = 8  # runs; with fewer the axes are not told apart
SURE = 0.04  # false-alarm rate of naming an axis, a beginning or an end that does not stand out
NEAR = 0.1  # of a fault's length, by which its ends may differ between two halves of the runs, or one step
TURNS = 10  # of moving both ends; they settle after two or three
APART = 0.25  # of a fault's length, from which on the steps before it do not belong to it


def location_of(sample: Sample, band: Band, faults: set[str], ordered: bool, detect: float) -> Location:
    """Steps outside the band, beginning or end of the fault, and its axes.

    Parameters
    ----------
    faults : questions that found one
    ordered : steps follow each other; otherwise a fault has no beginning or end
    detect : that of the settings, as a factor above 1
    """
    first_outside = first_step = since = last = None
    lasting = False
    if band.outside.any():
        first = int(np.argmax(band.outside))
        first_outside = first + 1
        if STEP in faults:
            first_step = first_outside
            if ordered:
                lasting = _is_lasting(sample, band, first)
            before, after = slice(first), slice(first, None)
            if lasting and _is_absent(sample.nees, sample.dof, before, after, 1.0 - CONFIDENCE):
                since = first_step
    if ordered and faults & {*SCALE, *BIAS}:
        stretch = _stretch(sample, detect)
        begins = _begins_late(sample, stretch)
        last = _end_of(sample, band, detect, stretch)
        if begins is not None and last is not None:
            since = begins
        else:
            last = until(sample, band, detect, stretch) or last
    where = Location(
        simultaneous=np.stack([band.low, band.high], axis=-1),
        steps_above=int(band.above.sum()),
        steps_below=int(band.below.sum()),
        first_outside=first_outside,
        first_step=first_step,
        since=since,
        lasting=lasting,
        until=last,
    )
    if sample.whitened is None or not faults & set(SCALE):
        return where
    return replace(where, subset=chief_axes(sample, where.steps, MAIN in faults))


def _is_lasting(sample: Sample, band: Band, first: int) -> bool:
    """Whether most steps from ``first`` on are outside their own interval, on the side of the first."""
    curve = anees(sample.nees)[first:]
    low, high = pointwise_band(sample.counted.sum(axis=0), sample.dof)[first:].T
    beyond = curve < low
    if band.above[first]:
        beyond = curve > high
    return bool(beyond[np.isfinite(curve)].mean() > 0.5)


def _is_absent(nees: Array, dof: int, rest: slice, inside: slice, rate: float) -> bool:
    """Whether steps of the ``rest`` are shown to have less than half of the fault ``inside``; nees (runs, steps)."""
    means, of_rest = run_means(nees[:, rest])
    within, of_inside = run_means(nees[:, inside])
    both = (of_rest > 0) & (of_inside > 0)
    return bool(both.sum() >= FEWEST and _less_than_half(means[both] / dof, within[both] / dof, rate))


def until(sample: Sample, band: Band, detect: float, stretch: slice | None = None) -> Until | None:
    """The first steps that alone carry the fault, or None.

    They are 1, 2, 4, ... steps from the first judged one on, at most half of all, and are themselves shown to be at
    fault. The fault of the others is shown to be less than half of theirs (:func:`_less_than_half`, Bonferroni over the
    numbers of steps and both signs): a fault that is the same in all steps is said to be in the first ones with
    probability ``SURE`` at most. Nothing is left of it afterwards (:func:`_is_right`), and no step is outside the band.
    Where the fault is in a ``stretch`` of steps, it has to begin with the first ones and to end among them.
    """
    ends, early, late = _splits(sample)
    if len(early) < FEWEST or not len(ends):
        return None
    least = 0
    if stretch is not None:
        least = stretch.stop
        before = stretch.start - int(np.argmax(sample.counted.any(axis=0)))
        if before > APART * (stretch.stop - stretch.start):
            return None
    for end, a, b in zip(ends, early.T, late.T, strict=True):
        if end < least or band.outside[end:].any() or not _less_than_half(b, a, SURE / (2.0 * len(ends))):
            continue
        rest = ratio_interval(b, sample.dof, CONFIDENCE)
        if _is_right(rest, detect) and not ratio_interval(a, sample.dof, CONFIDENCE).holds(1.0):
            return Until(int(end), float(a.mean()), rest)
    return None


def _less_than_half(rest: Array, inside: Array, rate: float) -> bool:
    """Whether the fault of the ``rest`` is shown to be less than half of that ``inside``, on the logarithm.

    With the means a_i inside and b_i over the rest of run i, both (runs,), D_i = b_i / mean b - a_i / (2 mean a) has
    the standard error of log mean b - log(mean a) / 2 to first order; Student's t over runs, one-sided at ``rate``.
    """
    if not inside.mean() > 0 or not rest.mean() > 0:
        return False
    left = np.log(rest.mean()) - 0.5 * np.log(inside.mean())
    if inside.mean() < 1.0:
        left = -left
    error = float((rest / rest.mean() - 0.5 * inside / inside.mean()).std(ddof=1)) / np.sqrt(len(rest))
    return bool(left + float(distributions.t.isf(rate, len(rest) - 1)) * error < 0.0)


def _is_right(ratio: Interval, detect: float) -> bool:
    """Whether the interval of a ratio holds 1, or lies within [1 / detect, detect]."""
    return ratio.holds(1.0) or (ratio.low >= 1.0 / detect and ratio.high <= detect)


# --- a stretch of steps ------------------------------------------------------------------------------


def _stretch(sample: Sample, detect: float) -> slice | None:
    """The stretch of steps that a fault is in, where two halves of the runs agree on it; None with fewer than 16 runs.

    Its ends may be the first and the last step.
    """
    halves = [sample.nees[half::2] for half in (0, 1)]
    if min(len(half) for half in halves) < FEWEST:
        return None
    found = [_likeliest_stretch(nees, sample.dof, detect) for nees in (sample.nees, *halves)]
    whole, one, other = found
    if whole is None or one is None or other is None:
        return None
    near = max(1.0, NEAR * (whole.stop - whole.start))
    if max(abs(one.start - other.start), abs(one.stop - other.stop)) > near:
        return None
    return whole


def _likeliest_stretch(nees: Array, dof: int, detect: float) -> slice | None:
    """The steps a to b - 1 with the likelihood ratio that is largest, of one ratio in them against 1; None without any.

    For K degrees of freedom with the mean ratio r in them it is K / 2 (r - 1 - log r), as if steps were independent;
    each end in turn takes its best place beside the other. The search begins where the ratios exceed sqrt(detect) most
    in total, and where they are short of its inverse.

    Parameters
    ----------
    nees : (runs, steps)
    """
    count = np.isfinite(nees).sum(axis=0)
    judged = np.flatnonzero(count)
    weight = count[judged] * float(dof)
    ratio = anees(nees)[judged] / dof
    total = np.append(0.0, np.cumsum(weight * ratio))
    K = np.append(0.0, np.cumsum(weight))
    places = np.arange(len(K))

    def gain(a: Indices | int, b: Indices | int) -> Array:
        r = np.maximum((total[b] - total[a]) / (K[b] - K[a]), TINY)
        return np.asarray(0.5 * (K[b] - K[a]) * (r - 1.0 - np.log(r)))

    best = 0.0
    stretch = None
    for edge, sign in ((np.sqrt(detect), 1.0), (1.0 / np.sqrt(detect), -1.0)):
        excess = sign * (total - edge * K)
        b = int(np.argmax(excess - np.minimum.accumulate(excess)))
        a = int(np.argmin(excess[: b + 1]))
        if a == b:
            continue
        for _ in range(TURNS):
            b = a + 1 + int(np.argmax(gain(a, places[a + 1 :])))
            a = int(np.argmax(gain(places[:b], b)))
        if gain(a, b) > best:
            best = float(gain(a, b))
            stretch = slice(int(judged[a]), int(judged[b - 1]) + 1)
    return stretch


def _begins_late(sample: Sample, stretch: slice | None) -> int | None:
    """The first step of a stretch, 1..T; None without one, and where it is the first that is judged."""
    if stretch is None or not sample.counted[:, : stretch.start].any():
        return None
    return int(stretch.start) + 1


def _end_of(sample: Sample, band: Band, detect: float, stretch: slice | None) -> Until | None:
    """The last step of a stretch that alone carries the fault, or None where that is not shown.

    The fault is shown to be less than half as large after it, and before it where steps are, in each half of the runs
    by the ends that are found in the other half. So a fault that is the same in all steps is said to have an end with
    probability ``SURE`` at most, however the ends are chosen. What remains is as in :func:`until`.
    """
    if stretch is None or not sample.counted[:, stretch.stop :].any():
        return None
    halves = [sample.nees[half::2] for half in (0, 1)]
    for nees, other in zip(halves, halves[::-1], strict=True):
        ends = _likeliest_stretch(other, sample.dof, detect)
        assert ends is not None
        for rest in (slice(ends.start), slice(ends.stop, None)):
            if np.isfinite(nees[:, rest]).any() and not _is_absent(nees, sample.dof, rest, ends, SURE):
                return None
    if band.outside[: stretch.start].any() or band.outside[stretch.stop :].any():
        return None
    ratio = ratio_interval(sample.means(stretch), sample.dof, CONFIDENCE)
    means, counts = run_means(np.delete(sample.nees, stretch, axis=1))
    others = ratio_interval(means[counts > 0] / sample.dof, sample.dof, CONFIDENCE)
    if not _is_right(others, detect) or ratio.holds(1.0):
        return None
    return Until(stretch.stop, ratio.value, others)


# --- first steps, and axes ---------------------------------------------------------------------------


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
