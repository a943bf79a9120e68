"""The pytest plugin: runs to simulate, a record of every gate, and one false-alarm rate for a whole session.

Nothing heavy is imported here: a session without gates pays for this file alone. It works with pytest 6.2, that of
Ubuntu 22.04: without the stash of 7.0, and with wrappers of hooks in their older form.
"""

from __future__ import annotations

import json
import re
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
from _pytest.reports import TestReport  # public under the name of pytest from 7.0 on

from consistency.referee.gating.session import (
    DEFAULTS,
    PROPERTY,
    STATISTICS,
    Entry,
    Ledger,
    RunningTest,
    current,
    in_place_rate,
    is_shown,
    pages_fault,
    path_fault,
    to_property,
    watching,
)

NAME = "consistency-gates"
MARKER = (
    "consistency(dof=3, detect=1.5, false_alarm=0.001, power=0.95, tolerance=None, allow=None, lost=None): "
    "what the gates of a test ask; plans the number of runs that the fixture consistency_runs gives"
)


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("consistency", "statistical gates of estimators")
    group.addoption(
        "--consistency-runs", type=int, metavar="N", help="runs to simulate, in place of the number planned for a test"
    )
    group.addoption("--consistency-report", metavar="FILE", help="write all gates to FILE: .json, .html, .xml, .md")
    group.addoption("--consistency-pages", metavar="FOLDER", help="write a page of every gate that fails to FOLDER")
    rate = "false-alarm rate of the whole session, split over the gates that state none of their own"
    group.addoption("--consistency-false-alarm", type=float, metavar="RATE", help=rate)
    parser.addini("consistency_false_alarm", rate)


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", MARKER)
    runs = config.getoption("--consistency-runs")
    if runs is not None and runs < 1:
        raise pytest.UsageError(f"--consistency-runs must be at least 1, got {runs}")
    report = config.getoption("--consistency-report")
    path = None if report is None else config.invocation_params.dir / report
    worker = hasattr(config, "workerinput")
    if path is not None and not worker and (why := path_fault(path)):
        raise pytest.UsageError(why)
    pages = config.getoption("--consistency-pages")
    folder = None if pages is None else config.invocation_params.dir / pages
    if folder is not None and not worker and (why := pages_fault(folder)):
        raise pytest.UsageError(why)
    config.pluginmanager.register(Gates(config, runs, path, folder, _budget(config), worker), NAME)


def _budget(config: pytest.Config) -> float | None:
    given, source = config.getoption("--consistency-false-alarm"), "--consistency-false-alarm"
    if given is None:
        given, source = config.getini("consistency_false_alarm") or None, "ini option consistency_false_alarm"
    try:
        budget = None if given is None else float(given)
    except ValueError:
        raise pytest.UsageError(f"{source} must be a number, got '{given}'") from None
    if budget is not None and not 0.0 < budget < 1.0:
        raise pytest.UsageError(f"{source} must lie between 0 and 1, got {budget}")
    return budget


@pytest.fixture
def consistency_runs(request: pytest.FixtureRequest) -> int:
    """Number of runs that this test should simulate for its gates.

    What --consistency-runs says; otherwise what ``consistency plan`` says for the values of the test's marker.
    """
    gates = request.config.pluginmanager.get_plugin(NAME)
    assert isinstance(gates, Gates)
    if gates.runs is None and "dof" not in marked(request.node)[0]:
        current().plan = lambda dof: gates.runs_of(request.node, dof)
    return gates.runs_of(request.node)


def marked(item: pytest.Item) -> tuple[dict[str, Any], str]:
    """Values of the test's markers, of which the nearest counts, and what is wrong with them ('' if nothing)."""
    options: dict[str, Any] = {}
    for mark in reversed(list(item.iter_markers("consistency"))):
        unknown = [*map(repr, mark.args), *(key for key in mark.kwargs if key not in DEFAULTS)]
        if unknown:
            return {}, f"marker consistency: takes {', '.join(DEFAULTS)} as keywords, got {', '.join(unknown)}"
        options |= mark.kwargs
    return options, ""


class Gates:
    """The hooks of one session; in an xdist worker those of its tests, in the controller those of the session."""

    def __init__(
        self, config: pytest.Config, runs: int | None, path: Path | None, folder: Path | None, budget: float | None,
        worker: bool,
    ) -> None:  # fmt: skip
        self.config, self.runs, self.path, self.folder, self.worker = config, runs, path, folder, worker
        self.budget = budget
        self.collected = 1
        self.ledger = Ledger(budget)
        self.statistics: list[Any] = []  # of the gates of the running test, where the report wants them

    # --- a test ---

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        self.collected = max(1, len(session.items))

    def runs_of(self, item: pytest.Item, dof: int | None = None) -> int:
        """Runs given on the command line, or planned for the marker of a test, or as if it had ``dof``."""
        from consistency.referee.diagnostics.number_of_runs import gate_runs

        if self.runs is not None:
            return self.runs
        options, _ = marked(item)
        terms = DEFAULTS | options | ({} if dof is None else {"dof": dof})
        if self.budget is not None and "false_alarm" not in options:  # enough whatever else will run
            terms["false_alarm"] = in_place_rate(self.budget, self.collected)
        return gate_runs(**{key: value for key, value in terms.items() if key != "tolerance"})

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, Any, None]:
        with watching(
            RunningTest(
                budget=self.budget, tests=self.collected, keep=lambda entry: self._keep(item, entry),
                page=lambda: self._page(item),
            )
        ):  # fmt: skip
            yield

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        watch, self.statistics = current(), []
        watch.budgeted = 0
        item.user_properties[:] = [pair for pair in item.user_properties if pair[0] != PROPERTY]  # of an earlier try
        watch.marked, why = marked(item)
        if why:
            pytest.fail(why, pytrace=False)

    def _page(self, item: pytest.Item) -> Path | None:
        """File for the page of the next gate of a test, named after both."""
        if self.folder is None:
            return None
        gate = sum(key == PROPERTY for key, _ in item.user_properties) + 1
        return self.folder / f"{re.sub(r'[^A-Za-z0-9._]+', '-', item.nodeid)[-150:]}-{gate}.html"

    def _keep(self, item: pytest.Item, entry: Entry) -> None:
        item.user_properties.append(to_property(entry))
        if self.path is not None and self.path.suffix.lower() == ".json":
            from consistency.referee.diagnostics.verdict import plain

            self.statistics.append(plain(entry.statistics))

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_makereport(self) -> Generator[None, Any, None]:
        made = yield
        if self.statistics:
            setattr(made.get_result(), STATISTICS, json.dumps(self.statistics, allow_nan=False))

    # --- the session ---

    def pytest_report_header(self) -> str | None:
        return None if self.budget is None else f"consistency: false-alarm budget {self.budget:g} for the session"

    def pytest_runtest_logreport(self, report: TestReport) -> None:
        if not self.worker and not hasattr(report, LATE):
            self.ledger.take(report)

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if self.worker:
            return
        for tested, texts in self.ledger.settle():
            self._fail(tested.nodeid, tested.location, "\n\n".join(texts))
            if session.exitstatus == pytest.ExitCode.OK:
                session.exitstatus = pytest.ExitCode.TESTS_FAILED
        for entry in self.ledger.entries():
            if entry.page and not is_shown(entry):
                Path(entry.page).unlink(missing_ok=True)
        if self.path is not None and not self.config.option.collectonly:
            from consistency.referee.gating.gate_results import write_gates

            write_gates(self.ledger, self.path)

    def _fail(self, nodeid: str, location: tuple[str, int | None, str], text: str) -> None:
        """Report a test as failed that has passed before its gates could be judged."""
        terminal = self.config.pluginmanager.get_plugin("terminalreporter")
        if terminal is not None:  # one outcome a test
            terminal.stats["passed"] = [r for r in terminal.stats.get("passed", []) if r.nodeid != nodeid]
        report = TestReport(nodeid, location, {}, "failed", text, "call")
        setattr(report, LATE, True)
        self.config.hook.pytest_runtest_logreport(report=report)

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        if self.ledger.tests:
            from consistency.referee.gating.gate_results import gate_lines

            terminalreporter.section("consistency gates")
            for line in gate_lines(self.ledger):
                terminalreporter.write_line(line)
            for entry in filter(is_shown, self.ledger.entries()):
                terminalreporter.write_line(f"page of {entry.test}: {entry.page}")
            if self.path is not None:
                terminalreporter.write_line(f"report in {self.path}")


LATE = "consistency_late"
