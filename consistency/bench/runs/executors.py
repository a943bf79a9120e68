"""Executors by name; what an extra brings is loaded when its backend is chosen."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from consistency.bench.runs.workers import worker_count
from consistency.referee.errors import InputError
from consistency.referee.extras import MissingPackageError, remedy

ENGINES = {"dask": "distributed", "slurm": "submitit"}  # package of each that is not local
NAMES = ("local", *ENGINES)
WAIT = 60.0  # s


def executor_for(
    name: str = "local",
    jobs: int = -1,
    scheduler: str | None = None,
    slurm: Sequence[str] = (),
    wait: float | None = None,
    out: Path = Path("results"),
) -> AbstractContextManager[Executor | None]:
    """Return the executor of a backend, for a ``with`` that shuts it down; None for threads of this process.

    Parameters
    ----------
    jobs : processes of this machine, or jobs of Slurm at a time; -1 for as many as the backend thinks right
    scheduler : of ``dask``, see :class:`consistency.bench.runs.dask_executor.DaskExecutor`
    slurm : options of ``slurm``, each ``key=value``, see :class:`consistency.bench.runs.slurm_executor.SlurmExecutor`
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
        worker_count(jobs)
        return nullcontext()
    try:
        if name == "dask":
            from consistency.bench.runs.dask_executor import DaskExecutor

            return DaskExecutor(scheduler, jobs, WAIT if wait is None else wait)
        from consistency.bench.runs.slurm_executor import SlurmExecutor, options_of

        return SlurmExecutor(out.absolute().with_name(f".{out.absolute().name}.jobs"), options_of(slurm), jobs)
    except ImportError:
        raise MissingPackageError(f"--backend {name} needs {remedy('cluster', package=ENGINES[name])}") from None
