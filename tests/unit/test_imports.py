"""Imports flow one way: one table of ranks, read off the sources with ``ast``."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import consistency

PACKAGE = Path(consistency.__file__).parent
EXPERIMENTS = PACKAGE.parent / "experiments"

# a room may import rooms of lower rank and itself; rooms of equal rank do not know each other
RANK = {
    "types": 0, "errors": 0, "progress": 0, "atomic": 0,
    "geometry": 1,
    "models": 2,
    "scenario": 3,
    "protocols": 4,
    "simulation": 5, "filters": 5, "vision": 5, "diagnostics": 5,
    "parquet": 4, "storage": 5, "results": 6, "gather": 7,
    "log": 7, "recording": 7,
    "montecarlo": 8, "judge": 8, "frontend": 8, "monitoring": 8,
    "sequential": 9, "comparison": 9,
    "plots": 10, "table": 10,
    "findings": 11,
    "reporting": 12, "gating": 12,
    "cli": 13, "testing": 13, "pytest_plugin": 13,
    "__main__": 14,
}  # fmt: skip
DIAGNOSTICS = {"types", "geometry", "errors", "diagnostics"}
DRAWING = {"matplotlib", "bokeh", "typst", "jinja2"}  # only plots and reporting draw
IN_EXPERIMENTS = {"consistency", "numpy", "pandas", "scipy"}
PEERS = {"bench_peers": {"filterpy"}, "bench_stonesoup": {"stonesoup"}}  # what the bench sets beside ours


def imported(source: str) -> Iterator[str]:
    """Dotted names that a source imports, wherever in it."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the room"
            assert node.module is not None
            if node.module == "consistency":
                yield from (f"consistency.{alias.name}" for alias in node.names)
            else:
                yield node.module


def complaints(room: str, source: str) -> list[str]:
    """What a module of ``room`` imports and may not."""
    found = []
    for name in imported(source):
        top, *rest = name.split(".")
        if top == "consistency":
            other = rest[0] if rest else "__init__"
            allowed = other == room or RANK.get(other, 99) < RANK[room]
            if room == "diagnostics":
                allowed = other in DIAGNOSTICS
            if not allowed:
                found.append(f"{room} imports consistency.{other}")
        elif room == "diagnostics" and top not in {"numpy", "scipy"} | sys.stdlib_module_names:
            found.append(f"diagnostics imports {top}")
        elif top in DRAWING and room not in {"plots", "reporting"}:
            found.append(f"{room} imports {top}")
    return found


def modules() -> list[tuple[str, Path]]:
    paths = [path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py"]
    return [(path.relative_to(PACKAGE).parts[0].removesuffix(".py"), path) for path in sorted(paths)]


def test_every_room_has_a_rank() -> None:
    assert {room for room, _ in modules()} <= set(RANK)


@pytest.mark.parametrize(("room", "path"), modules(), ids=lambda value: getattr(value, "stem", value))
def test_a_room_imports_only_rooms_below_it(room: str, path: Path) -> None:
    assert complaints(room, path.read_text(encoding="utf-8")) == []


FORBIDDEN = [
    ("filters", "from consistency.simulation import simulate"),
    ("simulation", "import consistency.filters.textbook"),
    ("simulation", "def f():\n    from consistency import filters"),
    ("models", "from consistency.scenario import Truth"),
    ("scenario", "import consistency as cs"),
    ("types", "from consistency.errors import InputError"),
    ("diagnostics", "import pandas as pd"),
    ("diagnostics", "from matplotlib.axes import Axes"),
    ("diagnostics", "from consistency.scenario import Belief"),
    ("montecarlo", "from consistency.verdicts.judge import analyse"),
    ("montecarlo", "import matplotlib.pyplot as plt"),
    ("plots", "from consistency.reporting import write_reports"),
    ("gating", "from consistency.testing import assert_consistent"),
    ("testing", "from consistency.pytest_plugin import Gates"),
    ("results", "if TYPE_CHECKING:\n    from consistency.store.log import Log"),
]


@pytest.mark.parametrize(("room", "source"), FORBIDDEN)
def test_a_forbidden_import_is_caught(room: str, source: str) -> None:
    assert len(complaints(room, source)) == 1


# --- experiments -----------------------------------------------------------------------------


def strangers(source: str) -> set[str]:
    """What an experiment imports beside the package, arrays, tables, the standard library and its siblings."""
    siblings = {path.stem for path in EXPERIMENTS.glob("*.py")}
    return {name.split(".")[0] for name in imported(source)} - IN_EXPERIMENTS - siblings - set(sys.stdlib_module_names)


@pytest.mark.parametrize("path", sorted(EXPERIMENTS.glob("*.py")), ids=lambda path: path.stem)
def test_an_experiment_only_uses_the_package(path: Path) -> None:
    assert strangers(path.read_text(encoding="utf-8")) == PEERS.get(path.stem, set())


def test_a_stranger_in_an_experiment_is_caught() -> None:
    source = "import consistency as cs\nimport os\nfrom matplotlib import pyplot\nimport numba"
    assert strangers(source) == {"matplotlib", "numba"}


# --- what is loaded ----------------------------------------------------------------------------


def loaded(statement: str) -> set[str]:
    """Top-level modules in a new process after ``statement``."""
    code = f"import sys\n{statement}\nprint(*{{name.split('.')[0] for name in sys.modules}})"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    return set(out.stdout.split())


def test_diagnostics_load_arrays_and_distributions_only() -> None:
    modules_ = loaded("import consistency.diagnostics")
    assert {"numpy", "scipy"} <= modules_
    assert not modules_ & {"pandas", "matplotlib", "numba", "pydantic", "joblib", "bokeh"}


def test_gates_need_arrays_only() -> None:
    modules_ = loaded("import consistency.testing")
    assert {"numpy", "scipy"} <= modules_
    assert not modules_ & {"pytest", "_pytest", "pandas", "matplotlib", "numba", "pydantic", "joblib", "rich"}


def test_the_pytest_plugin_loads_nothing_heavy() -> None:
    assert not loaded("import consistency.pytest_plugin") & {"numpy", "scipy", "pandas", "numba", "pydantic", "rich"}


def test_the_package_itself_loads_nothing_heavy() -> None:
    heavy = {"numpy", "scipy", "pandas", "numba", "pydantic", "matplotlib", "joblib", "bokeh", "typer"}
    assert not loaded("import consistency") & heavy
    assert "numba" in loaded("import consistency; consistency.get_filter('ekf-uvd')")  # negative control


def test_every_public_name_is_there() -> None:
    for name in consistency.__all__:
        assert getattr(consistency, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = consistency.nonsense
