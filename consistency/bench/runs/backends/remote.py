"""The far side of a backend: a process elsewhere that does runs and sends back what they left."""

from __future__ import annotations

import hashlib
import pickle
import platform
import socket
import threading
import time
from collections.abc import Generator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import version
from multiprocessing import current_process
from pathlib import Path

from joblib.externals.loky.backend.reduction import dumps

from consistency.bench.filters.compiled import one_blas_thread
from consistency.bench.runs.isolation.filter_process import dismiss
from consistency.bench.runs.trial_work import TrialWork
from consistency.bench.store.trial_rows import RunOutcome
from consistency.referee.errors import InputError
from consistency.referee.system.provenance import this_machine

PACKAGE = Path(__file__).parents[3]
DECIDING = ("numpy", "scipy", "numba")  # packages whose versions the bits depend on
ROOMS = (
    "referee/geometry",
    "bench/models",
    "bench/scenario",
    "bench/simulation",
    "bench/filters",
)  # and our own sources


@dataclass(frozen=True)
class Part:
    """What some runs left, pickled once, and who did them; it can be read wherever the versions differ.

    ``seconds`` is what they took. A ``refusal`` is bad input that ended the work.
    """

    pickled: bytes
    seconds: float
    host: str
    machine: dict[str, str]
    versions: dict[str, str]
    refusal: str = ""

    def outcomes(self) -> list[RunOutcome]:
        outcomes: list[RunOutcome] = pickle.loads(self.pickled)
        return [replace(outcome, machine=self.machine) for outcome in outcomes]


@cache
def versions_here() -> dict[str, str]:
    """What a worker must have in common with the process that it works for."""
    digest = hashlib.sha256()
    for path in sorted(path for room in ROOMS for path in (PACKAGE / room).rglob("*.py")):
        digest.update(path.read_bytes())
    own = f"{version('filter-consistency')} (sources {digest.hexdigest()[:12]})"
    python = ".".join(platform.python_version_tuple()[:2])  # classes from __main__ are sent as its bytecode
    return {"filter-consistency": own, "Python": python} | {name: version(name) for name in DECIDING}


def require_same_versions(part: Part) -> None:
    """Refuse what was done with other versions.

    Raises
    ------
    InputError
        Versions differ; names the host and the first of them.
    """
    for name, here in versions_here().items():
        if (there := part.versions.get(name)) != here:
            raise InputError(
                f"the worker on {part.host} has {name} {there}, here it is {here}; install the same version there"
            )


def pickled_work(work: TrialWork) -> bytes:
    """Work as it is sent; classes from ``__main__`` go with it."""
    return bytes(dumps(work))


class Worker:
    """Work that this process was sent: unpickled when the first run is asked for, and kept until it is closed."""

    def __init__(self, pickled: bytes) -> None:
        self._pickled = pickled
        self._work: TrialWork | None = None
        self._open, self._lock = ExitStack(), threading.Lock()

    def parts(self, runs: Sequence[int], seconds: float) -> Generator[Part, None, None]:
        """Do runs one after the other, and give what they left every so many seconds; bad input ends them."""
        work, outcomes, refusal = self._ready_for(runs[0]), list[RunOutcome](), ""
        with one_blas_thread():
            begun = time.monotonic()
            for run in runs:
                try:
                    outcomes.append(work(run))
                except InputError as error:
                    refusal = str(error)
                    break
                if (passed := time.monotonic() - begun) >= seconds:
                    yield _part(outcomes, passed)
                    outcomes, begun = [], time.monotonic()
            if outcomes or refusal:
                yield _part(outcomes, time.monotonic() - begun, refusal)

    def _ready_for(self, run: int) -> TrialWork:
        """The work, with all that is made once."""
        with self._lock:
            if self._work is None:
                current_process().daemon = False  # so that it may start processes: they end with it, whatever ends it
                work: TrialWork = pickle.loads(self._pickled)
                self._open.enter_context(work.isolation)
                with one_blas_thread():
                    work.compile(run)
                self._work = work
            return self._work

    def close(self) -> None:
        """End the processes of filters: this process may not end before they do."""
        self._open.close()
        dismiss()


def _part(outcomes: list[RunOutcome], seconds: float, refusal: str = "") -> Part:
    pickled = pickle.dumps(outcomes, pickle.HIGHEST_PROTOCOL)  # one buffer: an engine would send each array by itself
    return Part(pickled, seconds, socket.gethostname(), this_machine(), versions_here(), refusal)
