"""The gates of a test session.

They share a false-alarm rate, and are judged together at the end. Standard library only, because the pytest plugin
loads this module with every session.
"""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from consistency.referee.defaults import DETECT, GATE_FALSE_ALARM, POWER
from consistency.referee.show import FORMATS

FIRST = 10  # gates of each test that may fail in place
# of a gate that is told nothing else; dof plans the runs of a test without the marker: a planar pose
DEFAULTS: dict[str, Any] = {
    "dof": 3, "detect": DETECT, "false_alarm": GATE_FALSE_ALARM, "power": POWER, "tolerance": None,
    "allow": None, "lost": None,
}  # fmt: skip
_watches: list[RunningTest] = []  # the running test is last; tests of a process run one after the other
PROPERTY = "consistency"  # of a test, one a gate: JSON without the statistics
STATISTICS = "consistency_statistics"  # attribute of its reports: of every gate, as JSON


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
    planned_detect: float | None = None  # that plans the runs, where ranks among members show less; None: ``detect``
    axis: str | None = None  # that decides the status; None where the whole does
    axis_ratio: list[float | None] = field(default_factory=list)
    first_step: int | None = None
    subset: str | None = None
    faults: list[str] = field(default_factory=list)
    distance: float | None = None  # of a comparison
    standard_error: float | None = None
    spread: dict[str, float] = field(default_factory=dict)  # what else plans the runs of a comparison
    lost: float | None = None  # share of lost runs that must not pass
    page: str = ""  # file of the page with pictures, of a gate that did not pass
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
    page: Callable[[], Path | None] = lambda: None  # a new file for the page of a gate, where pages are asked for


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
    from consistency.referee.diagnostics.verdict_parts import Settings

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
    from consistency.referee.diagnostics.number_words import with_subject

    first, *rest = reasons
    return "\n  - ".join([f"{gate}: {with_subject(name, first)}", *rest])


def plan_invocation(dof: int, terms: Terms, level: float | None = None) -> str:
    what = f"--dof {dof}" if level is None else f"--level {100.0 * level:.9g}%"
    text = (
        f"consistency plan {what} --detect {terms.detect!r} --false-alarm {terms.false_alarm!r} --power {terms.power!r}"
    )
    if terms.allow:
        text += f" --allow {terms.allow}"
    if terms.lost is not None:
        text += f" --lost {terms.lost!r}"
    return text


def undecided_text(
    gate: str, name: str, sentence: str, needed: int, dof: int, terms: Terms, level: float | None = None
) -> str:
    """Neither a fault nor that there is none: how many runs to simulate, and where the number comes from."""
    larger = "a larger detect"
    if terms.lost is not None:
        larger += " and a larger lost"
    return (
        f"{gate}: {name} is {sentence}. Simulate {needed} runs, which are enough however the steps depend "
        f"on each other ({plan_invocation(dof, terms, level)}), or ask for {larger}"
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


def to_property(entry: Entry) -> tuple[str, str]:
    """A pair for ``user_properties``: text, so that every reporter can carry it."""
    data = dict(vars(entry))
    for key in ("statistics", "test", "test_outcome"):
        del data[key]
    return PROPERTY, json.dumps(data, allow_nan=False)


@dataclass
class Tested:
    nodeid: str
    location: tuple[str, int | None, str]
    outcome: str = ""
    expected_to_fail: bool = False
    entries: list[Entry] = field(default_factory=list)


@dataclass
class Ledger:
    """Tests with gates, in the order in which they came; under xdist one test may run in several workers."""

    budget: float | None = None
    tests: dict[tuple[str, str], Tested] = field(default_factory=dict)
    rate: float | None = None  # of each gate on the budget, once :meth:`settle` has run

    def take(self, report: Any) -> None:
        """Remember what a pytest ``TestReport`` carries; the last report of a test carries all its gates."""
        properties = [json.loads(text) for key, text in report.user_properties if key == PROPERTY]
        key = (getattr(report, "worker_id", ""), report.nodeid)
        if not properties and key not in self.tests:
            return
        tested = self.tests.setdefault(key, Tested(report.nodeid, report.location))
        details: list[dict[str, Any]] = [{}] * len(properties)
        if statistics := getattr(report, STATISTICS, None):
            details = json.loads(statistics)
        tested.entries = []
        for data, more in zip(properties, details, strict=True):
            tested.entries.append(Entry(**data, statistics=more, test=report.nodeid))
        tested.expected_to_fail |= hasattr(report, "wasxfail")
        if report.when == "setup":  # also of a second try
            tested.outcome = ""
        if report.when == "call" or report.outcome == "failed":
            tested.outcome = report.outcome

    def entries(self) -> list[Entry]:
        """Entries of all tests, each with the outcome of its test."""
        entries = []
        for tested in self.tests.values():
            entries += [replace(entry, test_outcome=tested.outcome) for entry in tested.entries]
        return entries

    def settle(self) -> list[tuple[Tested, list[str]]]:
        """Judge the gates on the budget at their final rate: tests that fail only now, and what to say."""
        spent = [entry.in_place for entry in self.entries() if entry.in_budget]
        if self.budget is None or not spent:
            return []
        self.rate = final_rate(self.budget, spent)
        late = []
        for tested in self.tests.values():
            texts = []
            for i, entry in enumerate(tested.entries):
                if entry.in_budget:
                    tested.entries[i], text = settled(entry, self.rate, self.budget, len(spent))
                    if text:
                        texts.append(text)
            if texts and not tested.expected_to_fail:
                late.append((tested, texts))
                tested.outcome = "failed"
        return late

    def bound(self) -> float:
        """Largest probability that any gate fails its test by a false alarm; those that a test wants to fail cannot."""
        bound = sum(e.false_alarm for e in self.entries() if not e.in_budget and not wanted(e))
        if self.rate is not None:
            bound += self.budget or 0.0
        return min(1.0, bound)


def settled(entry: Entry, rate: float, budget: float, gates: int) -> tuple[Entry, str]:
    """The gate at its final rate, and what to say if it fails only now ('' otherwise)."""
    needed = needed_at(entry, rate)
    entry = replace(entry, false_alarm=rate, needed=needed)
    if entry.outcome != "passed":
        return entry, ""
    share = f"Judged at the end of the session: its budget of {budget:g} over {gates} gates is {rate:.3g} for each."
    if entry.p_value is not None and entry.p_value <= rate:
        entry = replace(entry, outcome="fault found", **entry.late)
        return entry, f"{fault_text(entry.gate, entry.name, entry.reasons)}\n{share}"
    if entry.standard_error is not None and entry.runs < needed:
        text = few_to_compare(
            entry.gate, entry.name, entry.runs, needed, Terms(rate, entry.detect, entry.power, entry.allow)
        )
        return replace(entry, outcome="too few runs"), f"{text}\n{share}"
    return entry, ""


def needed_at(entry: Entry, rate: float) -> int:
    """Runs that a gate asks for at a false-alarm rate."""
    from consistency.referee.diagnostics.comparison import Comparison
    from consistency.referee.diagnostics.number_of_runs import gate_runs

    if not entry.dof:  # of bounds, whose number does not depend on the rate
        return entry.needed
    if entry.standard_error is None:
        detect = entry.planned_detect or entry.detect
        return gate_runs(entry.dof, detect, rate / entry.parts, entry.power, entry.allow, entry.lost)
    comparison = Comparison(entry.runs, True, (), 0.0, entry.standard_error, 1.0, rate, **entry.spread)
    return comparison.needed_runs(entry.planned_detect or entry.detect, entry.power)


def ending(ledger: Ledger) -> str:
    """How many gates, and the probability that any of them fails a test without a fault."""
    entries = ledger.entries()
    failed_as_expected = sum(wanted(e) for e in entries)
    failed = sum(e.outcome != "passed" for e in entries) - failed_as_expected
    noun = "gates"
    if len(entries) == 1:
        noun = "gate"
    text = f"{len(entries)} {noun}, {failed} failed"
    if failed_as_expected:
        text += f", {failed_as_expected} failed as expected"
    text += f"; probability that any fails without a fault at most {ledger.bound():.3g}"
    if ledger.rate is not None:
        text += f" (budget {ledger.budget:g}: {ledger.rate:.3g} for a gate)"
    return text


def outcome_text(e: Entry) -> str:
    """Also whether the test wanted the gate to fail."""
    if wanted(e):
        return f"{e.outcome} (expected)"
    return e.outcome


def wanted(e: Entry) -> bool:
    """The gate did not pass, and its test did."""
    return e.outcome != "passed" and e.test_outcome == "passed"


def is_shown(e: Entry) -> bool:
    """Whether the page of a gate is kept: it did not pass, and its test did not want that."""
    return bool(e.page) and e.outcome != "passed" and not wanted(e)


def pages_fault(folder: Path) -> str:
    """Why pages cannot be written to a folder, which is made if it is missing; '' if they can."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        return f"--consistency-pages {folder}: cannot be written ({error.strerror}); name another folder"
    return ""


def path_fault(path: Path) -> str:
    """Why a report cannot be written there, and what to do; '' if it can."""
    if path.suffix.lower() not in FORMATS:
        return f"--consistency-report {path}: must end in {' or '.join(FORMATS)}"
    if path.is_dir():
        return f"--consistency-report {path}: is a folder; name a file in it, or --consistency-pages {path}"
    if not path.parent.is_dir():
        return f"--consistency-report {path}: the folder {path.parent} does not exist; make it first"
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
        if path.exists() and not os.access(path, os.W_OK):
            raise PermissionError(13, "Permission denied")
    except OSError as error:
        return f"--consistency-report {path}: cannot be written ({error.strerror}); name another file"
    return ""
