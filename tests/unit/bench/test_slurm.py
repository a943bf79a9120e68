"""Runs in jobs of Slurm, here processes of this machine by the local executor of submitit."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import pytest
from misbehaving import Deadly, is_gone

import consistency as cs
from consistency.bench.runs.backends import slurm
from consistency.bench.runs.backends.local import LocalThreads
from consistency.bench.runs.backends.slurm import Slurm, options_of
from consistency.bench.runs.isolation.filter_process import Isolation
from consistency.bench.runs.montecarlo import run_trials
from consistency.bench.runs.trial_work import Outcomes, Simulated, TrialWork

pytestmark = [
    pytest.mark.skipif(os.name == "nt", reason="signals"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),  # processes that submitit leaves to the collector
]
RUNS = 12
LOCAL = {"cluster": "local", "time": 10}


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slurm, "GLANCE", 0.2)


def same(outcomes: Outcomes, expected: Outcomes, but: Sequence[int] = ()) -> None:
    """Bit by bit, whatever the order."""
    by_run, expected_by_run = ({outcome.run: outcome for outcome in each} for each in (outcomes, expected))
    assert sorted(by_run) == sorted(expected_by_run)
    for run in sorted(set(by_run) - set(but)):
        assert not by_run[run].failures
        for column, values in by_run[run].estimates["kf"].items():
            assert values.tobytes() == expected_by_run[run].estimates["kf"][column].tobytes()
    for run in but:
        assert [failure.reason[:12] for failure in by_run[run].failures] == ["its job died"]


def test_the_bytes_are_those_of_local_runs(linear: cs.Scenario, tmp_path: Path) -> None:
    local = run_trials(linear, ["kf"], RUNS, jobs=1, out=tmp_path / "local")
    backend = Slurm(tmp_path / "jobs", LOCAL, jobs=2)
    jobs = run_trials(linear, ["kf"], RUNS, out=tmp_path / "slurm", backend=backend)
    for path in local.folder.glob("*.parquet"):
        assert path.read_bytes() == (jobs.folder / path.name).read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["local", "slurm"]


@pytest.mark.slow
def test_a_job_that_dies_once_is_done_again(
    linear: cs.Scenario, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trials, isolation = Simulated(linear, 0), Isolation([cs.get_filter("kf")], linear.belief)
    fuse = tmp_path / "fuse"
    fuse.touch()
    work = TrialWork(Deadly(trials, (4,), os.getpid(), str(fuse)), isolation)
    outcomes = Slurm(tmp_path / "jobs", LOCAL, 1).outcomes(work, range(RUNS))
    same(outcomes, LocalThreads(1).outcomes(TrialWork(trials, isolation), range(RUNS)))
    assert f"consistency: 1 jobs died; their logs are in {tmp_path / 'jobs'}\n" == capsys.readouterr().err


@pytest.mark.slow
def test_a_run_that_kills_its_job_has_failed(linear: cs.Scenario, tmp_path: Path) -> None:
    trials, isolation = Simulated(linear, 0), Isolation([cs.get_filter("kf")], linear.belief)
    work = TrialWork(Deadly(trials, (1,), os.getpid()), isolation)
    outcomes = Slurm(tmp_path / "jobs", LOCAL, 1).outcomes(work, range(2))
    same(outcomes, LocalThreads(1).outcomes(TrialWork(trials, isolation), range(2)), but=[1])


def test_an_end_in_the_middle_leaves_nothing(
    linear: cs.Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(slurm, "EVERY", 0.0)
    pids: list[int] = []
    map_array = slurm.submitit.AutoExecutor.map_array

    def noted(*arguments: object) -> list[object]:
        jobs: list[object] = map_array(*arguments)
        pids.extend(int(job.job_id) for job in jobs)  # type: ignore[attr-defined]
        return jobs

    monkeypatch.setattr(slurm.submitit.AutoExecutor, "map_array", noted)
    work = TrialWork(Simulated(linear, 0), Isolation([cs.get_filter("kf")], linear.belief))
    outcomes = Slurm(tmp_path / "jobs", LOCAL, 1).outcomes(work, range(100_000))
    assert next(outcomes).run == 0
    outcomes.close()
    assert pids
    assert all(is_gone(pid, 60.0) for pid in pids)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({}, "--backend slurm: .*srun"),
        ({"cluster": "local", "colour": "red"}, "--backend slurm: .*Unknown argument 'colour'"),
        ({"cluster": "abacus"}, "--backend slurm: .*abacus"),
    ],
)
def test_what_submitit_does_not_know_is_said(
    linear: cs.Scenario, tmp_path: Path, options: dict[str, object], sentence: str
) -> None:
    with pytest.raises(cs.InputError, match=f"^{sentence}"):
        run_trials(linear, ["kf"], RUNS, out=tmp_path / "out", backend=Slurm(tmp_path / "jobs", options))
    assert list(tmp_path.iterdir()) == []


def test_options_are_numbers_or_words() -> None:
    assert options_of(["partition=short", "time=60", "mem=2GB"]) == {"partition": "short", "time": 60, "mem": "2GB"}
