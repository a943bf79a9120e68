"""Options that several commands share."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from consistency.referee.errors import InputError

if TYPE_CHECKING:
    from consistency.referee.document.blocks import Document

Out = Annotated[Path, typer.Option("--out", help="Folder to write; must not exist.")]
Runs = Annotated[int, typer.Option("--runs", help="Number of Monte Carlo runs.")]
Seed = Annotated[int, typer.Option("--seed", help="Seed of the noise.")]
Jobs = Annotated[int, typer.Option("--jobs", help="Workers; -1 is one a core. The result does not depend on it.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an output folder of this bench.")]
AsJson = Annotated[bool, typer.Option("--json", help="For programs.")]
ESTIMATES = ".csv, .parquet, .npz, TUM, ROS bags"
Judged = Annotated[Path, typer.Argument(metavar="PATH", help=f"Folder written by 'run', or estimates: {ESTIMATES}.")]
Power = Annotated[float, typer.Option("--power", help="Chance to find that ratio.")]
FalseAlarm = Annotated[float, typer.Option("--false-alarm", help="Chance to find a fault in a filter that has none.")]
BackendName = Annotated[
    str, typer.Option("--backend", help="Where runs are done: local; dask or slurm (docs/cluster.md).")
]
Scheduler = Annotated[
    str | None,
    typer.Option("--scheduler", help="For dask: tcp://HOST:PORT, tls://HOST:PORT or a scheduler file [this machine]."),
]
SchedulerWait = Annotated[
    float | None, typer.Option("--scheduler-wait", help="For dask: seconds to wait for the scheduler [60].")
]
SlurmOptions = Annotated[
    list[str] | None,
    typer.Option(
        "--slurm", metavar="KEY=VALUE", help="For slurm: partition=short, time=60 (minutes); may be repeated."
    ),
]
LOST_HELP = "share of lost runs that must be excluded"
Skip = Annotated[
    str | None,
    typer.Option("--skip", metavar="N|Ns", help="Leave the first N steps, or seconds (2s), of each run out."),
]
DETECT_HELP = "ratio of true to stated covariance that must be found"
SCENARIO = "Built-in name (see 'list') or path of a .toml file."


def given(**options: Any) -> dict[str, Any]:
    """Options that were given; the others keep the defaults of what they are handed to."""
    return {name: value for name, value in options.items() if value is not None}


def require_word(option: str, value: str | None, word: str) -> None:
    """Refuse what an option may not hold: it is ``word`` or is not given."""
    if value not in (None, word):
        raise InputError(f"{option} must be '{word}', got '{value}'")


def require_written(overwrite: bool, out: Path | None, option: str) -> None:
    """Refuse --overwrite where nothing is written, for want of ``option``."""
    if overwrite and out is None:
        raise InputError(f"--overwrite goes with {option}: nothing else is written")


def show(document: Document, as_json: bool, written: Sequence[Path] = ()) -> None:
    """Print a document for programs, or its opening and the files that were written."""
    if as_json:
        from consistency.referee.show import json

        print(json.render(document))
        return
    from consistency.referee.show import terminal

    terminal.show(*document.opening)
    for file in written:
        print(file)
