"""Runs on workers of dask, on loopback: the bytes of local ones, whatever dies meanwhile."""

import os
import signal
from concurrent.futures import Executor
from dataclasses import dataclass

import dask
import pytest
from cluster import Cluster, free_port
from misbehaving import KINDS, Deadly, Still

import consistency as cs
from consistency.bench.runs.dask_executor import Client, DaskExecutor
from consistency.bench.runs.isolation import Isolation
from consistency.bench.runs.montecarlo import run_trials
from consistency.bench.runs.run_outcome import Simulated, TrialWork
from consistency.bench.runs.workers import ExecutorWorkers, LocalThreads
from consistency.referee.system import this_machine

pytestmark = [
    pytest.mark.skipif(os.name == "nt", reason="signals"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),  # sockets that dask leaves to the collector
]
RUNS = 30
SEED = 3


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    with Cluster(tmp_path_factory.mktemp("cluster")) as cluster:
        yield cluster


@pytest.fixture(scope="module")
def world(xyz):
    return xyz


@pytest.fixture(scope="module")
def filters(world):
    """One that is compiled, and one whose process ends in one run."""
    doomed = cs.Control(*Simulated(world, SEED)(7).controls[0])
    return ["ekf-xyz", Still("still", KINDS["os._exit(3)"][0], doomed)]


@pytest.fixture(scope="module")
def whole(world, filters, tmp_path_factory):
    return run_trials(world, filters, RUNS, SEED, 2, out=tmp_path_factory.mktemp("local") / "whole")


def require_same(one, other):
    names = sorted(path.name for path in other.glob("*.parquet"))
    assert names == sorted(path.name for path in one.glob("*.parquet"))
    for name in names:
        assert (one / name).read_bytes() == (other / name).read_bytes(), name


class Disturbed(Executor):
    """An executor during whose work something happens, when so many batches have come back."""

    def __init__(self, executor, after, disturb):
        self.executor, self.left, self.disturb = executor, after, disturb

    def submit(self, function, /, *arguments, **options):
        future = self.executor.submit(function, *arguments, **options)
        future.add_done_callback(self.came)
        return future

    def came(self, _):
        self.left -= 1
        if self.left == 0:
            self.disturb()


def test_the_bytes_are_those_of_local_runs(cluster, world, filters, whole, tmp_path):
    with DaskExecutor(cluster.address) as executor:
        results = run_trials(world, filters, RUNS, SEED, out=tmp_path / "out", executor=executor)
    require_same(results.folder, whole.folder)
    assert results.manifest["machines"] == [this_machine()]
    assert len(results.failures) == len(whole.failures)


def test_a_worker_that_is_killed_loses_nothing(cluster, world, filters, whole, tmp_path):
    """By dask's own executor, of a client of one's own."""
    third = cluster.add_worker()
    with Client(cluster.address, set_as_default=False) as client:
        client.wait_for_workers(3, timeout=60)
        pids = client.run(os.getpid)

        def kill():
            os.killpg(third.pid, signal.SIGKILL)
            os.kill(next(iter(pids.values())), signal.SIGKILL)  # whose nanny lives and starts another

        executor = Disturbed(client.get_executor(), 10, kill)
        results = run_trials(world, filters, RUNS, SEED, out=tmp_path / "out", executor=executor)
    require_same(results.folder, whole.folder)


@pytest.mark.slow
def test_runs_that_kill_their_workers_have_failed(world):
    """Dask gives a batch up when its worker dies; by default when four do, each of which begins with its imports."""
    trials, isolation = Simulated(world, SEED), Isolation([cs.get_filter("ekf-xyz")], world.belief)
    work = TrialWork(Deadly(trials, (5,), os.getpid()), isolation)
    with dask.config.set({"distributed.scheduler.allowed-failures": 0}), DaskExecutor(jobs=2) as executor:
        outcomes = {outcome.run: outcome for outcome in ExecutorWorkers(executor).outcomes(work, range(8))}
    assert sorted(outcomes) == list(range(8))
    assert {run for run, outcome in outcomes.items() if outcome.failures} == {5}
    assert outcomes[5].failures[0].reason == "its worker died (KilledWorker)"
    expected = {o.run: o for o in LocalThreads(1).outcomes(TrialWork(trials, isolation), range(8))}
    for run in set(outcomes) - {5}:
        for column, values in outcomes[run].estimates["ekf-xyz"].items():
            assert values.tobytes() == expected[run].estimates["ekf-xyz"][column].tobytes()


@pytest.mark.parametrize(
    "error, raised, sentence",
    [
        (cs.InputError("run 5 is not to be"), cs.InputError, r"^run 5 is not to be$"),
        (
            OSError("no such luck"),
            RuntimeError,
            r"^a worker failed: OSError: no such luck \(in __call__, test_dask.py:\d+\)$",
        ),
    ],
)
def test_an_error_of_a_worker_is_an_error_here(world, cluster, error, raised, sentence):
    @dataclass(frozen=True)
    class Broken:
        def __call__(self, run):
            raise error

    work = TrialWork(Broken(), Isolation([Still("still")], world.belief))
    with DaskExecutor(cluster.address) as executor, pytest.raises(raised, match=sentence):
        list(ExecutorWorkers(executor).outcomes(work, [5]))


def test_nobody_at_the_address(world, tmp_path):
    address = f"tcp://127.0.0.1:{free_port()}"
    with pytest.raises(cs.InputError, match=f"^the scheduler {address} cannot be reached for 0.5 s$"):
        run_trials(world, ["ekf-xyz"], RUNS, out=tmp_path / "out", executor=DaskExecutor(address, wait=0.5))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "options, sentence",
    [
        ({"scheduler": "nobody"}, "scheduler 'nobody' is neither an address, such as tcp://host:8786, nor a "),
        ({"wait": 0.0}, "the wait for a scheduler must be positive, got 0"),
        (
            {"scheduler": "tcp://a:1", "jobs": 2},
            "jobs .2. are processes of this machine; a scheduler has workers of its",
        ),
        ({"jobs": -2}, "jobs must be at least 1, or -1"),
    ],
)
def test_what_makes_no_sense_is_refused(options, sentence):
    with pytest.raises(cs.InputError, match=f"^{sentence}"):
        DaskExecutor(**options)  # type: ignore[arg-type]


def test_tls_without_certificates(world):
    with pytest.raises(cs.InputError, match=r"^scheduler tls://127.0.0.1:1: tls needs the certificates"):
        run_trials(world, ["ekf-xyz"], RUNS, executor=DaskExecutor("tls://127.0.0.1:1", wait=0.5))
