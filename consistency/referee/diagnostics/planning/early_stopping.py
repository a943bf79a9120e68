"""Sequential verdicts on runs as they finish, with error rates that hold at any stopping time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import takewhile

from consistency.referee.defaults import DETECT, FALSE_ALARM, POWER
from consistency.referee.diagnostics.statistics.e_process import e_process, ever
from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.questions.sample import sample_of
from consistency.referee.diagnostics.verdict.answers import MAIN, SHARES
from consistency.referee.diagnostics.verdict.parts import Settings, Verdict
from consistency.referee.diagnostics.judging.decide import Look, judge_alone

FIRST = 12  # runs at the first look; with fewer hardly anything but a failed run would be found
PARTS = 4  # times that the scale is looked at from one look to the next


@dataclass(frozen=True)
class Design:
    """Plan of looks, with the share of the false-alarm rate of each.

    The scale is tested by an e-process, which is valid at any time. All other questions are asked at looks after 12,
    24, 48, ... runs; look j = 0, 1, ... has the share 1 / ((j + 1) (j + 2)) of their false-alarm rate. The shares add
    to 1 at most, however many looks there are (Bonferroni).
    """

    dof: int
    detect: float = DETECT
    false_alarm: float = FALSE_ALARM  # of all looks together
    power: float = POWER
    max_runs: int | None = None  # what is open then is undecided
    lost: float | None = None  # see :class:`Settings`

    def __post_init__(self) -> None:
        if self.max_runs is not None and self.max_runs < 1:
            raise ValueError(f"max_runs must be at least 1, got {self.max_runs}")
        if self.dof < 1:
            raise ValueError(f"dof must be at least 1, got {self.dof}")
        _ = self.settings

    @property
    def settings(self) -> Settings:
        """Settings of each look."""
        return Settings(self.false_alarm, self.detect, self.power, lost=self.lost)

    def inspections(self) -> Iterator[tuple[int, float | None]]:
        """Numbers of runs at which to look, and the share of each look; None where only the scale is tested."""
        runs, j, last = FIRST, 0, self.max_runs
        while True:
            spent = 1.0 / ((j + 1) * (j + 2))
            if last is not None and runs >= last:
                yield last, spent
                return
            yield runs, spent
            for part in range(1, PARTS):
                between = runs + runs * part // PARTS
                if last is not None and between >= last:
                    break
                yield between, None
            runs, j = 2 * runs, j + 1


def look(design: Design, evidence: Record, spent: float | None) -> Verdict:
    """The verdict at one inspection: `undecided` means that the runs go on.

    A filter without truth is judged by its innovations, at looks only.
    """
    verdict = judge_alone(evidence, design.settings, Look(spent, _scale(design, evidence)))
    if spent is None and verdict.consistent:
        text = "undecided: no fault found in the scale; the other questions are asked at the next look"
        return replace(verdict, status="undecided", reasons=(text, *verdict.reasons[1:]))
    return verdict


def speaks(design: Design, evidence: Record, spent: float | None) -> bool:
    """Whether this inspection can decide. Between looks only a fault of the scale does."""
    return spent is not None or _scale(design, evidence) <= SHARES[MAIN] * design.false_alarm


def _scale(design: Design, evidence: Record) -> float:
    """p value of the scale, valid at any time; 1 without truth."""
    sample = sample_of(evidence, design.settings)
    return 1.0 if sample is None else ever(e_process(sample.means(), sample.dof).both)


def follow(design: Design, evidence_of: Callable[[int], Record], limit: int | None = None) -> tuple[Verdict, int]:
    """Inspect runs until decided; return the verdict and the number of runs used.

    Parameters
    ----------
    evidence_of : function that returns the first k runs of a filter
    limit : number of available runs; the last inspection within it decides, or all runs if they are fewer than 12
    """
    inspections = list(takewhile(lambda each: each[0] <= limit, design.inspections())) if limit is not None else None
    if inspections == []:
        inspections = [(limit or 0, next(design.inspections())[1])]
    for runs, spent in inspections if inspections is not None else design.inspections():
        evidence = evidence_of(runs)
        last = runs == design.max_runs or (inspections is not None and (runs, spent) == inspections[-1])
        if last or speaks(design, evidence, spent):
            verdict = look(design, evidence, spent)
            if last or verdict.status != "undecided":
                return verdict, runs
    raise AssertionError("unreachable: a design without a last look is endless")


def sequential_design(
    dof: int,
    detect: float = DETECT,
    false_alarm: float = FALSE_ALARM,
    power: float = POWER,
    max_runs: int | None = None,
    lost: float | None = None,
) -> Design:
    """A :class:`Design`.

    Raises
    ------
    ValueError
        A value out of its range.
    """
    return Design(dof, detect, false_alarm, power, max_runs, lost)
