"""A command that is gone within two seconds of a signal, and what it leaves; by the standard library alone."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from consistency.referee.system import stopping
from consistency.referee.system.stopping import STOPS, stoppable

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="fork")

HANGS = "import signal; [signal.signal(n, signal.SIG_IGN) for n in (1, 2, 15)]; "  # as a compiler does that never looks
SLEEPS = "import time; print('there', flush=True); time.sleep(60)"
CHILD = "import subprocess, sys; subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)']); "


def begun(work: str, ignored: int | None = None) -> subprocess.Popen[str]:
    """``work`` under supervision, once it is there, with signals as in a terminal."""

    def as_in_a_terminal() -> None:
        for number in STOPS:
            signal.signal(number, signal.SIG_IGN if number == ignored else signal.SIG_DFL)

    code = f"from consistency.referee.system.stopping import supervised\nsupervised(lambda: exec({work!r}, {{}}))"
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True, preexec_fn=as_in_a_terminal,
    )  # fmt: skip
    process.stdout.readline()
    return process


def session(leader: int) -> list[str]:
    """Processes of a session, of /proc."""
    stats = {path.parent.name: path for path in Path("/proc").glob("[0-9]*/stat")}
    left = []
    for pid, path in stats.items():
        try:
            state, _, _, sid, *_ = path.read_text(errors="replace").rpartition(")")[2].split()
        except OSError:
            continue
        left += [pid] * (int(sid) == leader and state != "Z")
    return left


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_what_does_not_look_is_killed(number: int, status: int) -> None:
    process = begun(HANGS + CHILD + SLEEPS)
    begin = time.monotonic()
    process.send_signal(number)
    _, error = process.communicate(timeout=30)
    assert time.monotonic() - begin > stopping.GRACE - 0.1
    assert process.returncode == status
    assert error == "consistency: stopped\n"
    assert sys.platform != "linux" or session(process.pid) == []


def test_the_grace_and_the_rest_are_two_seconds() -> None:
    assert stopping.GRACE + stopping.LEAVE < 2.0


def test_before_the_command_takes_signals_it_ends_at_once() -> None:
    process = begun(CHILD + SLEEPS)
    process.send_signal(signal.SIGTERM)
    assert process.communicate(timeout=30)[1] == "consistency: stopped\n"
    assert process.returncode == 143
    assert sys.platform != "linux" or session(process.pid) == []


def test_the_first_signal_is_the_status_and_what_was_said_is_enough() -> None:
    takes = "import signal, sys; signal.signal(15, lambda *_: sys.exit('own words')); "
    process = begun(takes + SLEEPS)
    process.send_signal(signal.SIGTERM)
    assert process.communicate(timeout=30) == ("", "own words\n")
    assert process.returncode == 143


def test_a_signal_that_the_caller_ignores_stays_ignored() -> None:
    process = begun("import time; print('there', flush=True); time.sleep(0.5); print('done')", ignored=signal.SIGHUP)
    process.send_signal(signal.SIGHUP)
    assert process.communicate(timeout=30) == ("done\n", "")
    assert process.returncode == 0


@pytest.mark.parametrize(
    ("ends", "status"),
    [("pass", 0), ("raise SystemExit(2)", 2), ("1 / 0", 1), ("import os; os.kill(os.getpid(), 9)", -9)],
)
def test_without_a_signal_it_ends_as_its_work_did(ends: str, status: int) -> None:
    process = begun(f"print('there', flush=True)\n{ends}")
    process.communicate(timeout=30)
    assert process.returncode == status


def test_the_work_dies_with_the_parent() -> None:
    process = begun(SLEEPS)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=30)  # its pipes are closed once all that had them are dead
    assert process.returncode == -signal.SIGKILL


def test_a_program_with_handlers_of_its_own_is_not_supervised() -> None:
    here: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda *_: None)
    try:
        stopping.supervised(lambda: here.append(os.getpid()))
    finally:
        signal.signal(signal.SIGTERM, before)
    assert here == [os.getpid()]


def test_a_program_that_was_stopped_ends_soon_and_flushes_what_is_open(tmp_path: Path) -> None:
    program = """if True:
        import atexit, gc, signal, sys
        from consistency.referee.system.stopping import stoppable
        signal.signal(signal.SIGINT, signal.default_int_handler)
        class Cycle: pass
        held = Cycle()
        held.own, held.file = held, open(sys.argv[1], "w")
        held.file.write("all of it")
        for _ in range(2):
            try:
                with stoppable():
                    signal.raise_signal(signal.SIGINT)
            except KeyboardInterrupt:
                pass
        assert gc.get_freeze_count() == 0
        del held
        gc.disable()
        atexit._run_exitfuncs()
        assert gc.get_freeze_count() > 1000
    """
    words = [sys.executable, "-c", program, str(tmp_path / "file")]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert (tmp_path / "file").read_text() == "all of it"
    assert done.stderr == ""


@pytest.mark.filterwarnings("error")
def test_an_interrupt_that_a_callback_drops_is_remembered_in_silence(capsys: pytest.CaptureFixture[str]) -> None:
    class Dropped:
        def __init__(self, action: Callable[[], object]) -> None:
            self.action = action

        def __del__(self) -> None:
            self.action()

    before, hook = sys.unraisablehook, sys.__unraisablehook__
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.unraisablehook = hook  # pytest's own collects them
    try:
        with stoppable() as stop:
            Dropped(lambda: signal.raise_signal(signal.SIGINT))
            assert stop.number == signal.SIGINT
            assert capsys.readouterr().err == ""
            Dropped(lambda: 1 / 0)  # what else is dropped is printed as before
            assert "ZeroDivisionError" in capsys.readouterr().err
        assert sys.unraisablehook is hook
    finally:
        sys.unraisablehook = before
        signal.signal(signal.SIGINT, handler)
