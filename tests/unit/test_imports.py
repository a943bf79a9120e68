"""Imports flow one way: one table of ranks, read off the sources with ``ast``."""

from __future__ import annotations

import ast
import runpy
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence, Set
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import consistency

PACKAGE = Path(consistency.__file__).parent
SCRIPTS = [path for folder in ("experiments", "benchmarks") for path in sorted((PACKAGE.parent / folder).glob("*.py"))]

# A root may import roots of lower rank, a room itself and rooms of lower rank in its root; rooms of equal rank do not
# know each other. Rooms whose modules have ranks of their own ("room.module") keep the direction inside, too.
ROOTS = {"referee": 0, "bench": 1, "stereo": 2, "": 3}
RANKS = {
    "referee": {
        "types": 0, "errors": 0, "defaults": 0, "column_names": 0,
        "system.progress": 0, "system.atomic": 0, "system.stopping": 0, "system.shipped": 0,
        "extras": 1, "system.provenance": 1, "geometry": 1,
        "parsing": 1, "system.folders": 2,
        "diagnostics": 2, "readers": 3, "verdicts": 4, "document": 3, "show": 4, "pages": 5, "gating": 6, "notebook": 6,
        "fit_covariance": 6,
    },
    "bench": {
        "types": 0, "models": 1, "scenario": 2, "protocols": 3, "simulation": 4, "filters": 4,
        "store.parquet": 3, "store.folder_tables": 4, "store.results_check": 4, "store.log_tables": 4,
        "store.journal": 5, "store.results": 5, "store.trial_rows": 6, "store.log": 8,
        "runs.memory_needed": 8, "runs.gather": 8,
        "runs.isolation": 8, "runs.compiling": 8, "runs.trial_work": 9, "runs.backends": 10,
        "runs.campaign": 10, "runs.montecarlo": 11, "runs.results_to_records": 8, "runs.run_scores": 9,
        "runs.analyse_results": 9,
        "runs.sequential": 12, "runs.findings": 13,
        "sweeps": 14, "challenging": 14, "tuning": 14, "pages": 15,
    },
    "stereo": {"visual_odometry": 0, "rendered_images": 1, "frontend": 2, "characterising": 3, "pages": 4},
    "": {
        **dict.fromkeys(
            ("challenging", "diagnostics", "errors", "filters", "imaging", "protocols", "runs", "scenario", "store",
             "sweeps", "tuning", "types", "vision"), 0,
        ),
        "testing": 1, "pytest_plugin": 1, "commands": 1, "__main__": 2,
    },
}  # fmt: skip
ONLY = {  # all that these may import of ours
    "diagnostics": {"types", "geometry", "errors", "defaults", "diagnostics"},
    "document": {"types", "geometry", "errors", "diagnostics", "document"},
    "show": {"types", "diagnostics", "document", "show"},
}
ARRAYS = {"diagnostics", "document"}  # rooms that need these alone
OF_ARRAYS = {"numpy", "scipy"} | sys.stdlib_module_names
DRAWING = {"matplotlib", "bokeh", "typst", "jinja2"}
PAINTERS = {"show"}
IN_EXPERIMENTS = {"consistency", "numpy", "pandas", "scipy"}
# what the bench sets beside ours, and an experiment on images, which draws them
OTHERS = {
    "bench_peers": {"filterpy"},
    "bench_stonesoup": {"stonesoup"},
    "front_end_figures": {"matplotlib"},
}


def imported(source: str) -> Iterator[str]:
    """Dotted names that a source imports, wherever in it."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the room"
            room = node.module.split(".")[0] == "consistency" and node.module.count(".") < 3  # or a module in one
            yield from {f"{node.module}.{alias.name}" if room else node.module for alias in node.names}


def imported_modules(source: str, known: Set[str]) -> set[str]:
    """Those of the ``known`` modules that a source imports, wherever in it."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            inside = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= inside & known or {str(node.module)}
    return found & known


def place(parts: Sequence[str]) -> tuple[str, str]:
    """Root, and key of its ranks: the room, or room and module where modules have ranks."""
    root, parts = (parts[0], parts[1:]) if parts[0] in ROOTS else ("", parts)
    inside = ".".join(parts[:2])
    return root, inside if inside in RANKS[root] else ".".join(parts[:1])


def below(other: tuple[str, str], mine: tuple[str, str]) -> bool:
    """May a module at ``mine`` import one at ``other``?"""
    if other[0] != mine[0]:
        return ROOTS[other[0]] < ROOTS[mine[0]]
    ranks = RANKS[mine[0]]
    return other == mine or ranks.get(other[1], 99) < ranks.get(mine[1], -1)


def complaints(at: str, source: str) -> list[str]:
    """What a module at ``at`` ("referee.readers") imports and may not."""
    found, mine = set(), place(at.split("."))
    room = mine[1] if mine[0] == "referee" else ""
    for name in imported(source):
        top, *rest = name.split(".")
        if top == "consistency":
            other = place(rest) if rest else ("", "__init__")
            if not below(other, mine) or (room in ONLY and other[1] not in ONLY[room]):
                found.add(f"{at} imports {name}")
        elif top in (DRAWING if room not in PAINTERS else ()) or (room in ARRAYS and top not in OF_ARRAYS):
            found.add(f"{at} imports {top}")
    return sorted(found)


def modules() -> list[tuple[str, Path]]:
    """Dotted name below the package and path of each module."""
    paths = [path for path in sorted(PACKAGE.rglob("*.py")) if path != PACKAGE / "__init__.py"]
    return [(".".join(path.relative_to(PACKAGE).with_suffix("").parts), path) for path in paths]


def acyclic(graph: Mapping[str, set[str]]) -> bool:
    try:
        TopologicalSorter(graph).prepare()
    except CycleError:
        return False
    return True


def test_every_room_has_a_rank() -> None:
    for name, _ in modules():
        root, room = place(name.removesuffix(".__init__").split("."))
        inside = {
            key.split(".")[0] for key in RANKS[root]
        }  # their __init__.py has no rank and may import nothing of ours
        assert room in RANKS[root] or (name.endswith(".__init__") and (not room or room in inside)), name


def test_no_two_rooms_import_each_other() -> None:
    graph: dict[str, set[str]] = {}
    for module, path in modules():
        names = [name.split(".") for name in imported(path.read_text(encoding="utf-8"))]
        mine = ".".join(module.split(".")[:2])
        others = {".".join(parts[1:3]) for parts in names if parts[0] == "consistency" and len(parts) > 2}
        graph.setdefault(mine, set()).update(others - {mine})
    assert acyclic(graph)
    assert not acyclic(graph | {"bench.store": {"bench.runs"}})  # negative control


def test_no_two_modules_import_each_other() -> None:
    """Wherever in them, for the type checker too; but a result shows itself by the module that shows results."""
    paths = {".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): path for path in PACKAGE.rglob("*.py")}
    paths = {name.removesuffix(".__init__"): path for name, path in paths.items()}
    graph = {name: imported_modules(path.read_text(encoding="utf-8"), paths.keys()) for name, path in paths.items()}
    graph["consistency.referee.diagnostics.verdict.parts"].remove(
        "consistency.referee.diagnostics.verdict.as_dictionary"
    )
    graph["consistency.referee.fit_covariance.noise_model"] -= {
        "consistency.referee.fit_covariance.page", "consistency.referee.fit_covariance.model_text",
    }  # fmt: skip
    assert acyclic(graph)
    assert not acyclic(
        graph | {"consistency.bench.scenario.toml_tables": {"consistency.bench.scenario.sensor_view"}}
    )  # negative control


@pytest.mark.parametrize(("module", "path"), modules(), ids=[name for name, _ in modules()])
def test_a_room_imports_only_rooms_below_it(module: str, path: Path) -> None:
    assert complaints(module.removesuffix(".__init__"), path.read_text(encoding="utf-8")) == []


def not_of_the_textbook(source: str) -> list[str]:
    """What a reference implementation imports of the filters beside others and the noise that all are told of."""
    filters = "consistency.bench.filters"
    found = [name for name in imported(source) if name.startswith(filters)]
    return [name for name in found if not name.startswith((f"{filters}.textbook", f"{filters}.believed_noise"))]


@pytest.mark.parametrize("path", sorted((PACKAGE / "bench/filters/textbook").glob("*.py")), ids=lambda path: path.stem)
def test_the_textbook_knows_no_kernel(path: Path) -> None:
    assert not_of_the_textbook(path.read_text(encoding="utf-8")) == []
    assert not_of_the_textbook("from consistency.bench.filters.methods.ekf import parts") != []  # negative control


FORBIDDEN = [
    ("bench.filters", "from consistency.bench.simulation import simulate"),
    ("bench.simulation", "import consistency.bench.filters.compiled"),
    ("bench.simulation", "def f():\n    from consistency.bench import filters"),
    ("bench.models", "from consistency.bench.scenario import Truth"),
    ("bench.scenario", "import consistency as cs"),
    ("bench.scenario", "from consistency.stereo.visual_odometry import relative_motion"),
    ("referee.types", "from consistency.referee.errors import InputError"),
    ("referee.diagnostics", "import pandas as pd"),
    ("referee.diagnostics", "from matplotlib.axes import Axes"),
    ("referee.diagnostics", "from consistency.bench.scenario import Belief"),
    ("referee.diagnostics", "from consistency.referee.readers.read_files import read_recordings"),
    ("referee.verdicts.sources", "def f():\n    from consistency.bench.store.results import open_results"),
    ("referee.readers.formats.ros_bag", "import consistency.stereo.visual_odometry"),
    ("bench.runs.montecarlo", "from consistency.bench.pages import write_reports"),
    ("bench.runs.montecarlo", "import matplotlib.pyplot as plt"),
    ("referee.gating", "from consistency.testing import assert_consistent"),
    ("testing", "from consistency.pytest_plugin import Gates"),
    ("bench.store.results", "if TYPE_CHECKING:\n    from consistency.bench.store.log import Log"),
    ("bench.store.parquet", "from consistency.bench.store import storage"),
    ("bench.store", "from consistency.bench.store.folder_tables import read_manifest"),
    ("stereo.rendered_images", "from consistency.stereo.frontend.images_to_log import front_end"),
    ("stereo.visual_odometry", "from consistency.stereo.rendered_images.chain import Chain"),
    ("referee.document", "from consistency.referee.show.text import fragment"),
    ("referee.document", "from consistency.referee.verdicts.options import settings_of"),
    ("referee.document", "from rich.console import Console"),
    ("referee.show", "from consistency.referee.system.provenance import manifest_of"),
    ("stereo.visual_odometry", "from consistency.stereo.pages.images import IMAGES"),
]


@pytest.mark.parametrize(("module", "source"), FORBIDDEN)
def test_a_forbidden_import_is_caught(module: str, source: str) -> None:
    assert len(complaints(module, source)) == 1


def test_the_page_of_the_house_has_its_table() -> None:
    """``make house-write`` writes it."""
    house = runpy.run_path(str(PACKAGE.parent / "docs/house.py"))
    table = house["table"](exact=False)
    assert table in house["PAGE"].read_text(encoding="utf-8")
    assert "| `referee` |" in table
    assert "| none |" in table.splitlines()[2]


# --- experiments and benchmarks ----------------------------------------------------------------


def siblings(path: Path) -> set[str]:
    return {other.stem for other in path.parent.glob("*.py")}


def strangers(source: str, known: Set[str] = frozenset()) -> set[str]:
    """What a script imports beside the package, arrays, tables, the standard library and its ``known`` siblings."""
    return {name.split(".")[0] for name in imported(source)} - IN_EXPERIMENTS - known - set(sys.stdlib_module_names)


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_a_script_only_uses_the_package(path: Path) -> None:
    assert strangers(path.read_text(encoding="utf-8"), siblings(path)) == OTHERS.get(path.stem, set())


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
    names = "import consistency.referee.diagnostics as d\n_ = [getattr(d, name) for name in d.__all__]"
    modules_ = loaded(names)
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


def test_a_new_session_lists_the_public_names() -> None:
    """``dir``, and so tab completion, without loading what the names stand for."""
    code = "import sys, consistency; print(*dir(consistency)); print(*sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    names, modules_ = (set(line.split()) for line in out.stdout.splitlines())
    assert {"analyse", "run_trials", "Verdict"} <= names
    assert "numpy" not in modules_


def test_vision_needs_opencv_for_images_alone() -> None:
    assert not loaded("import consistency.vision") & {"cv2", "numba", "pandas", "matplotlib"}


def test_the_help_loads_nothing_heavy() -> None:
    modules_ = loaded("from consistency.commands.app import app\ntry: app(['--help'])\nexcept SystemExit: pass")
    assert "typer" in modules_
    assert not modules_ & {"numpy", "scipy", "pandas", "numba", "pydantic", "matplotlib", "joblib", "bokeh"}


def test_every_public_name_is_there() -> None:
    for name in consistency.__all__:
        assert getattr(consistency, name) is not None
    with pytest.raises(AttributeError, match="consistency attribute nonsense"):
        _ = consistency.nonsense
