"""Programs as forks of a process that has imported what they begin with: most of a short program is its imports."""

import atexit
import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
from contextlib import suppress
from functools import cache

LIMIT = 120.0  # s, of a program that compiles nothing new, on a busy machine
SERVER = """
import gc, json, os, signal, socket, sys

{imports}

gc.freeze()  # a fork that looks through all of it, to collect or to end, has a copy of it first
signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody asks how the forks end that wait for programs
link = socket.socket(fileno=os.dup(0))
while (received := socket.recv_fds(link, 2**16, 3))[0]:
    message, files, *_ = received
    if os.fork():
        for file in files:
            os.close(file)
        continue
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    if program := os.fork():
        os.write(files[2], b"%d\\n" % program)
        os.write(files[2], b"%d\\n" % os.waitstatus_to_exitcode(os.waitpid(program, 0)[1]))
        os._exit(0)
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # as in a terminal
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    for number, file in enumerate((os.open(os.devnull, os.O_RDONLY), *files[:2])):
        os.dup2(file, number)
        os.close(file)
    code, sys.argv, folder = json.loads(message)
    os.chdir(folder)
    exec(compile(code, "<string>", "exec"))
    sys.exit()
"""


class Program:
    """A running program: of :class:`subprocess.Popen` what tests use. It leads a session of its own."""

    def __init__(self, words, streams, told):
        self.args, self.returncode = words, None
        self._streams, self._told = streams, told
        self.pid = int(told.readline())

    def end(self):
        """Whatever it does."""
        self.kill()
        self.wait()
        for file in (*self._streams, self._told):
            if file is not None:
                file.close()

    def wait(self, timeout=LIMIT):
        if self.returncode is None:
            self._await(timeout)
            self.returncode = int(self._told.readline())
        return self.returncode

    def poll(self):
        with suppress(subprocess.TimeoutExpired):
            self.wait(0.0)
        return self.returncode

    def communicate(self, timeout=LIMIT):
        """What is in its files after its end and that of its forks; nothing of files that the caller has given."""
        self.wait(timeout)
        self._await(timeout)
        out, err = ("" if file is None else (file.seek(0), file.read())[1].decode() for file in self._streams)
        return out, err

    def send_signal(self, number):
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self):
        self.send_signal(signal.SIGKILL)

    def _await(self, timeout):
        if not select.select([self._told], [], [], timeout)[0]:
            raise subprocess.TimeoutExpired(self.args, timeout)


def begun(imports, code, *words, cwd, out=None, err=None):
    """Run ``code`` with the arguments ``words`` in a fork of a process that has executed ``imports``.

    Standard output and error go to the files with the numbers ``out`` and ``err``, or into files of the program. The
    environment is that of now, for the imports too.
    """
    changing = ("PYTEST_CURRENT_TEST", "KMP_")  # by pytest, and by libraries as they are loaded
    link = _server(imports, tuple(item for item in os.environ.items() if not item[0].startswith(changing)))
    streams = [tempfile.TemporaryFile() if number is None else None for number in (out, err)]  # noqa: SIM115
    numbers = [number if file is None else file.fileno() for number, file in zip((out, err), streams, strict=True)]
    ours, theirs = os.pipe()
    try:
        socket.send_fds(link, [json.dumps([code, words, str(cwd)]).encode()], [*numbers, theirs])
    finally:
        os.close(theirs)
    return Program(words, streams, open(ours, "rb", buffering=0))


def done(imports, code, *words, cwd, timeout=LIMIT):
    """As :func:`begun`, to its end."""
    program = begun(imports, code, *words, cwd=cwd)
    try:
        return subprocess.CompletedProcess(words, program.wait(timeout), *program.communicate(timeout))
    finally:
        program.end()


@cache
def _server(imports, environment):
    """The link to a process that ends with this one."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        process = subprocess.Popen(
            [sys.executable, "-c", SERVER.format(imports=imports)],
            stdin=theirs, stdout=subprocess.DEVNULL, start_new_session=True, env=dict(environment),
        )  # fmt: skip
    atexit.register(process.wait)
    atexit.register(ours.close)
    return ours
