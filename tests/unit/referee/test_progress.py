"""What is said of long work where standard error is no terminal."""

from __future__ import annotations

import io
import sys
import time

import pytest

from consistency.referee.system import progress as module
from consistency.referee.system.progress import each, foreseen, progress, quiet, say


def test_what_is_foreseen_to_take_long_is_said_at_once_and_once(capsys: pytest.CaptureFixture[str]) -> None:
    with quiet(), foreseen("compiling the kernel of ekf-uvd", 14.6):
        assert capsys.readouterr().err == "compiling the kernel of ekf-uvd: about 15 s, once\n"
    assert capsys.readouterr().err == ""
    with foreseen("compiling 40 kernels", 300.0):
        assert capsys.readouterr().err == "compiling 40 kernels: about 5 min, once\n"


def test_a_terminal_has_a_bar_by_the_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is full when the work is done, not when the seconds are over."""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    nearly, until = "━" * 39 + "\x1b[0m\x1b[91m╸", time.monotonic() + 20.0
    with foreseen("compiling", 0.01):
        while nearly not in bar(terminal) and time.monotonic() < until:
            time.sleep(0.01)
        time.sleep(0.1)
        assert nearly in bar(terminal)
    assert "━" * 40 in bar(terminal)
    assert "╸" not in bar(terminal)


def bar(terminal: Terminal) -> str:
    """What it shows now."""
    return terminal.getvalue().rpartition("compiling: about 1 s, once")[2]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_runs_are_said_when_some_are_done(capsys: pytest.CaptureFixture[str]) -> None:
    with progress("runs", 2) as advance:
        assert capsys.readouterr().err == ""
        advance(2)
        assert capsys.readouterr().err.startswith("runs: 2 of 2 runs")


def test_work_on_each_is_quiet_and_the_whole_is_not(capsys: pytest.CaptureFixture[str]) -> None:
    done = []
    for item in each("abc", 3, "worlds", "worlds"):
        say(f"inside {item}")
        with progress("runs", 1) as advance:
            advance(1)
        done.append(item)
    said = capsys.readouterr().err
    assert done == ["a", "b", "c"]
    assert "inside" not in said
    assert "runs: " not in said
    assert said.startswith("worlds: 3 of 3 worlds")
    say("outside")
    assert capsys.readouterr().err == "outside\n"


def test_an_item_that_breaks_leaves_nobody_quiet(capsys: pytest.CaptureFixture[str]) -> None:
    def breaks() -> None:
        for _ in each("abc", 3, "worlds", "worlds"):
            raise ValueError

    with pytest.raises(ValueError):  # noqa: PT011
        breaks()
    say("again")
    assert capsys.readouterr().err == "again\n"


def test_brief_work_is_said_when_it_takes_long(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with progress("report", 2, "parts", brief=True) as advance:
        advance(2)
    assert capsys.readouterr().err == ""
    clock = iter([0.0, 6.0, 7.0])
    monkeypatch.setattr(module.time, "monotonic", lambda: next(clock))
    with progress("report", 2, "parts", brief=True) as advance:
        advance(1)
        advance(1)
    assert [line.split(",")[0] for line in capsys.readouterr().err.splitlines()] == [
        "report: 1 of 2 parts", "report: 2 of 2 parts",
    ]  # fmt: skip
