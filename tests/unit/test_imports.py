"""Imports flow one way: one table of ranks, read off the sources with ``ast``."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence, Set
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import consistency

PACKAGE = Path(consistency.__file__).parent
SCRIPTS = [path for folder in ("experiments", "benchmarks") for path in sorted((PACKAGE.parent / folder).glob("*.py"))]

# A room may import rooms of lower rank and itself; rooms of equal rank do not know each other. Rooms whose modules have
# ranks of their own ("room.module") keep the direction inside, too.
RANK = {
    "types": 0, "errors": 0, "defaults": 0, "terminal.progress": 0, "store.atomic": 0, "store.machine": 0,
    "store.stopping": 0,
    "extras": 1, "store.ending": 1, "store.provenance": 1,
    "geometry": 1, "reading": 1,
    "models": 2,
    "scenario": 3,
    "protocols": 4,
    "simulation": 5, "filters": 5, "vision": 5, "diagnostics": 5,
    "store.parquet": 4, "store.storage": 5, "store.soundness": 5, "store.tables": 5, "store.journal": 6,
    "store.results": 6, "store.log": 7,
    "imaging": 6,
    "recording": 7,
    "runs.streams": 5, "runs.supervising": 6, "runs.touched": 6, "runs.footprint": 7,
    "runs.gather": 7, "runs.isolating": 7, "runs.resuming": 7, "runs.compiling": 7, "runs.work": 8,
    "runs.backends": 9, "runs.campaign": 9, "runs.montecarlo": 10,
    "frontend": 8,
    "verdicts.curves": 7, "verdicts.options": 8, "verdicts.files": 9, "verdicts.judge": 10, "verdicts.monitoring": 10,
    "verdicts.baselines": 10, "verdicts.comparison": 11,
    "runs.sequential": 11, "runs.ahead": 11,
    "terminal.table": 12,
    "runs.findings": 13, "sweeps": 13, "challenging": 13, "characterising": 13, "tuning": 13,
    "reporting": 14, "gating": 15,
    "cli": 16, "notebook": 16, "testing": 16, "pytest_plugin": 16,
    "__main__": 17,
}  # fmt: skip
DIAGNOSTICS = {"types", "geometry", "errors", "defaults", "diagnostics"}
DRAWING = {"matplotlib", "bokeh", "typst", "jinja2"}  # only reporting draws
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
            room = node.module.split(".")[0] == "consistency" and node.module.count(".") < 2  # or a module in one
            yield from {f"{node.module}.{alias.name}" if room else node.module for alias in node.names}


def place(parts: Sequence[str]) -> str:
    """Key of :data:`RANK`: the room, or room and module where modules have ranks."""
    inside = ".".join(parts[:2])
    return inside if inside in RANK else parts[0]


def complaints(room: str, source: str) -> list[str]:
    """What a module of ``room`` imports and may not."""
    found = set()
    for name in imported(source):
        top, *rest = name.split(".")
        if top == "consistency":
            other = place(rest) if rest else "__init__"
            allowed = other == room or RANK.get(other, 99) < RANK.get(room, -1)
            if room == "diagnostics":
                allowed = other in DIAGNOSTICS
            if not allowed:
                found.add(f"{room} imports consistency.{other}")
        elif room == "diagnostics" and top not in {"numpy", "scipy"} | sys.stdlib_module_names:
            found.add(f"diagnostics imports {top}")
        elif top in DRAWING and room != "reporting":
            found.add(f"{room} imports {top}")
    return sorted(found)


def modules() -> list[tuple[str, Path]]:
    paths = [path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py"]
    return [(place(path.relative_to(PACKAGE).with_suffix("").parts), path) for path in sorted(paths)]


def acyclic(graph: Mapping[str, set[str]]) -> bool:
    try:
        TopologicalSorter(graph).prepare()
    except CycleError:
        return False
    return True


def test_every_room_has_a_rank() -> None:
    inside = {room.split(".")[0] for room in RANK}  # their __init__.py has no rank and may import nothing of ours
    assert {room for room, path in modules() if path.name != "__init__.py" or room not in inside} <= set(RANK)


def test_the_root_is_small() -> None:
    assert len(list(PACKAGE.glob("*.py"))) <= 9


def test_no_two_rooms_import_each_other() -> None:
    graph: dict[str, set[str]] = {}
    for room, path in modules():
        names = [name.split(".") for name in imported(path.read_text(encoding="utf-8"))]
        others = {parts[1] for parts in names if parts[0] == "consistency" and len(parts) > 1}
        graph.setdefault(room.split(".")[0], set()).update(others - {room.split(".")[0]})
    assert acyclic(graph)
    assert not acyclic(graph | {"store": {"runs"}})  # negative control


@pytest.mark.parametrize(("room", "path"), modules(), ids=lambda value: getattr(value, "stem", value))
def test_a_room_imports_only_rooms_below_it(room: str, path: Path) -> None:
    assert complaints(room, path.read_text(encoding="utf-8")) == []


FORBIDDEN = [
    ("filters", "from consistency.bench.simulation import simulate"),
    ("simulation", "import consistency.bench.filters.plain"),
    ("simulation", "def f():\n    from consistency import filters"),
    ("models", "from consistency.bench.scenario import Truth"),
    ("scenario", "import consistency as cs"),
    ("types", "from consistency.referee.errors import InputError"),
    ("diagnostics", "import pandas as pd"),
    ("diagnostics", "from matplotlib.axes import Axes"),
    ("diagnostics", "from consistency.bench.scenario import Belief"),
    ("runs.montecarlo", "from consistency.bench.store.judge import analyse"),
    ("runs.montecarlo", "import matplotlib.pyplot as plt"),
    ("terminal.table", "from consistency.bench.pages import write_reports"),
    ("gating", "from consistency.testing import assert_consistent"),
    ("testing", "from consistency.pytest_plugin import Gates"),
    ("store.results", "if TYPE_CHECKING:\n    from consistency.bench.store.log import Log"),
    ("store.parquet", "from consistency.bench.store import storage"),
    ("store", "from consistency.referee.system.atomic import write_whole"),
    ("verdicts.judge", "import consistency.bench.store"),
    ("verdicts.judge", "from consistency.referee.verdicts.comparison import Compared"),
    ("imaging", "from consistency.bench.runs.findings import Study"),
    ("vision", "from consistency.stereo.imaging.chain import Chain"),
    ("vision", "from consistency.referee.terminal.table import print_findings"),
]


@pytest.mark.parametrize(("room", "source"), FORBIDDEN)
def test_a_forbidden_import_is_caught(room: str, source: str) -> None:
    assert len(complaints(room, source)) == 1


# --- experiments and benchmarks ----------------------------------------------------------------


def siblings(path: Path) -> set[str]:
    return {other.stem for other in path.parent.glob("*.py")}


def strangers(source: str, known: Set[str] = frozenset()) -> set[str]:
    """What a script imports beside the package, arrays, tables, the standard library and its ``known`` siblings."""
    return {name.split(".")[0] for name in imported(source)} - IN_EXPERIMENTS - known - set(sys.stdlib_module_names)


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_a_script_only_uses_the_package(path: Path) -> None:
    assert strangers(path.read_text(encoding="utf-8"), siblings(path)) == PEERS.get(path.stem, set())


def mentioned(path: Path) -> set[str]:
    """Siblings that a script imports, by a statement or, where a part is loaded later, by its name as text."""
    source = path.read_text(encoding="utf-8")
    texts = {str(node.value) for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Constant)}
    parts = {text for text in texts if "_" in text}
    return siblings(path) & ({*imported(source)} | parts) - {path.stem}


def test_scripts_do_not_import_each_other_in_a_circle() -> None:
    graph = {path.stem: mentioned(path) for path in SCRIPTS}
    assert {"bench_models", "bench_stonesoup"} <= graph["bench_peers"]
    assert acyclic(graph)
    assert not acyclic(graph | {"bench_models": {"bench_stonesoup"}})  # negative control


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
    modules_ = loaded("import consistency.referee.diagnostics")
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


def test_engines_of_clusters_are_loaded_when_they_are_chosen() -> None:
    engines = {"dask", "distributed", "submitit"}
    choose = "import consistency.bench.runs.montecarlo\nfrom consistency.bench.runs.backends import choosing\n"
    choose += "choosing.backend_for({!r})"
    assert not loaded(choose.format("local")) & engines
    assert loaded(choose.format("dask")) & engines == {"dask", "distributed"}
    assert loaded(choose.format("slurm")) & engines == {"submitit"}


@pytest.mark.parametrize("package", ["consistency", "consistency.stereo.vision"])
def test_a_new_session_lists_the_public_names(package: str) -> None:
    """``dir``, and so tab completion, without loading what the names stand for."""
    code = f"import sys, {package} as package; print(*dir(package)); print(*sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    names, modules_ = (set(line.split()) for line in out.stdout.splitlines())
    expected = {"consistency": {"analyse", "run_trials", "Verdict"}, "consistency.stereo.vision": {"relative_motion"}}
    assert expected[package] <= names
    assert not modules_ & {"numpy", "cv2"}


def test_the_help_loads_nothing_heavy() -> None:
    modules_ = loaded("from consistency.referee.cli.app import app\ntry: app(['--help'])\nexcept SystemExit: pass")
    assert "typer" in modules_
    assert not modules_ & {"numpy", "scipy", "pandas", "numba", "pydantic", "matplotlib", "joblib", "bokeh"}


def test_every_public_name_is_there() -> None:
    for name in consistency.__all__:
        assert getattr(consistency, name) is not None
    with pytest.raises(AttributeError, match="consistency attribute nonsense"):
        _ = consistency.nonsense
