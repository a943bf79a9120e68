"""Scenario files with changes of a built-in one."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import tomli_w

import consistency as cs
from consistency.bench.scenario import data_folder

Edit = Callable[[dict[str, Any]], None]


def _inner(data: dict[str, Any], path: str) -> tuple[dict[str, Any], str]:
    *parents, key = path.split(".")
    for parent in parents:
        data = data[parent]
    return data, key


def put(path: str, value: object) -> Edit:
    """Set ``a.b.c`` of a file's data."""

    def edit(data: dict[str, Any]) -> None:
        table, key = _inner(data, path)
        table[key] = value

    return edit


def drop(path: str) -> Edit:
    def edit(data: dict[str, Any]) -> None:
        table, key = _inner(data, path)
        del table[key]

    return edit


def load(folder: Path, *edits: Edit, name: str = "herath2007-stereo") -> cs.Scenario:
    """``mine.toml`` in the folder, read."""
    data = tomllib.loads((data_folder("scenarios") / f"{name}.toml").read_text(encoding="utf-8"))
    for edit in edits:
        edit(data)
    path = folder / "mine.toml"
    path.write_text(tomli_w.dumps(data), encoding="utf-8")
    return cs.load_scenario(path)
