"""Runs in batches on any executor: shares, what becomes of batches that fail, and who is refused."""

from __future__ import annotations

import pickle
import re
import sys
from collections import Counter
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from queue import SimpleQueue

import numpy as np
import pytest
from misbehaving import Deadly, Still

import consistency as cs
from consistency.bench.runs import workers
from consistency.bench.runs.executors import executor_for
from consistency.bench.runs.isolation import Isolation
from consistency.bench.runs.run_outcome import Recorded, RunOutcome, Simulated, TrialWork
from consistency.bench.runs.workers import BatchResult, ExecutorWorkers, LocalThreads, do_batch, failed
from consistency.bench.store.results import open_results
from consistency.referee.system import this_machine
from consistency.types import Failure

RUNS = 40
HERE = {"cpu": "abacus", "blas": "beads"}


def result(runs, **changes):
    """Of trials that leave nothing but their number."""
    outcomes = [RunOutcome(run, {}, None, ()) for run in runs]
    return replace(BatchResult(pickle.dumps(outcomes), "host", HERE, workers.versions_here()), **changes)


class Killed(Exception):
    """As of an engine whose worker has died."""


class Fake(Executor):
    """An executor with a worker that some runs kill, together with the batch that waits behind it.

    What waits is done when somebody waits for it. A batch gives back ``most`` runs at a time.
    """

    at_a_time = 4

    def __init__(self, killers=(), most=1000, **changes):
        self.killers, self.most, self.changes = set(killers), most, changes
        self.sent: list[tuple[int, ...]] = []
        self.seconds: list[float] = []
        self.waiting: list[tuple[tuple[int, ...], Future[BatchResult]]] = []
        self.together: list[int] = []  # batches that wait, each time that somebody waits for them

    def submit(self, function, /, *arguments, **_):
        assert function is do_batch
        _, runs, seconds, _ = arguments
        future = Future()
        self.sent.append(runs)
        self.seconds.append(seconds)
        self.waiting.append((runs, future))
        return future

    def work(self):
        self.together.append(len(self.waiting))
        runs, future = self.waiting.pop(0)
        if not self.killers & {*runs}:
            future.set_result(self.answer(runs[: self.most]))
            return
        future.set_exception(Killed())
        if self.waiting:
            self.waiting.pop(0)[1].set_exception(Killed())

    def answer(self, runs):
        return result(runs, **self.changes)

    def outcomes(self, work):
        executor = self

        class Finished(SimpleQueue):
            def get(self, *_, **__):
                if self.empty():
                    executor.work()
                return super().get(timeout=5.0)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(workers, "SimpleQueue", Finished)
            yield from ExecutorWorkers(self).outcomes(work, range(RUNS))


@pytest.fixture(scope="module")
def work(xyz):
    return TrialWork(Simulated(xyz, 0), Isolation([Still("still")], xyz.belief))


def done(executor, work):
    """What came of the runs; each came once."""
    outcomes = list(executor.outcomes(work))
    assert sorted(outcome.run for outcome in outcomes) == list(range(RUNS))
    return {outcome.run: outcome for outcome in outcomes}


def test_runs_are_sent_in_equal_shares(work):
    executor = Fake()
    outcomes = done(executor, work)
    assert sum(executor.sent, ()) == tuple(range(RUNS))
    assert len(executor.sent[0]) == RUNS / executor.at_a_time
    assert all(outcome.machine == HERE and not outcome.failures for outcome in outcomes.values())


def test_an_executor_says_how_long_a_batch_takes_and_how_many_it_has(work):
    plain, own = Fake(), Fake()
    own.at_a_time, own.batch_seconds = RUNS, 7.0  # type: ignore[attr-defined]
    done(plain, work)
    done(own, work)
    assert set(plain.seconds) == {1.5}
    assert set(own.seconds) == {7.0}
    assert len(own.sent) == RUNS


def test_what_a_batch_leaves_is_done_next(work):
    executor = Fake(most=2)
    done(executor, work)
    assert executor.sent[executor.at_a_time][0] == 2


@pytest.mark.parametrize("killers", [(0,), (17, 18), (3, 39), tuple(range(RUNS))])
def test_a_run_that_kills_has_failed_and_no_other(work, killers):
    executor = Fake(killers)
    outcomes = done(executor, work)
    assert {run for run, outcome in outcomes.items() if outcome.failures} == set(killers)
    for run in killers:
        assert outcomes[run].failures == (Failure("still", run, 1, "its worker died (Killed)"),)
        assert outcomes[run].truth is not None
        assert Counter(executor.sent)[(run,)] >= 2, "by itself, and alone"


def test_a_doubtful_run_is_alone(work):
    executor = Fake([20])
    outcomes = done(executor, work)
    assert max(executor.together) == executor.at_a_time
    assert {run for run, outcome in outcomes.items() if outcome.failures} == {20}
    doubtful = {runs for runs in executor.sent if executor.sent.count(runs) == 2}
    assert (20,) in doubtful
    assert executor.together[-len(doubtful) :] == [1] * len(doubtful)


def test_bad_input_keeps_what_is_finished(work):
    class Refusing(Fake):
        def answer(self, runs):
            kept = [run for run in runs if run < 3]
            return result(kept, refusal="" if len(kept) == len(runs) else "nothing in view")

    outcomes = Refusing(most=5).outcomes(work)
    assert [next(outcomes).run for _ in range(3)] == [0, 1, 2]
    with pytest.raises(cs.InputError, match=r"^nothing in view$"):
        next(outcomes)


@pytest.mark.parametrize(
    "error, raised, sentence",
    [
        (BrokenExecutor("no more"), cs.InputError, r"^the executor has ended \(BrokenExecutor: no more\)$"),
        (CancelledError(), cs.InputError, r"^the executor has ended \(CancelledError"),
        (ModuleNotFoundError("no consistency"), cs.InputError, "a worker lacks this package .*; install there"),
        (cs.InputError("Slurm does not take the jobs"), cs.InputError, "^Slurm does not take the jobs$"),
    ],
)
def test_an_executor_that_cannot_go_on(work, error, raised, sentence):
    class Ends(Fake):
        def work(self):
            self.waiting.pop()[1].set_exception(error)

    with pytest.raises(raised, match=sentence) as told:
        done(Ends(), work)
    if "ended" in sentence:  # no fault of the runs: what is finished is named, and a resume goes on
        assert isinstance(told.value.__cause__, OSError)


def test_what_is_not_done_is_cancelled(work):
    executor = Fake()
    outcomes = executor.outcomes(work)
    assert next(outcomes).run == 0
    assert executor.waiting
    outcomes.close()
    assert all(future.cancelled() for _, future in executor.waiting)


@pytest.mark.parametrize("name", ["numpy", "filter-consistency", "Python"])
def test_other_versions_are_refused(work, name):
    older = Fake(versions=workers.versions_here() | {name: "0.1"})
    with pytest.raises(cs.InputError, match=rf"the worker on host has {name} 0.1, here it is .*; install the same"):
        done(older, work)


def test_all_that_the_bits_depend_on_is_compared():
    assert set(workers.versions_here()) == {"filter-consistency", "Python", "numpy", "scipy", "numba"}


def test_sources_that_the_bits_depend_on_count_and_others_do_not(tmp_path, monkeypatch):
    def own():
        return str(workers.versions_here.__wrapped__()["filter-consistency"])

    assert Path(cs.__file__).parent == workers.PACKAGE
    assert workers.versions_here()["Python"] == f"{sys.version_info.major}.{sys.version_info.minor}"
    monkeypatch.setattr(workers, "PACKAGE", tmp_path)
    errors_of_poses = tmp_path / "referee" / "geometry.py"
    errors_of_poses.parent.mkdir()
    rooms = ("bench/scenario", "bench/simulation.py", "bench/filters")
    for room in rooms:
        (tmp_path / room / "inner").mkdir(parents=True)
    seen = []
    for text in ("x = 1", "x = 2"):
        errors_of_poses.write_text(text)
        seen.append(own())
    for room in rooms:
        (tmp_path / room / "inner" / "source.py").write_text(f"x = '{room}'")
        seen.append(own())
    assert len(set(seen)) == len(seen)
    assert re.search(r"\(sources [0-9a-f]{12}\)$", own())
    (tmp_path / "bench" / "pages").mkdir()
    (tmp_path / "bench" / "pages" / "source.py").write_text("x = 1")
    assert own() == seen[-1]


def test_differing_machines_are_said_once(work, capsys):
    class Mixed(Fake):
        def answer(self, runs):
            return result(runs, machine={"cpu": f"cpu{runs[0] % 2}", "blas": "b"})

    mixed = Mixed()
    mixed.at_a_time = RUNS
    done(mixed, work)
    (line,) = capsys.readouterr().err.splitlines()
    assert "the workers differ" in line
    assert "cpu0 (BLAS: b)" in line
    assert "cpu1 (BLAS: b)" in line


# --- the far side ---------------------------------------------------------------------------------


def sent(work):
    return bytes(pickle.dumps(work))


def test_a_worker_does_what_local_threads_do(linear):
    work = TrialWork(Simulated(linear, 5), Isolation([Still("still"), cs.get_filter("kf")], linear.belief))
    expected = {outcome.run: outcome for outcome in LocalThreads(1).outcomes(work, range(4))}
    whole, part = do_batch(sent(work), [3, 1], 1000.0, 0), do_batch(sent(work), [0, 2], 0.0, 1)
    assert [[outcome.run for outcome in each.outcomes()] for each in (whole, part)] == [[3, 1], [0]]
    for outcome in whole.outcomes() + part.outcomes():
        assert outcome.machine == this_machine()
        for name, columns in outcome.estimates.items():
            for column, values in columns.items():
                np.testing.assert_array_equal(values, expected[outcome.run].estimates[name][column])
    assert not whole.refusal + whole.fault + part.refusal + part.fault


@pytest.mark.parametrize(
    "error, refusal, fault",
    [
        (cs.InputError("no"), "no", ""),
        (OSError("no such luck"), "", r"OSError: no such luck \(in refuse, test_batches.py:\d+\)"),
        (ModuleNotFoundError("No module named 'mine'"), "a worker cannot load the work (No module named 'mine')", ""),
    ],
)
def test_an_error_ends_a_batch(linear, monkeypatch, error, refusal, fault):
    def refuse(_, run):
        if run == 2:
            raise error
        return RunOutcome(run, {}, None, ())

    monkeypatch.setattr(TrialWork, "__call__", refuse)
    work = TrialWork(Simulated(linear, 0), Isolation([Still("still")], linear.belief))
    part = do_batch(sent(work), [0, 1, 2, 3], 1000.0, 0)
    assert [outcome.run for outcome in part.outcomes()] == [0, 1]
    assert part.refusal.startswith(refusal)
    assert bool(part.refusal) == bool(refusal)
    assert re.fullmatch(fault, part.fault)
    with ThreadPoolExecutor(1) as executor, pytest.raises((cs.InputError, RuntimeError), match=re.escape(str(error))):
        list(ExecutorWorkers(executor).outcomes(work, [2]))


def test_a_failed_run_has_truth_and_a_reason_for_each_filter(work):
    outcome = failed(work, 7, "lost")
    assert outcome.run == 7
    assert [(f.filter, f.run, f.step, f.reason) for f in outcome.failures] == [("still", 7, 1, "lost")]
    assert len(outcome.estimates["still"]["step"]) == 0
    assert outcome.truth is not None


def test_of_a_log_only_the_trials_of_a_batch_are_sent(linear):
    trials = {run: cs.simulate(linear, run) for run in (3, 5, 8)}
    isolation = Isolation([cs.get_filter("kf")], linear.belief)
    recorded, drawn = TrialWork(Recorded(trials), isolation), TrialWork(Simulated(linear, 0), isolation)
    part = recorded.only([5])
    assert isinstance(part.trials, Recorded)
    assert list(part.trials.trials) == [5]
    assert drawn.only([5]) is drawn


# --- executors of others --------------------------------------------------------------------------


def test_any_executor_gives_the_tables_of_threads(linear):
    local = cs.run_trials(linear, ["kf", Still("still")], 8, jobs=2)
    with ThreadPoolExecutor(2) as threads, ProcessPoolExecutor(1, get_context("spawn")) as processes:
        for executor in (threads, processes):
            done = cs.run_trials(linear, ["kf", Still("still")], 8, executor=executor)
            for name in ("estimates", "truth", "map"):
                assert getattr(done, name).equals(getattr(local, name)), name


def test_a_pool_that_breaks_keeps_what_is_finished(linear, tmp_path):
    import os

    trials, isolation = Simulated(linear, 0), Isolation([cs.get_filter("kf")], linear.belief)
    work = TrialWork(Deadly(trials, (1,), os.getpid()), isolation)
    with (
        ProcessPoolExecutor(1, get_context("fork")) as executor,
        pytest.raises(cs.InputError, match="the executor has ended"),
    ):
        list(ExecutorWorkers(executor).outcomes(work, [1]))


def test_the_manifest_has_the_machines_that_did_runs(xyz, tmp_path, capsys, monkeypatch):
    here, out, still = this_machine(), tmp_path / "out", [Still("still")]
    assert here != HERE
    with ThreadPoolExecutor(1) as executor:
        assert cs.run_trials(xyz, still, 3, executor=executor).manifest["machines"] == [here]
        with monkeypatch.context() as patch:
            patch.setattr(workers, "this_machine", lambda: HERE)
            assert cs.run_trials(xyz, still, 3, executor=executor).manifest["machines"] == [HERE]  # and not this one
            cs.run_trials(xyz, still, 3, out=out, executor=executor)
    assert open_results(out).manifest["machines"] == [HERE]
    assert capsys.readouterr().err.count("computed the runs that are there") == 0
    resumed = cs.run_trials(xyz, still, 6, out=out, resume=True, jobs=1)
    assert resumed.manifest["machines"] == [HERE, here]
    assert "abacus (BLAS: beads) computed the runs that are there" in capsys.readouterr().err


# --- the choice -----------------------------------------------------------------------------------


def test_a_backend_is_chosen_by_name():
    with pytest.raises(cs.InputError, match=r"jobs must be at least 1, .* got 0"):
        executor_for("local", 0)
    with executor_for("local", 3) as executor:
        assert executor is None
    for options, sentence in (
        ({"name": "ray"}, "--backend must be one of local, dask, slurm, got 'ray'"),
        ({"scheduler": "tcp://a:1"}, "--scheduler goes with --backend dask, not with local"),
        ({"wait": 3.0, "name": "slurm"}, "--scheduler-wait goes with --backend dask, not with slurm"),
        ({"slurm": ["time=3"], "name": "dask"}, "--slurm goes with --backend slurm, not with dask"),
        ({"slurm": ["time"], "name": "slurm"}, "--slurm takes KEY=VALUE, such as .*, got 'time'"),
        ({"name": "dask", "jobs": 0}, "jobs must be at least 1"),
        ({"name": "slurm", "jobs": 0}, "jobs must be at least 1"),
        ({"jobs": -3}, "jobs must be at least 1"),
    ):
        with pytest.raises(cs.InputError, match=f"^{sentence}"), executor_for(**options):  # type: ignore[arg-type]
            pass


def test_without_the_extra_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.delitem(sys.modules, "consistency.bench.runs.dask_executor", raising=False)
    with pytest.raises(cs.InputError, match="needs distributed: pip install "), executor_for("dask"):
        pass
