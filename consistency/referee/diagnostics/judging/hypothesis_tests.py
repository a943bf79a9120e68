"""Every test that a sample allows: the p value of each question, and what the tests found on the way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from consistency.referee.diagnostics.questions.anees_band import Band, simultaneous_band
from consistency.referee.diagnostics.questions.bias import StepMoments, hotelling, step_moments, t_squared
from consistency.referee.diagnostics.questions.outliers import Outlier, beyond_stated, outliers
from consistency.referee.diagnostics.questions.sample import Sample
from consistency.referee.diagnostics.questions.scale import MeanTest, scale_test
from consistency.referee.diagnostics.questions.shape import Largest, largest_direction, mean_shape, sphericity
from consistency.referee.diagnostics.records.whitening import are_unlike, mean_of_runs
from consistency.referee.diagnostics.statistics.nees import Pit, pit
from consistency.referee.diagnostics.verdict.answers import (
    AXIS,
    DIRECTION,
    GROUP,
    MAIN,
    STEP,
    Settings,
    least_of_steps,
    shares_of,
)
from consistency.referee.types import Array

GRID = 9  # ratios within the tolerance at which the distribution is compared


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
    main = of_runs.name()
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
        axes = {key: of_axis.name() for key, of_axis in of_axes.items()}
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
    tests = []
    for number in range(len(sample.groups.names)):
        in_group = sample.in_group(number)
        tests.append(scale_test(in_group.means, sample.dof, in_group.longest, weights=in_group.counts))
    return tuple(tests)


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
