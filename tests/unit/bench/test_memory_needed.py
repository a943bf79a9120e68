"""How many workers have memory for a run, and the refusal of a run whose covariance exceeds the machine's."""

import pytest

import consistency as cs
from consistency.bench.runs import workers as module
from consistency.bench.runs.isolation import Isolation
from consistency.bench.runs.run_outcome import Recorded, TrialWork
from consistency.bench.runs.workers import LocalThreads, memory_here, workers_that_fit
from consistency.referee.errors import InputError


@pytest.fixture
def has(monkeypatch):
    """Let the machine have so many bytes."""
    return lambda size: monkeypatch.setattr(module, "memory_here", lambda: int(size))


def covariance_bytes(trial):
    return 8 * (3 + 3 * len(set(trial.landmark.tolist()))) ** 2


def test_workers_that_have_room(linear, has, capsys):
    trial = cs.simulate(linear)
    run = 4 * covariance_bytes(trial)
    has(20 * run)
    assert workers_that_fit([trial], 8) == 8
    assert capsys.readouterr().err == ""
    has(3.5 * run)
    assert workers_that_fit([trial], 8) == 3
    assert "of 0.0 GiB; 3 of 8 workers have room" in capsys.readouterr().err
    has(run / 4)
    assert workers_that_fit([trial], 8) == 1
    has(run / 4 - 1)
    with pytest.raises(InputError, match=r"takes 0\.0 GiB, and there are 0\.0 GiB; take fewer landmarks"):
        workers_that_fit([trial], 8)


def test_all_runs_of_a_log_count(linear, has, monkeypatch):
    wide = linear.variant("wide", truth__sensor__range=(0.0, 50.0), truth__steps=5)
    small, large = cs.simulate(linear.variant("short", truth__steps=2)), cs.simulate(wide, 1)
    work = TrialWork(Recorded({0: small, 1: large}), Isolation([cs.get_filter("kf")], linear.belief))
    has(8 * covariance_bytes(large))
    local = LocalThreads(-1)
    local._workers = 8
    monkeypatch.setattr(TrialWork, "compile", lambda *_: None)
    local.prepare(work, 0)
    assert local._workers == 2
    has(covariance_bytes(large) - 1)
    with pytest.raises(InputError, match="fewer landmarks"):
        LocalThreads().prepare(work, 0)


def test_jobs_that_were_asked_for_are_not_made_fewer(linear, has, monkeypatch):
    monkeypatch.setattr(TrialWork, "compile", lambda *_: None)
    monkeypatch.setattr("joblib.cpu_count", lambda: 8)
    trial = cs.simulate(linear)
    has(10 * covariance_bytes(trial))
    for jobs, workers in ((-1, 2), (4, 4)):
        local = LocalThreads(jobs)
        local.prepare(TrialWork(Recorded({0: trial}), Isolation([cs.get_filter("kf")], linear.belief)), 0)
        assert local._workers == workers


def test_the_limit_of_a_container_counts(monkeypatch, tmp_path):
    limit = tmp_path / "memory.max"
    monkeypatch.setattr(module, "CONTAINER_LIMIT", limit)
    machine = memory_here()
    assert 0 < machine < 2**60
    limit.write_text("max\n")
    assert memory_here() == machine
    limit.write_text("3000\n")
    assert memory_here() == 3000
