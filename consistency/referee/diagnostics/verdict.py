"""The verdict on one filter.

It holds what the tests found, the status that follows, and the sentences that say so, and gives all of it to programs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from consistency.referee.diagnostics.record import Record, Skipped, shown_by
from consistency.referee.diagnostics.verdict_parts import (
    REGIONS,
    SIDES,
    TINY,
    Accuracy,
    Answer,
    Bias,
    BoundScore,
    ByGroup,
    ComponentRatios,
    EarlyEnds,
    Equivalence,
    Innovations,
    Interval,
    JointScore,
    Location,
    Lost,
    RejectionScore,
    Scale,
    Settings,
    Shape,
    Tails,
    TruthShare,
    faults_of,
)
from consistency.referee.errors import InputError
from consistency.referee.types import Array, Failure, Indices

CLOCK = 1e8  # s, three years: times above are of a clock that does not start with the runs
MICROSECOND = 6  # digits behind the point
UNKNOWN_ENDS = (float("nan"), float("nan"))
Numbers = dict[str, Any]


@dataclass(frozen=True)
class Findings:
    """What the tests found in the errors and innovations of one filter; a part is None if it could not be computed."""

    filter: str
    status: str  # see STATUSES
    runs: int
    steps: int
    settings: Settings
    answers: tuple[Answer, ...] = ()
    failures: tuple[Failure, ...] = ()
    impossible: tuple[tuple[int, int], ...] = ()  # (run, step) of what no filter may say
    left_out_steps: tuple[int, ...] = ()  # rank-deficient covariance
    scale: Scale | None = None
    axes: ComponentRatios | None = None
    bias: Bias | None = None
    shape: Shape | None = None
    tails: Tails | None = None
    innovations: Innovations | None = None
    location: Location | None = None
    accuracy: Accuracy | None = None
    by_group: ByGroup | None = None  # where the record has groups
    landmarks: Indices | None = None  # (steps,), of the verdict on a map: what stands in the place of steps
    joint: JointScore | None = None  # of the verdict on a map
    times: Array | None = None  # (steps,), s, NaN where a step has none; None where no file has them
    files: Mapping[int, str] = field(default_factory=dict)  # of each run by its number, where each has one of its own
    unit: str = "run"  # what a run is called, as in :class:`~consistency.diagnostics.Record`
    lost: Lost | None = None  # where there is a NEES
    ends: EarlyEnds | None = None  # runs that end before the others; None where none does, and of maps
    skipped: Skipped | None = None  # first steps of each run that were left out
    truth: TruthShare | None = None  # where the truth has a covariance of its own
    bounds: tuple[BoundScore, ...] = ()  # where bounds are judged in place of covariances
    parts: Mapping[str, Findings] = field(default_factory=dict)  # where cross terms between them are not stated
    unshown: str = ""  # why nothing can be shown, so that nothing is decided
    later: bool = False  # this look found no fault; it asks the scale alone, or has too few runs for an all-clear

    @property
    def consistent(self) -> bool:
        return self.status == "consistent"

    def place(self, step: int, last: int | None = None) -> str:
        """Name of a step, 1..T, or of several: "step 3 (0.3 s)", "steps 3 to 9 (0.3 to 0.9 s)", "landmark 17" of a map.

        Times of a clock that counts from long before are told from the first one on.
        """
        if self.landmarks is not None:
            return f"landmark {self.landmarks[step - 1]}"
        ends = [step] if last in (None, step) else [step, last or step]
        text = f"step{'s' * (len(ends) - 1)} {' to '.join(map(str, ends))}"
        if self.times is None or not np.isfinite(times := self.times[np.array(ends) - 1]).all():
            return text
        after = ""
        if np.nanmin(self.times) > CLOCK:
            times = np.round(times - np.nanmin(self.times), MICROSECOND)
            after = " after the start"
        return f"{text} ({' to '.join(f'{time:.12g}' for time in times)} s{after})"

    def run_name(self, run: int) -> str:
        """Name of a run: "run 3 (est/3.csv)", or "window 3"."""
        if run in self.files:
            return f"{self.unit} {run} ({self.files[run]})"
        return f"{self.unit} {run}"

    @property
    def places(self) -> str:
        """Noun for the second axis of the arrays: steps, or landmarks of a map."""
        if self.landmarks is None:
            return "steps"
        return "landmarks"

    @property
    def worst_axis(self) -> tuple[str, Interval] | None:
        """Component whose ratio is farthest from 1, on the side of a fault of the scale; None if there is only one."""
        if self.axes is None or len(self.axes.names) < 2:
            return None
        side = SIDES.get(self.status, int(self.settings.one_sided))
        distances = {}
        for axis in self.axes.names:
            log = float(np.log(max(self.axes.inflation[axis].value, TINY)))
            if np.isfinite(log):
                distances[axis] = side * log if side else abs(log)
        if not distances:
            return None
        worst = max(distances, key=distances.__getitem__)
        return worst, self.axes.inflation[worst]

    @property
    def faults(self) -> tuple[str, ...]:
        """Questions in which a fault was found, those within the tolerance left out."""
        return tuple(faults_of(self.answers))

    @property
    def p_value(self) -> float:
        """False-alarm rate at which some fault would just be found, all questions together; NaN without any."""
        return min((min(1.0, a.p_value / a.share) for a in self.answers if not a.tolerated), default=float("nan"))

    @property
    def statistic(self) -> float:
        """Mean NEES over runs and steps; without truth, NIS per degree of freedom."""
        if self.scale is not None:
            return self.scale.mean_anees
        if self.innovations is not None:
            return self.innovations.ratio
        return float("nan")

    @property
    def threshold(self) -> tuple[float, float]:
        """Interval in which ``statistic`` is not a fault."""
        if self.scale is not None:
            return self.scale.accepted
        if self.innovations is not None:
            return self.innovations.interval
        return UNKNOWN_ENDS

    @property
    def inflation(self) -> float:
        """Factor by which the stated covariance has to grow (below 1: shrink) to be that of the errors."""
        if self.scale is None:
            return float("nan")
        return self.scale.inflation.value

    @property
    def inflation_interval(self) -> tuple[float, float]:
        """95 % interval of ``inflation``, from the spread between runs."""
        if self.scale is None:
            return UNKNOWN_ENDS
        return self.scale.inflation[1:]

    @property
    def equivalence(self) -> Equivalence | None:
        """Equivalence of the scale of the NEES, or of the NIS without truth."""
        if self.scale is not None:
            return self.scale.equivalence
        if self.innovations is not None:
            return self.innovations.equivalence
        return max((one.equivalence for one in self.bounds), key=lambda shown: shown.p_value, default=None)

    @property
    def first_step(self) -> int | None:
        """First step in which the ANEES is outside its simultaneous band; None if in none."""
        if self.location is None:
            return None
        return self.location.first_step

    @property
    def subset(self) -> str | None:
        """Axes that carry the fault; None if no axis stands out."""
        if self.location is None:
            return None
        return self.location.subset


@dataclass(frozen=True)
class MapScore:
    """Landmarks in the map after the last step, each with 3 degrees of freedom, or 2 in the plane."""

    ratio: Interval  # mean over runs of the mean NEES over its degrees of freedom, 95 % by the spread between runs
    runs: int  # with a landmark that has a NEES
    landmarks: int  # that have one, of all runs
    left_out: int  # that have none: no landmark of the world, not known where, or covariance not positive definite
    verdict: Verdict | None = None  # on the map, landmarks in the place of steps; None where it is not judged


class ConventionResult(NamedTuple):
    """What the errors say if they are of one convention, where none is declared."""

    status: str  # of that convention
    faults: tuple[str, ...]
    ratio: Interval  # of true to stated covariance, simultaneous over the conventions
    possible: bool  # no fault is found


@dataclass(frozen=True, repr=False)
class Verdict(Findings):
    """The referee's answer for one filter.

    ``print`` shows the sentence and a short table.
    """

    parts: Mapping[str, Verdict] = field(default_factory=dict)  # where cross terms between them are not stated
    reasons: tuple[str, ...] = ()  # the first is a sentence to act on
    details: tuple[str, ...] = ()  # of the reasons, those that only --verbose shows on a terminal
    axis: tuple[str, Interval] | None = None  # that decides the status, with its ratio; None where the whole does
    convention: str | None = None  # of the error that is judged, where files or the filter declare one
    notes: tuple[str, ...] = ()  # of whoever read the files
    causes: tuple[str, ...] = ()  # probable mix-ups; they stand in the reasons and notes, too
    align: str | None = None  # how estimates in files were moved into the world of the truth
    world: Verdict | None = None  # the same runs in the additive error of the world, where the filter has another
    map: MapScore | None = None
    rejection: RejectionScore | None = None  # of a filter with a guard
    guesses: Mapping[str, ConventionResult] = field(default_factory=dict)  # by convention, where none is declared
    record: Record | None = None  # what was judged, where it is kept to be drawn

    @property
    def in_world(self) -> Verdict:
        """The verdict whose errors are those of the pose in the world: ``world``, or this one."""
        if self.world is None:
            return self
        return self.world

    @property
    def statistics(self) -> dict[str, Any]:
        """Every number as one flat dictionary, as ``--json`` has it; parts that could not be computed are left out."""
        return _statistics_of(self)

    def as_dictionary(self) -> dict[str, Any]:
        """Status, reasons and statistics."""
        return {"status": self.status, "reasons": self.reasons, "statistics": self.statistics}

    def __str__(self) -> str:
        return str(shown_by("verdict_text", self))

    def __repr__(self) -> str:
        return f"<Verdict {self.filter}: {self.status}, {self.runs} runs x {self.steps} steps; print() shows it>"

    def _repr_html_(self) -> str:
        return str(shown_by("verdict_html", self))

    def plot(self, path: str | Path | None = None, figure: str | None = None) -> Any:
        """Errors with their bounds, NEES with its band, trajectory and coverage.

        Parameters
        ----------
        path : as of :meth:`Record.plot`
        figure : title of a figure of the report, which is drawn alone: "Errors and stated bounds", "Trajectory"

        Raises
        ------
        InputError
            The verdict was not made by ``consistency.judge``, nothing can be drawn, or the report has no such figure.
        """
        if self.record is None:
            raise InputError(f"{self.filter}: the record was not kept with the verdict; draw record.plot() of it")
        return shown_by("plot", self.record, self, path, figure)

    def write(self, path: str | Path, overwrite: bool = False) -> list[Path]:
        """Write the verdict as ``analyse --report`` does, and return the paths of what is written.

        Parameters
        ----------
        path : a folder for the page, the PDF and the JSON; or FILE.xml (JUnit) or FILE.md
        overwrite : replace also files other than earlier reports

        Raises
        ------
        InputError
            Something else is there, it cannot be written, or the verdict was not made by ``consistency.judge``.
        """
        written: list[Path] = shown_by("write_verdict", self, path, overwrite)
        return written


def _axes_numbers(v: Verdict, axes: ComponentRatios) -> dict[str, Any]:
    numbers: dict[str, Any] = {
        "axes": axes.names,
        "groups": {key: list(index) for key, index in axes.groups.items()},
        "of_axes": {key: tuple(interval) for key, interval in axes.inflation.items()},
        "impossible": [list(pair) for pair in v.impossible],
    }
    for key, axis in (("worst_axis", v.worst_axis), ("axis", v.axis)):
        if axis is not None:
            numbers |= {key: axis[0], f"{key}_ratio": tuple(axis[1])}
    if axes.largest is not None:
        numbers |= {"largest": tuple(axes.largest), "largest_direction": axes.direction}
    return numbers


def _map_numbers(score: MapScore) -> dict[str, Any]:
    numbers: dict[str, Any] = {
        "map_ratio": score.ratio.value,
        "map_ratio_interval": tuple(score.ratio[1:]),
        "map_runs": score.runs,
        "map_landmarks": score.landmarks,
        "map_left_out": score.left_out,
    }
    if score.verdict is not None:
        numbers["map"] = score.verdict.as_dictionary()
    return numbers


def _statistics_of(v: Verdict) -> dict[str, Any]:
    """Every number of a verdict; those of parts that could not be computed are left out."""

    numbers: dict[str, Any] = {
        "runs": v.runs,
        "steps": v.steps,
        "unit": v.unit,
        "false_alarm": v.settings.false_alarm,
        "confidence": 1.0 - v.settings.false_alarm,
        "detect": v.settings.detect,
        "power": v.settings.power,
        "tolerance": v.settings.tolerance,
        "allow": v.settings.allow,
        "failures": [[failure.run, failure.step, failure.reason] for failure in v.failures],
        "answers": [vars(answer) for answer in v.answers],
        "p_value": v.p_value,
        "left_out_steps": list(v.left_out_steps),
    }
    parts: list[tuple[Any, Callable[[Any], dict[str, Any]]]] = [
        (v.scale, scale_numbers),
        (v.lost, partial(lost_numbers, v.settings.lost)),
        (v.location, location_numbers),
        (v.axes, partial(_axes_numbers, v)),
        (v.bias, bias_numbers),
        (v.shape, shape_numbers),
        (v.tails, tails_numbers),
        (v.innovations, innovations_numbers),
        (v.accuracy, vars),
        (v.map, _map_numbers),
        (v.landmarks, lambda labels: {"landmarks": list(labels)}),
        (v.joint, joint_numbers),
        (v.rejection, rejection_numbers),
        (v.ends, ends_numbers),
        (v.skipped, skipped_numbers),
        (v.guesses or None, lambda guesses: {"guesses": {kind: guess._asdict() for kind, guess in guesses.items()}}),
        (v.truth, truth_numbers),
        (v.by_group, group_numbers),
        (v.bounds or None, bound_numbers),
    ]
    for part, numbers_of in parts:
        if part is not None:
            numbers |= numbers_of(part)
    of_parts = {name: group_numbers(part.by_group)["by"] for name, part in v.parts.items() if part.by_group}
    if of_parts:
        numbers["by_part"] = of_parts
    if v.convention is not None or v.notes:
        numbers |= {"convention": v.convention, "align": v.align, "notes": list(v.notes)}
    if v.world is not None:
        numbers["world"] = v.world.as_dictionary()
    return numbers


def scale_numbers(scale: Scale) -> Numbers:
    within: Numbers | None = None
    if scale.within is not None:
        within = {
            "ratio": scale.within.ratio.value,
            "ratio_interval": tuple(scale.within.ratio[1:]),
            "correlation_steps": scale.within.correlation,
            "effective_dof": scale.within.effective_dof,
            "deciding_steps": scale.within.steps,
            "deciding_pieces": scale.within.pieces,
        }
    return {
        "dof": scale.dof,
        "anees": scale.anees,
        "alive": scale.alive,
        "band": scale.band,
        "judged_steps": scale.judged_steps,
        "mean_anees": scale.mean_anees,
        "acceptance": scale.accepted,
        "effective_dof": scale.effective_dof,
        "ratio": scale.inflation.value,
        "ratio_interval": tuple(scale.inflation[1:]),
        "detectable": scale.detectable,
        "median_run": scale.median_run,
        "worst_run": scale.worst_run,
        "share_inside": scale.share_inside,
        "equivalence": equivalence_numbers(scale.equivalence),
        "within": within,
    }


def equivalence_numbers(equivalence: Equivalence | None) -> Numbers | None:
    if equivalence is None:
        return None
    return vars(equivalence) | {"shown": equivalence.shown}


def lost_numbers(asked: float | None, lost: Lost) -> Numbers:
    return {"lost": {"asked": asked} | vars(lost)}


def location_numbers(location: Location) -> Numbers:
    until = None
    if location.until is not None:
        until = location.until.step
    return vars(location) | {"until": until}


def bias_numbers(bias: Bias) -> Numbers:
    by_axis = {axis: tuple(interval) for axis, interval in bias.by_axis.items()}
    numbers: Numbers = {"bias": by_axis, "bias_step": bias.step}
    if bias.inflation_without is not None:
        numbers["ratio_without_bias"] = tuple(bias.inflation_without)
        numbers["bias_axis"] = bias.axis
        numbers["bias_in_step"] = bias.size
    return numbers


def shape_numbers(shape: Shape) -> Numbers:
    a, b = shape.pair or (None, None)
    return {
        "shape": shape.matrix,
        "shape_step": shape.step,
        "correlation": [a, b, shape.actual, shape.stated],
        "correlation_wrong_sign": shape.wrong_sign,
    }


def tails_numbers(tails: Tails) -> Numbers:
    outlier = {"run": tails.run, "step": tails.step, "distance": tails.distance}
    return {"outlier": outlier, "pit": tails.pit, "pit_half_width": tails.half_width}


def innovations_numbers(innovations: Innovations) -> Numbers:
    numbers = {
        "nis_ratio": innovations.ratio,
        "nis_interval": list(innovations.interval),
        "nis_dof": innovations.dof,
        "nis_judged": innovations.judged,
        "autocorrelation": innovations.autocorrelation,
        "autocorrelation_bound": innovations.bound,
        "nis_equivalence": equivalence_numbers(innovations.equivalence),
    }
    if innovations.outliers is not None:
        numbers["nis_outliers"] = vars(innovations.outliers) | {"rest": innovations.outliers.rest.ratio}
    return numbers


def joint_numbers(joint: JointScore) -> Numbers:
    return {
        "joint_ratio": joint.both.value,
        "joint_ratio_interval": tuple(joint.both[1:]),
        "joint_pose": tuple(joint.pose),
        "joint_map": tuple(joint.map),
        "joint_runs": joint.runs,
        "joint_dof": joint.dof,
        "joint_chief": list(joint.chief),
        "joint_not_definite": list(joint.not_definite),
    }


def rejection_numbers(rejection: RejectionScore) -> Numbers:
    return {
        "rejected": rejection.rejected,
        "offered": rejection.offered,
        "spurious": rejection.spurious,
        "rejection_precision": tuple(rejection.precision),
        "rejection_recall": tuple(rejection.recall),
        "rejection_false_alarms": tuple(rejection.false_alarms),
    }


def ends_numbers(ends: EarlyEnds) -> Numbers:
    return {"early_ends": vars(ends) | {"lost": ends.lost}}


def skipped_numbers(skipped: Skipped) -> Numbers:
    return {"skip": skipped.skip.option, "skipped_steps": skipped.steps, "skipped_runs": skipped.empty}


def truth_numbers(truth: TruthShare) -> Numbers:
    return {
        "truth_share": truth.share,
        "truth_share_of_axes": dict(truth.by_axis),
        "truth_errors": truth.errors,
        "truth_shared": truth.shared,
    }


def bound_numbers(bounds: tuple[BoundScore, ...]) -> Numbers:
    scores = []
    for one in bounds:
        numbers = vars(one) | {"factor": one.factor.value, "factor_interval": tuple(one.factor[1:])}
        if one.alerts is not None:
            shares = dict(zip(REGIONS, one.alerts.shares, strict=True))
            numbers |= {"alerts": one.alerts._asdict() | {"shares": shares}}
        scores.append(numbers | {"equivalence": equivalence_numbers(one.equivalence)})
    return {"bounds": scores}


def group_numbers(by: ByGroup) -> Numbers:
    groups = [
        {
            "name": group.name,
            "status": group.status,
            "runs": group.runs,
            "steps": group.steps,
            "ratio": group.ratio.value,
            "ratio_interval": tuple(group.ratio[1:]),
            "p_value": group.p_value,
            "equivalence": equivalence_numbers(group.equivalence),
        }
        for group in by.groups
    ]
    return {"by": {"column": by.column, "groups": groups, "outcome": by.outcome, "without": by.without}}


def plain(value: Any) -> Any:
    """Verdicts as dictionaries, arrays as lists, not finite numbers as None: what JSON can hold."""
    if hasattr(value, "as_dictionary"):
        return plain(value.as_dictionary())
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
