"""Kernels compiled side by side: nothing is left behind, whoever is killed, and what is not kept is compiled here."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from consistency.filters.kernel import foreseen, kept
from consistency.filters.kernel.content import Content
from consistency.filters.kernel.foreseen import FIRST
from consistency.runs import compiling

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="kernels are compiled side by side on Linux")
SCRIPT = """
import multiprocessing, os, resource, signal, sys, time
from pathlib import Path
from consistency.filters.compiled import Compiled
from consistency.filters.kernel.jit import Kernel
from consistency.runs import compiling

here, what, jobs = os.getpid(), sys.argv[1], int(sys.argv[2])

def total(values):
    result = 0.0
    for value in values:
        result += value
    return result

class Sum(Compiled):
    def __init__(self, name, values):
        self.name, self.values, self.kernel = name, values, Kernel(total)
    def outlook(self, *_):
        return self.kernel.outlook(self.values)
    def compile(self, *_):
        if os.getpid() != here:
            Path(sys.argv[3], str(os.getpid())).touch()
            if what == "die":
                os.kill(os.getpid(), signal.SIGKILL)
            if what in ("hang", "abandon"):
                os.kill(here, signal.SIGALRM)
                time.sleep(60.0)
        self.kernel.compile(self.values)

def wake(*_):
    if what == "abandon":
        os.kill(here, signal.SIGKILL)
    raise KeyboardInterrupt

filters = [Sum("two", (1.0, 2.0)), Sum("three", (1.0, 2.0, 3.0)), Sum("again", (4.0, 5.0))]
if what == "full":
    resource.setrlimit(resource.RLIMIT_FSIZE, (2048, 2048))
if what in ("hang", "abandon"):
    signal.signal(signal.SIGALRM, wake)
try:
    compiling.compile_for(filters, None, None, jobs)
except KeyboardInterrupt:
    print("stopped")
else:
    print(*(f.kernel(f.values) for f in filters), *(f.kernel.loaded for f in filters))
assert not multiprocessing.active_children()
"""


@pytest.fixture
def folder() -> Iterator[Path]:
    """A folder that other users can read, with the script and the numbers of the processes that have compiled."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name)
        path.chmod(0o755)
        (path / "script.py").write_text(SCRIPT)
        (path / "processes").mkdir()
        yield path


def done(folder: Path, what: str = "", jobs: int = 2, **options: object) -> tuple[str, str]:
    """What the script says on standard output and error."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache")}
    command = [sys.executable, str(folder / "script.py"), what, str(jobs), str(folder / "processes")]
    process = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=120, check=False, **options
    )  # type: ignore[call-overload]
    assert process.returncode == (-signal.SIGKILL if what == "abandon" else 0), process.stderr
    return process.stdout.strip(), process.stderr


def processes(folder: Path) -> list[int]:
    return [int(path.name) for path in (folder / "processes").iterdir()]


def living(folder: Path) -> list[int]:
    return [number for number in processes(folder) if Path(f"/proc/{number}").exists()]


@LINUX
def test_kernels_are_compiled_side_by_side_and_once(folder: Path) -> None:
    """Two of the three filters have one kernel."""
    out, err = done(folder)
    assert out == "3.0 6.0 9.0 1 1 1"
    assert err == "compiling 2 kernels of two, three: about 1 s, once\n"
    assert len(processes(folder)) == 2
    assert not living(folder)
    assert done(folder) == ("3.0 6.0 9.0 1 1 1", "")
    assert len(processes(folder)) == 2


@LINUX
def test_one_job_compiles_here(folder: Path) -> None:
    out, err = done(folder, jobs=1)
    assert out == "3.0 6.0 9.0 0 0 1"
    assert err.count("\n") == 1
    assert not processes(folder)


@LINUX
def test_what_killed_compilers_leave_is_compiled_here(folder: Path) -> None:
    assert done(folder, "die")[0] == "3.0 6.0 9.0 0 0 1"
    assert len(processes(folder)) == 2


@LINUX
def test_a_disk_that_is_full_costs_the_cache_alone(folder: Path) -> None:
    """A limit on the size of files, which refuses what is written in the middle of it."""
    out, err = done(folder, "full")
    assert out == "3.0 6.0 9.0 0 0 0"
    assert err.count("is not kept") == 1
    assert {path.suffix for path in (folder / "cache" / "filter-consistency").iterdir()} <= {".lock", ".txt"}


@LINUX
@pytest.mark.parametrize("what", ["hang", "abandon"])
def test_no_compiler_outlives_who_waits_for_it(folder: Path, what: str) -> None:
    """Whether that is stopped or killed."""
    assert done(folder, what)[0] == ("stopped" if what == "hang" else "")
    assert processes(folder)
    until = time.monotonic() + 10.0
    while living(folder) and time.monotonic() < until:
        time.sleep(0.02)
    assert not living(folder)


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="only root can become another user")
def test_kernels_of_root_serve_other_users(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in an image: made by root, read-only to who runs, who can still compile what is missing."""
    nobody = {"user": 65534, "group": 65534, "extra_groups": []}
    tried = subprocess.run([sys.executable, "-c", "import consistency"], check=False, capture_output=True, **nobody)  # type: ignore[call-overload]
    if tried.returncode:
        pytest.skip("another user cannot read this environment")
    done(folder, jobs=1)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder / "cache"))
    assert done(folder, jobs=1, **nobody)[0] == "3.0 6.0 9.0 0 0 0"  # root's own cache is not for others to read
    kept.open_to_readers()
    before = sorted(kept.folder().iterdir())
    assert done(folder, **nobody) == ("3.0 6.0 9.0 1 1 1", "")
    one = next(kept.folder().glob("*.kernel"))
    one.unlink()
    out, err = done(folder, **nobody)
    assert sorted(out.split()[3:]) in (["0", "0", "1"], ["0", "1", "1"])
    assert err.count("is not kept") == 1
    assert sorted(kept.folder().iterdir()) == [path for path in before if path != one]


# --- what is foreseen -------------------------------------------------------------------------------


def inner(x: float) -> float:
    return x + 1.0


def outer(x: float) -> float:
    return inner(x) * 2.0


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    kept.folder().mkdir(mode=0o700)
    return kept.folder() / foreseen.FILE


def test_seconds_are_those_of_this_machine(cache: Path) -> None:
    assert foreseen.seconds_for(10_000) == pytest.approx(10_000 * FIRST)
    cache.write_text("1000 2\nnonsense\n1000 4\n0 7\n1000 -1\n1000 nan\n2000 200\n")
    assert foreseen.seconds_for(10_000) == pytest.approx(40.0)
    cache.write_text("1 100\n" * 50 + "1000 2\n" * foreseen.RECENT)
    assert foreseen.seconds_for(10_000) == pytest.approx(20.0)


def test_what_compiling_took_is_kept(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(foreseen.time, "monotonic", iter([0.0, 3.0, 5.0, 6.0, 7.0, 9.0]).__next__)
    for size in (1000.0, 500.0):
        with foreseen.measured(size):
            pass
    assert cache.read_text() == "1000 3.000\n500 1.000\n"
    monkeypatch.setattr(foreseen, "LONGEST", 5)
    with foreseen.measured(10.0):
        pass
    assert cache.read_text() == "10 2.000\n"


def test_the_size_is_that_of_all_functions() -> None:
    sizes = Content(outer, ()).functions
    assert sizes == {f"{__name__}.{f.__name__}": len(f.__code__.co_code) for f in (inner, outer)}


def test_seconds_of_several() -> None:
    """The second kernel of a process shares functions with the first."""
    assert compiling._wall([10.0], 1) == 10.0
    assert compiling._wall([10.0, 20.0], 1) == 25.0
    assert compiling._wall([10.0, 20.0], 2) == 20.0
    assert compiling._wall([10.0, 10.0, 10.0, 10.0], 2) == 15.0
