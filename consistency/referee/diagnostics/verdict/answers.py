"""The questions of a verdict: the p value and the share of the false-alarm rate of each, and Holm's correction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from consistency.referee.diagnostics.questions.band import Band, simultaneous_band
from consistency.referee.diagnostics.questions.bias import Moments, hotelling, moments, t_squared
from consistency.referee.diagnostics.questions.outliers import Outlier, beyond_stated, outliers
from consistency.referee.diagnostics.questions.scale import MeanTest, scale_test
from consistency.referee.diagnostics.questions.shape import Largest, largest_direction, mean_shape, sphericity
from consistency.referee.diagnostics.questions.sample import Sample
from consistency.referee.diagnostics.records.whitening import mean_of_runs
from consistency.referee.diagnostics.statistics.nees import Pit, pit
from consistency.referee.diagnostics.verdict.parts import Answer, Settings
from consistency.referee.types import Array

GRID = 9  # ratios within the tolerance at which the distribution is compared
MAIN, STEP, AXIS, DIRECTION = "scale", "scale in some step", "scale of an axis", "scale in some direction"
SCALE = (MAIN, STEP, AXIS, DIRECTION)
BIAS = ("bias", "bias in some step")
SHAPE = ("shape", "shape in some step")
INNOVATIONS = ("innovation scale", "innovation whiteness")
JOINT, JOINT_DISTRIBUTION = "scale of pose and map", "distribution of pose and map"
# Share of the false-alarm rate of each question; those that are asked share what the main one leaves. Half goes to
# the mean over the trajectory, so that the number of runs planned for a covariance ratio does not depend on what
# else is asked.
SHARES = {
    MAIN: 0.5,
    STEP: 0.1,
    AXIS: 0.1,
    DIRECTION: 0.1,
    "bias": 0.05,
    "bias in some step": 0.05,
    "shape": 0.05,
    "shape in some step": 0.05,
    "outliers": 0.025,
    "distribution": 0.025,
    "innovation scale": 0.025,
    "innovation whiteness": 0.025,
    JOINT: 0.1,
    JOINT_DISTRIBUTION: 0.025,
}
ABOUT = {
    MAIN: "mean NEES of whole trajectories against its degrees of freedom",
    STEP: "ANEES of every step against its simultaneous band",
    AXIS: "the same mean for each axis and subset by itself",
    DIRECTION: "largest eigenvalue of the mean whitened second moment, where only too small a covariance is a fault",
    "bias": "Hotelling's T-squared of the mean whitened error of a trajectory",
    "bias in some step": "Hotelling's T-squared of every step",
    "shape": "mean products of different whitened components over a trajectory",
    "shape in some step": "Mauchly's sphericity of the whitened errors of every step",
    "outliers": "Wilks' largest distance of one run from the others in any step",
    "distribution": "Kolmogorov's distance of the NEES from chi-square, one step a run",
    "innovation scale": "total NIS against its degrees of freedom",
    "innovation whiteness": "portmanteau test of the autocorrelation over steps",
    JOINT: "NEES of pose and all landmarks together against its degrees of freedom",
    JOINT_DISTRIBUTION: "Kolmogorov's distance of that NEES from chi-square, one value a run",
}
# what is wrong, where the answer to one of these questions is the only fault
ALONE = {
    JOINT_DISTRIBUTION: "the NEES of pose and map together does not follow the chi-square distribution",
    "distribution": "the NEES does not follow the chi-square distribution",
}


def answers(p_values: Mapping[str, float], false_alarm: float) -> dict[str, Answer]:
    """Answers corrected for the number of questions: weighted Holm (1979), valid under any dependence.

    The chance that a right filter is found at fault in any question is at most ``false_alarm``. The main question
    keeps its share; the shares of questions that cannot be asked (p is NaN) go to the other ones. The
    adjusted p value of a question is the false-alarm rate at which it would just be found.
    """
    by_question = {q: p for q, p in p_values.items() if np.isfinite(p)}
    total = sum(SHARES[q] for q in by_question if q != MAIN)
    kept = SHARES[MAIN] if MAIN in by_question else 0.0
    share = {q: kept if q == MAIN else SHARES[q] * (1.0 - kept) / total for q in by_question}
    if set(by_question) == {MAIN}:
        share = {MAIN: 1.0}
    result: dict[str, Answer] = {}
    left, least = 1.0, 0.0
    for question in sorted(by_question, key=lambda q: by_question[q] / share[q]):
        least = max(least, min(1.0, by_question[question] * left / share[question]))
        result[question] = Answer(question, by_question[question], share[question], least, least <= false_alarm)
        left -= share[question]
    return {q: result[q] for q in by_question}


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
        if settings.one_sided:  # runs may be conservative to different degrees: an outlier must be one for P, too
            p["outliers"] = float(np.maximum(outlier.p_value, beyond_stated(w)))
        if settings.one_sided:
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
