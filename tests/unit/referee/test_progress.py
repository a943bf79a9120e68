"""What is said of long work where standard error is no terminal."""

import pytest

from consistency.referee import system as module
from consistency.referee.system import announce, each, progress, quiet, say, with_progress


def test_what_is_announced_is_said_where_all_else_is_quiet(capsys):
    with quiet():
        say("one of many")
        announce("compiling the kernel of ekf-uvd")
    assert capsys.readouterr().err == "compiling the kernel of ekf-uvd\n"


def test_runs_are_said_when_some_are_done(capsys):
    with progress("runs", 2) as advance:
        assert capsys.readouterr().err == ""
        advance(2)
        assert capsys.readouterr().err.startswith("runs: 2 of 2 runs")


def test_work_on_each_is_quiet_and_the_whole_is_not(capsys):
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


def test_an_item_that_breaks_leaves_nobody_quiet(capsys):
    def breaks():
        for _ in each("abc", 3, "worlds", "worlds"):
            raise ValueError

    with pytest.raises(ValueError):  # noqa: PT011
        breaks()
    say("again")
    assert capsys.readouterr().err == "again\n"


def test_several_items_are_counted_and_one_is_not(capsys, monkeypatch):
    clock = iter([0.0, 4.0, 5.0])
    monkeypatch.setattr(module.time, "monotonic", lambda: next(clock))
    assert list(with_progress("ab", "reading", "bags")) == ["a", "b"]
    assert [line.split(",")[0] for line in capsys.readouterr().err.splitlines()] == [
        "reading: 1 of 2 bags", "reading: 2 of 2 bags",
    ]  # fmt: skip
    assert list(with_progress("a", "reading", "bags")) == ["a"]  # no clock is read


def test_brief_work_is_said_when_it_takes_long(capsys, monkeypatch):
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
