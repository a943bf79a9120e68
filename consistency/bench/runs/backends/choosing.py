"""Backends by name; what an extra brings is loaded when its backend is chosen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from consistency.bench.runs.backends.local import LocalThreads
from consistency.bench.runs.trial_work import Backend
from consistency.referee.errors import InputError
from consistency.referee.extras import MissingPackageError, remedy

ENGINES = {"dask": "distributed", "slurm": "submitit"}  # package of each that is not local
NAMES = ("local", *ENGINES)


def backend_for(
    name: str = "local",
    jobs: int = -1,
    scheduler: str | None = None,
    slurm: Sequence[str] = (),
    wait: float | None = None,
    out: Path = Path("results"),
) -> Backend:
    """The backend of that name.

    Parameters
    ----------
    jobs : workers of this machine, or jobs of Slurm at a time; -1 for as many as the backend thinks right
    scheduler : of ``dask``, see :class:`consistency.bench.runs.backends.dask.Dask`
    slurm : options of ``slurm``, each ``key=value``, see :class:`consistency.bench.runs.backends.slurm.Slurm`
    wait : seconds to wait for the scheduler of ``dask``, 60 if not given
    out : folder of the results; ``slurm`` keeps the files of its jobs beside it, on a disk that they see

    Raises
    ------
    InputError
        Another name, an option of another backend, or a package that is not installed.
    """
    if name not in NAMES:
        raise InputError(f"--backend must be one of {', '.join(NAMES)}, got '{name}'")
    for option, owner, is_given in (
        ("--scheduler", "dask", scheduler is not None),
        ("--scheduler-wait", "dask", wait is not None),
        ("--slurm", "slurm", bool(slurm)),
    ):
        if is_given and name != owner:
            raise InputError(f"{option} goes with --backend {owner}, not with {name}")
    if name == "local":
        return LocalThreads(jobs)
    try:
        if name == "dask":
            from consistency.bench.runs.backends.dask import Dask

            return Dask(scheduler, jobs) if wait is None else Dask(scheduler, jobs, wait)
        from consistency.bench.runs.backends.slurm import Slurm, options_of

        return Slurm(out.absolute().with_name(f".{out.absolute().name}.jobs"), options_of(slurm), jobs)
    except ImportError:
        raise MissingPackageError(f"--backend {name} needs {remedy('cluster', package=ENGINES[name])}") from None


def require_scheduler(name: str, scheduler: str | None, what: str) -> None:
    """Refuse to start workers anew for each of the many looks of ``what``."""
    if name == "dask" and scheduler is None:
        raise InputError(f"--scheduler: missing; {what} looks often, and workers would be started for each look")
