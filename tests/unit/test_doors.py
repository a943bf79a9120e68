"""Public packages are found by their short names, and are the modules of their roots."""

from __future__ import annotations

import pkgutil
import re
import subprocess
import sys
from importlib import import_module
from operator import attrgetter
from pathlib import Path

import pytest

import consistency
from consistency.doors import DOORS

BELOW = {
    "diagnostics": "records.record", "filters": "external", "imaging": "camera", "runs": "findings",
    "scenario": "effects", "store": "log", "sweeps": "axes", "vision": "motion",
}  # fmt: skip


@pytest.mark.parametrize("name", DOORS)
def test_a_short_name_is_the_module_of_its_root(name: str) -> None:
    long = import_module(f"consistency.{DOORS[name]}")
    assert import_module(f"consistency.{name}") is long
    assert attrgetter(name)(consistency) is long
    assert long.__name__ == long.__spec__.name == f"consistency.{DOORS[name]}"  # type: ignore[union-attr]


@pytest.mark.parametrize("order", ["short, long", "long, short"])
def test_a_module_below_is_one_whichever_name_comes_first(order: str) -> None:
    """Two copies of a class would not be the same to isinstance."""
    short, long = (
        [f"consistency.{names.get(name, name)}.{module}" for name, module in BELOW.items()] for names in ({}, DOORS)
    )
    pairs = ", ".join(f"({a!r}, {b!r})" for a, b in zip(short, long, strict=True))
    code = (
        f"from importlib import import_module as load\nfor short, long in ({pairs},):\n"
        f"    first, second = map(load, ({order}))\n    assert first is second, short\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_other_names_are_not_found() -> None:
    for name in ("recording", "diagnostics.nonsense", "referee.nonsense"):
        with pytest.raises(ModuleNotFoundError, match=r"nonsense|recording"):
            import_module(f"consistency.{name}")


def test_names_of_the_documents_are_found() -> None:
    """Every name that docs/api lists, by the path that stands there."""
    names = []
    for page in sorted((Path(__file__).parents[2] / "docs/api").glob("*.md")):
        module = "consistency"
        for line in page.read_text(encoding="utf-8").splitlines():
            if found := re.match(r"\.\. (currentmodule|autofunction|autoclass):: (\S+)", line):
                kind, name = found.groups()
                if kind == "currentmodule":
                    module = name
                else:
                    names.append(name if name.startswith("consistency") else f"{module}.{name}")
    assert len(names) > 100
    for name in names:
        assert callable(pkgutil.resolve_name(name)), name
