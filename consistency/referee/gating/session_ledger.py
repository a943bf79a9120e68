"""The gates of a whole test session: collected from reports, judged together, failed late where the budget says so."""

from __future__ import annotations

import json
import os
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from consistency.referee.gating.gate_terms import Entry, Terms, fault_text, few_to_compare, final_rate
from consistency.referee.show import FORMATS

PROPERTY = "consistency"  # of a test, one a gate: JSON without the statistics
STATISTICS = "consistency_statistics"  # attribute of its reports: of every gate, as JSON


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
    from consistency.referee.diagnostics.statistics.number_of_runs import gate_runs

    if entry.standard_error is None:
        return gate_runs(entry.dof, entry.detect, rate / entry.parts, entry.power, entry.allow, entry.lost)
    comparison = Comparison(entry.runs, True, (), 0.0, entry.standard_error, 1.0, rate, **entry.spread)
    return comparison.needed_runs(entry.detect, entry.power)


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


def path_fault(path: Path) -> str:
    """Why a report cannot be written there, and what to do; '' if it can."""
    if path.suffix.lower() not in FORMATS:
        return f"--consistency-report {path}: must end in {' or '.join(FORMATS)}"
    if path.is_dir():
        return f"--consistency-report {path}: is a folder; name a file in it"
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
