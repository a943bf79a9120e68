"""Results that are streamed to a folder: the same bytes as from memory, without holding them, whole or not at all."""

from __future__ import annotations

import os
import signal
import threading
import time
import tracemalloc
import weakref
from contextlib import nullcontext
from dataclasses import dataclass, replace
from queue import SimpleQueue
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from edited import accept_changes, content

import consistency as cs
from consistency.bench.runs import outcomes_to_results, run_outcome, workers
from consistency.bench.runs.run_outcome import RunOutcome, TrialWork, outcome_of
from consistency.bench.simulation import World
from consistency.bench.store import parquet
from consistency.bench.store.results import StoredResults, open_results
from consistency.referee.show.as_json import render
from consistency.referee.verdicts.tables import document

TABLES = ("estimates", "failures", "truth", "landmarks", "map")
FILTERS = ["ekf-uvd", "ekf-xyz"]


class Halts:
    """Stays where it started; breaks in step 5 of about half of the runs, by a digit of what they see first."""

    name = "halts"

    def init(self, problem):
        return {"pose": problem.start, "steps": 0, "doomed": False}

    def predict(self, state, control):
        return {**state, "steps": state["steps"] + 1}

    def update(self, state, observation):
        if state["steps"] == 1:
            state = {**state, "doomed": int(1e6 * abs(observation.z.sum())) % 2 == 0}
        return state, None

    def pose(self, state):
        return cs.Gaussian(state["pose"], -np.eye(3) if state["doomed"] and state["steps"] == 5 else np.eye(3))


def damage(path):
    """Flip a bit in the middle of the column y."""
    group = pq.ParquetFile(path).metadata.row_group(0)
    column = next(c for c in map(group.column, range(group.num_columns)) if c.path_in_schema == "y")
    bytes_ = bytearray(path.read_bytes())
    bytes_[column.data_page_offset + column.total_compressed_size // 2] ^= 1
    path.write_bytes(bytes_)


@pytest.fixture
def few_rows(monkeypatch):
    """Row groups that end in the middle of runs."""
    monkeypatch.setattr(parquet, "ROWS", 97)


@pytest.fixture(scope="session")
def run(uvd):
    """Nine runs of the same study, unless told otherwise."""

    def work(filters=FILTERS, **options):
        return cs.run_trials(uvd, filters, **{"runs": 9, "seed": 3, "jobs": 1, **options})

    return work


@pytest.fixture(scope="module")
def written(run, tmp_path_factory):
    """Nine runs from memory."""
    folder = tmp_path_factory.mktemp("gather") / "memory"
    run().write(folder)
    return folder


# --- the same bytes ----------------------------------------------------------------------------------


@pytest.mark.parametrize("jobs", [1, 2])
def test_streamed_is_what_is_written_from_memory(run, written, tmp_path, jobs):
    stored = run(jobs=jobs, out=tmp_path / "deep" / "out")
    assert isinstance(stored, StoredResults)
    assert content(tmp_path / "deep" / "out") == content(written)
    assert stored.manifest == open_results(tmp_path / "deep" / "out").manifest
    other = run(seed=4, jobs=jobs, out=tmp_path / "other")
    assert content(other.folder) != content(written), "negative control"


@pytest.mark.usefixtures("few_rows")
def test_row_groups_do_not_depend_on_the_pieces(run, tmp_path):
    stored = run([*FILTERS, Halts()], out=tmp_path / "streamed")
    memory = run([*FILTERS, Halts()])
    assert 0 < len(memory.failures) < 9
    memory.write(tmp_path / "memory")
    assert content(tmp_path / "streamed") == content(tmp_path / "memory")
    about = pq.ParquetFile(tmp_path / "streamed" / "estimates.parquet").metadata
    groups = [about.row_group(k) for k in range(about.num_row_groups)]
    assert [group.num_rows for group in groups][:6] == [97, 97, 97, 97, 97, 55], "9 x 60 rows of the first filter"
    assert all(g.column(0).statistics.min == g.column(0).statistics.max for g in groups)
    for name in TABLES:
        pd.testing.assert_frame_equal(getattr(stored, name), getattr(memory, name), check_exact=True)


# --- memory ------------------------------------------------------------------------------------------


def peak(work):
    """Bytes at the peak, of what Python and NumPy hold."""
    tracemalloc.start()
    try:
        work()
        return float(tracemalloc.get_traced_memory()[1])
    finally:
        tracemalloc.stop()


def test_memory_does_not_grow_with_the_runs(uvd, tmp_path, monkeypatch):
    monkeypatch.setattr(parquet, "ROWS", 256)
    few, many = 10, 60
    row = 8 * (len(parquet.COLUMNS["estimates"]) - 1 + len(parquet.COLUMNS["truth"]))
    all_rows = (many - few) * 60 * row
    streamed = [
        peak(lambda n=n: cs.run_trials(uvd, ["ekf-uvd"], n, jobs=1, out=tmp_path / str(n))) for n in (few, many)
    ]
    held = [peak(lambda n=n: cs.run_trials(uvd, ["ekf-uvd"], n, jobs=1)) for n in (few, many)]
    assert streamed[1] - streamed[0] < 0.25 * all_rows
    assert held[1] - held[0] > all_rows, "negative control"


def test_few_outcomes_wait_for_their_turn(uvd, tmp_path, monkeypatch):
    alive = weakref.WeakSet()
    most = []

    class Counted(RunOutcome):
        __hash__ = object.__hash__

    def counted(*arguments):
        outcome = Counted(**vars(outcome_of(*arguments)))
        alive.add(outcome)
        most.append(len(alive))
        return outcome

    monkeypatch.setattr(run_outcome, "outcome_of", counted)
    monkeypatch.setattr(workers, "AHEAD", 2)
    cs.run_trials(uvd, ["ekf-uvd"], 60, jobs=2, out=tmp_path / "out")
    assert len(most) == 60
    assert max(most) <= 2 * 2 + 2, "those ahead, the one that is written, and the next"


def test_a_filter_is_read_without_the_others(uvd, written, monkeypatch):
    read = []
    batches = pq.ParquetFile.iter_batches

    def counted(self, size, groups, columns):
        if "nees" in columns:
            read.extend(groups)
        return batches(self, size, groups, columns)

    monkeypatch.setattr(pq.ParquetFile, "iter_batches", counted)
    cs.analyse(open_results(written), ["ekf-xyz"])
    assert read == [1, 1], "the second row group of the estimates, and that of the maps"


# --- read back ---------------------------------------------------------------------------------------


def test_verdicts_from_a_folder_are_those_from_memory(written):
    stored, memory = open_results(written), cs.read_results(written)
    assert render(document(cs.analyse(stored))) == render(document(cs.analyse(memory)))
    assert stored.finished_runs(FILTERS) == set(range(9))
    assert stored.scenario == memory.scenario


@pytest.mark.usefixtures("few_rows")
def test_a_folder_that_another_program_wrote(written, tmp_path):
    """One row group for all filters, rows of filters in turn; but the steps of each in order."""
    memory = cs.read_results(written)
    memory.write(tmp_path / "out")
    mixed = memory.estimates.sort_values(["run", "step"], kind="stable")
    mixed.to_parquet(tmp_path / "out" / "estimates.parquet", index=False)
    accept_changes(tmp_path / "out")
    assert render(document(cs.analyse(open_results(tmp_path / "out")))) == render(document(cs.analyse(memory)))
    mixed.sample(frac=1.0, random_state=1).to_parquet(tmp_path / "out" / "estimates.parquet", index=False)
    with pytest.raises(cs.InputError, match=r"estimates\.parquet: step \d+ of run \d+ .* is not what comes next"):
        open_results(tmp_path / "out")


@pytest.mark.usefixtures("few_rows")
def test_a_bad_number_is_found_where_it_is(written, tmp_path):
    memory = cs.read_results(written)
    estimates = memory.estimates.copy()
    estimates.loc[701, "P_xx"] = np.inf  # of the second filter, in another row group
    memory.write(tmp_path / "out")
    parquet.write_table(tmp_path / "out" / "estimates.parquet", "estimates", estimates)
    accept_changes(tmp_path / "out")
    stored = open_results(tmp_path / "out")
    assert cs.analyse(stored, ["ekf-uvd"])
    with pytest.raises(cs.InputError, match=r"estimates\.parquet: column 'P_xx', row 701: not a finite number"):
        cs.analyse(stored)


@pytest.mark.parametrize("name", ["estimates", "truth"])
def test_changed_bytes_are_refused(written, tmp_path, name):
    """Numbers that hardly compress are stored as they are: a flipped bit would be another number."""
    cs.read_results(written).write(tmp_path / "out")
    path = tmp_path / "out" / f"{name}.parquet"
    damage(path)
    accept_changes(tmp_path / "out")
    for read in (open_results, cs.read_results):
        with pytest.raises(cs.InputError, match=rf"{name}\.parquet: cannot be read, damaged or cut short"):
            cs.analyse(read(tmp_path / "out"))


def test_a_row_of_no_filter_is_refused(written, tmp_path):
    memory = cs.read_results(written)
    memory.write(tmp_path / "out")
    estimates = memory.estimates.copy()
    estimates.loc[7, "filter"] = None
    estimates.to_parquet(tmp_path / "out" / "estimates.parquet", index=False)
    accept_changes(tmp_path / "out")
    for read in (open_results, cs.read_results):
        with pytest.raises(cs.InputError, match=r"estimates\.parquet: a column of text, row 7: nothing there"):
            cs.analyse(read(tmp_path / "out"))


# --- stopped and resumed -----------------------------------------------------------------------------


@pytest.mark.parametrize("jobs", [1, 2])
def test_stopped_and_resumed_gives_the_same_bytes(run, written, tmp_path, stop_at, monkeypatch, jobs):
    out = tmp_path / "out"
    stop_at(4, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        run(jobs=jobs, out=out)
    monkeypatch.undo()
    part = run(runs=1, jobs=jobs, out=out, resume=True)  # writes what is finished
    finished = part.finished_runs(FILTERS)
    assert finished == {0, 1, 2, 3} or (jobs > 1 and 4 not in finished)  # another worker may be before or behind
    is_whole = finished == set(range(len(finished)))
    assert part.manifest["complete"] == is_whole
    assert part.manifest.get("finished_runs") == (None if is_whole else len(finished))
    assert part.manifest["runs"] == max(finished) + 1
    assert open_results(out).manifest == part.manifest
    (out / "notes.txt").write_text("mine")
    run(jobs=jobs, previous=part, out=out)
    assert content(out) == content(written)
    assert (out / "notes.txt").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.usefixtures("few_rows")
def test_resuming_keeps_failures_and_fills_gaps(run, uvd, tmp_path):
    filters = [Halts(), "ekf-uvd"]
    whole = run(filters)
    whole.write(tmp_path / "whole")
    tables = (("estimates", whole.estimates), ("truth", whole.truth), ("map", whole.map))
    gaps = {n: t[~t["run"].isin([1, 4, 8])] for n, t in tables}
    failures = whole.failures[~whole.failures["run"].isin([1, 4, 8])]
    manifest = whole.manifest | {"complete": False, "finished_runs": 6, "failures": len(failures)}
    part = cs.Results(gaps["estimates"], failures, gaps["truth"], whole.landmarks, manifest, gaps["map"])
    part.write(tmp_path / "out")
    run(filters, previous=open_results(tmp_path / "out"), out=tmp_path / "out")
    assert content(tmp_path / "out") == content(tmp_path / "whole")


def test_a_filter_without_any_row_is_resumed(uvd, tmp_path):
    class Stillborn(Halts):
        name = "stillborn"

        def init(self, problem):
            raise KeyError("no such map")

    filters = [Stillborn(), "ekf-uvd"]
    cs.run_trials(uvd, filters, runs=2, jobs=1, out=tmp_path / "out")
    for previous in (open_results(tmp_path / "out"), cs.read_results(tmp_path / "out")):
        cs.run_trials(uvd, filters, runs=4, jobs=1, previous=previous, out=tmp_path / "out", overwrite=True)
        cs.run_trials(uvd, filters, runs=4, jobs=1, out=tmp_path / "whole", overwrite=True)
        assert content(tmp_path / "out") == content(tmp_path / "whole")


def test_a_run_that_takes_long_keeps_no_other_from_the_journal(run, written, tmp_path, monkeypatch):
    trial, kept = World.trial, threading.Event()
    add = outcomes_to_results.Gathered.add

    def last(self, run, seed):
        ahead = threading.current_thread() is threading.main_thread()  # looks what the first takes
        assert run or ahead or kept.wait(60.0), "the others wait for the first"
        return trial(self, run, seed)

    def counted(self, outcome):
        add(self, outcome)
        if self.finished == set(range(1, 9)):
            kept.set()

    monkeypatch.setattr(World, "trial", last)
    monkeypatch.setattr(TrialWork, "compile", lambda self, run, jobs: None)
    monkeypatch.setattr(outcomes_to_results.Gathered, "add", counted)
    run(jobs=2, out=tmp_path / "out")
    assert content(tmp_path / "out") == content(written)


class Together(SimpleQueue[Any]):
    """Gives nothing before four are there."""

    def get(self, block=True, timeout=None):
        while self.qsize() < 4:
            time.sleep(0.01)
        return super().get(block, timeout)


@dataclass
class Work:
    """Runs that give their number, or fail."""

    failing: tuple[int, ...] = ()
    isolation = nullcontext()

    def __call__(self, run):
        if run in self.failing:
            raise RuntimeError("out of ideas")
        return run


def test_what_ends_together_with_an_error_counts(monkeypatch):
    monkeypatch.setattr(workers, "SimpleQueue", Together)
    outcomes = workers.LocalThreads(2).outcomes(Work((0, 2)), range(4))  # type: ignore[arg-type]
    assert {next(outcomes), next(outcomes)} == {1, 3}
    with pytest.raises(RuntimeError, match="out of ideas"):
        next(outcomes)


def test_what_ends_together_leaves_room_for_as_many(monkeypatch):
    monkeypatch.setattr(workers, "SimpleQueue", Together)
    outcomes = workers.LocalThreads(2).outcomes(Work(), range(8))  # type: ignore[arg-type]
    assert sorted(map(int, outcomes)) == list(range(8))  # type: ignore[call-overload]


def test_rows_out_of_order_are_not_resumed(run, written):
    memory = cs.read_results(written)
    upside_down = cs.Results(memory.estimates[::-1], memory.failures, memory.truth, memory.landmarks, memory.manifest)
    with pytest.raises(cs.InputError, match="estimates to resume must be in order of the runs"):
        run(runs=10, previous=upside_down)


@pytest.mark.parametrize("name", ["estimates", "truth"])
def test_what_cannot_be_resumed_is_refused_before_any_work(run, written, tmp_path, stop_at, name):
    out = tmp_path / "out"
    cs.read_results(written).write(out)
    damage(out / f"{name}.parquet")
    accept_changes(out)
    stop_at(9, RuntimeError("work"))
    with pytest.raises(cs.InputError, match=rf"{name}\.parquet: cannot be read, damaged or cut short"):
        run(runs=10, previous=open_results(out), out=out)


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_ctrl_c_waits_while_the_folder_is_written(run, tmp_path, monkeypatch):
    pressed = []

    class Pressed(outcomes_to_results.Writer):
        def end_group(self):
            if not pressed:
                pressed.append(1)
                os.kill(os.getpid(), signal.SIGINT)
            super().end_group()

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(outcomes_to_results, "Writer", Pressed)
    with pytest.raises(KeyboardInterrupt):
        run(runs=3, out=tmp_path / "out")
    signal.signal(signal.SIGINT, before)
    assert open_results(tmp_path / "out").finished_runs(FILTERS) == {0, 1, 2}


# --- nothing half-written ----------------------------------------------------------------------------


def test_an_error_in_the_middle_leaves_the_finished_runs(run, written, tmp_path, stop_at, monkeypatch):
    out = tmp_path / "deep" / "out"
    stop_at(5, RuntimeError("out of ideas"))
    with pytest.raises(RuntimeError, match="out of ideas"):
        run(out=out)
    monkeypatch.undo()
    assert [path.name for path in out.parent.iterdir()] == [".out.unfinished"]
    done = []
    trial = World.trial
    monkeypatch.setattr(World, "trial", lambda self, run, seed: (done.append(run), trial(self, run, seed))[1])
    run(out=out, resume=True)
    assert {5} <= set(done) <= {5, 6, 7, 8}
    assert content(out) == content(written)
    assert [path.name for path in out.parent.iterdir()] == ["out"]


@pytest.mark.parametrize("error", [RuntimeError("out of ideas"), KeyboardInterrupt()], ids=["error", "ctrl-c"])
def test_what_ends_in_the_first_run_leaves_nothing(run, tmp_path, stop_at, error):
    stop_at(0, error)
    with pytest.raises(type(error)):
        run(out=tmp_path / "deep" / "out")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("where", ["Journal.append", "Writer.add"])
def test_a_full_disk_keeps_what_was_there(run, written, tmp_path, monkeypatch, where):
    cs.read_results(written).write(tmp_path / "out")
    before = content(tmp_path / "out")

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(getattr(outcomes_to_results, where.split(".")[0]), where.split(".")[1], full)
    kept = "; 3 finished runs are kept, and the same command with --resume continues" if where == "Writer.add" else ""
    said = rf"--out .*out: cannot be written \(No space left on device\){kept}$"
    with pytest.raises(cs.InputError, match=said):
        run(runs=3, seed=4, jobs=2, out=tmp_path / "out", overwrite=True)
    assert content(tmp_path / "out") == before
    assert {path.name for path in tmp_path.iterdir()} == {"out", *[".out.unfinished"] * bool(kept)}
    monkeypatch.undo()
    if kept:  # the disk was freed: what was there is replaced, as was asked for at the beginning
        monkeypatch.setattr(World, "trial", None)
        run(runs=3, seed=4, jobs=1, out=tmp_path / "out", resume=True)
        monkeypatch.undo()
        run(runs=3, seed=4, jobs=1, out=tmp_path / "whole")
        assert content(tmp_path / "out") == content(tmp_path / "whole")


def test_a_folder_that_is_there_is_refused_before_any_work(uvd, written, stop_at):
    stop_at(0, RuntimeError("work"))
    with pytest.raises(cs.InputError, match="exists already"):
        cs.run_trials(uvd, FILTERS, runs=3, out=written)


def test_a_folder_that_came_meanwhile_is_not_replaced(uvd, tmp_path, stop_at):
    class Comes(Halts):
        def init(self, problem):
            (tmp_path / "out").mkdir(exist_ok=True)
            (tmp_path / "out" / "thesis.txt").write_text("all of it")
            return super().init(problem)

    with pytest.raises(cs.InputError, match=r"exists already; .*; the finished work is in .*out-2$"):
        cs.run_trials(uvd, [Comes()], runs=2, jobs=1, out=tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "out-2"]
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["thesis.txt"]
    assert open_results(tmp_path / "out-2").finished_runs(["halts"]) == {0, 1}


def test_a_folder_may_be_named_by_text(uvd, tmp_path, monkeypatch):
    """And by another path when it is gone on with."""
    monkeypatch.chdir(tmp_path)
    before = cs.run_trials(uvd, ["ekf-uvd"], runs=1, jobs=1, out="here")
    (tmp_path / "other").mkdir()
    after = cs.run_trials(uvd, ["ekf-uvd"], runs=2, jobs=1, out="other/../here", previous=before)
    assert after.finished_runs(["ekf-uvd"]) == {0, 1}


def test_steps_begin_at_one(uvd):
    results = cs.run_trials(uvd, ["ekf-uvd"], runs=2, jobs=1)
    shifted = results.estimates.assign(step=results.estimates["step"] - 1)
    with pytest.raises(cs.InputError, match="column 'step' must be at least 1"):
        cs.analyse(replace(results, estimates=shifted))
