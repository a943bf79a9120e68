"""Options that several commands share."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Collection, Iterable, Sequence
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from consistency.referee.errors import InputError
from consistency.referee.readers.options import OPTIONS, VALUES, Option, Reading, flag_of, make_reading

if TYPE_CHECKING:
    from consistency.referee.diagnostics.record import Record
    from consistency.referee.show.blocks import Document


def completed(values: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """A completion of values in the shell, which are looked up when they are asked for."""
    return lambda incomplete: [value for value in values() if value.startswith(incomplete)]


def _filters() -> Iterable[str]:
    from consistency.bench.filters import filter_names

    return filter_names()


def _scenarios() -> Iterable[str]:
    from consistency.bench.scenario import scenario_names

    return scenario_names()


FILTER_NAMES, SCENARIO_NAMES = completed(_filters), completed(_scenarios)
Out = Annotated[Path, typer.Option("--out", help="Output folder; must not exist.")]
Runs = Annotated[int, typer.Option("--runs", help="Number of Monte Carlo runs.")]
Seed = Annotated[int, typer.Option("--seed", help="Seed of the noise.")]
Jobs = Annotated[
    int, typer.Option("--jobs", help="Number of workers; -1 is one for each core. Results do not depend on it.")
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Overwrite an existing output folder of this bench.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
ESTIMATES = ".csv, .parquet, .npz, TUM, ROS bags"
Judged = Annotated[Path, typer.Argument(metavar="PATH", help=f"Folder written by 'run', or estimates: {ESTIMATES}.")]
Power = Annotated[float, typer.Option("--power", help="Probability of finding that ratio.")]
FalseAlarm = Annotated[float, typer.Option("--false-alarm", help="Probability of finding a fault in a correct filter.")]
BackendName = Annotated[str, typer.Option("--backend", help="Where to run: local; dask or slurm (docs/long-runs.md).")]
Scheduler = Annotated[
    str | None,
    typer.Option(
        "--scheduler", help="Scheduler for dask: tcp://HOST:PORT, tls://HOST:PORT or a scheduler file [this machine]."
    ),
]
SchedulerWait = Annotated[
    float | None, typer.Option("--scheduler-wait", help="Seconds to wait for the scheduler of dask [60].")
]
SlurmOptions = Annotated[
    list[str] | None,
    typer.Option(
        "--slurm",
        metavar="KEY=VALUE",
        help="Option for slurm, such as partition=short or time=60 (minutes); may be repeated.",
    ),
]
LOST_HELP = "share of lost runs that must be excluded"
Skip = Annotated[
    str | None,
    typer.Option("--skip", metavar="N|Ns", help="Leave out the first N steps, or seconds, of each run."),
]
DETECT_HELP = "ratio of true to stated covariance that must be found"
SCENARIO = "Built-in name (see 'list') or path to a .toml file."


def given_options(**options: Any) -> dict[str, Any]:
    """Options that were given; the others keep the defaults of what they are handed to."""
    return {name: value for name, value in options.items() if value is not None}


def require_word(option: str, value: str | None, word: str) -> None:
    """Refuse what an option may not hold: it is ``word`` or is not given."""
    if value not in (None, word):
        raise InputError(f"{option} must be '{word}', got '{value}'")


def require_written(overwrite: bool, out: Path | None, option: str) -> None:
    """Refuse --overwrite where nothing is written, without ``option``."""
    if overwrite and out is None:
        raise InputError(f"--overwrite goes with {option}: nothing else is written")


def print_document(document: Document, as_json: bool, written: Sequence[Path] = ()) -> None:
    """Print a document for programs, or its opening and the files that were written."""
    if as_json:
        from consistency.referee.show.as_json import render

        print(render(document))
        return
    from consistency.referee.show import terminal

    terminal.show(*document.opening)
    for file in written:
        print(file)


def are_files(path: Path, files: Reading) -> bool:
    """Whether a path is files of another estimator, and no folder of ``consistency run``."""
    from consistency.referee.readers.pipeline.read_files import is_recording

    return is_recording(path, files)


def read_files(path: Path, files: Reading) -> list[Record]:
    from consistency.referee.readers.pipeline.read_files import read_recordings

    return read_recordings(path, files)


def tell_notes(*read: list[Record]) -> None:
    """What was assumed and left out, to standard error; said when nothing is refused any more."""
    tell(
        dict.fromkeys(
            note
            for recordings in read
            for one in recordings
            for note in one.origin.notes
            if note not in one.origin.causes
        )
    )


def print_next(what: str, folder: Path) -> None:
    """Print where results are and the command that shows them, with what that needs and is not installed."""
    from consistency.referee.extras import missing, remedy

    line = f"{what} in {folder}; next: consistency report {folder}"
    if missing("report"):
        line += f" (needs {remedy('report')})"
    print(line)


def tell(notes: Iterable[str]) -> None:
    """A line for each note on standard error."""
    from consistency.referee.parsing import one_line

    for note in notes:
        print(f"consistency: {one_line(note, 4000)}", file=sys.stderr)


def reads_files(
    command: Callable[..., Any] | None = None, only: Collection[str] | None = None, without: Collection[str] = ()
) -> Callable[..., Any]:
    """A command with the options of files, which it gets as one argument ``files``: all, ``only`` some, or without."""
    if command is None:
        return partial(reads_files, only=only, without=without)
    signature = inspect.signature(command, eval_str=True)
    files = Reading()
    kinds: dict[str, Any] = {}
    for name in dict.fromkeys(VALUES.values()):
        kinds |= get_type_hints(type(getattr(files, name)))
    taken = [each for each in OPTIONS if only is None or each.name in only]
    taken = [each for each in taken if each.name not in without]
    own = {each.name: _parameter(each, kinds[each.name]) for each in taken}

    @wraps(command)
    def with_files(**given: Any) -> Any:
        options = {each.name: given.pop(each.name) for each in taken}
        for each in taken:
            if each.parse is not None and options[each.name] is not None:
                options[each.name] = each.parse(options[each.name])
        return command(files=make_reading(**options), **given)

    parameters = []
    for name, parameter in signature.parameters.items():
        parameters += list(own.values()) if name == "files" else [parameter.replace(kind=parameter.KEYWORD_ONLY)]
    with_files.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    with_files.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return with_files


def _parameter(of: Option, kind: Any) -> inspect.Parameter:
    """An option of files as typer takes it; what is parsed comes as text."""
    completion = completed(lambda: of.values) if of.values else None
    flag = of.flag or flag_of(of.name)
    option = typer.Option(flag, help=of.help, metavar=of.metavar, show_default=False, autocompletion=completion)
    typed = str | None if of.parse else kind
    annotation = Annotated[typed, option]  # type: ignore[valid-type]
    return inspect.Parameter(of.name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)
