"""Finished runs survive: the journal, its lock, signals, what cannot be written, and tables that were edited."""

import errno
import json
import os
import shutil
import signal
import sqlite3
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from edited import accept_changes, change_manifest, content

import consistency as cs
from consistency.bench.runs import outcomes_to_results
from consistency.bench.runs.outcomes_to_results import Interrupted
from consistency.bench.simulation import World
from consistency.bench.store import journal as journals
from consistency.bench.store.journal import DATABASE, Journal, Unfinished
from consistency.bench.store.results import open_results
from consistency.referee import system
from consistency.referee.system import progress, say

FILTER = ["ekf-uvd"]
RUNS = 6


def columns(run, rows=5):
    numbers = np.random.default_rng(run).standard_normal(rows)
    numbers[0] = np.nan
    return {"run": np.full(rows, run), "x": numbers}


def fill(journal, *runs):
    for run in runs:
        notes = {"failures": [["f", run, 3, "odd \udce9 letters"]]} if run == 2 else {}
        journal.append(run, {"estimates f": columns(run), "truth": columns(100 + run, 3)}, notes)


def reopened(path):
    """What a journal holds when it is opened again."""
    journal = Journal(path)
    pieces = held(journal)
    journal.close()
    return pieces


def held(journal, part="estimates f"):
    pieces = {run: b"".join(each.tobytes() for each in piece.values()) for run, piece in journal.pieces(part)}
    assert list(pieces) == sorted(pieces)
    return pieces


def expected(*runs):
    return {run: b"".join(each.tobytes() for each in columns(run).values()) for run in sorted(runs)}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "journal"


@pytest.fixture(scope="session")
def run(uvd):
    """Six runs of the same study, unless told otherwise."""

    def work(filters=FILTER, **options):
        return cs.run_trials(uvd, filters, **{"runs": RUNS, "seed": 3, "jobs": 1, **options})

    return work


@pytest.fixture(scope="module")
def whole(run, tmp_path_factory):
    """Results of one go."""
    folder = tmp_path_factory.mktemp("journal") / "whole"
    run(out=folder)
    return folder


@pytest.fixture
def at_run(monkeypatch):
    """Has something done at the beginning of a run, or of each where its number is ``...``."""
    trial = World.trial

    def arm(number, work):
        def worked(self, run, seed):
            if number is ...:
                work(run)
            elif run == number:
                work()
            return trial(self, run, seed)

        monkeypatch.setattr(World, "trial", worked)

    yield arm
    monkeypatch.setattr(World, "trial", trial)


# --- the file ------------------------------------------------------------------------------------


def test_runs_come_back_in_their_order_with_all_bits(path):
    journal = Journal(path)
    journal.begin({"seed": 3})
    fill(journal, 4000, 0, 2)  # a set has these in another order
    for reopened in (False, True):
        if reopened:
            journal.close()
        each = Journal(path) if reopened else journal
        assert held(each) == expected(0, 2, 4000)
        assert each.runs == {0, 2, 4000}
        assert each.notes == {2: {"failures": [["f", 2, 3, "odd \udce9 letters"]]}}
        assert list(each.pieces("truth"))[1][1]["run"].tolist() == [102] * 3
        assert list(each.pieces("map f")) == []
        assert each.study == {"seed": 3}
    each.close()


@pytest.mark.parametrize("cut", [0, 1, 7_000])
def test_what_a_killed_process_leaves_are_whole_runs(path, cut):
    """Files as SIGKILL leaves them, the last transaction cut as a power cut may leave it."""
    journal = Journal(path)
    fill(journal, 0, 1)
    journal.append(2, {"estimates f": columns(2, 5_000)})
    left = path.with_name("left")
    for suffix in ("", "-wal"):
        shutil.copy(f"{path}{suffix}", f"{left}{suffix}")
    journal.close()
    wal = Path(f"{left}-wal")
    os.truncate(wal, wal.stat().st_size - cut)
    again = Journal(left)
    assert again.runs == ({0, 1, 2} if cut == 0 else {0, 1})
    assert {run: held(again)[run] for run in (0, 1)} == expected(0, 1)
    again.close()


def test_an_append_that_fails_leaves_nothing(path):
    """The first table of the run is written, the second cannot be."""
    journal = Journal(path)
    fill(journal, 0)
    broken = {"estimates f": columns(1), "truth": {"x": None}}
    with pytest.raises(AttributeError):
        journal.append(1, broken)
    assert journal.runs == {0}
    fill(journal, 2)
    journal.close()
    assert reopened(path) == expected(0, 2)


def test_a_full_disk_leaves_whole_runs_and_may_be_freed(path):
    journal = Journal(path)
    fill(journal, 0)
    (pages,) = journal._database.execute("PRAGMA page_count").fetchone()
    journal._database.execute(f"PRAGMA max_page_count = {pages + 1}")
    with pytest.raises(OSError, match="No space left"):
        journal.append(1, {"estimates f": columns(1, 50_000)})
    assert journal.runs == {0}
    journal._database.execute("PRAGMA max_page_count = 100000")
    fill(journal, 2)
    journal.close()
    assert reopened(path) == expected(0, 2)


def test_a_damaged_number_is_refused(path):
    journal = Journal(path)
    fill(journal, 0, 1)
    journal.close()
    numbers = columns(1)["x"].tobytes()
    content = path.read_bytes()
    assert content.count(numbers) == 1
    path.write_bytes(content.replace(numbers, numbers[:-1] + b"\x01"))
    again = Journal(path)
    with pytest.raises(cs.InputError, match=r"damaged \(run 1\); the same command with --overwrite drops it"):
        held(again)
    again.close()


def test_the_numbers_of_another_run_are_refused(path):
    journal = Journal(path)
    fill(journal, 0, 1)
    journal._database.execute("DELETE FROM part WHERE run = 0")
    journal._database.execute("UPDATE part SET run = 0 WHERE run = 1")
    with pytest.raises(cs.InputError, match=r"damaged \(run 0\)"):
        held(journal)
    journal.close()


def test_a_file_that_is_no_database_is_refused_and_closed(path, monkeypatch):
    closed = []

    class Connection(sqlite3.Connection):
        def close(self):
            closed.append(path)
            super().close()

    monkeypatch.setattr(sqlite3, "connect", partial(sqlite3.connect, factory=Connection))
    path.write_bytes(b"run:" + bytes(4096))
    with pytest.raises(cs.InputError, match=r"damaged \(file is not a database\)"):
        Journal(path)
    assert closed == [path]


def test_runs_are_brought_to_disk_now_and_then(path, monkeypatch):
    """After a checkpoint the database itself, without its log, has the runs."""
    journal = Journal(path)
    fill(journal, 0)
    monkeypatch.setattr(journals, "CHECKPOINT_EVERY", 0.0)
    fill(journal, 1)
    monkeypatch.undo()
    fill(journal, 2)
    shutil.copy(path, path.with_name("copied"))
    copied = Journal(path.with_name("copied"))
    assert copied.runs == {0, 1}
    copied.close()
    journal.close()


# --- beside an output folder -----------------------------------------------------------------------


def test_one_process_at_a_time(tmp_path):
    out = tmp_path / "out"
    with Unfinished(out) as first:
        fill(first.journal, 0)
        for options in ({}, {"resume": True}, {"overwrite": True}):
            with pytest.raises(cs.InputError, match=r"--out .*out: another process is at work on it"):
                Unfinished(out, **options)
        fill(first.journal, 1)
    with Unfinished(out, resume=True) as second:
        assert second.journal.runs == {0, 1}


def test_unfinished_work_is_neither_ignored_nor_dropped_unasked(tmp_path):
    out = tmp_path / "deep" / "out"
    with Unfinished(out) as first:
        fill(first.journal, 0, 1)
    for _ in range(2):
        said = "with 2 finished runs; add --resume to the same command to continue, or --overwrite"
        with pytest.raises(cs.InputError, match=said):
            Unfinished(out)
    with Unfinished(out, resume=True) as again:
        assert again.journal.runs == {0, 1}
    with Unfinished(out, overwrite=True) as fresh:
        assert fresh.journal.runs == set()
    assert list((tmp_path / "deep").iterdir()) == [], "nothing is finished, nothing stays"


def test_resume_where_nothing_is(run, tmp_path):
    """Nothing at all is refused; a journal that a process was killed in before its first run is begun."""
    with pytest.raises(cs.InputError, match=r"out: there is nothing to resume; leave --resume out"):
        run(out=tmp_path / "out", resume=True)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / ".out.unfinished").mkdir()
    Journal(tmp_path / ".out.unfinished" / DATABASE).close()
    assert run(runs=1, out=tmp_path / "out", resume=True).manifest["complete"]


def test_folders_that_were_made_go_with_what_was_for_nothing(tmp_path):
    with Unfinished(tmp_path / "a" / "b" / "out"):
        (tmp_path / "a" / "mine.txt").write_text("x")
    assert [path.name for path in tmp_path.rglob("*")] == ["a", "mine.txt"]


# --- whatever ends the process -----------------------------------------------------------------------


def test_what_a_killed_process_leaves_is_resumed(run, whole, tmp_path, at_run):
    """What is on disk in the middle of a run is what SIGKILL would leave."""
    out, left = tmp_path / "first" / "out", tmp_path / "second"
    at_run(4, lambda: shutil.copytree(out.parent, left))
    run(out=out)
    begun = set()
    at_run(..., begun.add)
    run(out=left / "out", resume=True)
    assert content(left / "out") == content(whole)
    assert [path.name for path in left.iterdir()] == ["out"]
    assert {4, 5} <= begun <= {3, 4, 5}, "run 3 was finished, but may not have been written yet"


def test_unfinished_work_of_an_earlier_version_is_refused(tmp_path):
    out = tmp_path / "out"
    (tmp_path / ".out.unfinished").mkdir()
    (tmp_path / ".out.unfinished" / "journal").write_bytes(b"run:")
    with pytest.raises(cs.InputError, match=r"of an earlier version is there; .* or add --overwrite to drop it"):
        Unfinished(out, resume=True)
    with Unfinished(out, overwrite=True) as fresh:
        assert fresh.journal.runs == set()


def test_only_what_is_missing_is_done_again(run, uvd, whole, tmp_path, monkeypatch):
    with Unfinished(tmp_path / "out") as unfinished:  # another filter's journal
        unfinished.journal.begin({"scenario_hash": uvd.hash, "filters": FILTER, "error": {}, "seed": 4})
        fill(unfinished.journal, 0)
    with pytest.raises(cs.InputError, match="the results to resume have another seed"):
        run(out=tmp_path / "out", resume=True)
    with Unfinished(tmp_path / "out", resume=True) as unfinished:
        assert unfinished.journal.runs == {0}, "it is still there"
    monkeypatch.setattr(outcomes_to_results, "Writer", None)
    with pytest.raises(TypeError):
        run(out=tmp_path / "other")
    monkeypatch.undo()
    monkeypatch.setattr(World, "trial", None)
    run(out=tmp_path / "other", resume=True)
    assert content(tmp_path / "other") == content(whole)


def test_killed_while_results_were_replaced(run, whole, tmp_path, monkeypatch):
    """The old folder is away and the new one not there: both are found again."""
    out, replace = tmp_path / "out", os.replace
    run(runs=3, out=out)

    def dies(source, target):
        if Path(target) == out:
            raise SystemExit("killed")
        replace(source, target)

    monkeypatch.setattr(system.os, "replace", dies)
    with pytest.raises(SystemExit):
        run(out=out, resume=True)
    monkeypatch.undo()
    assert not out.exists()
    monkeypatch.setattr(World, "trial", None)
    run(out=out, resume=True)
    assert content(out) == content(whole)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_killed_before_the_journal_was_removed(run, whole, tmp_path, at_run):
    """The results are there, and their runs are in the journal, too: they count once."""
    out, unfinished = tmp_path / "out", tmp_path / ".out.unfinished"
    at_run(4, lambda: shutil.copytree(unfinished, tmp_path / "copy"))
    run(out=out)
    (tmp_path / "copy").rename(unfinished)
    run(out=out, resume=True)
    assert content(out) == content(whole)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_place_that_was_removed_meanwhile_is_made_again(run, whole, tmp_path, at_run):
    """The whole folder above is gone, with the journal in it: the work is not."""
    at_run(4, lambda: shutil.rmtree(tmp_path / "deep"))
    run(out=tmp_path / "deep" / "out")
    assert content(tmp_path / "deep" / "out") == content(whole)


# --- Ctrl-C in a script ------------------------------------------------------------------------------------


@pytest.fixture
def handled():
    """Ctrl-C as in a terminal; as it was at the end."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("handled")
@pytest.mark.parametrize("jobs", [1, 2])
def test_ctrl_c_loses_nothing(run, whole, tmp_path, at_run, jobs):
    """The trial in progress is done to its end; the journal has all that came before."""
    ended = []

    def pressed():
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.3)
        ended.append(4)

    at_run(4, pressed)
    with pytest.raises(KeyboardInterrupt) as stop:
        run(jobs=jobs, out=tmp_path / "out")
    assert not isinstance(stop.value, Interrupted)
    assert ended == [4]
    assert not (tmp_path / "out").exists()
    with Unfinished(tmp_path / "out", resume=True) as unfinished:
        done = unfinished.journal.runs
    assert 4 not in done
    assert jobs == 2 or {0, 1, 2} <= done, "run 3 was finished, but may not have been written yet"
    at_run(4, int)
    run(out=tmp_path / "out", resume=bool(done))
    assert content(tmp_path / "out") == content(whole)


# --- what cannot be written ------------------------------------------------------------------------


class Gone:
    """A terminal that was closed."""

    def write(self, _):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    def flush(self):
        raise BrokenPipeError

    def isatty(self):
        return False


class GoneTerminal(Gone):
    encoding = "utf-8"

    def isatty(self):
        return True


@pytest.mark.parametrize("stream", [None, Gone(), GoneTerminal()], ids=["closed", "pipe", "terminal"])
def test_progress_that_nobody_can_read_ends_nothing(stream, monkeypatch):
    monkeypatch.setattr(sys, "stderr", stream)
    say("one line")
    with progress("runs", 2) as advance:
        advance(1)
        advance(1)


# --- manifest ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["estimates", "truth", "map", "landmarks"])
def test_an_edited_table_is_refused(whole, tmp_path, name):
    shutil.copytree(whole, tmp_path / "out")
    path = tmp_path / "out" / f"{name}.parquet"
    table = pd.read_parquet(path)
    table.assign(x=table["x"] + 1e-9).to_parquet(path, index=False)
    said = rf"{name}\.parquet: is not as it was written, .*; write the folder again, or, .* 'contents' of manifest.json"
    with pytest.raises(cs.InputError, match=said):
        open_results(tmp_path / "out")
    accept_changes(tmp_path / "out")
    assert open_results(tmp_path / "out")


def test_a_folder_of_before_has_no_digests(whole, tmp_path):
    shutil.copytree(whole, tmp_path / "out")
    change_manifest(tmp_path / "out", "contents", "machines")
    assert open_results(tmp_path / "out").finished_runs(FILTER) == set(range(RUNS))


def test_another_processor_is_named(run, whole, tmp_path, capsys):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    manifest = json.loads((out / "manifest.json").read_text())
    (here,) = manifest["machines"]
    assert here["cpu"]
    assert here["blas"]
    old = {"cpu": "Z80", "blas": "Prescott"}
    capsys.readouterr()
    run(runs=RUNS + 1, out=out, resume=True)
    assert "last digits" not in capsys.readouterr().err
    change_manifest(out, "contents", machines=[old])
    run(runs=RUNS + 2, out=out, resume=True)
    assert "Z80 (BLAS: Prescott) computed the runs that are there" in capsys.readouterr().err
    assert open_results(out).manifest["machines"] == [old, here]
