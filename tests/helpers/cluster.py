"""A scheduler of dask and workers on loopback, as processes that can be killed."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from contextlib import suppress

PATH = os.pathsep.join([*sys.path, os.environ.get("PYTHONPATH", "")])  # so that workers find the modules of tests
QUIET = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
QUIET |= {"env": os.environ | {"PYTHONPATH": PATH}}


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
        return port


class Cluster:
    """A scheduler and workers with a nanny each; all of it is killed at the end."""

    def __init__(self, folder, workers=2, *options):
        self.folder, self.workers, self.options = folder, workers, options
        self.port = free_port()
        self.address = f"tcp://127.0.0.1:{self.port}"
        self._processes: list[subprocess.Popen[bytes]] = []

    def __enter__(self):
        self.start()
        return self

    def __exit__(self, _, __, ___):
        self.kill()

    def start(self):
        command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--no-dashboard"]
        command += ["--port", str(self.port), "--no-show"]
        self._processes.append(subprocess.Popen(command, cwd=self.folder, **QUIET))
        for _ in range(self.workers):
            self.add_worker()

    def add_worker(self):
        command = [sys.executable, "-m", "distributed.cli.dask_worker", self.address, "--nthreads", "1"]
        command += ["--no-dashboard", "--memory-limit", "0", *self.options]
        worker = subprocess.Popen(command, cwd=self.folder, **QUIET)
        self._processes.append(worker)
        return worker

    def kill(self):
        """All of it with SIGKILL."""
        _kill(self._processes)

    def kill_workers(self):
        """All workers and their nannies, with SIGKILL."""
        _kill(self._processes, keep=1)


def _kill(processes, keep=0):
    """Kill processes, and what they have started, but for the first ones."""
    for process in processes[keep:]:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    del processes[keep:]
