"""The far side of an executor: a batch of runs, wherever it is done, and what it sends back."""

from __future__ import annotations

import hashlib
import pickle
import platform
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import version
from multiprocessing import current_process
from pathlib import Path

from consistency.bench.filters.compiled import one_blas_thread
from consistency.bench.filters.stepping import reason_of
from consistency.bench.runs.trial_work import TrialWork
from consistency.bench.store.trial_rows import RunOutcome
from consistency.referee.errors import InputError
from consistency.referee.system.provenance import this_machine

PACKAGE = Path(__file__).parents[2]
DECIDING = ("numpy", "scipy", "numba")  # packages whose versions the bits depend on
# and our own sources
ROOMS = ("referee/geometry", "bench/models", "bench/scenario", "bench/simulation", "bench/filters")


@dataclass(frozen=True)
class BatchResult:
    """What the first runs of a batch left, and who did them; it can be read wherever the versions differ.

    Attributes
    ----------
    pickled : outcomes in one buffer, as an executor would send each array by itself
    refusal : bad input that ended the batch
    fault : any other exception that did
    """

    pickled: bytes
    host: str
    machine: dict[str, str]
    versions: dict[str, str]
    refusal: str = ""
    fault: str = ""

    def outcomes(self) -> list[RunOutcome]:
        outcomes: list[RunOutcome] = pickle.loads(self.pickled)
        return [replace(outcome, machine=self.machine) for outcome in outcomes]


def do_batch(pickled: bytes, runs: Sequence[int], seconds: float, number: int) -> BatchResult:
    """Do runs of pickled work one after the other, until ``seconds`` have passed.

    The ``number`` of the batch makes its arguments unlike those of all others: some executors remember results.
    """
    current_process().daemon = False  # so that it may start processes: they end with it, whatever ends it
    outcomes: list[RunOutcome] = []
    refusal = fault = ""
    try:
        work: TrialWork = pickle.loads(pickled)
        with one_blas_thread(), work.isolation:
            started = time.monotonic()
            for run in runs:
                outcomes.append(work(run))
                if time.monotonic() - started >= seconds:
                    break
    except InputError as error:
        refusal = str(error)
    except ImportError as error:
        refusal = f"a worker cannot load the work ({error}); install there what is installed here"
    except Exception as error:
        fault = reason_of(error)
    left = pickle.dumps(outcomes, pickle.HIGHEST_PROTOCOL)
    return BatchResult(left, socket.gethostname(), this_machine(), versions_here(), refusal, fault)


@cache
def versions_here() -> dict[str, str]:
    """What a worker must have in common with the process that it works for."""
    digest = hashlib.sha256()
    for path in sorted(path for room in ROOMS for path in (PACKAGE / room).rglob("*.py")):
        digest.update(path.read_bytes())
    own = f"{version('filter-consistency')} (sources {digest.hexdigest()[:12]})"
    python = ".".join(platform.python_version_tuple()[:2])  # classes from __main__ are sent as its bytecode
    return {"filter-consistency": own, "Python": python} | {name: version(name) for name in DECIDING}


def require_same_versions(result: BatchResult) -> None:
    """Refuse what was done with other versions.

    Raises
    ------
    InputError
        Versions differ; names the host and the first of them.
    """
    for name, here in versions_here().items():
        if (there := result.versions.get(name)) != here:
            raise InputError(
                f"the worker on {result.host} has {name} {there}, here it is {here}; install the same version there"
            )
