"""Runs in jobs of Slurm, here processes of this machine by the local executor of submitit."""

import os

import pytest
from misbehaving import Deadly, is_gone

import consistency as cs
from consistency.bench.runs import slurm_executor as slurm
from consistency.bench.runs.isolation import Isolation
from consistency.bench.runs.montecarlo import run_trials
from consistency.bench.runs.run_outcome import Simulated, TrialWork
from consistency.bench.runs.slurm_executor import SlurmExecutor, options_of
from consistency.bench.runs.workers import ExecutorWorkers, LocalThreads

pytestmark = [
    pytest.mark.skipif(os.name == "nt", reason="signals"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),  # processes that submitit leaves to the collector
]
RUNS = 12
LOCAL = {"cluster": "local", "time": 10}


@pytest.fixture(autouse=True)
def soon(monkeypatch):
    monkeypatch.setattr(slurm, "GLANCE", 0.2)
    monkeypatch.setattr(slurm.submitit.Job, "_results_timeout_s", 1)  # for what a slow disk may still bring of the dead


def on_jobs(folder, work, runs):
    """Of one job at a time."""
    with SlurmExecutor(folder, LOCAL, 1) as executor:
        outcomes = {outcome.run: outcome for outcome in ExecutorWorkers(executor).outcomes(work, range(runs))}
    assert sorted(outcomes) == list(range(runs))
    return outcomes


def require_same(outcomes, work):
    """Bit by bit."""
    for expected in LocalThreads(1).outcomes(work, range(len(outcomes))):
        outcome = outcomes[expected.run]
        for column, values in outcome.estimates["kf"].items():
            assert values.tobytes() == expected.estimates["kf"][column].tobytes()


def test_the_bytes_are_those_of_local_runs(linear, tmp_path):
    local = run_trials(linear, ["kf"], RUNS, jobs=1, out=tmp_path / "local")
    with SlurmExecutor(tmp_path / "jobs", LOCAL, jobs=2) as executor:
        jobs = run_trials(linear, ["kf"], RUNS, out=tmp_path / "slurm", executor=executor)
    for path in local.folder.glob("*.parquet"):
        assert path.read_bytes() == (jobs.folder / path.name).read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["local", "slurm"]


@pytest.mark.slow
def test_a_job_that_dies_once_is_done_again(linear, tmp_path, capsys):
    trials, isolation = Simulated(linear, 0), Isolation([cs.get_filter("kf")], linear.belief)
    fuse = tmp_path / "fuse"
    fuse.touch()
    outcomes = on_jobs(tmp_path / "jobs", TrialWork(Deadly(trials, (1,), os.getpid(), str(fuse)), isolation), 2)
    assert not any(outcome.failures for outcome in outcomes.values())
    require_same(outcomes, TrialWork(trials, isolation))
    assert f"consistency: 1 jobs died; their logs are in {tmp_path / 'jobs'}\n" == capsys.readouterr().err


@pytest.mark.slow
def test_a_run_that_kills_its_job_has_failed(linear, tmp_path):
    trials, isolation = Simulated(linear, 0), Isolation([cs.get_filter("kf")], linear.belief)
    outcomes = on_jobs(tmp_path / "jobs", TrialWork(Deadly(trials, (0,), os.getpid()), isolation), 1)
    assert [failure.reason for failure in outcomes[0].failures] == ["its worker died (UncompletedJobError)"]


def test_an_end_in_the_middle_leaves_nothing(linear, tmp_path, monkeypatch):
    monkeypatch.setattr(SlurmExecutor, "batch_seconds", 0.0)
    pids = []
    submit_array = slurm.submitit.AutoExecutor.submit_array

    def noted(*arguments):
        jobs = submit_array(*arguments)
        pids.extend(int(job.job_id) for job in jobs)  # type: ignore[attr-defined]
        return jobs

    monkeypatch.setattr(slurm.submitit.AutoExecutor, "submit_array", noted)
    work = TrialWork(Simulated(linear, 0), Isolation([cs.get_filter("kf")], linear.belief))
    with SlurmExecutor(tmp_path / "jobs", LOCAL, 1) as executor:
        outcomes = ExecutorWorkers(executor).outcomes(work, range(100_000))
        assert next(outcomes).run == 0
        outcomes.close()
    assert pids
    assert all(is_gone(pid, 60.0) for pid in pids)
    assert list(tmp_path.iterdir()) == []


def test_what_waits_is_sent_as_one_array(tmp_path, monkeypatch):
    sizes = []
    submit_array = slurm.submitit.AutoExecutor.submit_array

    def noted(self, calls):
        sizes.append(len(calls))
        jobs = submit_array(self, calls)
        return jobs

    monkeypatch.setattr(slurm.submitit.AutoExecutor, "submit_array", noted)
    with SlurmExecutor(tmp_path / "jobs", LOCAL) as executor:
        right, broken = executor.submit(divmod, 7, 3), executor.submit(divmod, 1, 0)
        assert right.result(60) == (2, 1)
        with pytest.raises(Exception, match="ZeroDivisionError"):
            broken.result(60)
    assert sizes[0] == 2


@pytest.mark.parametrize(
    "options, sentence",
    [
        ({}, "--backend slurm: .*srun"),
        ({"cluster": "local", "colour": "red"}, "--backend slurm: .*Unknown argument 'colour'"),
        ({"cluster": "abacus"}, "--backend slurm: .*abacus"),
    ],
)
def test_what_submitit_does_not_know_is_said(linear, tmp_path, options, sentence):
    with pytest.raises(cs.InputError, match=f"^{sentence}"):
        run_trials(linear, ["kf"], RUNS, out=tmp_path / "out", executor=SlurmExecutor(tmp_path / "jobs", options))
    assert list(tmp_path.iterdir()) == []


def test_options_are_numbers_or_words():
    assert options_of(["partition=short", "time=60", "mem=2GB"]) == {"partition": "short", "time": 60, "mem": "2GB"}
