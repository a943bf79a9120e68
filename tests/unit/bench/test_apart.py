"""Calls in a thread that takes no signals, and trials that are given up."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import consistency as cs
from consistency.bench.filters.compiled import Compiled, Halted
from consistency.bench.filters.compiler.uninterrupted import apart
from consistency.bench.runs.isolation.filter_process import Isolation


@pytest.fixture
def ctrl_c() -> Iterator[None]:
    """Ctrl-C as in a terminal."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_the_main_thread_does_not_make_the_call_itself() -> None:
    assert apart(threading.current_thread) is not threading.main_thread()
    inner = apart(lambda: (threading.current_thread(), apart(threading.current_thread)))
    assert inner[0] is inner[1], "a thread that takes no signals needs no other"


def test_results_and_exceptions_come_back() -> None:
    assert apart(divmod, 7, 2) == (3, 1)
    with pytest.raises(ZeroDivisionError):
        apart(divmod, 7, 0)


@pytest.mark.usefixtures("ctrl_c")
@pytest.mark.skipif(os.name == "nt", reason="signals")
@pytest.mark.parametrize("looks", [True, False])
def test_ctrl_c_does_not_wait_for_the_call(looks: bool) -> None:
    told, over = threading.Event(), threading.Event()

    def work() -> None:
        os.kill(os.getpid(), signal.SIGINT)
        (told if looks else over).wait(20.0)
        over.set()

    begin = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        apart(work, stop=told.set)
    assert time.monotonic() - begin < 5.0
    assert told.is_set()
    assert over.is_set() == looks, "what looks has ended, what does not is left alone"
    over.set()


@pytest.mark.skipif(os.name == "nt", reason="signals")
@pytest.mark.parametrize(("seconds", "ended"), [(0.4, True), (30.0, False)])
def test_what_was_given_up_is_waited_for_at_exit(seconds: float, ended: bool, tmp_path: Path) -> None:
    """Compiled code that ends while Python shuts down would abort it."""
    program = f"""
import os, signal, time, pathlib
from consistency.bench.filters.compiler.uninterrupted import apart
signal.signal(signal.SIGINT, signal.default_int_handler)
def work():
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep({seconds})
    pathlib.Path("ended").touch()
apart(work)
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, timeout=20)
    assert done.returncode in (-signal.SIGINT, 1, 130), done.stderr
    assert "KeyboardInterrupt" in done.stderr
    assert (tmp_path / "ended").exists() == ended


@pytest.mark.usefixtures("ctrl_c")
@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_what_cannot_be_stopped_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    over = threading.Event()

    def work() -> None:
        os.kill(os.getpid(), signal.SIGINT)
        over.wait(20.0)

    monkeypatch.setattr("consistency.bench.filters.compiler.uninterrupted.PATIENCE", 20.0)
    begin = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        apart(work)
    assert time.monotonic() - begin < 5.0
    over.set()


def test_a_trial_that_was_given_up(linear: cs.Scenario) -> None:
    filter_ = cs.get_filter("kf")
    assert isinstance(filter_, Compiled)
    with pytest.raises(Halted, match="'kf' was told to stop in step 1"):
        filter_.run(cs.simulate(linear), linear.belief, np.ones(1, np.int64))


def test_the_end_of_a_study_gives_up_its_trials(linear: cs.Scenario) -> None:
    trial, isolation = cs.simulate(linear), Isolation([cs.get_filter("kf")], linear.belief)
    with isolation:
        assert len(isolation.run(trial)) == 1
    with pytest.raises(Halted):
        isolation.run(trial)
    with isolation:
        assert isolation.run(trial)[0].failure is None


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc")
@pytest.mark.parametrize(("seconds", "status"), [(0.2, -signal.SIGABRT), (30.0, 3)])
def test_destructors_of_libraries_are_left_out_while_something_works(seconds: float, status: int) -> None:
    """Those of LLVM would crash a compiler that goes on; Python's own handlers run, and the status stays."""
    program = f"""
import atexit, ctypes, os, signal, sys, time
libc = ctypes.CDLL(None)
libc.on_exit(libc.abort, None)  # in place of a destructor
atexit.register(print, "handled")
from consistency.bench.filters.compiler.uninterrupted import apart
signal.signal(signal.SIGINT, signal.default_int_handler)
try:
    apart(lambda: (os.kill(os.getpid(), signal.SIGINT), time.sleep({seconds})))
except KeyboardInterrupt:
    sys.exit(3)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=20)
    assert (done.returncode, done.stdout) == (status, "handled\n"), done.stderr
