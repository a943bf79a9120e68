"""Imports flow one way, as import-linter reads in pyproject.toml; what is loaded is seen in a new process."""

import ast
import runpy
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import forks
import grimp
import pytest

import consistency

PACKAGE = Path(consistency.__file__).parent
SETTINGS = PACKAGE.parent / "pyproject.toml"
SCRIPTS = [path for folder in ("experiments", "benchmarks") for path in sorted((PACKAGE.parent / folder).glob("*.py"))]
IN_EXPERIMENTS = {"consistency", "numpy", "pandas", "scipy"}
# what the bench sets beside ours, and an experiment on images, which draws them
OTHERS = {
    "bench_peers": {"filterpy"},
    "bench_stonesoup": {"stonesoup"},
    "front_end_figures": {"matplotlib"},
}


def imported(source):
    """Dotted names that a source imports, wherever in it."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield str(node.module)


def acyclic(graph):
    try:
        TopologicalSorter(graph).prepare()
    except CycleError:
        return False
    return True


def linted(settings):
    """What import-linter says of the package by these settings."""
    code = "from importlinter.cli import lint_imports_command; lint_imports_command()"
    command = [sys.executable, "-c", code, str(settings), "--no-cache"]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=PACKAGE.parent)


def test_directions_between_roots_folders_and_layers():
    done = linted(SETTINGS)
    assert done.returncode == 0, done.stdout


def test_a_direction_that_is_turned_is_reported(tmp_path):
    """Negative control: in truth the second imports the first."""
    contract = 'name = "turned"\ntype = "layers"\nlayers = ["consistency.referee", "consistency.bench"]'
    settings = tmp_path / "pyproject.toml"
    settings.write_text(
        f'[tool.importlinter]\nroot_package = "consistency"\n[[tool.importlinter.contracts]]\n{contract}\n'
    )
    done = linted(settings)
    assert done.returncode == 1
    assert "turned BROKEN" in done.stdout


def imports_of(package):
    """What each module of a package imports from it: on top, within functions, and for the type checker."""
    modules = grimp.build_graph(package, cache_dir=None)
    return {name: modules.find_modules_directly_imported_by(name) for name in modules.modules}


def test_no_modules_import_each_other_in_a_circle():
    graph = imports_of("consistency")
    assert len(graph) > 250
    assert acyclic(graph)
    assert not acyclic(
        graph | {"consistency.bench.scenario.toml_tables": {"consistency.bench.scenario.observations"}}
    )  # negative control


@pytest.mark.parametrize("condition", ["def later():", "if TYPE_CHECKING:"])
def test_a_circle_by_an_import_below_the_top_is_seen(tmp_path, monkeypatch, condition):
    package = tmp_path / "circle"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "first.py").write_text("import circle.second")
    second = package / "second.py"
    second.write_text("from typing import TYPE_CHECKING")
    monkeypatch.syspath_prepend(tmp_path)
    assert acyclic(imports_of("circle"))
    second.write_text(f"from typing import TYPE_CHECKING\n{condition}\n    from circle.first import name")
    assert not acyclic(imports_of("circle"))


def test_the_page_of_the_house_has_its_table():
    """``make house-write`` writes it."""
    house = runpy.run_path(str(PACKAGE.parent / "docs/house.py"))
    table = house["table"](exact=False)
    assert table in house["PAGE"].read_text(encoding="utf-8")
    assert "| `referee` |" in table
    assert "| none |" in table.splitlines()[2]


# --- experiments and benchmarks ----------------------------------------------------------------


def siblings(path):
    return {other.stem for other in path.parent.glob("*.py")}


def strangers(source, known=frozenset()):
    """What a script imports beside the package, arrays, tables, the standard library and its ``known`` siblings."""
    return {name.split(".")[0] for name in imported(source)} - IN_EXPERIMENTS - known - set(sys.stdlib_module_names)


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_a_script_only_uses_the_package(path):
    assert strangers(path.read_text(encoding="utf-8"), siblings(path)) == OTHERS.get(path.stem, set())


def mentioned(path):
    """Siblings that a script imports, by a statement or, where a part is loaded later, by its name as text."""
    source = path.read_text(encoding="utf-8")
    texts = {str(node.value) for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Constant)}
    parts = {text for text in texts if "_" in text}
    return siblings(path) & ({*imported(source)} | parts) - {path.stem}


def test_scripts_do_not_import_each_other_in_a_circle():
    graph = {path.stem: mentioned(path) for path in SCRIPTS}
    assert {"bench_models", "bench_stonesoup"} <= graph["bench_peers"]
    assert acyclic(graph)
    assert not acyclic(graph | {"bench_models": {"bench_stonesoup"}})  # negative control


def test_a_stranger_in_an_experiment_is_caught():
    source = "import consistency as cs\nimport os\nfrom matplotlib import pyplot\nimport numba"
    assert strangers(source) == {"matplotlib", "numba"}


# --- what is loaded ----------------------------------------------------------------------------


def loaded(statement):
    """Top-level modules in a new process after ``statement``."""
    code = f"import sys\n{statement}\nprint(*{{name.split('.')[0] for name in sys.modules}})"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    return set(out.stdout.split())


def test_diagnostics_load_arrays_and_distributions_only():
    names = "import consistency.diagnostics as d\n_ = [getattr(d, name) for name in d.__all__]"
    modules_ = loaded(names)
    assert {"numpy", "scipy"} <= modules_
    assert not modules_ & {"pandas", "matplotlib", "numba", "pydantic", "joblib"}


def test_gates_need_arrays_only():
    modules_ = loaded("import consistency.testing")
    assert {"numpy", "scipy"} <= modules_
    assert not modules_ & {"pytest", "_pytest", "pandas", "matplotlib", "numba", "pydantic", "joblib", "rich"}


def test_the_pytest_plugin_loads_nothing_heavy():
    assert not loaded("import consistency.pytest_plugin") & {"numpy", "scipy", "pandas", "numba", "pydantic", "rich"}


def test_the_package_itself_loads_nothing_heavy():
    heavy = {"numpy", "scipy", "pandas", "numba", "pydantic", "matplotlib", "joblib", "typer"}
    assert not loaded("import consistency") & heavy
    assert "numba" in loaded("import consistency; consistency.get_filter('ekf-uvd')")  # negative control


def test_engines_of_clusters_are_loaded_when_they_are_chosen():
    begin = "import consistency.bench.runs.montecarlo\nfrom consistency.bench.runs.executors import executor_for"
    choose = "with executor_for(sys.argv[0]): pass\nprint(*{name.split('.')[0] for name in sys.modules})"
    for name, engines in (("local", set()), ("dask", {"dask", "distributed"}), ("slurm", {"submitit"})):
        done = forks.done(begin, choose, name, cwd=PACKAGE.parent)
        assert done.returncode == 0, done.stderr
        assert {"dask", "distributed", "submitit"} & {*done.stdout.split()} == engines


def test_a_new_session_lists_the_public_names():
    """``dir``, and so tab completion, without loading what the names stand for."""
    code = "import sys, consistency; print(*dir(consistency)); print(*sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    names, modules_ = (set(line.split()) for line in out.stdout.splitlines())
    assert {"analyse", "run_trials", "Verdict"} <= names
    assert "numpy" not in modules_


def test_vision_needs_opencv_for_images_alone():
    assert not loaded("import consistency.vision") & {"cv2", "numba", "pandas", "matplotlib"}


def test_the_help_loads_nothing_heavy():
    modules_ = loaded("from consistency.commands.app import app\ntry: app(['--help'])\nexcept SystemExit: pass")
    assert "typer" in modules_
    assert not modules_ & {"numpy", "scipy", "pandas", "numba", "pydantic", "matplotlib", "joblib"}


def test_every_public_name_is_there():
    for name in consistency.__all__:
        assert getattr(consistency, name) is not None
    with pytest.raises(AttributeError, match="consistency attribute nonsense"):
        _ = consistency.nonsense


def test_lists_of_sources_name_what_is_there():
    """A digest over a place that is gone would never change."""
    from consistency.bench.runs.workers import PACKAGE, ROOMS
    from consistency.bench.sweeps.run_sweep import CODE

    assert [place for place in (*ROOMS, *CODE) if not (PACKAGE / place).exists()] == []
