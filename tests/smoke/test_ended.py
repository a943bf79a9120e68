"""SIGKILL at random moments in runs until decided, runs of a log and sweeps: the bytes at the end are those of one go.

A process of the command line each. The same inside one process: ``test_kept_looks.py`` and ``test_kept_cells.py``.
"""

import os
import random
import signal
import time
from pathlib import Path

import pytest
from forks import LIMIT
from own_process import begun, consistency, size_of

from consistency.bench.scenario import data_folder
from consistency.bench.store.journal import DATABASE, Journal

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name == "nt", reason="signals")]
FILTER = ("--filter", "kf")
LOOKS = (
    "run",
    "world.toml",
    *FILTER,
    "--until-decided",
    "--detect",
    "1.02",
    "--false-alarm",
    "1e-6",
    "--max-runs",
    "700",
)
LOG = ("run", "--log", "log", *FILTER)
SWEEP = """
summary = "Densities of a linear world"
base = "world.toml"
filters = ["kf"]
[rule]
false_alarm = 1e-6
detect = 1.02
max_runs = 150
[grid]
density = [0.5, 1.0, 1.5]
"""


@pytest.fixture(scope="module")
def at(tmp_path_factory):
    """A folder with a world of 40 steps, a log and a sweep of it, and what each leaves in one go."""
    folder = tmp_path_factory.mktemp("ended")
    text = (data_folder("scenarios") / "linear-gaussian.toml").read_text()
    (folder / "world.toml").write_text(text.replace("steps = 500", "steps = 40"))
    (folder / "grid.toml").write_text(SWEEP)
    consistency("simulate", "world.toml", "--runs", "700", "--out", "log", cwd=folder)
    consistency(*LOOKS, "--out", "looks-whole", cwd=folder)
    consistency(*LOG, "--out", "log-whole", cwd=folder)
    consistency("sweep", "grid.toml", "--out", "sweep-whole", cwd=folder)
    return folder


def runs_in(journal):
    opened = Journal(journal)
    opened.close()
    return len(opened.runs)


def sizes(folder):
    """Bytes of each journal below a folder, while folders come and go."""
    for at, _, names in os.walk(folder):
        for name in {DATABASE, f"{DATABASE}-wal"} & set(names):
            yield size_of(Path(at) / name)


def stopped_once_grown(process, out, size, number, wait):
    """Send the signal some time after the journals below a folder have grown by ``size`` bytes in all."""
    before, end = sum(sizes(out.parent)), time.monotonic() + LIMIT
    while process.poll() is None and sum(sizes(out.parent)) < before + size and time.monotonic() < end:
        time.sleep(0.002)
    time.sleep(wait)
    process.send_signal(number)
    process.communicate()


@pytest.mark.parametrize("which", ["looks", "log"])
def test_killed_again_and_again(at, which):
    """No run that a journal has is lost by the next kill."""
    moments, command, name = random.Random(), {"looks": LOOKS, "log": LOG}[which], f"{which}-out"
    journal, done = at / f".{name}.unfinished" / DATABASE, 0
    for kill in range(8):
        process = begun(*command, "--out", name, *["--resume"] * (kill > 0), cwd=at)
        stopped_once_grown(process, at / name, 30_000, signal.SIGKILL, moments.uniform(0.0, 0.1))
        if not journal.exists():  # it was just done
            break
        now = runs_in(journal)
        assert now >= done
        done = now
    if journal.exists():
        assert done > 0
        consistency(*command, "--out", name, "--resume", cwd=at)
    for path in (at / f"{which}-whole").glob("*.parquet"):
        assert (at / name / path.name).read_bytes() == path.read_bytes(), path.name
    assert not journal.exists()


@pytest.mark.parametrize("name, status", [("SIGINT", 130), ("SIGTERM", -15)])
@pytest.mark.parametrize("which", ["looks", "log", "sweep"])
def test_a_signal_keeps_what_is_finished(at, which, name, status):
    command = {"looks": LOOKS, "log": LOG, "sweep": ("sweep", "grid.toml")}[which]
    out = at / f"{which}-{name}" / "out"
    process = begun(*command, "--out", str(out), cwd=at)
    end = time.monotonic() + LIMIT
    while process.poll() is None and time.monotonic() < end:
        if any(size > 50_000 for size in sizes(out.parent)):
            break
        time.sleep(0.002)
    process.send_signal(getattr(signal, name))
    _, error = process.communicate()
    assert process.returncode == status, error
    assert "Traceback" not in error
    assert error.rstrip().endswith("the same command continues, 'run' with --resume") == (name == "SIGINT")
    assert which == "sweep" or not out.exists()
    consistency(*command, "--out", str(out), *["--resume"] * (which != "sweep"), cwd=at)
    require_same(at, out, which)


def require_same(at, out, which):
    whole = at / f"{which}-whole"
    paths = list(whole.rglob("runs.csv") if which == "sweep" else whole.glob("*.parquet"))
    assert paths
    for path in paths:
        assert (out / path.relative_to(whole)).read_bytes() == path.read_bytes(), path.name
    assert not [*out.parent.rglob(".*.unfinished")]


def test_a_sweep_that_is_killed_again_and_again(at):
    moments, out = random.Random(), at / "killed" / "out"
    for _ in range(8):
        process = begun("sweep", "grid.toml", "--out", str(out), cwd=at)
        stopped_once_grown(process, out, 20_000, signal.SIGKILL, moments.uniform(0.0, 0.3))
    consistency("sweep", "grid.toml", "--out", str(out), cwd=at)
    require_same(at, out, "sweep")


def test_two_processes_on_one_sweep(at):
    """Each cell is done by one of them; one that is killed leaves its cell to the other."""
    out = at / "two" / "out"
    first, second = (begun("sweep", "grid.toml", "--out", str(out), cwd=at) for _ in range(2))
    stopped_once_grown(first, out, 20_000, signal.SIGKILL, 0.0)
    _, error = second.communicate()
    assert second.returncode == 0, error
    require_same(at, out, "sweep")
