"""What a fit leaves as a folder: the model in TOML, files of data, lines for other programs, and a page."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from consistency.referee.document.blocks import Document
from consistency.referee.show import as_html, as_json
from consistency.referee.system.folders import write_folder
from consistency.referee.system.provenance import manifest_of


def write_fit(
    folder: Path,
    kind_and_source: tuple[str, str],
    texts: dict[str, str],
    page: Document,
    data: Callable[[Path], Sequence[str]],
    overwrite: bool = False,
) -> list[Path]:
    """Write what a fit leaves, as a folder that appears whole or not at all; its files.

    Pictures need ``[plot]``; without it the page has none.

    Parameters
    ----------
    texts : files by name, the model first
    page : what is shown, and as data
    data : writes files of data into a folder, and returns their names

    Raises
    ------
    InputError
        The folder exists or cannot be written.
    """
    kind, source = kind_and_source
    texts = texts | {"verdict.json": as_json.render(page) + "\n", "report.html": as_html.render(page)}
    names: list[str] = []

    def contents(at: Path) -> None:
        names.extend(data(at))
        for name, text in texts.items():
            (at / name).write_text(text, encoding="utf-8")

    write_folder(folder, manifest_of(kind=kind, source=source), contents, overwrite)
    first, *rest = texts
    return [folder / name for name in (first, *names, *rest)]


def toml(comment: str, values: Mapping[str, Any]) -> str:
    """Plain data as TOML below lines of comment; what the referee says is left out, as it is in verdict.json."""
    lines = [f"# {line}" for line in comment.splitlines()]
    known = {key: value for key, value in values.items() if key != "referee"}
    return "\n".join([*lines, *_lines(known)]) + "\n"


def _lines(values: Mapping[str, Any], above: str = "") -> list[str]:
    """Numbers and words, then tables and arrays of tables; a value of None is left out."""
    lines, tables = [], []
    for key, value in values.items():
        if isinstance(value, Mapping):
            tables += ["", f"[{above}{key}]", *_lines(value, f"{above}{key}.")]
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            for each in value:
                tables += ["", f"[[{above}{key}]]", *_lines(each, f"{above}{key}.")]
        elif value is not None:
            lines.append(f"{key} = {_text(value)}")
    return lines + tables


def _text(value: Any) -> str:
    """A number, a word or a list of these, of which None is a number that is not known."""
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_text, value))}]"
    return "nan" if value is None else json.dumps(value, ensure_ascii=False)
