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
    return inside if inside.is_dir() else beside


def summaries() -> dict[str, dict[str, str]]:
    experiments = data_folder("experiments")
    scripts = {path.stem: path.read_text(encoding="utf-8") for path in sorted(experiments.glob("e[0-9][0-9]_*.py"))}
    return {
        "scenarios": _of_tables(data_folder("scenarios")),
        "experiments": {
            name: (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0] for name, text in scripts.items()
        },
        "sweeps": _of_tables(experiments / "sweeps"),
    }


def _of_tables(folder: Path) -> dict[str, str]:
    found = {path.stem: SUMMARY.search(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.toml"))}
    return {name: "" if summary is None else summary[1] for name, summary in found.items()}
