"""Whatever ends the process, at random moments: finished runs are kept, and a resume gives the bytes of one go.

A process of the command line each: the first of its own, the others forks. The same faults inside one process are in
``tests/unit/bench/test_journal.py``.
"""

import os
import random
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from forks import LIMIT
from own_process import COMPILING, begun, size_of

from consistency.bench.scenario import data_folder
from consistency.bench.store.journal import DATABASE, Journal
from consistency.bench.store.results import open_results

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals")
RUNS = 1000  # of some milliseconds each
FILTER = "kf"
UNFINISHED = ".out.unfinished"


@pytest.fixture(scope="module")
def at(tmp_path_factory):
    """A folder with a short world and results of one go."""
    folder = tmp_path_factory.mktemp("faults")
    text = (data_folder("scenarios") / "linear-gaussian.toml").read_text()
    (folder / "world.toml").write_text(text.replace(f"steps = {steps_of(text)}", "steps = 40"))
    done = subprocess.run(words("whole"), cwd=folder, capture_output=True, text=True, timeout=COMPILING)
    assert done.returncode == 0, done.stderr
    return folder


def steps_of(text):
    return next(line.split("=")[1].strip() for line in text.splitlines() if line.startswith("steps"))


def words(out="out", runs=RUNS):
    """The command as a process of its own."""
    options = ["--filter", FILTER, "--out", out, "--runs", str(runs), "--jobs", "2"]
    return [sys.executable, "-m", "consistency", "run", "world.toml", *options]


def begin(at, *options, runs=RUNS, **how):
    return begun(*words(runs=runs)[3:], *options, cwd=at, **how)


def end(process):
    """Exit status and what was said on standard error."""
    _, error = process.communicate()
    return process.wait(), error


def wait_for(condition, process):
    end = time.monotonic() + LIMIT
    while not condition() and process.poll() is None and time.monotonic() < end:
        time.sleep(0.002)


def working(at, size=200_000):
    """Whether the journal has grown so large."""
    return lambda: journal_size(at / UNFINISHED) > size


def journal_size(folder):
    """Bytes of the database and of its log."""
    return size_of(folder / DATABASE) + size_of(folder / f"{DATABASE}-wal")


def kept(at):
    journal = Journal(at / UNFINISHED / DATABASE)
    journal.close()
    return len(journal.runs)


def kept_beside(at):
    """As :func:`kept`, of a journal that another process writes."""
    shutil.copytree(at / UNFINISHED, at / ".out-copied")
    journal = Journal(at / ".out-copied" / DATABASE)
    journal.close()
    return len(journal.runs)


@pytest.fixture
def fresh(at):
    for path in at.iterdir():
        if path.name.startswith(("out", ".out")):
            shutil.rmtree(path)
    return at


def require_same(at, out="out"):
    for path in (at / "whole").glob("*.parquet"):
        assert (at / out / path.name).read_bytes() == path.read_bytes(), path.name
    assert not (at / f".{out}.unfinished").exists()


def resume(at):
    status, error = end(begin(at, "--resume"))
    assert status == 0, error
    require_same(at)


def one_sentence(error):
    """What was said beside progress."""
    lines = [line for line in error.splitlines() if not line.startswith("runs: ")]
    assert len(lines) == 1, error
    return lines[0]


def test_killed_and_resumed(fresh):
    pipe = subprocess.PIPE
    with subprocess.Popen(words(), cwd=fresh, stdout=pipe, stderr=pipe, text=True) as process:
        wait_for(working(fresh), process)
        process.kill()
        process.communicate(timeout=LIMIT)
    done = kept(fresh)
    assert 0 < done < RUNS
    resume(fresh)


@pytest.mark.slow
def test_twenty_kills_at_random_moments(fresh):
    """Half of them while runs are done, half while the tables are written or put in place."""
    moments, done = random.Random(), 0
    for kill in range(20):
        late = kill >= 10
        process = begin(fresh, *["--resume"] * (kill > 0))
        tables, journal = fresh / UNFINISHED / "tables", fresh / UNFINISHED / DATABASE
        size = journal_size(fresh / UNFINISHED)
        wait_for(tables.exists if late else working(fresh, size + 3_000), process)
        time.sleep(moments.uniform(0.0, 0.15))
        process.kill()
        process.communicate()
        if not journal.exists():  # it was just done
            assert open_results(fresh / "out").finished_runs([FILTER]) == set(range(RUNS))
            done = 0  # in the journal of the next command, which begins anew beside these results
            continue
        now = kept(fresh)
        assert now >= done
        done = now
    resume(fresh)


GONE = (
    "consistency: stopped; finished runs are kept where there are any: the same command continues, 'run' with --resume"
)


@pytest.mark.slow
@pytest.mark.parametrize("name, status, said", [("SIGINT", 130, GONE), ("SIGTERM", -15, ""), ("SIGHUP", -1, "")])
def test_a_signal_keeps_what_is_finished(fresh, name, status, said):
    """The same command writes what is finished, and goes on."""
    process = begin(fresh)
    wait_for(working(fresh), process)
    os.kill(process.pid, getattr(signal, name))
    assert end(process)[0] == status
    assert not (fresh / "out").exists()
    status, error = end(begun("analyse", "out", cwd=fresh))
    assert status == 2
    assert "out: not written yet, its runs are in a journal" in one_sentence(error)
    done = kept(fresh)
    assert done > 0
    status, error = end(begin(fresh, "--resume", runs=1))
    assert status == 0, error
    assert len(open_results(fresh / "out").finished_runs([FILTER])) == done
    resume(fresh)


@pytest.mark.slow
def test_ctrl_c_says_one_line(fresh):
    process = begin(fresh)
    wait_for(working(fresh), process)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    status, error = end(process)
    assert status == 130
    assert one_sentence(error) == GONE
    resume(fresh)


@pytest.mark.slow
def test_a_terminal_that_is_closed(fresh):
    """SIGHUP to all, and nothing can be written any more."""
    terminal, theirs = os.pipe()
    process = begin(fresh, out=theirs, err=theirs)
    os.close(theirs)
    wait_for(working(fresh), process)
    os.close(terminal)
    os.killpg(process.pid, signal.SIGHUP)
    assert process.wait() == -signal.SIGHUP
    assert kept(fresh) > 0
    resume(fresh)


@pytest.mark.slow
@pytest.mark.parametrize("how", ["pipe", "closed"])
def test_output_that_nobody_reads(fresh, how):
    """As ``2>&1 | head -1`` and ``>&- 2>&-``."""
    if how == "pipe":
        with nobody() as pipe:
            assert begin(fresh, out=pipe, err=pipe).wait() == 141
    else:
        command = f"{shlex.join(words())} >&- 2>&-"
        assert subprocess.run(["bash", "-c", command], cwd=fresh, timeout=LIMIT, check=False).returncode == 0
    require_same(fresh)


@contextmanager
def nobody():
    """The end of a pipe whose other end is closed."""
    other, pipe = os.pipe()
    os.close(other)
    yield pipe
    os.close(pipe)


@pytest.mark.slow
def test_standard_output_alone_is_closed(fresh):
    with nobody() as pipe:
        status, error = end(begin(fresh, out=pipe))
    assert status == 141
    assert [line for line in error.splitlines() if not line.startswith("runs: ")] == []
    require_same(fresh)


@pytest.mark.slow
def test_a_limit_on_the_size_of_files(fresh):
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, resource.RLIM_INFINITY))"
    status, error = end(begin(fresh, before=limit))
    assert status == 2
    done = kept(fresh)
    said = f"--out out: cannot be written (disk I/O error); {done} finished runs are kept, and the same command"
    assert said in one_sentence(error)
    resume(fresh)


@pytest.mark.slow
def test_three_processes_on_one_place(fresh):
    first = begin(fresh)
    wait_for(working(fresh), first)
    os.killpg(first.pid, signal.SIGSTOP)  # as a terminal does
    for options in ((), ("--overwrite",), ("--resume",)):
        status, error = end(begin(fresh, *options))
        assert status == 2
        assert "another process is at work on it" in one_sentence(error)
    os.killpg(first.pid, signal.SIGCONT)
    assert end(first)[0] == 0
    require_same(fresh)


@pytest.mark.slow
def test_results_that_are_removed_meanwhile(fresh):
    """Those that a resume goes on from: the runs that it has done are kept."""
    assert end(begin(fresh, runs=50))[0] == 0
    process = begin(fresh, "--resume")
    wait_for(working(fresh), process)
    shutil.rmtree(fresh / "out")
    assert end(process)[0] == 2
    assert kept(fresh) == RUNS - 50
    resume(fresh)


@pytest.mark.slow
def test_memory_that_is_taken_away(fresh):
    """A limit on the address space at what is taken; no run is lost.

    There is a sentence, or the C library ends the process, or Python waits for ever for a thread that never began.
    """
    process = begin(fresh)
    wait_for(working(fresh), process)
    taken = int(Path(f"/proc/{process.pid}/statm").read_text().split()[0]) * resource.getpagesize()
    resource.prlimit(process.pid, resource.RLIMIT_AS, (taken, resource.RLIM_INFINITY))
    done = kept_beside(fresh)
    with suppress(subprocess.TimeoutExpired):
        process.wait(20.0)
    process.kill()
    status, error = end(process)
    assert "Traceback" not in error
    if status > 0:  # below 0 a library aborted, by a signal
        assert "memory" in error.lower() or "resource temporarily unavailable" in error.lower()  # of a thread
    if (fresh / UNFINISHED).exists():  # else the results are there, and a verdict may be missing
        assert kept(fresh) >= done > 0
        resume(fresh)
    require_same(fresh)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device that is always full")
@pytest.mark.parametrize("arguments", [["list"], ["--help"]])
def test_standard_output_on_a_full_disk(arguments):
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "consistency", *arguments]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=LIMIT)
    assert done.returncode == 2
    assert done.stderr == "consistency: output cannot be written (No space left on device)\n"
