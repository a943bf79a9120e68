"""Options of files of another estimator, which several commands read."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Collection
from dataclasses import Field, fields
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from consistency.referee.parsing.options import Reading, flag_of

if TYPE_CHECKING:
    from consistency.referee.diagnostics import Evidence


def are_files(path: Path, files: Reading) -> bool:
    """Whether a path is files of another estimator, and no folder of ``consistency run``."""
    from consistency.referee.readers import is_recording

    return is_recording(path, files)


def read_files(path: Path, files: Reading) -> list[Evidence]:
    """Files of another estimator."""
    from consistency.referee.readers import read_recordings

    return read_recordings(path, files)


def tell_notes(*read: list[Evidence]) -> None:
    """What was assumed and left out, to standard error; said when nothing is refused any more."""
    from consistency.referee.parsing import one_line

    for note in dict.fromkeys(note for recordings in read for one in recordings for note in one.notes):
        print(f"consistency: {one_line(note, 4000)}", file=sys.stderr)


def reads_files(command: Callable[..., Any] | None = None, only: Collection[str] | None = None) -> Callable[..., Any]:
    """A command with the options of files, which it gets as one argument ``files``; with all, or ``only`` some."""
    if command is None:
        return partial(reads_files, only=only)
    signature = inspect.signature(command, eval_str=True)
    hints = get_type_hints(Reading)
    taken = [each for each in fields(Reading) if only is None or each.name in only]
    own = {each.name: _parameter(each, hints[each.name]) for each in taken}

    @wraps(command)
    def with_files(**given: Any) -> Any:
        options = {each.name: _parsed(each, given.pop(each.name)) for each in taken}
        return command(files=Reading(**options), **given)

    parameters = []
    for name, parameter in signature.parameters.items():
        parameters += list(own.values()) if name == "files" else [parameter.replace(kind=parameter.KEYWORD_ONLY)]
    with_files.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    with_files.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return with_files


def _parameter(of: Field[Any], kind: Any) -> inspect.Parameter:
    """An option of files as typer takes it; what is parsed comes as text."""
    m = of.metadata
    option = typer.Option(m["flag"] or flag_of(of.name), help=m["help"], metavar=m["metavar"], show_default=False)
    typed = str | None if m["parse"] else kind
    annotation = Annotated[typed, option]  # type: ignore[valid-type]
    return inspect.Parameter(of.name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)


def _parsed(of: Field[Any], value: Any) -> Any:
    parse = of.metadata["parse"]
    return value if value is None or parse is None else parse(value)
