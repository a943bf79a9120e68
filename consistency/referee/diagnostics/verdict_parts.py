"""The questions of a verdict with the share of the false-alarm rate of each, and the parts that answer them.

The parts are frozen, and each field has its shape beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from consistency.referee.defaults import DETECT, FALSE_ALARM, POWER
from consistency.referee.types import Array, Indices

SIDES = {"overconfident": 1, "conservative": -1}  # statuses of a covariance that is too small, or too large
TINY = 1e-12  # ratio of an error that is rounding
# chance to call runs that end early lost where they end for reasons that have nothing to do with their errors
EARLY = 1e-3
# status -> what it means; the order is that of reports
STATUSES = {
    "consistent": "no fault is found, and the errors are shown to be as large as the covariance says",
    "overconfident": "the errors are larger than the covariance says",
    "conservative": "the errors are smaller than the covariance says",
    "biased": "the errors have a mean; about it they are as large as the covariance says",
    "heavy-tailed": "a few errors are far larger than a Gaussian of the stated covariance has them",
    "inconsistent": "the errors disagree with the covariance in more than scale",
    "undecided": "no fault is found, and it is not shown that there is none",
    "failed": "a run broke down, or there was nothing to judge",
}
CERTAIN = 0.999  # false-alarm rate, at most
MAIN = "scale"
STEP = "scale in some step"
AXIS = "scale of an axis"
DIRECTION = "scale in some direction"
SCALE = (MAIN, STEP, AXIS, DIRECTION)
BIAS = ("bias", "bias in some step")
SHAPE = ("shape", "shape in some step")
INNOVATIONS = ("innovation scale", "innovation whiteness")
GROUP = "scale in some group"
JOINT = "scale of pose and map"
JOINT_DISTRIBUTION = "distribution of pose and map"
# Share of the false-alarm rate of each question; those that are asked share what the main one leaves. Half goes to
# the mean over the trajectory, so that the number of runs planned for a covariance ratio does not depend on what
# else is asked.
SHARES = {
    MAIN: 0.5,
    STEP: 0.1,
    AXIS: 0.1,
    DIRECTION: 0.1,
    GROUP: 0.2,
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
    GROUP: "mean NEES of each run over its steps in a group, for each group by itself",
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


class Interval(NamedTuple):
    """A value and a confidence interval."""

    value: float
    low: float
    high: float

    def holds(self, value: float) -> bool:
        """Is ``value`` inside? NaN ends hold nothing."""
        return self.low <= value <= self.high


@dataclass(frozen=True)
class Answer:
    """Result of one question."""

    question: str
    p_value: float
    share: float  # of the false-alarm rate; all of a verdict add to 1
    adjusted: float  # p value corrected for all questions asked
    found: bool  # adjusted is at most the false-alarm rate of the verdict
    tolerated: bool = False  # found, but shown to lie within the tolerance


@dataclass(frozen=True)
class Equivalence:
    """Two one-sided tests that the ratio of true to stated covariance lies near 1 (Schuirmann 1987)."""

    factor: float  # the interval is [1 / factor, factor]
    p_value: float  # the larger of both; NaN where there is nothing to judge
    level: float  # at which it is shown
    runs: int | None  # that would probably decide, shown or found at fault; None where it is not known
    one_sided: bool = False  # only that the ratio is below ``factor``
    interval: tuple[float, float] | None = None  # ratios that neither test excludes at ``level``; None where not known

    @property
    def shown(self) -> bool:
        return self.p_value <= self.level


@dataclass(frozen=True)
class Within:
    """Scale of a single run, if errors go on to decorrelate as within it; reported, not judged."""

    ratio: Interval  # of true to stated covariance, 95 %
    correlation: float  # time over which the NEES decorrelates, in steps
    effective_dof: float  # of the run: its mean NEES spreads as chi-square(nu) / nu
    steps: int | None  # in all, that would probably decide as ``pieces`` runs; None where it is not known
    pieces: int | None


@dataclass(frozen=True)
class Scale:
    """Size of the errors against the stated covariance; T steps."""

    dof: int
    anees: Array  # (T,), average NEES over runs
    alive: Indices  # (T,), runs that have a value
    band: Array  # (T, 2), 95 % interval of the ANEES of one step by itself; not judged
    mean_anees: float  # over whole runs
    accepted: tuple[float, float]  # interval of mean_anees without a fault
    effective_dof: float  # nu of one run: its mean NEES spreads as chi-square(nu) / nu
    inflation: Interval  # ratio of true to stated covariance, 95 % interval; since the fault begins, if it begins late
    detectable: float  # smallest ratio that the runs find with power 0.95, however steps depend on each other
    median_run: float  # mean NEES
    worst_run: float
    share_inside: float  # of steps inside ``band``
    equivalence: Equivalence
    within: Within | None = None  # of a single run whose errors decorrelate

    @property
    def judged_steps(self) -> int:
        return int((self.alive > 0).sum())

    @property
    def not_shown(self) -> Scale:
        """The same scale where it is shown to be nothing."""
        return replace(self, equivalence=replace(self.equivalence, p_value=float("nan"), runs=None))


@dataclass(frozen=True)
class ComponentRatios:
    """The error by component; n components."""

    names: tuple[str, ...]
    groups: Mapping[str, Sequence[int]]  # components, named groups and subsets
    inflation: Mapping[str, Interval] = field(default_factory=dict)  # of each group, simultaneous 95 %
    largest: Interval | None = None  # inflation in the worst direction, where one-sided
    direction: Array | None = None  # (n,), of whitened errors


@dataclass(frozen=True)
class Group:
    """Size of the errors against the stated covariance in one group of runs and steps."""

    name: str
    runs: int  # that have a step in the group
    steps: int  # of all runs
    ratio: Interval  # of true to stated covariance, simultaneous 95 % over the groups
    p_value: float  # corrected for the number of groups
    equivalence: Equivalence
    status: str  # overconfident, conservative, consistent or undecided; "" where nothing is judged
    span: tuple[float, float] | None = None  # of numbers: above the first, up to the second; None of words


@dataclass(frozen=True)
class ByGroup:
    """The groups of a column."""

    column: str
    groups: tuple[Group, ...]  # without those that no step belongs to
    outcome: str = ""  # why the column selects on the outcome, so that nothing is judged; "" if it does not
    without: int = 0  # steps that have no value, and belong to no group

    @property
    def worst(self) -> Group:
        """The group at fault that is clearest; without a fault, the group whose ratio is farthest from 1."""
        wrong = [group for group in self.groups if group.status in SIDES]
        if wrong:
            return min(wrong, key=lambda group: (group.p_value, -abs(_log(group.ratio.value))))
        return max(self.groups, key=lambda group: abs(_log(group.ratio.value)))


REGIONS = (
    "nominal operation",
    "misleading",
    "hazardously misleading",
    "unavailable",
    "unavailable and misleading",
)  # of the Stanford diagram
HAZARD = 2  # its place


class Alerts(NamedTuple):
    """Shares of the steps in the regions of the Stanford diagram of a bound and its alert limit.

    A bound above the limit makes the system *unavailable*. An error outside its bound is *misleading*, and
    *hazardously* so if it is above the limit while the bound is not (Tossaint et al. 2007, The Stanford-ESA integrity
    diagram).
    """

    limit: float
    shares: tuple[float, ...]  # of REGIONS, means over runs
    hazard_limit: float  # rates of hazardously misleading steps from here on are excluded at 95 %


@dataclass(frozen=True)
class BoundScore:
    """How often the error leaves a bound, of all steps or of a group of them, and the factor that it needs."""

    name: str  # of the bound; with its group where it is of one
    level: float  # share of the steps in which the error is to stay inside
    factor: Interval  # by which the bound has to grow for its level to hold, 95 %; infinite where no end is known
    rate: float  # mean over runs of the share of steps outside
    rate_limit: float  # rates from here on are excluded at 95 %
    above: float  # share of steps above the upper bound; NaN of a length
    below: float
    runs: int
    steps: int  # of all runs
    missing: int  # steps after the end of runs, and of lost ones
    fewest: int  # runs below which neither consistent nor conservative can be shown
    p_value: float  # corrected for all bounds and groups
    equivalence: Equivalence  # of the factor
    status: str  # overconfident, conservative, consistent or undecided; "" where it is not judged
    group: str = ""
    alerts: Alerts | None = None  # where the bound has an alert limit


@dataclass(frozen=True)
class Lost:
    """Runs that failed, or whose mean NEES is beyond the limit for a right run."""

    count: int
    runs: int  # that failed or have a NEES
    bound: float  # mean NEES beyond which a run is lost
    upper: float  # limit of the share of lost runs
    level: float  # confidence of the limit
    needed: int | None = None  # runs that show the share asked for, if no further run is lost; None without one


@dataclass(frozen=True)
class EarlyEnds:
    """Runs that end before the last step of the others, and their errors there."""

    runs: int  # that end while others go on
    above: (
        float  # share of the runs that continue whose NEES is smaller in that step; 1/2 if ends do not depend on errors
    )
    p_value: float  # that they do not, or on small errors only; NaN where no run ends early

    @property
    def lost(self) -> bool:
        """Whether runs that end early have clearly larger errors than those that continue."""
        return self.p_value <= EARLY


@dataclass(frozen=True)
class Bias:
    """Mean of the error."""

    by_axis: Mapping[str, Interval]  # in stated standard deviations
    step: int | None  # where it is clearest, 1..T
    axis: str | None  # the one that carries it in that step
    size: float | None  # its mean there, in stated standard deviations
    inflation_without: Interval | None  # of the errors less their mean; where a bias was found


@dataclass(frozen=True)
class Shape:
    """Relative sizes and correlations of the components."""

    matrix: Array  # (n, n), mean product of whitened errors over whole runs, scaled to trace n: I if right
    step: int | None  # where it is worst, 1..T
    pair: tuple[int, int] | None  # components that correlate least as stated
    actual: float  # their correlation
    stated: float
    wrong_sign: bool = False  # of the correlation, beyond doubt
    alone: bool = False  # and no component is wrong by itself, so that a fault of the scale is its
    shown: bool = False  # the correlation is wrong beyond doubt, whatever the factors on the components


@dataclass(frozen=True)
class Tails:
    """Outliers among the errors, and the distribution of the NEES."""

    run: int  # of the error farthest from the other runs; -1 if none is
    step: int  # 1..T
    distance: float  # in standard deviations of the other runs
    pit: Array  # (N,), sorted distribution function of the NEES, one step a run: uniform if right
    half_width: float  # of its simultaneous band


@dataclass(frozen=True)
class NisTest:
    """Total NIS against its degrees of freedom."""

    ratio: float  # total NIS over total degrees of freedom
    dof: int
    above: float  # one-sided p values
    below: float

    @property
    def p_value(self) -> float:
        return float(np.minimum(1.0, 2.0 * np.minimum(self.above, self.below)))


@dataclass(frozen=True)
class Outliers:
    """Few innovations that are far larger than a Gaussian of the stated covariance allows."""

    count: int
    of: int  # innovations
    run: int  # row of the largest
    step: int  # its column
    nis: float
    dof: int
    p_value: float  # of the largest among all
    rest: NisTest  # of the other innovations


@dataclass(frozen=True)
class Innovations:
    """Size and whiteness of the innovations."""

    ratio: float  # total NIS over its degrees of freedom
    interval: tuple[float, float]  # 95 % expected of white innovations
    dof: int
    judged: bool  # an optimal gain was declared
    autocorrelation: Array  # (lags,)
    bound: float  # that 95 % of each lag stay within, if white
    equivalence: Equivalence | None = None  # of the NIS, where it is judged
    outliers: Outliers | None = None  # where it is judged; ``run`` is what the run is called, ``step`` 1..T


@dataclass(frozen=True)
class Until:
    """The last of the steps that carry a fault, 1..T, and the ratio in these steps and in the others."""

    step: int
    early: float  # mean NEES over dof
    late: Interval  # ratio of true to stated covariance in the other steps, 95 %


@dataclass(frozen=True)
class Location:
    """Beginning and place of a fault; T steps."""

    simultaneous: Array  # (T, 2), where the ANEES of a consistent filter lies in all steps at once
    steps_above: int
    steps_below: int
    first_outside: int | None  # first step outside, found at fault or not
    first_step: int | None = None  # the same where some step was found at fault
    since: int | None = None  # the fault begins there: it was absent before
    lasting: bool = False  # most steps from there on are outside
    subset: str | None = None  # axes that carry the fault, where axes differ from each other
    until: Until | None = None  # the fault ends there: it is in the first steps only, or in those from ``since`` on

    @property
    def steps(self) -> slice:
        """Steps of a fault that begins late, up to its end; all where it does not begin late."""
        if self.since is None:
            return slice(0, None)
        return slice(self.since - 1, self.until and self.until.step)


@dataclass(frozen=True)
class JointScore:
    """NEES of pose and map together over its degrees of freedom, 1 if right, with 95 % intervals from the runs."""

    both: Interval
    pose: Interval  # part of the pose alone
    map: Interval  # and of the landmarks given the pose: the map as the robot sees it
    runs: int
    dof: int  # of all runs
    chief: tuple[int, ...] = ()  # landmarks whose part is beyond chance
    not_definite: tuple[int, ...] = ()  # runs whose joint covariance is not positive definite, left out


@dataclass(frozen=True)
class RejectionScore:
    """Observations that a guard rejected, with 95 % intervals of the shares from the runs."""

    precision: Interval  # of the rejected ones those that are spurious
    recall: Interval  # of the spurious ones those that are rejected
    false_alarms: Interval  # of the right ones those that are rejected
    runs: int
    offered: int
    spurious: int  # none where it is not known
    rejected: int


@dataclass(frozen=True)
class Accuracy:
    """Size of the errors, coverage, and credibility indices from the literature."""

    coverage: Array  # (n,), share of errors within 2 stated standard deviations, all steps
    coverage_one_step: Array  # (n,), of one step of each run
    coverage_interval: Array  # (n, 2), its exact binomial 95 % interval
    rmse: Array  # (n,)
    rmse_position: float
    rmse_heading: float
    nci: float  # noncredibility index, dB (Li & Zhao 2006)
    inclination: float  # dB


@dataclass(frozen=True)
class TruthShare:
    """Share of the truth's own covariance P_t in that of the errors, P + P_t; ratios are of P alone."""

    share: float  # tr((P + P_t)^-1 P_t) / n, mean of runs
    by_axis: Mapping[str, float]  # of each component and group
    errors: str | None  # declared: "independent", "per-run" or "common"; None: nothing is
    shared: bool  # the estimator has fused the truth


class ErrorParts(NamedTuple):
    """What the tests say about the errors of a sample; a part is None if it could not be computed."""

    scale: Scale | None = None
    location: Location | None = None
    axes: ComponentRatios | None = None
    bias: Bias | None = None
    shape: Shape | None = None
    tails: Tails | None = None
    accuracy: Accuracy | None = None
    by_group: ByGroup | None = None

    def with_ratios(self, of: Callable[[Interval, str], Interval]) -> ErrorParts:
        """The parts with other ratios; ``of`` gives them of those here and the name of components, MAIN of all."""

        def of_value(value: float) -> float:
            return of(Interval(value, value, value), MAIN).value

        scale, location, axes, bias, by_group = self.scale, self.location, self.axes, self.bias, self.by_group
        if scale is not None:
            within = scale.within and replace(scale.within, ratio=of(scale.within.ratio, MAIN))
            inflation, detectable = of(scale.inflation, MAIN), of_value(scale.detectable)
            scale = replace(scale, inflation=inflation, detectable=detectable, within=within)
        if axes is not None:
            largest = axes.largest and of(axes.largest, MAIN)
            inflation_of = {key: of(interval, key) for key, interval in axes.inflation.items()}
            axes = replace(axes, inflation=inflation_of, largest=largest)
        if bias is not None and bias.inflation_without is not None:
            bias = replace(bias, inflation_without=of(bias.inflation_without, MAIN))
        if location is not None and location.until is not None:
            until = location.until
            until = replace(until, early=of_value(until.early), late=of(until.late, MAIN))
            location = replace(location, until=until)
        if by_group is not None:
            groups = tuple(replace(group, ratio=of(group.ratio, MAIN)) for group in by_group.groups)
            by_group = replace(by_group, groups=groups)
        return self._replace(scale=scale, location=location, axes=axes, bias=bias, by_group=by_group)


def _log(ratio: float) -> float:
    return float(np.log(max(ratio, TINY)))


@dataclass(frozen=True)
class Settings:
    """Questions of a verdict, and its error rates.

    Raises
    ------
    ValueError
        A value out of its range.
    """

    false_alarm: float = FALSE_ALARM  # chance to find a fault in a right filter, all questions together
    detect: float = DETECT  # consistent: the ratio of true to stated covariance is shown to be in [1 / detect, detect]
    power: float = POWER  # a filter at either end is not called consistent, with this probability or more
    tolerance: float | None = None  # a ratio shown to lie in [1 / tolerance, tolerance] is not a fault
    allow: str | None = None  # "conservative": a covariance that is too large is not a fault
    method: str = "max"  # of the band over all steps: "max" or "bonferroni"
    subsets: Mapping[str, Sequence[int]] | None = None  # further groups of components to look at, name -> indices
    lost: float | None = None  # consistent: the share of lost runs is shown to be this at most

    def __post_init__(self) -> None:
        for name in ("false_alarm", "power"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(f"{name} must lie between 0 and 1, got {getattr(self, name)}")
        for name in ("detect", "tolerance"):
            value = getattr(self, name)
            if value is not None and not (0.0 < value < float("inf") and value != 1.0):
                raise ValueError(f"{name} must be a positive ratio of true to stated covariance, not 1; got {value}")
        if self.lost is not None and not 0.0 < self.lost < 1.0:
            raise ValueError(f"lost must lie between 0 and 1, got {self.lost}")
        if self.allow not in (None, "conservative"):
            raise ValueError(f"allow must be 'conservative' or None, got '{self.allow}'")
        if self.method not in ("max", "bonferroni"):
            raise ValueError(f"method must be 'max' or 'bonferroni', got '{self.method}'")

    @property
    def factor(self) -> float:
        """``detect`` as a factor above 1."""
        return max(self.detect, 1.0 / self.detect)

    @property
    def tolerated(self) -> float:
        """``tolerance`` as a factor of 1 or more; 1 where nothing is tolerated."""
        if self.tolerance is None:
            return 1.0
        return max(self.tolerance, 1.0 / self.tolerance)

    @property
    def one_sided(self) -> bool:
        """Only a covariance that is too small is a fault."""
        return self.allow == "conservative"


def answers(
    p_values: Mapping[str, float], false_alarm: float, shares: Mapping[str, float] | None = None
) -> dict[str, Answer]:
    """Answers corrected for the number of questions: weighted Holm (1979), valid under any dependence.

    The probability that a right filter is found at fault in any question is at most ``false_alarm``. The main question
    keeps its share; the shares of questions that cannot be asked (p is NaN) go to the other ones. The
    adjusted p value of a question is the false-alarm rate at which it would just be found.

    Parameters
    ----------
    shares : of the false-alarm rate of each question that is asked, adding to 1; those of ``SHARES`` if not given
    """
    asked = {question: p for question, p in p_values.items() if np.isfinite(p)}
    share = shares or shares_of(asked)
    found: dict[str, Answer] = {}
    left = 1.0
    least = 0.0
    for question in sorted(asked, key=lambda q: asked[q] / share[q]):
        least = max(least, min(1.0, asked[question] * left / share[question]))
        found[question] = Answer(question, asked[question], share[question], least, least <= false_alarm)
        left -= share[question]
    return {question: found[question] for question in asked}


def named_p_values(p_values: Mapping[str, float], named: Mapping[str, float]) -> dict[str, float]:
    """p values with those that ``named`` has in the place of others, each only once some question finds a fault.

    The ``named`` ones are smaller and not valid by themselves. None of them becomes so small that a fault would be
    found, in all questions together, at a smaller rate than before (a gatekeeping procedure).
    """
    share = shares_of([question for question, p in p_values.items() if np.isfinite(p)])
    least = min((p_values[question] / share[question] for question in share), default=1.0)
    return dict(p_values) | {q: max(named[q], least * share[q]) for q in named if q in share}


def shares_of(questions: Collection[str]) -> dict[str, float]:
    """Share of the false-alarm rate of each of the ``questions`` that are asked together; they add to 1."""
    if set(questions) == {MAIN}:
        return {MAIN: 1.0}
    kept = 0.0
    if MAIN in questions:
        kept = SHARES[MAIN]
    total = sum(SHARES[q] for q in questions if q != MAIN)
    shares = {}
    for question in questions:
        if question == MAIN:
            shares[question] = kept
        else:
            shares[question] = SHARES[question] * (1.0 - kept) / total
    return shares


def at_share(given: Sequence[Answer], settings: Settings) -> Settings:
    """Settings at whose usual share the scale is asked as it was: at the whole rate where nothing else is asked."""
    share = SHARES[MAIN]
    for answer in given:
        if answer.question == MAIN:
            share = answer.share
    return replace(settings, false_alarm=min(settings.false_alarm * share / SHARES[MAIN], CERTAIN))


def faults_of(given: Sequence[Answer]) -> dict[str, Answer]:
    """Answers that found a fault, those within the tolerance left out, by question."""
    return {answer.question: answer for answer in given if answer.found and not answer.tolerated}


def with_tolerated(given: Sequence[Answer], questions: Collection[str]) -> tuple[Answer, ...]:
    """Answers with the faults in these questions marked as tolerated."""
    return tuple(replace(a, tolerated=a.tolerated or (a.found and a.question in questions)) for a in given)


def least_of_steps(p_values: Array) -> tuple[float, int | None]:
    """The smallest p value of all steps, corrected for their number, and its step 1..T."""
    count = int(np.isfinite(p_values).sum())
    if not count:
        return float("nan"), None
    return min(1.0, float(np.nanmin(p_values)) * count), int(np.nanargmin(p_values)) + 1
