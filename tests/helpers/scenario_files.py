"""Scenario files with changes of a built-in one."""

import tomllib

import tomli_w

import consistency as cs
from consistency.bench.scenario import data_folder


def _inner(data, path):
    *parents, key = path.split(".")
    for parent in parents:
        data = data[parent]
    return data, key


def put(path, value):
    """Set ``a.b.c`` of a file's data."""

    def edit(data):
        table, key = _inner(data, path)
        table[key] = value

    return edit


def drop(path):
    def edit(data):
        table, key = _inner(data, path)
        del table[key]

    return edit


def load(folder, *edits, name="herath2007-stereo"):
    """``mine.toml`` in the folder, read."""
    data = tomllib.loads((data_folder("scenarios") / f"{name}.toml").read_text(encoding="utf-8"))
    for edit in edits:
        edit(data)
    path = folder / "mine.toml"
    path.write_text(tomli_w.dumps(data), encoding="utf-8")
    return cs.load_scenario(path)
