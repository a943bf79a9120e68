"""Filters and trials that do to their process what they should not; light, because each process imports it."""

from __future__ import annotations

import ctypes
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import consistency as cs
from consistency.bench.types import Control, Gaussian, Trial

STEP = 7  # in which they misbehave
MEMORY = 0.0625  # GiB that they have


class Unreadable(Exception):
    def __str__(self):
        raise ValueError("no words")


@dataclass
class Still:
    """Stays where it was and says so; in one step of one run, known by its first control, it does as it is told."""

    name: str
    act: Callable[[Still, Any], Any] | None = None
    control: Control | None = None
    step: int = 0
    is_doomed: bool = False
    kept: list[Any] = field(default_factory=list)

    def init(self, problem):
        self.problem = problem
        return problem.start

    def predict(self, state, control):
        self.step += 1
        self.is_doomed = control == self.control if self.step == 1 else self.is_doomed
        return state

    def update(self, state, observation):
        k = len(observation.landmarks)
        info = cs.Info(np.full(k, 0.5), np.eye(k), np.zeros((3, k)))
        self.answer = state, info
        self.estimate = Gaussian(state, np.eye(3))
        if self.act is not None and self.is_doomed and self.step == STEP:
            self.act(self, observation)
        return self.answer

    def pose(self, state):
        return self.estimate


def raises(exception):
    def act(*_):
        raise exception

    return act


def answers(**changes):
    """Says something else for the innovation, S or the pose."""

    def act(self, _):
        state, info = self.answer
        parts = {"innovation": info.innovation, "S": info.S, "mean": state, "covariance": np.eye(3)} | changes
        self.answer = state, cs.Info(parts["innovation"], parts["S"], info.gain)
        self.estimate = Gaussian(parts["mean"], parts["covariance"])

    return act


def sleeps_in_c(*_):
    ctypes.PyDLL(None).sleep(100)  # with the GIL


def segfaults(*_):
    ctypes.string_at(0)


def takes_memory(self, _):
    while True:
        self.kept.append(np.ones(2**20))


def takes_memory_at_once(*_):
    np.ones(2**40)


def takes_a_little_too_much(*_):
    np.ones(int(1.5 * MEMORY * 2**27))


def takes_memory_in_lists(self, _):
    while True:
        self.kept.append([0.5] * 1000)


def closes_all_files(*_):
    os.closerange(3, 256)
    time.sleep(100)


def forks(*_):
    os.fork()


def forks_and_dies(*_):
    if os.fork():
        os._exit(5)
    time.sleep(100)


def reads(*_):
    input()


def stops_itself(*_):
    os.kill(os.getpid(), signal.SIGSTOP)


def ignores_signals(*_):
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGALRM):
        signal.signal(number, signal.SIG_IGN)
    while True:
        pass


def is_gone(pid, patience=10.0):
    """Whether a process ends in good time; it may have to be reaped by others than us."""
    until = time.monotonic() + patience
    while time.monotonic() < until:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
        except (FileNotFoundError, ProcessLookupError):
            return True
        if state == "Z":
            return True
        time.sleep(0.05)
    return False


TIME_OUT = "time-out after 1 s"
NO_INNOVATION = "the innovation or its covariance is not finite"
KINDS = {
    "sleeps in C": (sleeps_in_c, TIME_OUT),
    "ignores signals": (ignores_signals, TIME_OUT),
    "stops itself": (stops_itself, TIME_OUT),
    "segfaults": (segfaults, "its process was killed by SIGSEGV"),
    "os._exit(3)": (lambda *_: os._exit(3), "its process ended with exit status 3"),
    "os._exit(0)": (lambda *_: os._exit(0), "its process ended with exit status 0"),
    "kills itself": (
        lambda *_: os.kill(os.getpid(), signal.SIGKILL),
        "its process was killed by SIGKILL, from outside or because memory ran out",
    ),
    "closes all files": (closes_all_files, TIME_OUT),
    "forks and dies": (forks_and_dies, "its process ended with exit status 5"),
    "reads the keyboard": (reads, "EOFError: EOF when reading a line"),
    "KeyboardInterrupt": (raises(KeyboardInterrupt("mine")), "KeyboardInterrupt: mine"),
    "BaseException": (raises(BaseException("odd")), "BaseException: odd"),
    "unreadable exception": (raises(Unreadable()), "Unreadable: its message cannot be read (ValueError)"),
    "takes memory": (takes_memory, "out of memory: Unable to allocate 8.00 MiB"),
    "takes memory at once": (takes_memory_at_once, "out of memory: Unable to allocate 8.00 TiB"),
    "takes a little too much": (takes_a_little_too_much, "out of memory: Unable to allocate 96.0 MiB"),
    "takes memory in lists": (takes_memory_in_lists, "out of memory"),
    "complex pose": (answers(mean=np.full(3, 1 + 1j)), "TypeError: pose() gave numbers of type complex128, not real"),
    "text for a pose": (answers(mean=["1", "2", "3"]), "TypeError: pose() gave numbers of type <U1, not real"),
    "too few numbers": (answers(mean=np.zeros(2)), "ValueError: pose() gave an array of shape (2,), not (3,)"),
    "raises": (raises(RuntimeError("out of ideas")), "RuntimeError: out of ideas"),
    "NaN pose": (answers(mean=np.full(3, np.nan)), "the pose is not finite"),
    "indefinite": (answers(covariance=np.diag([1.0, 1.0, -1.0])), "the pose covariance is not positive definite"),
    "singular": (answers(covariance=np.diag([1.0, 1.0, 0.0])), "the pose covariance is not positive definite"),
    "asymmetric": (answers(covariance=np.eye(3) + 1e-3 * np.eye(3, k=1)), "the pose covariance is not symmetric"),
    "small covariance": (
        answers(covariance=np.eye(2)),
        "ValueError: pose() gave an array of shape (2, 2), not (3, 3)",
    ),
    "NaN innovation": (answers(innovation=np.full(1, np.nan), S=np.eye(1)), NO_INNOVATION),
    "infinite S": (answers(innovation=np.ones(1), S=np.full((1, 1), np.inf)), NO_INNOVATION),
    "infinite NIS": (answers(innovation=np.full(1, 1e200), S=np.eye(1)), "the NIS is not finite"),
    "wrong S": (
        answers(innovation=np.ones(2), S=np.eye(3)),
        "ValueError: update() gave an array of shape (3, 3), not (2, 2)",
    ),
    "pose of 1e61 m": (answers(mean=np.full(3, 1e61), covariance=1e120 * np.eye(3)), "the pose is beyond 1e+60"),
    "error of 1e160 sigma": (answers(mean=np.full(3, 1e160)), "the NEES is not finite"),
}  # fmt: skip


@dataclass(frozen=True)
class Deadly:
    """Trials of which some kill whoever simulates them, but for one process, for good or as long as a file is there."""

    trials: Callable[[int], Trial]
    runs: tuple[int, ...]
    spared: int
    fuse: str = ""

    def __call__(self, run):
        if run in self.runs and os.getpid() != self.spared and (not self.fuse or os.path.exists(self.fuse)):
            if self.fuse:
                os.unlink(self.fuse)
            os.kill(os.getpid(), signal.SIGKILL)
        return self.trials(run)
