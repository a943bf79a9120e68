"""Beginning, size and place of a fault. Nothing here decides whether there is one: the answers have."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.questions.band import Band
from consistency.referee.diagnostics.questions.bias import hotelling
from consistency.referee.diagnostics.questions.outliers import Outlier
from consistency.referee.diagnostics.questions.scale import pointwise_band, ratio_interval, run_means
from consistency.referee.diagnostics.records.large_arrays import Symmetric, blocks, by_runs
from consistency.referee.diagnostics.questions.sample import ATTITUDE, POSITION, Sample
from consistency.referee.diagnostics.records.whitening import mean_of_runs, standardise
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.diagnostics.statistics.accuracy import coverage, coverage_interval, noncredibility, rmse
from consistency.referee.diagnostics.statistics.nees import anees
from consistency.referee.diagnostics.verdict.answers import BIAS, MAIN, SCALE, SHAPE, STEP, Tests
from consistency.referee.diagnostics.verdict.parts import (  # fmt: skip
    Accuracy,
    Answer,
    Axes,
    Bias,
    Interval,
    Location,
    Settings,
    Shape,
    Tails,
    Until,
)
from consistency.referee.types import Array, Indices

DETECT = Settings().factor
FEWEST = 8  # runs; with fewer the axes are not told apart
SIGN = 2.0  # standard errors from 0, of steps that are all one and the same, at which a correlation has a sign
VISIBLE = 0.05  # a stated correlation that is worth a word
SURE = 0.04  # false-alarm rate of naming an axis, or a beginning, that does not stand out

Answers = Mapping[str, Answer]


def location_of(sample: Sample, band: Band, answers: Answers, ordered: bool = True, detect: float = DETECT) -> Location:
    """Steps outside the band, beginning or end of the fault, and its axes.

    Without ``ordered`` steps a fault has no beginning or end. ``detect`` is that of the settings.
    """
    outside = band.outside
    first = int(np.argmax(outside)) if outside.any() else None
    faulty = first is not None and _any(answers, (STEP,))
    since, lasting = None, False
    if first is not None and faulty and ordered:
        sign = 1 if band.above[first] else -1
        curve, steps = anees(sample.nees)[first:], pointwise_band(sample.counted.sum(axis=0), sample.dof)[first:]
        beyond = curve > steps[:, 1] if sign > 0 else curve < steps[:, 0]
        lasting = bool(beyond[np.isfinite(curve)].mean() > 0.5)  # in most steps from there on
        since = first + 1 if lasting and _absent_before(sample, first, sign) else None
    late = slice(0 if since is None else since - 1, None)
    return Location(
        simultaneous=np.stack([band.low, band.high], axis=-1),
        above=int(band.above.sum()),
        below=int(band.below.sum()),
        first_outside=None if first is None else first + 1,
        first_step=first + 1 if first is not None and faulty else None,
        since=since,
        lasting=lasting,
        subset=chief_axes(sample, late, _any(answers, (MAIN,)))
        if sample.errors is not None and _any(answers, SCALE)
        else None,
        until=until(sample, band, detect) if ordered and _any(answers, (*SCALE, *BIAS)) else None,
    )


def _absent_before(sample: Sample, first: int, sign: int) -> bool:
    """Whether the steps before ``first`` are shown to have less than half of the fault, on the logarithm.

    One-sided Student's t of the log mean before, with the standard error of the runs.
    """
    early, late = sample.means(slice(0, first)), sample.means(slice(first, None))
    if len(early) < FEWEST or not early.mean() > 0 or not late.mean() > 0:
        return False
    error = float(early.std(ddof=1) / (early.mean() * np.sqrt(len(early))))
    upper = sign * np.log(early.mean()) + float(distributions.t.isf(1.0 - CONFIDENCE, len(early) - 1)) * error
    return bool(upper < 0.5 * sign * np.log(late.mean()))


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
        sign = 1.0 if a.mean() > 1.0 else -1.0
        left = sign * (np.log(b.mean()) - 0.5 * np.log(a.mean()))
        error = float((b / b.mean() - 0.5 * a / a.mean()).std(ddof=1))
        if left + bar * error >= 0.0 or (band.above if sign > 0 else band.below)[end:].any():
            continue
        rest = ratio_interval(b, sample.dof, CONFIDENCE)
        if rest.holds(1.0) or (rest.low >= 1.0 / detect and rest.high <= detect):
            return Until(int(end), float(a.mean()), rest)
    return None


def _splits(sample: Sample) -> tuple[Indices, Array, Array]:
    """Ends (K,) of the first steps, and mean NEES over dof before and after each, (runs, K), of runs with both."""
    judged = np.flatnonzero(sample.counted.any(axis=0))
    ends = judged[2 ** np.arange((len(judged) // 2).bit_length()) - 1] + 1
    means, counts = (
        np.stack(part, axis=-1) for part in zip(*map(run_means, np.split(sample.nees, ends, axis=1)), strict=True)
    )
    sums = np.where(counts > 0, means * counts, 0.0)
    before, many = np.cumsum(sums, axis=1)[:, :-1], np.cumsum(counts, axis=1)[:, :-1]
    both = (many > 0).all(axis=1) & (counts[:, -1] > 0)
    after, fewer = sums.sum(axis=1)[:, None] - before, counts.sum(axis=1)[:, None] - many
    return ends, before[both] / many[both] / sample.dof, after[both] / fewer[both] / sample.dof


def chief_axes(sample: Sample, steps: slice, as_whole: bool) -> str | None:
    """Axes that carry the fault: those farther from 1 than the others together, beyond chance.

    With Y_ij the mean NEES of axis j alone in run i and O_ij that of the other axes, each over its mean over runs,
    D_i = Y_ij - O_ij has the standard error of log mean Y_j - log mean O_j to first order; Student's t, two-sided,
    Bonferroni over axes. None where no axis stands out, or all do, or with fewer than 8 runs. Where the whole is at
    fault (``as_whole``), an axis that errs in the other direction does not carry it.
    """
    names, n = sample.known_errors.names, sample.dof
    if n == 1 or np.isfinite(sample.nees[:, steps]).any(axis=1).sum() < FEWEST:
        return None
    Y = np.stack([sample.group_means([j], steps) for j in range(n)], axis=-1)
    mean = Y.mean(axis=0)
    chief = mean == 0.0  # axes without any error
    if not chief.any():
        chief = np.array([_stands_out(Y[:, j], (Y.sum(axis=1) - Y[:, j]) / (n - 1), n) for j in range(n)])
    if chief.all():
        return None
    if as_whole:
        chief &= (mean > 1.0) == (sample.means(steps).mean() > 1.0)
    return ", ".join(name for name, is_chief in zip(names, chief, strict=True) if is_chief) or None


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


# --- records -----------------------------------------------------------------------------------------


def axes_of(sample: Sample, tests: Tests, location: Location) -> Axes:
    """Inflation of each component and group, since the fault began."""
    errors = sample.known_errors
    late, confidence = _late(location), 1.0 - (1.0 - CONFIDENCE) / len(errors.groups)
    inflation = {
        key: ratio_interval(sample.group_means(index, late), len(index), confidence)
        for key, index in errors.groups.items()
    }
    largest = tests.largest
    return Axes(
        errors.names, errors.groups, inflation,
        None if largest is None else largest.ratio, None if largest is None else largest.direction,
    )  # fmt: skip


def bias_of(sample: Sample, step: int | None, location: Location, answers: Answers) -> Bias:
    """Mean error of each axis, clearest in ``step``, and the scale without it."""
    errors, late = sample.known_errors, _late(location)

    def means(error: Array, covariance: Symmetric, counted: Array) -> Array:
        return mean_of_runs(np.where(counted[..., None], standardise(error, covariance), np.nan))

    of_runs = by_runs(means, errors.error[:, late], errors.covariance[:, late], sample.counted[:, late])
    of_runs = of_runs[np.isfinite(of_runs).all(axis=-1)]
    by_axis = {}
    if len(of_runs) > sample.dof:
        test = hotelling(of_runs, CONFIDENCE)
        by_axis = {a: Interval(test.mean[i], *test.interval[i]) for i, a in enumerate(errors.names)}
    if not _any(answers, BIAS):
        return Bias(by_axis, step, None, None, None)
    axis = size = None
    if step is not None:
        at = standardise(errors.error[:, step - 1], errors.covariance[:, step - 1])[sample.counted[:, step - 1]]
        mean = at.mean(axis=0)
        chief = int(np.argmax(np.abs(mean) / at.std(axis=0, ddof=1).clip(1e-300)))  # what stands out most
        axis, size = errors.names[chief], float(mean[chief])
    return Bias(by_axis, step, axis, size, ratio_interval(sample.centred_means(late), sample.dof, CONFIDENCE))


def shape_of(sample: Sample, tests: Tests, answers: Answers, false_alarm: float) -> Shape | None:
    """The two axes that are correlated least as stated: over whole runs, or in the step where a fault was found."""
    if tests.matrix is None or sample.dof == 1:
        return None
    errors = sample.known_errors
    in_step = not _any(answers, ("shape",)) and tests.shape_step is not None
    here = slice(tests.shape_step - 1, tests.shape_step) if in_step and tests.shape_step else slice(None)
    counted = sample.counted[:, here]
    pair, actual, stated = _correlation(errors.error[:, here], errors.covariance[:, here], counted)
    known = SIGN / np.sqrt(max(int(counted.any(axis=1).sum()), 1))
    wrong_sign = _any(answers, SHAPE) and actual * stated < 0.0 and abs(actual) > known and abs(stated) > VISIBLE
    right = all(tests.axes[axis].p_value * len(tests.axes) > false_alarm for axis in errors.names)
    return Shape(tests.matrix, tests.shape_step, pair, actual, stated, wrong_sign, wrong_sign and right)


def tails_of(tests: Tests, run_numbers: Indices) -> Tails:
    """The error that stands out most, and the whole distribution; ``run_numbers`` (runs,) names the runs."""
    odd = tests.outlier or Outlier(float("nan"), -1, -1, float("nan"))
    run = int(run_numbers[odd.run]) if odd.run >= 0 else odd.run
    return Tails(run, odd.step + 1, odd.distance, tests.pit.values, tests.pit.half_width)


def accuracy_of(sample: Sample) -> Accuracy:
    """Coverage, RMSE and the noncredibility index."""
    errors = sample.known_errors
    index, inclination = noncredibility(errors.error, sample.nees)
    counted = sample.counted
    inside, interval = coverage_interval(errors.error, errors.covariance, counted=counted)

    def rmse_of(members: set[str]) -> float:
        columns = [i for i, axis in enumerate(errors.names) if axis in members]
        return rmse(errors.error, columns, counted) if columns else float("nan")

    return Accuracy(
        coverage=coverage(errors.error, errors.covariance, counted=counted),
        coverage_one_step=inside,
        coverage_interval=interval,
        rmse=np.array([rmse(errors.error, [i], counted) for i in range(sample.dof)]),
        rmse_position=rmse_of(POSITION),
        rmse_heading=rmse_of(ATTITUDE),
        nci=float(np.nanmean(index)) if np.isfinite(index).any() else float("nan"),
        inclination=float(np.nanmean(inclination)) if np.isfinite(inclination).any() else float("nan"),
    )


def _late(location: Location) -> slice:
    return slice(0 if location.since is None else location.since - 1, None)


def _any(answers: Answers, questions: tuple[str, ...]) -> bool:
    return any(q in answers and answers[q].found for q in questions)


def _correlation(error: Array, covariance: Symmetric, counted: Array) -> tuple[tuple[int, int] | None, float, float]:
    """The two axes whose errors are correlated least as stated, with both correlations, averaged over steps."""
    if not counted.any():
        return None, float("nan"), float("nan")
    n, count = error.shape[-1], int(counted.sum())
    parts, half = list(blocks(*counted.shape)), np.argwhere(np.triu(np.ones((n, n))))

    def standard(here: slice) -> Array:
        return standardise(error[here], covariance[here])[counted[here]]

    mean = sum(e.sum(axis=0) for e in map(standard, parts)) / count
    stated, second = np.zeros((n, n)), np.zeros((n, n))
    for here in parts:
        P, e = covariance[here], standard(here) - mean
        sigma = [np.sqrt(P.entry(i, i)[counted[here]]) for i in range(n)]
        part = np.empty((len(e), len(half)))
        for k, (i, j) in enumerate(half):
            part[:, k] = P.entry(i, j)[counted[here]] / (sigma[i] * sigma[j])
        stated[tuple(half.T)] += part.sum(axis=0) / count
        second += e.T @ e / count
    stated[tuple(half.T[::-1])] = stated[tuple(half.T)]
    scale = np.sqrt(np.diag(second))
    with np.errstate(invalid="ignore", divide="ignore"):
        gap = np.nan_to_num(second / np.outer(scale, scale) - stated)
    np.fill_diagonal(gap, 0.0)
    i, j = sorted(int(k) for k in np.unravel_index(np.abs(gap).argmax(), gap.shape))
    return (i, j), float(stated[i, j] + gap[i, j]), float(stated[i, j])
