"""The p value of every question about the errors, and the statistics that come with it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from consistency.referee.diagnostics.questions.band import Band, simultaneous_band
from consistency.referee.diagnostics.questions.bias import Moments, hotelling, moments, t_squared
from consistency.referee.diagnostics.questions.outliers import Outlier, outliers
from consistency.referee.diagnostics.questions.scale import MeanTest, scale_test
from consistency.referee.diagnostics.questions.shape import mean_shape, sphericity
from consistency.referee.diagnostics.records.sample import Sample
from consistency.referee.diagnostics.records.whitening import mean_of_runs
from consistency.referee.diagnostics.statistics.nees import Pit, pit
from consistency.referee.diagnostics.verdict.answers import AXIS, DIRECTION, MAIN, STEP, answers
from consistency.referee.diagnostics.verdict.parts import Settings
from consistency.referee.types import Array

if TYPE_CHECKING:
    from consistency.referee.diagnostics.questions.direction import Largest

GRID = 9  # ratios within the tolerance at which the distribution is compared


@dataclass(frozen=True)
class Tests:
    """p value of each question, NaN where it cannot be asked, and intermediate results."""

    p_values: Mapping[str, float]
    main: MeanTest
    band: Band
    pit: Pit
    axes: Mapping[str, MeanTest] = field(default_factory=dict)  # and groups
    largest: Largest | None = None
    outlier: Outlier | None = None
    matrix: Array | None = None  # mean product of whitened errors, scaled
    bias_step: int | None = None  # 1..T, with the smallest p value
    shape_step: int | None = None


def ask(sample: Sample, settings: Settings, also: Mapping[str, float], scale: float | None = None) -> Tests:
    """Test every question that the sample allows.

    Parameters
    ----------
    also : p values of other questions of the same verdict, among which the false-alarm rate is split
    scale : p value of the main question, where it comes from elsewhere
    """
    main = scale_test(sample.means(), sample.dof, sample.longest)
    p = {MAIN: (main.above if settings.one_sided else main.p_value) if scale is None else scale}
    axes: dict[str, MeanTest] = {}
    largest = outlier = matrix = bias_step = shape_step = None
    if sample.errors is not None:
        w, n = sample.errors.whitened, sample.dof
        in_steps = moments(w)
        axes = {
            key: scale_test(sample.group_means(index), len(index), sample.longest)
            for key, index in sample.errors.groups.items()
        }
        worst = np.array([t.above if settings.one_sided else t.p_value for t in axes.values()])
        p[AXIS] = least(worst)[0] if n > 1 else float("nan")
        bias_step = _bias(w, in_steps, p)
        outlier = outliers(w, in_steps)
        p["outliers"] = outlier.p_value
        if settings.one_sided:
            from consistency.referee.diagnostics.questions.direction import largest_direction

            largest = largest_direction(w)
            p[DIRECTION] = largest.p_value
        else:
            matrix, shape_step = _shape(w, in_steps, p)
    distribution = pit(sample.nees, sample.dof)
    if not settings.one_sided:
        p["distribution"] = distribution.p_value
        if settings.tolerated > 1.0:  # the largest over the ratios that are tolerated
            ratios = np.geomspace(1.0 / settings.tolerated, settings.tolerated, GRID)
            others = (pit(sample.nees / ratio, sample.dof).p_value for ratio in ratios)
            p["distribution"] = max(distribution.p_value, *others)
    among = dict.fromkeys([q for q, value in (dict(also) | p).items() if np.isfinite(value)] + [STEP], 1.0)
    rate = answers(among, 0.5)[STEP].share * settings.false_alarm
    band = simultaneous_band(sample.nees, sample.dof, rate, settings.method, settings.allow)
    if sample.nees.shape[1] > 1:
        p[STEP] = band.p_value
    return Tests(p, main, band, distribution, axes, largest, outlier, matrix, bias_step, shape_step)


def _bias(whitened: Array, in_steps: Moments, p: dict[str, float]) -> int | None:
    of_runs = mean_of_runs(whitened)
    of_runs = of_runs[np.isfinite(of_runs).all(axis=-1)]
    p["bias"] = hotelling(of_runs).p_value if len(of_runs) > whitened.shape[-1] else float("nan")
    if whitened.shape[1] == 1:
        return None
    _, steps = t_squared(whitened, in_steps)
    p["bias in some step"], step = least(steps)
    return step


def _shape(whitened: Array, in_steps: Moments, p: dict[str, float]) -> tuple[Array, int | None]:
    _, steps = sphericity(whitened, in_steps)
    matrix, over_runs = mean_shape(whitened)
    in_step, step = least(steps)
    if whitened.shape[1] > 1:
        p["shape"], p["shape in some step"] = over_runs, in_step
    else:
        p["shape"] = in_step
    return matrix, step


def least(p_values: Array) -> tuple[float, int | None]:
    """The smallest p value of all steps, corrected for their number, and its step 1..T."""
    count = int(np.isfinite(p_values).sum())
    if not count:
        return float("nan"), None
    return min(1.0, float(np.nanmin(p_values)) * count), int(np.nanargmin(p_values)) + 1
