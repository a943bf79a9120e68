"""Runs on workers of dask, on loopback: the bytes of local ones, whatever dies meanwhile."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest
from cluster import Cluster, free_port
from misbehaving import KINDS, Deadly, Still

import consistency as cs
from consistency.bench.runs.backends import dask
from consistency.bench.runs.backends.dask import Dask
from consistency.bench.runs.backends.local import LocalThreads
from consistency.bench.runs.isolation.filter_process import Isolation
from consistency.bench.runs.montecarlo import run_trials
from consistency.bench.runs.trial_work import Outcomes, Simulated, TrialWork
from consistency.bench.store.results import StoredResults
from consistency.bench.store.trial_rows import RunOutcome
from consistency.bench.types import Trial
from consistency.referee.system.provenance import this_machine

pytestmark = [
    pytest.mark.skipif(os.name == "nt", reason="signals"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),  # sockets that dask leaves to the collector
]
RUNS = 60
SEED = 3


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    with Cluster(tmp_path_factory.mktemp("cluster")) as cluster:
        yield cluster


@pytest.fixture(scope="module")
def world(linear: cs.Scenario) -> cs.Scenario:
    return linear


@pytest.fixture(scope="module")
def filters(world: cs.Scenario) -> list[str | Still]:
    """One that is compiled, and one whose process ends in one run."""
    doomed = cs.Control(*Simulated(world, SEED)(7).controls[0])
    return ["kf", Still("still", KINDS["os._exit(3)"][0], doomed)]


@pytest.fixture(scope="module")
def whole(world: cs.Scenario, filters: list[str | Still], tmp_path_factory: pytest.TempPathFactory) -> StoredResults:
    return run_trials(world, filters, RUNS, SEED, 2, out=tmp_path_factory.mktemp("local") / "whole")


def require_same(one: Path, other: Path) -> None:
    names = sorted(path.name for path in other.glob("*.parquet"))
    assert names == sorted(path.name for path in one.glob("*.parquet"))
    for name in names:
        assert (one / name).read_bytes() == (other / name).read_bytes(), name


@dataclass(frozen=True)
class Disturbed:
    """A backend during whose work something happens, after so many runs."""

    backend: Dask
    after: int
    disturb: Callable[[], object]

    def prepare(self, work: TrialWork, run: int, /) -> None:
        self.backend.prepare(work, run)

    def outcomes(self, work: TrialWork, runs: Sequence[int], /) -> Outcomes:
        for number, outcome in enumerate(self.backend.outcomes(work, runs)):
            if number == self.after:
                self.disturb()
            yield outcome


def test_the_bytes_are_those_of_local_runs(
    cluster: Cluster, world: cs.Scenario, filters: list[str | Still], whole: StoredResults, tmp_path: Path
) -> None:
    results = run_trials(world, filters, RUNS, SEED, out=tmp_path / "out", backend=Dask(cluster.address))
    require_same(results.folder, whole.folder)
    assert results.manifest["machines"] == [this_machine()]
    assert len(results.failures) == len(whole.failures)


def test_a_worker_that_is_killed_loses_nothing(
    cluster: Cluster, world: cs.Scenario, filters: list[str | Still], whole: StoredResults, tmp_path: Path
) -> None:
    third = cluster.add_worker()
    with dask.Client(cluster.address, set_as_default=False) as client:
        client.wait_for_workers(3, timeout=60)
        pids = client.run(os.getpid)

    def kill() -> None:
        os.killpg(third.pid, signal.SIGKILL)
        os.kill(next(iter(pids.values())), signal.SIGKILL)  # whose nanny lives and starts another

    backend = Disturbed(Dask(cluster.address), 10, kill)
    require_same(run_trials(world, filters, RUNS, SEED, out=tmp_path / "out", backend=backend).folder, whole.folder)


def test_a_result_that_died_with_the_last_worker_is_not_waited_for(world: cs.Scenario, tmp_path: Path) -> None:
    work = TrialWork(Simulated(world, SEED), Isolation([cs.get_filter("kf")], world.belief))
    with Cluster(tmp_path, workers=1) as cluster:
        engine = dask._Engine({"address": cluster.address}, work, 20.0)
        engine._wait = 1.0  # from here on: the worker has been found
        engine.submit([dask.Batch(range(2))])
        ((_, future),) = engine._sent.values()
        assert engine._ended.get(timeout=60) == future.key
        engine._ended.put(future.key)  # finished, and nobody has asked for what it left
        cluster.kill_workers()
        with pytest.raises(cs.InputError, match=f"^the scheduler {cluster.address} has had no worker for 1 s$"):
            assert not any(engine.events() for _ in range(100))


@pytest.mark.slow
def test_runs_that_kill_their_workers_have_failed(world: cs.Scenario) -> None:
    trials, isolation = Simulated(world, SEED), Isolation([cs.get_filter("kf")], world.belief)
    work = TrialWork(Deadly(trials, (0, 20), os.getpid()), isolation)
    outcomes = {outcome.run: outcome for outcome in Dask(jobs=2).outcomes(work, range(30))}
    assert sorted(outcomes) == list(range(30))
    assert {run for run, outcome in outcomes.items() if outcome.failures} == {0, 20}
    assert "its worker died" in outcomes[20].failures[0].reason
    expected: dict[int, RunOutcome] = {
        o.run: o for o in LocalThreads(1).outcomes(TrialWork(trials, isolation), range(30))
    }
    for run in set(outcomes) - {0, 20}:
        for column, values in outcomes[run].estimates["kf"].items():
            assert values.tobytes() == expected[run].estimates["kf"][column].tobytes()


def test_bad_input_of_a_worker_is_said_here(world: cs.Scenario, cluster: Cluster) -> None:
    @dataclass(frozen=True)
    class Refusing:
        def __call__(self, run: int) -> Trial:
            raise cs.InputError(f"run {run} is not to be")

    isolation = Isolation([Still("still")], world.belief)
    with pytest.raises(cs.InputError, match=r"^run 5 is not to be$"):
        list(Dask(cluster.address).outcomes(TrialWork(Refusing(), isolation), [5]))


def test_an_error_of_a_worker_is_an_error_here(world: cs.Scenario, cluster: Cluster) -> None:
    @dataclass(frozen=True)
    class Broken:
        def __call__(self, run: int) -> Trial:
            raise OSError("no such luck")  # and no trouble of the connection

    isolation = Isolation([Still("still")], world.belief)
    with pytest.raises(RuntimeError, match=r"^a worker of dask failed: OSError: no such luck$"):
        list(Dask(cluster.address).outcomes(TrialWork(Broken(), isolation), [5]))


def test_nobody_at_the_address(world: cs.Scenario, tmp_path: Path) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    with pytest.raises(cs.InputError, match=f"^the scheduler {address} cannot be reached for 0.5 s$"):
        run_trials(world, ["kf"], RUNS, out=tmp_path / "out", backend=Dask(address, wait=0.5))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "sentence"),
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
def test_what_makes_no_sense_is_refused(options: dict[str, object], sentence: str) -> None:
    with pytest.raises(cs.InputError, match=f"^{sentence}"):
        Dask(**options)  # type: ignore[arg-type]


def test_tls_without_certificates(world: cs.Scenario) -> None:
    with pytest.raises(cs.InputError, match=r"^scheduler tls://127.0.0.1:1: tls needs the certificates"):
        run_trials(world, ["kf"], RUNS, backend=Dask("tls://127.0.0.1:1", wait=0.5))
