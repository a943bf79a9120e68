"""What a gate and the test session around it tell each other, the false-alarm rate that they share, and messages.

Standard library only, so that a plugin loads fast.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from consistency.referee.defaults import DETECT, GATE_FALSE_ALARM, POWER

FIRST = 10  # gates of each test that may fail in place


def in_place_rate(budget: float, tests: int, before: int = 0) -> float:
    """False-alarm rate at which the gate after ``before`` others of its test fails without waiting for the end.

    The first 10 gates of each of ``tests`` collected tests share half of the budget; later ones wait (0).
    """
    if before >= FIRST:
        return 0.0
    return 0.5 * budget / (FIRST * max(tests, 1))


def final_rate(budget: float, in_place: Sequence[float]) -> float:
    """False-alarm rate r of every gate, known when all have run: the sum of max(in_place, r) is the budget.

    With up to 20 gates a test this is budget / number of gates (Bonferroni). Where more ran, the gates that
    could fail in place have had their larger share, and the others split what is left: half the budget at least.

    Parameters
    ----------
    in_place : rate of each gate of :func:`in_place_rate`
    """
    rate = budget / max(len(in_place), 1)
    larger = [each for each in in_place if each > rate]
    if not larger:
        return rate
    return (budget - sum(larger)) / (len(in_place) - len(larger))


# of a gate that is told nothing else; dof plans the runs of a test without the marker: a planar pose
DEFAULTS: dict[str, Any] = {
    "dof": 3, "detect": DETECT, "false_alarm": GATE_FALSE_ALARM, "power": POWER, "tolerance": None,
    "allow": None, "lost": None,
}  # fmt: skip


@dataclass(frozen=True)
class Entry:
    """What one gate found, in words and numbers that JSON holds; not finite numbers are None."""

    gate: str  # assert_consistent | assert_not_worse
    name: str  # of the filter
    outcome: str  # passed | fault found | too few runs
    status: str  # of the verdict; better or worse of a comparison
    p_value: float | None  # false-alarm rate at which a fault is just found
    false_alarm: float  # rate that the gate was judged at
    in_budget: bool  # the rate is provisional: the session decides at its end
    in_place: float  # rate at which a gate of a budget may fail at once; 0 if it must wait
    runs: int
    needed: int
    dof: int
    detect: float
    power: float
    allow: str | None
    reasons: list[str]  # the first is a sentence
    statistic: float | None = None
    threshold: list[float | None] = field(default_factory=list)
    inflation: float | None = None
    inflation_interval: list[float | None] = field(default_factory=list)
    parts: int = 1  # that share the false-alarm rate: components whose cross terms are not stated
    axis: str | None = None  # that decides the status; None where the whole does
    axis_ratio: list[float | None] = field(default_factory=list)
    first_step: int | None = None
    subset: str | None = None
    faults: list[str] = field(default_factory=list)
    distance: float | None = None  # of a comparison
    standard_error: float | None = None
    spread: dict[str, float] = field(default_factory=dict)  # what else plans the runs of a comparison
    lost: float | None = None  # share of lost runs that must not pass
    late: dict[str, Any] = field(default_factory=dict)  # what changes here if the end of the session finds the fault
    statistics: dict[str, Any] = field(default_factory=dict)  # all of the verdict
    test: str = ""
    test_outcome: str = ""


@dataclass(frozen=True)
class Terms:
    """Settings of a gate, from arguments, marker, budget and defaults."""

    false_alarm: float
    detect: float
    power: float
    allow: str | None
    tolerance: float | None = None
    budget: float | None = None  # of the whole session; ``false_alarm`` is then provisional
    may_fail: bool = True  # in place
    lost: float | None = None  # share of lost runs that must be excluded

    @property
    def planned(self) -> float:
        """Largest false-alarm rate that this gate can end with."""
        if self.budget is None:
            return self.false_alarm
        return self.budget


@dataclass
class RunningTest:
    """One running test: what its gates are told, and where their entries go."""

    marked: Mapping[str, Any] = field(default_factory=dict)  # of the marker, only what was said
    budget: float | None = None
    tests: int = 1  # collected
    plan: Callable[[int], int] | None = None  # runs that the fixture would give by dimension of the error; None unasked
    budgeted: int = 0  # gates of this test that ran on the budget
    keep: Callable[[Entry], None] = lambda entry: None


_watches: list[RunningTest] = []  # the running test is last; tests of a process run one after the other


def current() -> RunningTest:
    """The watch of the running test; outside a session one that tells nothing."""
    if not _watches:
        return RunningTest()
    return _watches[-1]


@contextlib.contextmanager
def watching(watch: RunningTest) -> Iterator[None]:
    """Make ``watch`` the current one."""
    _watches.append(watch)
    try:
        yield
    finally:
        _watches.remove(watch)


def terms(
    false_alarm: float | None,
    detect: float | None,
    power: float | None,
    allow: str | None,
    tolerance: float | None = None,
    lost: float | None = None,
) -> Terms:
    """Arguments first, then the marker of the running test, then the session's budget, then the defaults.

    Raises
    ------
    ValueError
        An argument out of its range.
    """
    from consistency.referee.diagnostics.verdict.answers import Settings

    watch = current()
    given: dict[str, Any] = {
        "false_alarm": false_alarm, "detect": detect, "power": power, "allow": allow, "tolerance": tolerance,
        "lost": lost,
    }  # fmt: skip
    choices: dict[str, Any] = dict(watch.marked) | {key: value for key, value in given.items() if value is not None}
    options = DEFAULTS | choices
    Settings(**{key: options[key] for key in given})  # refuses what is out of range
    if options["allow"] == "conservative" and options["detect"] < 1.0:
        raise ValueError(f"detect {options['detect']} is a covariance too large, which allow='conservative' accepts")
    rest = float(options["detect"]), float(options["power"]), options["allow"], options["tolerance"]
    if watch.budget is None or "false_alarm" in choices:
        return Terms(float(options["false_alarm"]), *rest, lost=options["lost"])
    rate = in_place_rate(watch.budget, watch.tests, watch.budgeted)
    watch.budgeted += 1
    provisional = rate or in_place_rate(watch.budget, watch.tests)
    return Terms(provisional, *rest, budget=watch.budget, may_fail=rate > 0, lost=options["lost"])


def fault_text(gate: str, name: str, reasons: Sequence[str]) -> str:
    from consistency.referee.diagnostics.words.numbers import with_subject

    first, *rest = reasons
    return "\n  - ".join([f"{gate}: {with_subject(name, first)}", *rest])


def plan_invocation(dof: int, terms: Terms) -> str:
    text = (
        f"consistency plan --dof {dof} --detect {terms.detect!r} --false-alarm {terms.false_alarm!r} "
        f"--power {terms.power!r}"
    )
    if terms.allow:
        text += f" --allow {terms.allow}"
    if terms.lost is not None:
        text += f" --lost {terms.lost!r}"
    return text


def undecided_text(gate: str, name: str, sentence: str, needed: int, dof: int, terms: Terms) -> str:
    """Neither a fault nor that there is none: how many runs to simulate, and where the number comes from."""
    larger = "a larger detect"
    if terms.lost is not None:
        larger += " and a larger lost"
    return (
        f"{gate}: {name} is {sentence}. Simulate {needed} runs, or ask for {larger}; the number that is enough "
        f"however the steps depend on each other: {plan_invocation(dof, terms)}"
    )


def few_to_compare(gate: str, name: str, runs: int, needed: int, terms: Terms) -> str:
    """How many runs a comparison lacks, and for what."""
    few = "runs are"
    if runs == 1:
        few = "run is"
    return (
        f"{gate}: {name} is not found worse, but {runs} {few} too few to pass: "
        f"{needed} find a covariance ratio farther from 1 by x{terms.detect:g} with power {terms.power:g} "
        f"at a false-alarm rate of {terms.false_alarm:.3g}, at the spread between these runs. Simulate more "
        "runs, or ask for a larger detect."
    )
