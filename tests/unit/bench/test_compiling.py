"""Kernels compiled side by side: nothing is left behind, whoever is killed, and what is not kept is compiled here."""

import os
import pickle
import signal
import sys
import tempfile
import time
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace

import forks
import pytest

from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.compiler import jit
from consistency.bench.filters.compiler.jit import Content, Outlook
from consistency.bench.filters.run_filter import resolve_filters
from consistency.bench.runs import run_outcome
from consistency.bench.runs.reproduce_findings import experiments
from consistency.bench.scenario import load_scenario

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="kernels are compiled side by side on Linux")
SCRIPT = """
import multiprocessing, os, resource, signal, sys, time
from pathlib import Path
from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.compiler.jit import Kernel
from consistency.bench.runs import run_outcome

def total(values):
    result = 0.0
    for value in values:
        result += value
    return result

class Sum(Compiled):
    def __init__(self, name, values):
        self.name, self.values, self.kernel = name, values, Kernel(total)
    def __reduce__(self):
        return Sum, (self.name, self.values)
    def outlook(self, *_):
        return self.kernel.outlook(self.values)
    def compile(self, *_):
        if os.getpid() != here:
            Path(folder, "processes", str(os.getpid())).touch()
            if what == "die":
                os.kill(os.getpid(), signal.SIGKILL)
            if what in ("hang", "abandon"):
                if not os.path.exists(f"{folder}/signalled"):
                    Path(folder, "signalled").touch()
                    os.kill(here, signal.SIGINT)
                time.sleep(600.0)
        self.kernel.compile(self.values)

def case():
    os.environ["NUMBA_CACHE_DIR"] = f"{folder}/cache"
    filters = [Sum("two", (1.0, 2.0)), Sum("three", (1.0, 2.0, 3.0)), Sum("again", (4.0, 5.0))]
    if what == "full":
        resource.setrlimit(resource.RLIMIT_FSIZE, (2048, 2048))
    if what == "abandon":
        signal.signal(signal.SIGINT, lambda *_: os.kill(here, signal.SIGKILL))
    if what == "nobody":
        os.setgroups([])
        os.setgid(65534)
        os.setuid(65534)
    try:
        run_outcome.compile_all(((f, None, None) for f in filters), int(jobs))
    except KeyboardInterrupt:
        print("stopped")
    else:
        print(*(f.kernel(f.values) for f in filters), *(f.kernel.loaded for f in filters))
    assert not multiprocessing.active_children()

os.environ["NUMBA_CACHE_DIR"] = os.devnull
Kernel(total)((1.0,))  # what another user may not read is loaded
"""


@pytest.fixture
def folder():
    """A folder that other users can read, for the cache and the numbers of the processes that have compiled."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name)
        path.chmod(0o755)
        (path / "processes").mkdir()
        (path / "processes").chmod(0o777)
        yield path


@pytest.fixture
def done(folder):
    """Does a case, and gives what it says on standard output and error."""

    def done(what="", jobs=2):
        code = f"folder, what, jobs, here = {str(folder)!r}, {what!r}, {jobs}, os.getpid(); case()"
        program = forks.done(SCRIPT, code, "-c", cwd=folder)
        assert program.returncode == (-signal.SIGKILL if what == "abandon" else 0), program.stderr
        return program.stdout.strip(), program.stderr

    return done


def processes(folder):
    return [int(path.name) for path in (folder / "processes").iterdir() if path.name.isdecimal()]


def living(folder):
    return [number for number in processes(folder) if Path(f"/proc/{number}").exists()]


@LINUX
def test_kernels_are_compiled_side_by_side_and_once(done, folder):
    """Two of the three filters have one kernel."""
    out, err = done()
    assert out == "3.0 6.0 9.0 1 1 1"
    assert err == "compiling 2 kernels of two, three, once: 10 to 60 s for each\n"
    assert 1 <= len(processes(folder)) <= 2  # the first may be done with both before the second has started
    assert not living(folder)
    count = len(processes(folder))
    assert done() == ("3.0 6.0 9.0 1 1 1", "")
    assert len(processes(folder)) == count


@LINUX
def test_one_job_compiles_here(done, folder):
    out, err = done(jobs=1)
    assert out == "3.0 6.0 9.0 0 0 1"
    assert err.count("\n") == 1
    assert not processes(folder)


@LINUX
def test_what_killed_compilers_leave_is_compiled_here(done, folder):
    assert done("die")[0] == "3.0 6.0 9.0 0 0 1"
    assert 1 <= len(processes(folder)) <= 2


@LINUX
def test_a_disk_that_is_full_costs_the_cache_alone(done, folder):
    """A limit on the size of files, which refuses what is written in the middle of it."""
    out, err = done("full")
    assert out == "3.0 6.0 9.0 0 0 0"
    assert err.count("is not kept") == 1
    assert {path.suffix for path in (folder / "cache" / "filter-consistency").iterdir()} <= {".lock", ".txt"}


@LINUX
@pytest.mark.parametrize("what", ["hang", "abandon"])
def test_no_compiler_outlives_who_waits_for_it(done, folder, what):
    """Whether that is stopped or killed."""
    assert done(what)[0] == ("stopped" if what == "hang" else "")
    assert processes(folder)
    until = time.monotonic() + 10.0
    while living(folder) and time.monotonic() < until:
        time.sleep(0.02)
    assert not living(folder)


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="only root can become another user")
def test_kernels_of_root_serve_other_users(done, folder, monkeypatch):
    """As in an image: made by root, read-only to who runs, who can still compile what is missing."""
    (folder / "processes").chmod(0o777)
    done(jobs=1)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder / "cache"))
    out, err = done("nobody")
    assert out == "3.0 6.0 9.0 0 0 0"  # root's own cache is not for others to read
    assert "Permission denied" in err
    jit.folder().chmod(0o755)
    for path in jit.folder().glob("*.kernel"):
        path.chmod(0o644)
    before = sorted(jit.folder().iterdir())
    assert done("nobody") == ("3.0 6.0 9.0 1 1 1", "")
    for path in jit.folder().glob("*.kernel"):
        path.unlink()
    out, err = done("nobody")
    assert out == "3.0 6.0 9.0 0 0 0"
    assert err.count("is not kept") == 1
    assert {*before} - {*jit.folder().iterdir()} == {path for path in before if path.suffix == ".kernel"}


def test_what_others_cannot_read_is_compiled_here(capsys):
    made = []

    class Mine(Compiled):
        name = "mine"

        def __init__(self, key):
            self.key = key

        def outlook(self, *_):
            return Outlook(self.key, is_ready=False, is_shared=False, size=4)

        def compile(self, *_):
            made.append(self.key)

    run_outcome.compile_all([(Mine("a"), None, None), (Mine("b"), None, None)], 2)  # type: ignore[arg-type]
    assert made == ["a", "b"]
    assert capsys.readouterr().err == "compiling 2 kernels of mine, once: 10 to 60 s for each\n"


def test_a_few_filters_are_named():
    needs = [SimpleNamespace(filter=SimpleNamespace(name=name)) for name in "abcde"]
    assert run_outcome._label(needs) == "compiling 5 kernels of a, b, c and 2 more"
    assert run_outcome._label(needs[:1]) == "compiling the kernel of a"


# --- the size ---------------------------------------------------------------------------------------


def inner(x):
    return x + 1.0


def outer(x):
    return inner(x) * 2.0


def test_the_size_is_that_of_all_functions():
    assert Content(outer, ()).size == sum(len(f.__code__.co_code) for f in (inner, outer))


def test_the_largest_kernel_is_compiled_first(monkeypatch):
    """It may take as long as two others."""
    begun = []

    class Pool:
        def __init__(self, *_, **__): ...

        def submit(self, _, need):
            begun.append(pickle.loads(need)[0])
            done = Future()
            done.set_result(None)
            return done

        def shutdown(self, **_): ...

    monkeypatch.setattr(run_outcome, "ProcessPoolExecutor", Pool)
    needs = [run_outcome.Need(f"of {size}", None, None, Outlook("", False, True, size)) for size in (2, 3, 1)]
    run_outcome._compile_side_by_side(needs, 2)
    assert begun == ["of 3", "of 2", "of 1"]


# --- before what takes long -------------------------------------------------------------------------


def test_what_experiments_say_that_they_need_fits():
    needs = [need for module in experiments().values() for need in getattr(module, "KERNELS", {}).items()]
    assert len(needs) > 5
    for world, names in needs:
        assert len(resolve_filters(names, load_scenario(world).belief)) == len(names)
