"""The scripts of ``experiments/``: found, imported, and run alone."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType

from consistency.bench.scenario import data_folder
from consistency.bench.types import OURS as OURS
from consistency.referee.errors import InputError


def experiments() -> dict[str, ModuleType]:
    """Scripts of ``experiments/`` by name; each has FINDINGS (ids) and ``main(study)``.

    KERNELS, names of filters by scenario, says what is compiled before the first script runs; what it leaves out is
    compiled when it is needed.

    A script that takes long says so with ``LONG = True``; one that runs no filter, and so shares no trials with the
    others, with ``OWN_PROCESS = True``; one whose data are not shipped with NOT_SHIPPED, what these are, and it
    needs no ``main``. NEEDS says what else a script needs.

    Raises
    ------
    InputError
        A script cannot be imported, or the folder is not there.
    """
    folder = data_folder("experiments")
    if not folder.is_dir():
        raise InputError(f"{folder}: the experiments are missing; install the package again")
    return {path.stem: load_script(path) for path in sorted(folder.glob("e[0-9][0-9]_*.py"))}


@cache
def figure_scripts() -> dict[str, ModuleType]:
    """Scripts of ``experiments/figures/`` by name, each a chapter of a report on the tables that experiments leave.

    A script has CHAPTER (anchor, title, entry in the contents), ``blocks(report)``, empty without its tables, and
    ON_PAPER: whether the PDF of several studies has it, too.

    Raises
    ------
    InputError
        A script cannot be imported.
    """
    folder = data_folder("experiments") / "figures"
    return {path.stem: load_script(path) for path in sorted(folder.glob("*.py"))}


def load_script(path: Path) -> ModuleType:
    try:
        return _executed(path, f"consistency_experiment_{path.stem}")
    except Exception as error:
        raise InputError(f"{path}: cannot be imported ({type(error).__name__}: {error})") from error


def sibling(script: str, name: str) -> ModuleType:
    """The module ``name`` beside a script, whose folder need not be on the path."""
    return _executed(Path(script).with_name(f"{name}.py"), name)


def _executed(path: Path, name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # where dataclasses of the script look for their names
    spec.loader.exec_module(module)
    return module


def first_line_of(module: ModuleType) -> str:
    return (module.__doc__ or "").strip().splitlines()[0]


def command_line(command: Callable[[], None]) -> None:
    """Run a script that reads its own arguments: unusable input ends in one line and exit status 2."""
    try:
        command()
    except InputError as error:
        print(f"{Path(sys.argv[0]).stem}: {error}", file=sys.stderr)
        sys.exit(2)
