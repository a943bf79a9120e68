"""Batches of runs with an engine that is a list: sizes, retries, splitting, and who is blamed."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from misbehaving import Still

import consistency as cs
from consistency.bench.runs.backends import remote
from consistency.bench.runs.backends.batches import Batch, Batches, Event, failed, in_batches
from consistency.bench.runs.backends.choosing import backend_for
from consistency.bench.runs.backends.local import LocalThreads
from consistency.bench.runs.backends.remote import Part, Worker, pickled_work
from consistency.bench.runs.isolation.filter_process import Isolation
from consistency.bench.runs.montecarlo import Interrupted
from consistency.bench.runs.trial_work import Outcomes, Simulated, TrialWork
from consistency.bench.store.results import open_results
from consistency.bench.store.trial_rows import RunOutcome
from consistency.referee.system.provenance import this_machine
from consistency.types import Failure

RUNS = 40
HERE = {"cpu": "abacus", "blas": "beads"}


class Counted:
    """Trials that leave nothing but their number."""

    def part(self, runs: Sequence[int], refusal: str = "", seconds: float = 0.0) -> Part:
        outcomes = [RunOutcome(run, {}, None, ()) for run in runs]
        pickled = remote.pickle.dumps(outcomes)
        return Part(pickled, seconds, "host", HERE, remote.versions_here(), refusal)


class Fake:
    """An engine with a worker that some runs kill, together with all that waits for it; the last sent comes first.

    A batch gives back ``most`` runs at a time and leaves the rest.
    """

    def __init__(
        self, killers: Sequence[int] = (), shares: bool = True, most: int = 1000, per_run: float = 0.1
    ) -> None:
        self.killers, self.shares, self.most, self.per_run = set(killers), shares, most, per_run
        self.waiting: list[Batch] = []
        self.sent: list[tuple[int, ...]] = []
        self.together: list[int] = []

    room = 4

    def submit(self, batches: Sequence[Batch]) -> None:
        self.waiting += batches
        self.sent += [batch.runs for batch in batches]
        self.together.append(len(self.waiting))

    def events(self) -> list[Event]:
        batch = self.waiting.pop()
        if self.killers & set(batch.left):
            dead = [batch, *(self.waiting if self.shares else [])]
            self.waiting = [] if self.shares else self.waiting
            return [(each, "killed") for each in dead]
        done = batch.left[: self.most]
        return [(batch, Counted().part(done, seconds=self.per_run * len(done))), (batch, None)]


@pytest.fixture(scope="module")
def work(xyz: cs.Scenario) -> TrialWork:
    return TrialWork(Simulated(xyz, 0), Isolation([Still("still")], xyz.belief))


def done(engine: Fake, work: TrialWork, retries: int = 0, seconds: float = 1.0) -> dict[int, RunOutcome]:
    """What came of the runs; each came once."""
    outcomes = list(in_batches(engine, Batches(range(RUNS), seconds, retries, engine.shares), work))
    assert sorted(outcome.run for outcome in outcomes) == list(range(RUNS))
    return {outcome.run: outcome for outcome in outcomes}


def test_batches_grow_to_so_much_work_and_shrink_at_the_end(work: TrialWork) -> None:
    engine = Fake(per_run=0.2)
    outcomes = done(engine, work)
    sizes = [len(runs) for runs in engine.sent]
    assert sizes[: engine.room] == [1] * engine.room  # until it is known what a run takes
    assert max(sizes) == 5  # 1 s of 0.2 s each
    assert sizes.count(5) == 4  # until fewer are left than four times as many
    assert sizes[-1] == 1
    assert max(engine.together) == engine.room
    assert all(outcome.machine == HERE and not outcome.failures for outcome in outcomes.values())


def test_a_batch_has_a_run_at_least(work: TrialWork) -> None:
    engine = Fake(per_run=100.0)
    done(engine, work)
    assert {len(runs) for runs in engine.sent} == {1}


def test_without_a_length_there_are_equal_shares(work: TrialWork) -> None:
    engine = Fake()
    list(in_batches(engine, Batches(range(RUNS)), work))
    assert engine.sent == [tuple(range(first, first + 10)) for first in range(0, RUNS, 10)]


def test_what_a_batch_leaves_is_done_next(work: TrialWork) -> None:
    engine = Fake(most=2, per_run=0.2)
    done(engine, work)
    assert max(len(runs) for runs in engine.sent) == 5


@pytest.mark.parametrize("shares", [True, False])
@pytest.mark.parametrize("retries", [0, 1])
@pytest.mark.parametrize("killers", [(0,), (17, 18), (3, 39)])
def test_a_run_that_kills_has_failed_and_no_other(
    work: TrialWork, shares: bool, retries: int, killers: tuple[int, ...]
) -> None:
    engine = Fake(killers, shares)
    outcomes = done(engine, work, retries)
    assert {run for run, outcome in outcomes.items() if outcome.failures} == set(killers)
    for run in killers:
        assert outcomes[run].failures == (Failure("still", run, 1, "killed"),)
        assert outcomes[run].truth is not None


def test_a_batch_is_sent_again_before_it_is_split(work: TrialWork) -> None:
    for retries in (0, 1, 2):
        engine = Fake([20], shares=False, per_run=0.2)
        done(engine, work, retries)
        whole = next(runs for runs in engine.sent if 20 in runs)
        assert len(whole) > 1
        assert engine.sent.count(whole) == 1 + retries
        assert engine.sent.count((20,)) == 1  # once more


def test_a_suspect_runs_alone_where_workers_share_their_fate(work: TrialWork) -> None:
    engine = Fake([20], per_run=0.2)
    done(engine, work)
    assert all(
        count == 1
        for count, runs in zip(engine.together[-6:], engine.sent[-6:], strict=True)
        if len(runs) == 1 and runs in engine.sent[:-1]
    )
    assert engine.sent.count((20,)) == 2


def test_a_suspect_that_a_dying_worker_was_given_is_tried_again() -> None:
    batches = Batches([7], 1.0)
    (batch,) = batches.take(3)
    assert batches.lost(batch) == []
    (suspect,) = batches.take(3)
    assert batches.lost(suspect) == []
    (again,) = batches.take(3)
    assert again.is_suspect
    assert batches.lost(again) == [7]
    assert batches.are_done


def test_a_loss_after_progress_is_no_second_loss() -> None:
    batches = Batches(range(6), 1.0, retries=1, shares=False)
    batches._per_run = 0.1
    (batch,) = batches.take(1)
    assert batch.runs == tuple(range(6))
    assert batches.lost(batch) == []
    (again,) = batches.take(1)
    assert (again.runs, again.losses) == (batch.runs, 1)
    assert batches.came(again, [0, 1], 0.2) == [0, 1]
    assert batches.came(again, [0, 1], 0.2) == []  # sent twice, kept once
    assert batches.lost(again) == []
    (rest,) = batches.take(1)
    assert (rest.runs, rest.losses) == ((2, 3, 4, 5), 1)
    assert batches.lost(rest) == []
    assert [suspect.runs for suspect in batches.take(9)] == [(2,), (3,), (4,), (5,)]


def test_bad_input_keeps_what_is_finished(work: TrialWork) -> None:
    class Refusing(Fake):
        def events(self) -> list[Event]:
            batch = self.waiting.pop(0)
            return [(batch, Counted().part(batch.runs, "nothing in view" if batch.runs == (2,) else "")), (batch, None)]

    outcomes = in_batches(Refusing(), Batches(range(RUNS), 1.0), work)
    assert [next(outcomes).run for _ in range(3)] == [0, 1, 2]
    with pytest.raises(cs.InputError, match=r"^nothing in view$"):
        next(outcomes)


def test_what_comes_twice_is_kept_once(work: TrialWork) -> None:
    class Twice(Fake):
        def events(self) -> list[Event]:
            part, end = super().events()
            return [part, part, end]

    done(Twice(), work)


@pytest.mark.parametrize("name", ["numpy", "filter-consistency", "Python"])
def test_other_versions_are_refused(work: TrialWork, name: str) -> None:
    class Older(Fake):
        def events(self) -> list[Event]:
            batch = self.waiting.pop()
            part = Counted().part(batch.runs)
            return [(batch, replace(part, versions=part.versions | {name: "0.1"})), (batch, None)]

    with pytest.raises(cs.InputError, match=rf"the worker on host has {name} 0.1, here it is .*; install the same"):
        next(in_batches(Older(), Batches(range(RUNS), 1.0), work))


def test_all_that_the_bits_depend_on_is_compared() -> None:
    assert set(remote.versions_here()) == {"filter-consistency", "Python", "numpy", "scipy", "numba"}


def test_sources_that_the_bits_depend_on_count_and_others_do_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def own() -> str:
        return str(remote.versions_here.__wrapped__()["filter-consistency"])

    assert Path(cs.__file__).parent == remote.PACKAGE
    assert remote.versions_here()["Python"] == f"{sys.version_info.major}.{sys.version_info.minor}"
    monkeypatch.setattr(remote, "PACKAGE", tmp_path)
    seen = [own()]
    for room in ("referee/geometry", "bench/models", "bench/scenario", "bench/simulation", "bench/filters"):
        (tmp_path / room / "inner").mkdir(parents=True)
        (tmp_path / room / "inner" / "source.py").write_text(f"x = '{room}'")
        seen.append(own())
    assert len(set(seen)) == len(seen)
    assert re.search(r"\(sources [0-9a-f]{12}\)$", own())
    (tmp_path / "bench" / "pages").mkdir()
    (tmp_path / "bench" / "pages" / "source.py").write_text("x = 1")
    assert own() == seen[-1]


def test_differing_machines_are_said_once(work: TrialWork, capsys: pytest.CaptureFixture[str]) -> None:
    class Mixed(Fake):
        def events(self) -> list[Event]:
            batch = self.waiting.pop()
            part = Counted().part(batch.runs)
            return [(batch, replace(part, machine={"cpu": f"cpu{batch.runs[0] % 2}", "blas": "b"})), (batch, None)]

    done(Mixed(), work)
    (line,) = capsys.readouterr().err.splitlines()
    assert "the workers differ" in line
    assert "cpu0 (BLAS: b)" in line
    assert "cpu1 (BLAS: b)" in line


# --- the far side ---------------------------------------------------------------------------------


def test_a_desk_does_what_local_workers_do(linear: cs.Scenario) -> None:
    work = TrialWork(Simulated(linear, 5), Isolation([Still("still"), cs.get_filter("kf")], linear.belief))
    expected = {outcome.run: outcome for outcome in LocalThreads(1).outcomes(work, range(4))}
    worker = Worker(pickled_work(work))
    try:
        whole = list(worker.parts([3, 1], 1000.0))
        each = list(worker.parts([0, 2], 0.0))
    finally:
        worker.close()
    assert [[outcome.run for outcome in part.outcomes()] for part in whole + each] == [[3, 1], [0], [2]]
    for outcome in (outcome for part in whole + each for outcome in part.outcomes()):
        assert outcome.machine == remote.this_machine()
        for name, columns in outcome.estimates.items():
            for column, values in columns.items():
                np.testing.assert_array_equal(values, expected[outcome.run].estimates[name][column])
    assert all(part.seconds > 0.0 and not part.refusal for part in whole + each)


def test_bad_input_ends_a_desk(linear: cs.Scenario, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: TrialWork, run: int) -> RunOutcome:
        if run == 2:
            raise cs.InputError("no")
        return RunOutcome(run, {}, None, ())

    monkeypatch.setattr(TrialWork, "__call__", refuse)
    worker = Worker(pickled_work(TrialWork(Simulated(linear, 0), Isolation([Still("still")], linear.belief))))
    (part,) = worker.parts([0, 1, 2, 3], 1000.0)
    assert [outcome.run for outcome in part.outcomes()] == [0, 1]
    assert part.refusal == "no"
    (part,) = worker.parts([2], 1000.0)
    assert (part.outcomes(), part.refusal) == ([], "no")


def test_a_failed_run_has_truth_and_a_reason_for_each_filter(work: TrialWork) -> None:
    outcome = failed(work, 7, "lost")
    assert outcome.run == 7
    assert [(f.filter, f.run, f.step, f.reason) for f in outcome.failures] == [("still", 7, 1, "lost")]
    assert len(outcome.estimates["still"]["step"]) == 0
    assert outcome.truth is not None


@dataclass(frozen=True)
class Elsewhere:
    """A backend on another machine, which is stopped after so many runs."""

    machine: dict[str, str] | None
    most: int = 1000
    prepared: list[int] = field(default_factory=list)

    def prepare(self, work: TrialWork, run: int, /) -> None:
        self.prepared.append(run)

    def outcomes(self, work: TrialWork, runs: Sequence[int], /) -> Outcomes:
        for outcome in LocalThreads(1).outcomes(work, runs[: self.most]):
            yield replace(outcome, machine=self.machine)
        if len(runs) > self.most:
            raise KeyboardInterrupt


def test_the_manifest_has_the_machines_that_did_runs(
    xyz: cs.Scenario, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    here, out, still = this_machine(), tmp_path / "out", [Still("still")]
    assert here != HERE
    backend = Elsewhere(HERE)
    results = cs.run_trials(xyz, still, 3, backend=backend)
    assert results.manifest["machines"] == [HERE]  # and not this one, which did none
    assert backend.prepared == [0]
    assert cs.run_trials(xyz, still, 3, backend=Elsewhere(None)).manifest["machines"] == [here]
    with pytest.raises(Interrupted):
        cs.run_trials(xyz, still, 6, out=out, backend=Elsewhere(HERE, 2))
    assert open_results(out).manifest["machines"] == [HERE]
    assert capsys.readouterr().err.count("computed the runs that are there") == 0
    resumed = cs.run_trials(xyz, still, 6, out=out, resume=True, jobs=1)
    assert resumed.manifest["machines"] == [HERE, here]
    assert "abacus (BLAS: beads) computed the runs that are there" in capsys.readouterr().err


# --- the choice -----------------------------------------------------------------------------------


def test_a_backend_is_chosen_by_name() -> None:
    assert backend_for("local", 3) == LocalThreads(3)
    for options, sentence in (
        ({"name": "ray"}, "--backend must be one of local, dask, slurm, got 'ray'"),
        ({"scheduler": "tcp://a:1"}, "--scheduler goes with --backend dask, not with local"),
        ({"wait": 3.0, "name": "slurm"}, "--scheduler-wait goes with --backend dask, not with slurm"),
        ({"slurm": ["time=3"], "name": "dask"}, "--slurm goes with --backend slurm, not with dask"),
        ({"slurm": ["time"], "name": "slurm"}, "--slurm takes KEY=VALUE, such as .*, got 'time'"),
        ({"name": "dask", "jobs": 0}, "jobs must be at least 1"),
    ):
        with pytest.raises(cs.InputError, match=f"^{sentence}"):
            backend_for(**options)  # type: ignore[arg-type]


def test_without_the_extra_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.delitem(sys.modules, "consistency.bench.runs.backends.dask", raising=False)
    with pytest.raises(cs.InputError, match="needs distributed: pip install "):
        backend_for("dask")
