"""A command that any signal ends at once, workers that end with it, and what is cleared by the next command."""

import os
import pty
import re
import select
import signal
import subprocess
import sys
import threading
import time
import traceback

import pytest

from consistency.referee import system
from consistency.referee.errors import InputError
from consistency.referee.system import (
    NewFolder,
    away_from_signals,
    end_with_parent,
    link_to_parent,
    read_manifest,
    require_free,
    unfinished_of,
    write_folder,
    write_whole,
)

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="fork")
STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
SLEEPS = "print('there', flush=True); time.sleep(60)"
IN_C = "print('there', flush=True); ctypes.CDLL(None).sleep(60)"  # as a compiler, which releases the GIL
SWALLOWS = """
print('there', flush=True)
while True:
    try:
        time.sleep(60)
    except BaseException:
        pass
"""
COMMAND = """
import ctypes, os, sys, time
import consistency.commands as cli
from consistency.__main__ import main
sys.argv = ["consistency", {word!r}]
cli.main = lambda: exec({work!r}, globals())
main()
"""


def begun(work, word="list", ignored=None, err=subprocess.PIPE):
    """The command line whose command is ``work``, once that is there, with signals as in a terminal."""

    def as_in_a_terminal():
        for number in STOPS:
            signal.signal(number, signal.SIG_IGN if number == ignored else signal.SIG_DFL)

    process = subprocess.Popen(
        [sys.executable, "-c", COMMAND.format(word=word, work=work)], stdout=subprocess.PIPE, stderr=err, text=True,
        start_new_session=True, preexec_fn=as_in_a_terminal,
    )  # fmt: skip
    process.stdout.readline()
    return process


@pytest.mark.parametrize("work", [SLEEPS, IN_C, SWALLOWS], ids=["sleeps", "in C", "swallows"])
@pytest.mark.parametrize(
    "number, status, line",
    [
        (signal.SIGINT, 130, "consistency: stopped\n"),
        (signal.SIGTERM, -signal.SIGTERM, ""),
        (signal.SIGHUP, -signal.SIGHUP, ""),
    ],
)
def test_a_signal_ends_a_command_whatever_it_does(work, number, status, line):
    process = begun(work)
    process.send_signal(number)
    assert process.communicate(timeout=30)[1] == line
    assert process.returncode == status


def test_ctrl_c_says_where_finished_runs_are_and_shows_the_cursor():
    terminal, theirs = pty.openpty()
    process = begun(SLEEPS, "run", err=theirs)
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=30) == ("", None)
    assert process.returncode == 130
    said = os.read(terminal, 1000).decode()
    assert said.startswith("\x1b[?25h")
    assert re.search(r"^consistency: stopped; finished runs are kept .* --resume\r\n$", said, re.MULTILINE)
    os.close(terminal)
    os.close(theirs)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_signal_that_the_caller_ignores_stays_ignored(number):
    process = begun("print('there', flush=True); time.sleep(0.5); print('done')", ignored=number)
    process.send_signal(number)
    assert process.communicate(timeout=30) == ("done\n", "")
    assert process.returncode == 0


@pytest.mark.parametrize("ends, status", [("pass", 0), ("raise SystemExit(2)", 2), ("sys.exit()", 0), ("1 / 0", 1)])
def test_without_a_signal_it_ends_as_its_work_did(ends, status):
    process = begun(f"print('there', flush=True)\n{ends}")
    process.communicate(timeout=30)
    assert process.returncode == status


def test_the_command_line_never_ends_its_caller(monkeypatch, capsys):
    """A notebook or a test that calls ``main`` gets SystemExit, and its handlers stay."""
    from consistency.commands import main

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    before = [signal.getsignal(number) for number in STOPS]
    monkeypatch.setattr(sys.modules["consistency.commands.app"], "app", interrupted)
    with pytest.raises(SystemExit) as end:
        main(["list", "--json"])
    assert end.value.code == 130
    assert capsys.readouterr().err == "consistency: stopped\n"
    assert [signal.getsignal(number) for number in STOPS] == before


# --- calls that no signal disturbs ----------------------------------------------------------------------


@pytest.fixture
def ctrl_c():
    """Ctrl-C as in a terminal."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_the_main_thread_does_not_make_the_call_itself():
    assert away_from_signals(threading.current_thread) is not threading.main_thread()
    outer, inner = away_from_signals(lambda: (threading.current_thread(), away_from_signals(threading.current_thread)))
    assert outer is inner, "a thread that takes no signals needs no other"


def test_results_and_exceptions_come_back():
    assert away_from_signals(divmod, 7, 2) == (3, 1)
    with pytest.raises(ZeroDivisionError):
        away_from_signals(divmod, 7, 0)


def functions_of(thread):
    """Names of the functions in which a thread is."""
    return [frame.f_code.co_name for frame, _ in traceback.walk_stack(sys._current_frames()[thread.ident or 0])]


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_comes_after_the_call():
    over = []

    def work():
        until = time.monotonic() + 20.0
        while "result" not in functions_of(threading.main_thread()) and time.monotonic() < until:
            time.sleep(0.001)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.3)
        over.append(True)

    with pytest.raises(KeyboardInterrupt):
        away_from_signals(work)
    assert over == [True]


# --- workers ---------------------------------------------------------------------------------------------

WORKER = """
import multiprocessing, os, sys, time
from consistency.referee import system
system.IS_LINUX = system.IS_LINUX and {prctl}

def work(*link):
    system.end_with_parent(*link)
    print('there', flush=True)
    time.sleep(60)

if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    context.Process(target=work, args=system.link_to_parent(context)).start()
    time.sleep(60)
"""


@pytest.mark.parametrize("prctl", [True, False])
def test_a_worker_ends_with_its_parent(prctl, tmp_path):
    """By the system, and by a pipe where the system cannot."""
    script = tmp_path / "script.py"
    script.write_text(WORKER.format(prctl=prctl))
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "there\n"
        process.kill()
        assert select.select([process.stdout], [], [], 20.0)[0], "the worker has the pipe as long as it lives"
        assert process.stdout.read() == ""


@pytest.mark.skipif(not system.IS_LINUX, reason="prctl")
def test_a_worker_whose_parent_has_ended_before_ends():
    child = os.fork()
    if child == 0:
        end_with_parent(os.getpid(), None)  # not the number of the parent
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 1


def test_workers_share_one_pipe():
    import multiprocessing

    context = multiprocessing.get_context("spawn")
    assert link_to_parent(context)[1] is link_to_parent(context)[1]
    assert link_to_parent(context)[0] == os.getpid()


# --- what killed commands leave ------------------------------------------------------------------------


def killed_while(work):
    """Do ``work`` in a process that is killed then."""
    child = os.fork()
    if child == 0:
        work()
        os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_what_is_left_in_the_way_is_cleared_by_the_next_command(tmp_path):
    out = tmp_path / "out"
    killed_while(lambda: (NewFolder(out, "log").path / "table").touch())
    assert len(names(tmp_path)) == 1
    others = tmp_path / ".out-2.elsewhere-1.x.partial"  # of another place, and of another machine
    others.mkdir()
    with NewFolder(out, "log") as ours:
        require_free(out, overwrite=False)
        assert names(tmp_path) == sorted([others.name, ours.path.name]), "who lives keeps what it has"
    assert names(tmp_path) == [others.name]


def test_a_folder_that_was_being_replaced_is_put_back(tmp_path, monkeypatch):
    out, manifest = tmp_path / "out", {"kind": "log", "schema_version": 1}
    write_folder(out, manifest, lambda path: (path / "old").touch())
    replace = os.replace

    def killed(source, target):
        replace(source, target)
        os.kill(os.getpid(), signal.SIGKILL)

    def overwritten():
        monkeypatch.setattr(os, "replace", killed)
        write_folder(out, manifest, lambda path: (path / "new").touch(), overwrite=True)

    killed_while(overwritten)
    assert not out.exists()
    with pytest.raises(InputError, match="exists already"):
        require_free(out, overwrite=False)
    assert names(tmp_path) == ["out"]
    assert "old" in names(out)


def test_a_file_that_was_being_written_is_cleared(tmp_path, monkeypatch):
    def half():
        monkeypatch.setattr(os, "fsync", lambda _: os.kill(os.getpid(), signal.SIGKILL))
        write_whole(tmp_path / "page.html", b"half")

    killed_while(half)
    assert len(names(tmp_path)) == 1
    write_whole(tmp_path / "page.html", b"whole")
    assert names(tmp_path) == ["page.html"]


def test_a_place_that_has_only_a_journal_says_so(tmp_path):
    out = tmp_path / "night"
    unfinished_of(out).mkdir()
    with pytest.raises(
        InputError, match=r"night: not written yet, its runs are in a journal; .* --resume --runs 1 writes"
    ):
        read_manifest(out)
