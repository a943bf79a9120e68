"""How much memory a trial takes, how much there is, and what is done where the one exceeds the other."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

import consistency as cs
from consistency.errors import InputError
from consistency.filters.compiled import Compiled
from consistency.filters.kernel.loop import _make_memory
from consistency.runs import footprint as module
from consistency.runs.backends.local import Local
from consistency.runs.footprint import footprint, memory_here, trial_bytes, workers_that_fit
from consistency.runs.isolating import Isolation
from consistency.runs.work import Recorded, Work

GIB = 2**30


def compiled(name: str) -> Compiled:
    filter_ = cs.get_filter(name)
    assert isinstance(filter_, Compiled)
    return filter_


@pytest.fixture
def has(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Let the machine have so many bytes."""
    return lambda size: monkeypatch.setattr(module, "memory_here", lambda: int(size))


def test_the_covariance_counts_as_the_kernel_makes_it(linear: cs.Scenario) -> None:
    filter_, trial = compiled("kf"), cs.simulate(linear)
    _, _, size = filter_._arguments(trial, linear.belief)
    seen = len(set(trial.landmark))
    assert size == 3 + 3 * seen
    memory = _make_memory(size, trial.n_landmarks)
    whole = footprint(filter_, trial, linear.belief)
    assert whole.joint == 8 * (3 + 3 * seen) ** 2
    assert whole.scoring == 3 * whole.joint, "a copy, the factor and LAPACK's copy"
    assert whole.working > memory.P.nbytes + whole.joint


def test_it_grows_by_the_square_of_the_landmarks(linear: cs.Scenario) -> None:
    def bytes_of(count: int) -> int:
        changes = {"truth__landmarks__count": count, "truth__sensor__range": (0.0, 50.0), "truth__steps": 2}
        world = linear.variant("many", **changes)
        return trial_bytes([compiled("kf")], cs.simulate(world), world.belief)

    few, many = bytes_of(200), bytes_of(800)
    assert 12.0 < many / few < 24.0  # four times as many, of which the camera sees not quite so many


def test_maps_of_filters_before_are_held(linear: cs.Scenario) -> None:
    trial, filter_ = cs.simulate(linear), compiled("kf")
    one = footprint(filter_, trial, linear.belief)
    two = trial_bytes([filter_, filter_], trial, linear.belief)
    arrays = trial_bytes([], trial, linear.belief)
    assert two == arrays + max(2 * one.joint + one.scoring, one.joint + one.working)


def test_workers_that_have_room(
    linear: cs.Scenario, has: Callable[[float], None], capsys: pytest.CaptureFixture[str]
) -> None:
    trial, filters = cs.simulate(linear), [compiled("kf")]
    needed = trial_bytes(filters, trial, linear.belief)
    has(20 * needed)
    assert workers_that_fit(filters, [trial], linear.belief, 8) == 8
    assert capsys.readouterr().err == ""
    has(3.5 * needed)
    assert workers_that_fit(filters, [trial], linear.belief, 8) == 3
    assert "takes about 0.0 GiB of 0.0 GiB; 3 of 8 workers have room" in capsys.readouterr().err
    has(needed)
    assert workers_that_fit(filters, [trial], linear.belief, 8) == 1
    has(needed - 1)
    with pytest.raises(InputError, match=r"about 0\.0 GiB, and there are 0\.0 GiB; take fewer landmarks or steps"):
        workers_that_fit(filters, [trial], linear.belief, 8)


def test_all_runs_of_a_log_are_looked_at(linear: cs.Scenario, has: Callable[[float], None]) -> None:
    filters = [compiled("kf")]
    wide = linear.variant("wide", truth__sensor__range=(0.0, 50.0), truth__steps=5)
    small, large = cs.simulate(linear.variant("short", truth__steps=2)), cs.simulate(wide, 1)
    work = Work(Recorded({0: small, 1: large}), Isolation(filters, linear.belief))
    has(2 * trial_bytes(filters, large, linear.belief))
    assert work.room_for(0, 8) == 2
    has(trial_bytes(filters, small, linear.belief))
    with pytest.raises(InputError, match="fewer landmarks"):
        Local().prepare(work, 0)


def test_jobs_that_were_asked_for_are_not_made_fewer(
    linear: cs.Scenario, has: Callable[[float], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Work, "compile", lambda *_: None)
    monkeypatch.setattr("consistency.runs.backends.local.joblib.cpu_count", lambda: 8)
    trial, filters = cs.simulate(linear), [compiled("kf")]
    has(2.5 * trial_bytes(filters, trial, linear.belief))
    for jobs, workers in ((-1, 2), (4, 4)):
        local = Local(jobs)
        local.prepare(Work(Recorded({0: trial}), Isolation(filters, linear.belief)), 0)
        assert local._room == workers


def test_limits_of_control_groups(tmp_path: Path) -> None:
    groups, proc = tmp_path / "groups", tmp_path / "cgroup"
    (groups / "a" / "b").mkdir(parents=True)
    (groups / "a" / "memory.max").write_text("3000\n")
    (groups / "a" / "b" / "memory.max").write_text("max\n")
    proc.write_text("0::/a/b\n")
    assert module._of_groups(proc, groups) == [3000]
    (groups / "memory" / "c").mkdir(parents=True)
    (groups / "memory" / "c" / "memory.limit_in_bytes").write_text("2000\n")
    (groups / "memory" / "memory.limit_in_bytes").write_text("9000\n")
    proc.write_text("5:cpu:/c\n4:memory:/c\n")
    assert module._of_groups(proc, groups) == [2000, 9000]
    assert module._of_groups(tmp_path / "none", groups) == []


def test_ulimit_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    resource = pytest.importorskip("resource")
    assert 0 < memory_here() < 2**60
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (GIB // 8, -1) if kind == resource.RLIMIT_AS else (-1, -1))
    assert memory_here() == GIB // 8
