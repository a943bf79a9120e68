"""Every test that a sample allows, and what they say about its errors, part by part.

The word that the answers lead to is in ``status``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.bias_and_shape import (
    Largest,
    StepMoments,
    hotelling,
    largest_direction,
    mean_shape,
    pair_p_values,
    sphericity,
    step_moments,
    t_squared,
)
from consistency.referee.diagnostics.fault_location import location_of
from consistency.referee.diagnostics.nees import (
    Band,
    Pit,
    anees,
    coverage,
    coverage_interval,
    noncredibility,
    pit,
    pointwise_band,
    rmse,
    simultaneous_band,
)
from consistency.referee.diagnostics.number_of_runs import detectable_ratio
from consistency.referee.diagnostics.record import Record
from consistency.referee.diagnostics.sample import ATTITUDE, POSITION, Sample
from consistency.referee.diagnostics.scale import MeanTest, RunMeans, acceptance, equivalence, ratio_interval
from consistency.referee.diagnostics.tails import Outlier, beyond_stated, outliers
from consistency.referee.diagnostics.verdict_parts import (
    AXIS,
    BIAS,
    DIRECTION,
    GROUP,
    MAIN,
    SCALE,
    SHAPE,
    SHARES,
    STEP,
    Accuracy,
    Answer,
    Bias,
    ByGroup,
    ComponentRatios,
    Equivalence,
    ErrorParts,
    Group,
    Interval,
    Location,
    Scale,
    Settings,
    Shape,
    Tails,
    at_share,
    faults_of,
    least_of_steps,
    shares_of,
    with_tolerated,
)
from consistency.referee.diagnostics.whitening import (
    are_unlike,
    block_slices,
    by_runs,
    mean_of_runs,
    standardise,
)
from consistency.referee.types import Array, Indices

SIGN = 2.0  # standard errors from 0, of steps that are all one and the same, at which a correlation has a sign
NAMING = 0.5  # of the false-alarm rate: that a pair of axes is named where the factors of the axes alone are wrong
VISIBLE = 0.05  # a stated correlation that is worth a word
TINIEST = 1e-300
GRID = 9  # ratios within the tolerance at which the distribution is compared


def error_parts(
    record: Record, sample: Sample, tests: Tests, given: Sequence[Answer], settings: Settings, shown: Equivalence
) -> ErrorParts:
    """All parts of the errors of a sample; those of NEES alone have no components."""
    faults = set(faults_of(given))
    band = tests.band
    if STEP in faults and not band.outside.any():  # found by what Holm's correction left over: a band that shows it
        rate = np.nextafter(band.p_value, 1.0) * (1 + 1e-6)
        band = simultaneous_band(sample.nees, sample.dof, rate, settings.method, settings.allow)
    location = location_of(sample, band, faults, ordered=record.map.landmarks is None, detect=settings.factor)
    scaled = at_share(given, settings)
    scale = scale_of(sample, tests, scaled, location, shown, faults)
    tails = tails_of(tests, record.run_numbers)
    by_group = by_group_of(record, sample, tests, given, settings)
    if sample.whitened is None:
        return ErrorParts(scale, location, tails=tails, by_group=by_group)
    return ErrorParts(
        scale,
        location,
        axes_of(sample, tests, location, faults),
        bias_of(sample, tests.bias_step, location, faults),
        shape_of(sample, tests, faults, scaled.false_alarm),
        tails,
        accuracy_of(sample),
        by_group,
    )


def excused(given: Sequence[Answer], sample: Sample, tests: Tests, settings: Settings) -> tuple[Answer, ...]:
    """Answers with faults of the scale marked as tolerated whose ratio is shown to lie within the tolerance."""
    if settings.tolerance is None:
        return tuple(given)
    R = settings.tolerated
    if not _is_tolerated(sample.run_means(), settings):
        return tuple(given)
    tolerated = {MAIN}
    groups = sample.components.values() if sample.whitened is not None else []
    if groups and all(_is_tolerated(sample.run_means(group), settings) for group in groups):
        tolerated.add(AXIS)
    if tests.largest is not None and tests.largest.ratio.high <= R:
        tolerated.add(DIRECTION)
    by_group = [sample.in_group(number) for number in range(len(tests.groups))]
    if all(equivalence(one.values, one.dof, one.steps, settings, R, weights=one.counts).shown for one in by_group):
        tolerated.add(GROUP)
    curve = anees(sample.nees)
    if not ((curve > tests.band.high * R) | (curve < tests.band.low / R)).any():
        tolerated.add(STEP)
    return with_tolerated(given, tolerated)


def _is_tolerated(means: RunMeans, settings: Settings) -> bool:
    """Whether the ratio is shown to lie within the tolerance."""
    test = means.tests(gaussian=False)
    return equivalence(means.values, means.dof, means.steps, settings, settings.tolerated, test=test).shown


def scale_of(
    sample: Sample, tests: Tests, settings: Settings, location: Location, shown: Equivalence, faults: set[str]
) -> Scale:
    """Size of the errors; the inflation is that since the fault began, if it began late."""
    dof = sample.dof
    means = sample.means()
    alive = sample.counted.sum(axis=0)
    curve = anees(sample.nees)
    band = pointwise_band(alive, dof)
    rate = SHARES[MAIN] * settings.false_alarm
    judged = alive > 0
    detectable = median_run = worst_run = share_inside = float("nan")
    if judged.any():
        detectable = detectable_ratio(dof, len(means), rate, two_sided=not settings.one_sided)
        median_run = float(np.median(means)) * dof
        worst_run = float(means.max()) * dof
        inside = (curve >= band[:, 0]) & (curve <= band[:, 1])
        share_inside = float(inside[judged].mean())
    of_log = None
    if len(sample.nees) == 1:
        from consistency.referee.diagnostics.planning import within

        of_log = within(sample.nees[0], dof, settings, shown.factor)
    accepted = acceptance(tests.main, dof, rate, settings.allow)
    mean = tests.main.ratio * dof
    if MAIN not in faults and tests.named:  # the test weighted by steps may accept what this one does not
        accepted = min(accepted[0], mean), max(accepted[1], mean)
    return Scale(
        dof=dof,
        anees=curve,
        alive=alive,
        band=band,
        mean_anees=mean,
        accepted=accepted,
        effective_dof=tests.main.effective_dof,
        inflation=_interval_of(sample, None, location, CONFIDENCE, faults),
        detectable=detectable,
        median_run=median_run,
        worst_run=worst_run,
        share_inside=share_inside,
        equivalence=shown,
        within=of_log,
    )


def _interval_of(
    sample: Sample, index: Sequence[int] | None, location: Location, confidence: float, faults: set[str]
) -> Interval:
    """Ratio of all components or some since the fault began; without a fault by runs and by steps."""
    if not faults:
        return sample.run_means(index).interval(confidence)
    late = location.steps
    if index is None:
        return ratio_interval(sample.means(late), sample.dof, confidence)
    return ratio_interval(sample.group_means(index, late), len(index), confidence)


def axes_of(sample: Sample, tests: Tests, location: Location, faults: set[str]) -> ComponentRatios:
    """Inflation of each component and group, and of velocity, since the fault began."""
    confidence = 1.0 - (1.0 - CONFIDENCE) / len(sample.components)
    reported = sample.reported
    inflation = {}
    for key, index in reported.items():
        inflation[key] = _interval_of(sample, index, location, confidence, faults)
    if tests.largest is None:
        return ComponentRatios(sample.names, reported, inflation)
    return ComponentRatios(sample.names, reported, inflation, tests.largest.ratio, tests.largest.direction)


def by_group_of(
    record: Record, sample: Sample, tests: Tests, given: Sequence[Answer], settings: Settings
) -> ByGroup | None:
    """Ratio and status of each group of runs and steps that has a step; None without groups.

    Once some group is found at fault, each one is named whose own p value times the number of groups is at most the
    false-alarm rate. Nothing is judged where the question of groups was not asked.
    """
    groups = sample.groups
    if groups is None:
        return None
    found = [sample.in_group(number) for number in range(len(groups.names))]
    there = sum(len(one.values) > 0 for one in found)
    is_asked = any(answer.question == GROUP for answer in given)
    is_found = GROUP in faults_of(given)
    both_sides = replace(settings, allow=None) if record.fit.reduced else settings
    factor = max(settings.factor, settings.tolerated)
    confidence = 1.0 - (1.0 - CONFIDENCE) / max(there, 1)
    from consistency.referee.diagnostics.groups import spans_of

    by_group = []
    spans = None if groups.edges is None else spans_of(groups.edges)
    for number, (name, one) in enumerate(zip(groups.names, found, strict=True)):
        if not len(one.values):
            continue
        shown = equivalence(one.values, one.dof, one.steps, both_sides, factor, weights=one.counts)
        p_value = float("nan")
        status = ""
        if is_asked:
            p_value = min(1.0, sided_p_value(tests.groups[number], settings) * there)
            is_wrong = is_found and p_value <= settings.false_alarm
            status = _status_of_group(tests.groups[number].ratio, is_wrong, shown)
        ratio = ratio_interval(one.values, one.dof, confidence, one.counts)
        span = None if spans is None else spans[number]
        by_group.append(Group(name, len(one.values), int(one.counts.sum()), ratio, p_value, shown, status, span))
    without = int((sample.counted & (groups.index < 0)).sum())
    return ByGroup(groups.column, tuple(by_group), groups.outcome, without)


def _status_of_group(ratio: float, is_wrong: bool, shown: Equivalence) -> str:
    """One word for a group."""
    if is_wrong:
        return "overconfident" if ratio > 1.0 else "conservative"
    return "consistent" if shown.shown else "undecided"


def bias_of(sample: Sample, step: int | None, location: Location, faults: set[str]) -> Bias:
    """Mean error of each axis, clearest in ``step``, and the scale without it."""
    late = location.steps

    def means(error: Array, covariance: Array, counted: Array) -> Array:
        return mean_of_runs(np.where(counted[..., None], standardise(error, covariance), np.nan))

    of_runs = by_runs(means, sample.error[:, late], sample.covariance[:, late], sample.counted[:, late])
    of_runs = of_runs[np.isfinite(of_runs).all(axis=-1)]
    by_axis = {}
    if len(of_runs) > sample.dof:
        test = hotelling(of_runs, CONFIDENCE)
        for i, axis in enumerate(sample.names):
            by_axis[axis] = Interval(test.mean[i], *test.interval[i])
    if not faults & set(BIAS):
        return Bias(by_axis, step, None, None, None)
    without = ratio_interval(sample.centred_means(late), sample.dof, CONFIDENCE)
    if step is None:
        return Bias(by_axis, step, None, None, without)
    at = standardise(sample.error[:, step - 1], sample.covariance[:, step - 1])[sample.counted[:, step - 1]]
    mean = at.mean(axis=0)
    chief = int(np.argmax(np.abs(mean) / at.std(axis=0, ddof=1).clip(TINIEST)))  # what stands out most
    return Bias(by_axis, step, sample.names[chief], float(mean[chief]), without)


def shape_of(sample: Sample, tests: Tests, faults: set[str], false_alarm: float) -> Shape | None:
    """The two axes that are correlated least as stated: over whole runs, or in the step where a fault was found.

    A pair whose correlation is itself shown to be wrong (:func:`_shown_pairs`) comes before the others, and among these
    one of the wrong sign. Only such a pair can make a verdict *inconsistent*: by chance in none of 1,152 simulated data
    sets where the factor of one axis or one block alone is wrong.
    """
    if tests.matrix is None or sample.dof == 1:
        return None
    here = slice(None)
    if tests.shape_step is not None and "shape" not in faults:
        here = slice(tests.shape_step - 1, tests.shape_step)
    counted = sample.counted[:, here]
    if not counted.any():
        return Shape(tests.matrix, tests.shape_step, None, float("nan"), float("nan"))
    gap, stated = _correlations(sample.error[:, here], sample.covariance[:, here], counted)
    shown = np.zeros(gap.shape, bool)
    if faults & {*SCALE, *SHAPE}:
        shown = _shown_pairs(sample, here, NAMING * false_alarm)
    clear = SIGN / np.sqrt(max(int(counted.any(axis=1).sum()), 1))
    actual = stated + gap
    opposite = (actual * stated < 0.0) & (np.abs(actual) > clear) & (np.abs(stated) > VISIBLE)
    opposite &= shown & bool(faults & set(SHAPE))
    pair = _largest(gap)
    for some in (opposite, shown):
        if some.any():
            pair = _largest(np.where(some, gap, 0.0))
            break
    right = all(tests.axes[axis].p_value * len(tests.axes) > false_alarm for axis in sample.names)
    wrong_sign = bool(opposite[pair])
    return Shape(
        matrix=tests.matrix,
        step=tests.shape_step,
        pair=pair,
        actual=float(actual[pair]),
        stated=float(stated[pair]),
        wrong_sign=wrong_sign,
        alone=wrong_sign and right,
        shown=bool(shown[pair]),
    )


def _shown_pairs(sample: Sample, here: slice, false_alarm: float) -> Array:
    """Pairs of axes whose correlation is shown to be wrong, (n, n) of bool.

    Over whole runs, and in the step ``here`` where the shape was found at fault: each at half the rate then, and the
    step corrected for the number of steps from which it was chosen. Where the axes alone are wrong, each by a factor
    of its own, a pair is shown with probability ``false_alarm`` at most (Bonferroni over the pairs). Simulated at 5 %:
    some pair in 4.2 % of 9,600 data sets of 3, 9 and 15 axes, 20 and 100 runs, steps that depend by 0 to 0.99.
    """
    counted = sample.counted
    pairs = sample.dof * (sample.dof - 1) // 2
    found = [(slice(None), pairs)]
    if here != slice(None):
        found = [(slice(None), 2 * pairs), (here, 2 * pairs * int(counted.any(axis=0).sum()))]
    shown = np.zeros((sample.dof, sample.dof), bool)
    for steps, looks in found:
        p_values = pair_p_values(sample.error[:, steps], sample.covariance[:, steps], counted[:, steps])
        shown |= p_values * looks <= false_alarm
    return shown


def tails_of(tests: Tests, run_numbers: Indices) -> Tails:
    """The error that stands out most, and the whole distribution; ``run_numbers`` (runs,) names the runs."""
    found = tests.outlier
    if found is None or found.run < 0:
        return Tails(-1, 0, float("nan"), tests.pit.values, tests.pit.half_width)
    run = int(run_numbers[found.run])
    return Tails(run, found.step + 1, found.distance, tests.pit.values, tests.pit.half_width)


def accuracy_of(sample: Sample) -> Accuracy:
    """Coverage, RMSE and the noncredibility index."""
    counted = sample.counted
    index, inclination = noncredibility(sample.error, sample.nees)
    inside, interval = coverage_interval(sample.error, sample.covariance, counted=counted)

    def rmse_of(members: set[str]) -> float:
        columns = sample.members(members)
        if not columns:
            return float("nan")
        return rmse(sample.error, columns, counted)

    return Accuracy(
        coverage=coverage(sample.error, sample.covariance, counted=counted),
        coverage_one_step=inside,
        coverage_interval=interval,
        rmse=np.array([rmse(sample.error, [i], counted) for i in range(sample.dof)]),
        rmse_position=rmse_of(POSITION),
        rmse_heading=rmse_of(ATTITUDE),
        nci=_mean_of_known(index),
        inclination=_mean_of_known(inclination),
    )


def _mean_of_known(values: Array) -> float:
    if not np.isfinite(values).any():
        return float("nan")
    return float(np.nanmean(values))


def _largest(matrix: Array) -> tuple[int, int]:
    """Place of the largest absolute entry of a symmetric matrix, above the diagonal."""
    i, j = np.unravel_index(np.abs(matrix).argmax(), matrix.shape)
    return min(int(i), int(j)), max(int(i), int(j))


def _correlations(error: Array, covariance: Array, counted: Array) -> tuple[Array, Array]:
    """Correlations of the errors less those stated, and those stated, averaged over steps; (n, n) both."""
    n = error.shape[-1]
    count = int(counted.sum())
    mean = np.zeros(n)
    stated = np.zeros((n, n))
    second = np.zeros((n, n))
    parts = list(block_slices(*counted.shape))
    for here in parts:
        mean += standardise(error[here], covariance[here])[counted[here]].sum(axis=0)
    mean /= count
    for here in parts:
        e = standardise(error[here], covariance[here])[counted[here]] - mean
        second += e.T @ e / count
        stated += _sum_of_correlations(covariance[here][counted[here]]) / count
    scale = np.sqrt(np.diag(second))
    with np.errstate(invalid="ignore", divide="ignore"):
        gap = np.nan_to_num(second / np.outer(scale, scale) - stated)
    np.fill_diagonal(gap, 0.0)
    return gap, stated


def _sum_of_correlations(covariance: Array) -> Array:
    """Correlation matrices of covariances (N, n, n), added up."""
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    rows = [(covariance[:, i] / (sigma[:, i, None] * sigma)).sum(axis=0) for i in range(sigma.shape[1])]
    return np.array(rows)


@dataclass(frozen=True)
class Tests:
    """p value of each question, NaN where it cannot be asked, and intermediate results."""

    p_values: Mapping[str, float]
    main: MeanTest  # with runs of equal weight
    band: Band
    pit: Pit
    axes: Mapping[str, MeanTest] = field(default_factory=dict)  # and groups
    largest: Largest | None = None
    outlier: Outlier | None = None
    matrix: Array | None = None  # mean product of whitened errors, scaled
    bias_step: int | None = None  # 1..T, with the smallest p value
    shape_step: int | None = None
    groups: tuple[MeanTest, ...] = ()  # of each group of runs and steps
    named: Mapping[str, float] = field(default_factory=dict)  # p values that name a fault, once one is found


def run_tests(sample: Sample, settings: Settings, also: Mapping[str, float], scale: float | None = None) -> Tests:
    """Test every question that the sample allows.

    Parameters
    ----------
    also : p values of other questions of the same verdict, among which the false-alarm rate is split
    scale : p value of the main question, where it comes from elsewhere
    """
    of_runs = sample.run_means()
    main = of_runs.named
    named = {MAIN: sided_p_value(main, settings)}
    if scale is None:
        scale = sided_p_value(of_runs.find(), settings)
    p = {MAIN: scale}
    axes: dict[str, MeanTest] = {}
    largest = outlier = matrix = bias_step = shape_step = None
    if sample.whitened is not None:
        whitened = sample.whitened
        in_steps = step_moments(whitened)
        of_axes = {key: sample.run_means(index) for key, index in sample.components.items()}
        axes = {key: of_axis.named for key, of_axis in of_axes.items()}
        p[AXIS] = float("nan")
        if sample.dof > 1:
            find = [of_axis.find() for of_axis in of_axes.values()]
            for values, tests in ((named, axes.values()), (p, find)):
                values[AXIS], _ = least_of_steps(np.array([sided_p_value(test, settings) for test in tests]))
        bias_step = _test_bias(sample, in_steps, p)
        outlier = outliers(whitened, in_steps)
        p["outliers"] = outlier.p_value
        if settings.one_sided:
            # runs may be conservative to different degrees: an outlier must be one for P, too
            p["outliers"] = float(np.maximum(outlier.p_value, beyond_stated(whitened)))
            largest = largest_direction(whitened)
            p[DIRECTION] = largest.p_value
        else:
            matrix, shape_step = _test_shape(whitened, in_steps, p)
    groups = group_tests(sample)
    if groups:
        p[GROUP], _ = least_of_steps(np.array([sided_p_value(test, settings) for test in groups]))
    distribution = pit(sample.nees, sample.dof)
    if not settings.one_sided:
        p["distribution"] = _distribution(sample, settings, distribution)
    asked = [question for question, value in (dict(also) | p).items() if np.isfinite(value)]
    rate = shares_of(dict.fromkeys([*asked, STEP]))[STEP] * settings.false_alarm
    band = simultaneous_band(sample.nees, sample.dof, rate, settings.method, settings.allow)
    if sample.nees.shape[1] > 1:
        p[STEP] = band.p_value
    if not are_unlike(sample.counts):
        named = {}
    return Tests(p, main, band, distribution, axes, largest, outlier, matrix, bias_step, shape_step, groups, named)


def sided_p_value(test: MeanTest, settings: Settings) -> float:
    """Two-sided, or against a covariance that is too small where nothing else is a fault."""
    if settings.one_sided:
        return test.above
    return test.p_value


def group_tests(sample: Sample) -> tuple[MeanTest, ...]:
    """Test of the scale in each group of runs and steps by itself; none where groups do not convict."""
    if sample.groups is None or sample.groups.outcome:
        return ()
    return tuple(sample.in_group(number).by_steps()(1.0) for number in range(len(sample.groups.names)))


def _distribution(sample: Sample, settings: Settings, distribution: Pit) -> float:
    """p value of the distribution of the NEES: the largest over the ratios that are tolerated."""
    largest = distribution.p_value
    if settings.tolerated > 1.0:
        for ratio in np.geomspace(1.0 / settings.tolerated, settings.tolerated, GRID):
            largest = max(largest, pit(sample.nees / ratio, sample.dof).p_value)
    return largest


def _test_bias(sample: Sample, in_steps: StepMoments, p: dict[str, float]) -> int | None:
    """Put the p values of a mean error into ``p``; the step with the smallest, 1..T."""
    whitened = sample.whitened
    assert whitened is not None
    of_runs = mean_of_runs(whitened)
    of_runs = of_runs[np.isfinite(of_runs).all(axis=-1)]
    p["bias"] = float("nan")
    if len(of_runs) > whitened.shape[-1]:
        p["bias"] = hotelling(of_runs).p_value
        if are_unlike(sample.counts):
            p["bias"] = max(p["bias"], hotelling(of_runs * sample.counts[:, None]).p_value)
    if whitened.shape[1] == 1:
        return None
    _, steps = t_squared(whitened, in_steps)
    p["bias in some step"], step = least_of_steps(steps)
    return step


def _test_shape(whitened: Array, in_steps: StepMoments, p: dict[str, float]) -> tuple[Array, int | None]:
    """Put the p values of the shape into ``p``; the mean products, and the step with the smallest p value, 1..T."""
    _, steps = sphericity(whitened, in_steps)
    matrix, over_runs = mean_shape(whitened)
    in_step, step = least_of_steps(steps)
    if whitened.shape[1] == 1:
        p["shape"] = in_step
    else:
        p["shape"] = over_runs
        p["shape in some step"] = in_step
    return matrix, step
