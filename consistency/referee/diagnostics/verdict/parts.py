"""Settings and output of the referee: frozen, with the shape of each field; :mod:`record` has its input."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from consistency.referee.defaults import DETECT, FALSE_ALARM, POWER
from consistency.referee.diagnostics.records.record import Record, shown_by
from consistency.referee.diagnostics.records.skipping import Skipped
from consistency.referee.errors import InputError
from consistency.referee.types import Array, Failure, Indices

if TYPE_CHECKING:
    from consistency.referee.diagnostics.questions.innovations import Outliers

TINY = 1e-12  # ratio of an error that is rounding
EARLY = (
    1e-3  # chance to call runs that end early lost where they end for reasons that have nothing to do with their errors
)

# status -> what it means; the order is that of reports
STATUSES = {
    "consistent": "no fault is found, and the errors are shown to be as large as the covariance says",
    "overconfident": "the errors are larger than the covariance says",
    "conservative": "the errors are smaller than the covariance says",
    "biased": "the errors have a mean; about it they are as large as the covariance says",
    "heavy-tailed": "a few errors are far larger than a Gaussian of the stated covariance has them",
    "inconsistent": "the errors are otherwise than the covariance says, in more than their size",
    "undecided": "no fault is found, and it is not shown that there is none",
    "failed": "a run broke down, or there was nothing to judge",
}


class Interval(NamedTuple):
    """A value and a confidence interval."""

    value: float
    low: float
    high: float

    def holds(self, value: float) -> bool:
        """Is ``value`` inside? NaN ends hold nothing."""
        return self.low <= value <= self.high


# --- questions -------------------------------------------------------------------------------------


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
    tolerance: float | None = None  # a ratio shown to lie in [1 / tolerance, tolerance] is no fault
    allow: str | None = None  # "conservative": a covariance that is too large is no fault
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
        return 1.0 if self.tolerance is None else max(self.tolerance, 1.0 / self.tolerance)

    @property
    def one_sided(self) -> bool:
        """Only a covariance that is too small is a fault."""
        return self.allow == "conservative"


# --- output of the referee ---------------------------------------------------------------------------


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


@dataclass(frozen=True)
class Axes:
    """The error by component; n components."""

    names: tuple[str, ...]
    groups: Mapping[str, Sequence[int]]  # components, named groups and subsets
    inflation: Mapping[str, Interval] = field(default_factory=dict)  # of each group, simultaneous 95 %
    largest: Interval | None = None  # inflation in the worst direction, where one-sided
    direction: Array | None = None  # (n,), of whitened errors


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
    above: float  # share of the runs that go on whose NEES is smaller in that step; 1/2 if ends do not depend on errors
    p_value: float  # that they do not, or on small errors only; NaN where no run ends early

    @property
    def lost(self) -> bool:
        """Whether runs that end early have clearly larger errors than those that go on."""
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


@dataclass(frozen=True)
class Tails:
    """Outliers among the errors, and the distribution of the NEES."""

    run: int  # of the error farthest from the other runs; -1 if none is
    step: int  # 1..T
    distance: float  # in standard deviations of the other runs
    pit: Array  # (N,), sorted distribution function of the NEES, one step a run: uniform if right
    half_width: float  # of its simultaneous band


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
    """The last of the first steps that carry a fault, 1..T, and the ratio in these steps and after them."""

    step: int
    early: float  # mean NEES over dof
    late: Interval  # ratio of true to stated covariance, 95 %


@dataclass(frozen=True)
class Location:
    """Beginning and place of a fault; T steps."""

    simultaneous: Array  # (T, 2), where the ANEES of a consistent filter lies in all steps at once
    above: int  # steps above it
    below: int
    first_outside: int | None  # first step outside, found at fault or not
    first_step: int | None = None  # the same where some step was found at fault
    since: int | None = None  # the fault begins there: it was absent before
    lasting: bool = False  # most steps from there on are outside
    subset: str | None = None  # axes that carry the fault, where axes differ from each other
    until: Until | None = None  # the fault is in the first steps only


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
class MapScore:
    """Landmarks in the map after the last step, each with 3 degrees of freedom, or 2 in the plane."""

    ratio: Interval  # mean over runs of the mean NEES over its degrees of freedom, 95 % by the spread between runs
    runs: int  # with a landmark that has a NEES
    landmarks: int  # that have one, of all runs
    left_out: int  # that have none: no landmark of the world, not known where, or covariance not positive definite
    verdict: Verdict | None = None  # on the map, landmarks in the place of steps; None where it is not judged


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


class Guess(NamedTuple):
    """What the errors say if they are of one convention, where none is declared."""

    status: str  # of that convention
    faults: tuple[str, ...]
    ratio: Interval  # of true to stated covariance, simultaneous over the conventions
    possible: bool  # no fault is found


@dataclass(frozen=True)
class Verdict:
    """The referee's answer for one filter.

    ``print`` shows the sentence and a short table. A part is None if it could not be computed.
    """

    filter: str
    status: str  # see STATUSES
    reasons: tuple[str, ...]  # the first is a sentence to act on
    runs: int
    steps: int
    settings: Settings
    answers: tuple[Answer, ...] = ()
    failures: tuple[Failure, ...] = ()
    impossible: tuple[tuple[int, int], ...] = ()  # (run, step) of what no filter may say
    left_out_steps: tuple[int, ...] = ()  # rank-deficient covariance
    scale: Scale | None = None
    axes: Axes | None = None
    bias: Bias | None = None
    shape: Shape | None = None
    tails: Tails | None = None
    innovations: Innovations | None = None
    location: Location | None = None
    accuracy: Accuracy | None = None
    convention: str | None = None  # of the error that is judged, where files or the filter declare one
    notes: tuple[str, ...] = ()  # of whoever read the files
    causes: tuple[str, ...] = ()  # probable mix-ups; they stand in the reasons and notes, too
    align: str | None = None  # how estimates in files were moved into the world of the truth
    world: Verdict | None = None  # the same runs in the additive error of the world, where the filter has another
    map: MapScore | None = None
    landmarks: Indices | None = None  # (steps,), of the verdict on a map: what stands in the place of steps
    joint: JointScore | None = None  # of the verdict on a map
    rejection: RejectionScore | None = None  # of a filter with a guard
    unit: str = "run"  # what a run is called, as in :class:`~consistency.diagnostics.Record`
    lost: Lost | None = None  # where there is a NEES
    ends: EarlyEnds | None = None  # runs that end before the others; None where none does, and of maps
    skipped: Skipped | None = None  # first steps of each run that were left out
    axis: tuple[str, Interval] | None = None  # that decides the status, with its ratio; None where the whole does
    truth: TruthShare | None = None  # where the truth has a covariance of its own
    guesses: Mapping[str, Guess] = field(default_factory=dict)  # by convention, where none is declared
    parts: Mapping[str, Verdict] = field(default_factory=dict)  # where cross terms between them are not stated
    record: Record | None = None  # what was judged, where it is kept to be drawn

    @property
    def in_world(self) -> Verdict:
        """The verdict whose errors are those of the pose in the world: ``world``, or this one."""
        return self if self.world is None else self.world

    @property
    def consistent(self) -> bool:
        return self.status == "consistent"

    def place(self, step: int) -> str:
        """Name of step 1..T: "step 3", or "landmark 17" where landmarks stand in the place of steps."""
        return f"step {step}" if self.landmarks is None else f"landmark {self.landmarks[step - 1]}"

    @property
    def places(self) -> str:
        """Noun for the second axis of the arrays: steps, or landmarks of a map."""
        return "steps" if self.landmarks is None else "landmarks"

    @property
    def worst_axis(self) -> tuple[str, Interval] | None:
        """Component whose ratio is farthest from 1, on the side of a fault of the scale; None if there is only one."""
        if self.axes is None or len(self.axes.names) < 2:
            return None
        logs = {a: np.log(max(i.value, TINY)) for a, i in self.axes.inflation.items() if a in self.axes.names}
        side = {"overconfident": 1.0, "conservative": -1.0}.get(self.status, 1.0 if self.settings.one_sided else 0.0)
        known = [axis for axis, log in logs.items() if np.isfinite(log)]
        if not known:
            return None
        worst = max(known, key=lambda axis: side * logs[axis] if side else abs(logs[axis]))
        return worst, self.axes.inflation[worst]

    @property
    def faults(self) -> tuple[str, ...]:
        """Questions in which a fault was found, those within the tolerance left out."""
        return tuple(a.question for a in self.answers if a.found and not a.tolerated)

    @property
    def p_value(self) -> float:
        """False-alarm rate at which some fault would just be found, all questions together; NaN without any."""
        return min((min(1.0, a.p_value / a.share) for a in self.answers if not a.tolerated), default=float("nan"))

    @property
    def statistic(self) -> float:
        """Mean NEES over runs and steps; without truth, NIS per degree of freedom."""
        if self.scale is not None:
            return self.scale.mean_anees
        return self.innovations.ratio if self.innovations is not None else float("nan")

    @property
    def threshold(self) -> tuple[float, float]:
        """Interval in which ``statistic`` is no fault."""
        if self.scale is not None:
            return self.scale.accepted
        return self.innovations.interval if self.innovations is not None else (float("nan"), float("nan"))

    @property
    def inflation(self) -> float:
        """Factor by which the stated covariance has to grow (below 1: shrink) to be that of the errors."""
        return self.scale.inflation.value if self.scale is not None else float("nan")

    @property
    def inflation_interval(self) -> tuple[float, float]:
        """95 % interval of ``inflation``, from the spread between runs."""
        return self.scale.inflation[1:] if self.scale is not None else (float("nan"), float("nan"))

    @property
    def equivalence(self) -> Equivalence | None:
        """Equivalence of the scale of the NEES, or of the NIS without truth."""
        if self.scale is not None:
            return self.scale.equivalence
        return self.innovations.equivalence if self.innovations is not None else None

    @property
    def first_step(self) -> int | None:
        """First step in which the ANEES is outside its simultaneous band; None if in none."""
        return self.location.first_step if self.location is not None else None

    @property
    def subset(self) -> str | None:
        """Axes that carry the fault; None if no axis stands out."""
        return self.location.subset if self.location is not None else None

    @property
    def statistics(self) -> dict[str, Any]:
        """Every number as one flat dictionary, as ``--json`` has it."""
        from consistency.referee.diagnostics.verdict.as_dictionary import flat

        return flat(self)

    def __str__(self) -> str:
        return str(shown_by("verdict_text", self))

    def __repr__(self) -> str:
        return f"<Verdict {self.filter}: {self.status}, {self.runs} runs x {self.steps} steps; print() shows it>"

    def _repr_html_(self) -> str:
        return str(shown_by("verdict_html", self))

    def plot(self, path: str | Path | None = None) -> Any:
        """Errors with their bounds, NEES with its band, and coverage; arguments as those of :meth:`Record.plot`.

        Raises
        ------
        InputError
            The verdict was not made by ``consistency.judge``, or nothing can be drawn.
        """
        if self.record is None:
            raise InputError(f"{self.filter}: the record was not kept with the verdict; draw record.plot() of it")
        return shown_by("plot", self.record, self, path)
