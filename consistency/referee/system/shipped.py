"""Data that come with the package: where they are, and what each is, without loading it."""

from __future__ import annotations

import ast
import re
from importlib import resources
from pathlib import Path

SUMMARY = re.compile(r'^summary = "(.*)"$', re.MULTILINE)


def data_folder(name: str) -> Path:
    """Folder of shipped data (``scenarios``, ``experiments``): inside the wheel, else beside the package."""
    inside = Path(str(resources.files("consistency"))) / "_data" / name
    beside = Path(str(resources.files("consistency"))).parent / name
    if inside.is_dir():
        return inside
    return beside


def summaries() -> dict[str, dict[str, str]]:
    """A line about each shipped scenario, experiment and sweep, by its name."""
    experiments = data_folder("experiments")
    return {
        "scenarios": _summaries_in(data_folder("scenarios"), "*.toml"),
        "experiments": _summaries_in(experiments, "e[0-9][0-9]_*.py"),
        "sweeps": _summaries_in(experiments / "sweeps", "*.toml"),
    }


def _summaries_in(folder: Path, pattern: str) -> dict[str, str]:
    """The ``summary`` of each table, or the first line of each script's docstring; "" without."""
    summaries = {}
    for path in sorted(folder.glob(pattern)):
        text = path.read_text(encoding="utf-8")
        summary = ""
        if path.suffix == ".py":
            summary = (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0]
        elif (line := SUMMARY.search(text)) is not None:
            summary = line[1]
        summaries[path.stem] = summary
    return summaries
