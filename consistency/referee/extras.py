"""Optional packages: which extra brings which, what is missing here, and the one sentence that says how to install it.

Also names of a package that are loaded on first use, and functions that are loaded when they are called, those of the
bench by name: that is where a missing package is noticed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from consistency.referee.errors import InputError

DISTRIBUTION = "filter-consistency"
# what pyproject.toml lists for each extra; one in brackets is another extra
EXTRAS = {
    "bench": (
        "numpy>=2.0", "scipy>=1.16", "numba", "llvmlite", "joblib", "pebble", "filelock", "threadpoolctl", "psutil",
        "pandas",
        "pyarrow", "pydantic", "rich>=14.1", "tomli-w",
    ),
    "plot": ("matplotlib",),
    "report": ("[plot]", "typst"),
    "vision": ("[bench]", "opencv-python-headless", "pyyaml"),
    "parquet": ("pyarrow",),
    "ros": ("rosbags",),
    "ulog": ("pyulog",),
    "ardupilot": ("pymavlink",),
    "peers": ("[bench]", "filterpy", "stonesoup"),
    "smoothing": ("[bench]", "gtsam"),
    "cluster": ("[bench]", "distributed", "submitit"),
}  # fmt: skip
MODULES = {"opencv-python-headless": "cv2", "pyyaml": "yaml", "tomli-w": "tomli_w"}  # where the name differs
PYTHON = {"bench": (3, 11)}  # needed by the SciPy of an extra


class MissingPackageError(InputError, ImportError):
    """An optional package is not installed: says which, and how to install it."""


def packages(*extras: str) -> list[str]:
    """Requirements of extras, with those of the extras that they include."""
    found: dict[str, None] = {}
    for extra in extras:
        for name in EXTRAS[extra]:
            found |= dict.fromkeys(packages(name.strip("[]")) if name.startswith("[") else [name])
    return list(found)


def missing(*extras: str) -> list[str]:
    """Requirements of extras that are not met here."""
    return [requirement for requirement in packages(*extras) if not _is_met(requirement)]


def require(what: str, *extras: str) -> None:
    """Refuse ``what``, before any work, where packages of the extras are missing.

    Raises
    ------
    MissingPackageError
        Names the packages and how to install them.
    """
    if missing(*extras):
        raise MissingPackageError(f"{what} needs {remedy(*extras)}")


def remedy(*extras: str, own: str = "") -> str:
    """What is missing of extras, and how to install it: ``numba, joblib: pip install numba joblib``.

    Parameters
    ----------
    own : the one package that is needed of those that a single extra lists itself
    """
    from shlex import join

    included = {*extras, *(name.strip("[]") for extra in extras for name in EXTRAS[extra])}
    if low := [version for extra, version in PYTHON.items() if extra in included and sys.version_info < version]:
        return f"Python {'.'.join(map(str, max(low)))} or later; this is {sys.version_info[0]}.{sys.version_info[1]}"
    lacking = [each for each in missing(*extras) if not own or each == own or each not in EXTRAS[extras[0]]]
    lacking = lacking or [own or EXTRAS[extras[0]][-1]]  # is there and cannot be loaded
    return f"{', '.join(lacking)}: pip install {join(_from_origin(extras) or lacking)}"


def explained(error: ModuleNotFoundError, what: str) -> MissingPackageError | None:
    """The sentence of :func:`require` for an import that failed; None if no extra lacks the module."""
    module = (error.name or "").partition(".")[0]
    for extra in EXTRAS:
        if any(_module(requirement) == module for requirement in missing(extra)):
            return MissingPackageError(f"{what} needs {remedy(extra)}")
    return None


def _module(requirement: str) -> str:
    name = requirement.partition(">=")[0]
    return MODULES.get(name, name)


@cache
def is_installed(extra: str) -> bool:
    """Whether all packages of an extra are found, of whatever version."""
    return all(find_spec(_module(requirement)) is not None for requirement in packages(extra))


def _is_met(requirement: str) -> bool:
    name, _, floor = requirement.partition(">=")
    if not floor or find_spec(name) is None:
        return find_spec(_module(requirement)) is not None
    from importlib.metadata import version

    here = version(name).split(".")
    return [int(part) for part in here[:2]] >= [int(part) for part in floor.split(".")]


def _from_origin(extras: tuple[str, ...]) -> list[str]:
    """Arguments of pip for this package with extras, from where it was installed; none if that is not known (PEP 610).

    The package is on no index, so that its name alone is none.
    """
    import json
    from importlib.metadata import PackageNotFoundError, distribution
    from urllib.parse import urlsplit
    from urllib.request import url2pathname

    try:
        record = json.loads(distribution(DISTRIBUTION).read_text("direct_url.json") or "{}")
    except PackageNotFoundError:
        return []
    url, added = record.get("url", ""), f"[{','.join(extras)}]"
    if url.startswith("file:"):
        path = Path(url2pathname(urlsplit(url).path))
        editable = record.get("dir_info", {}).get("editable", False)
        is_there = path.is_file() or (path / "pyproject.toml").is_file()  # not so in a bare repository
        return [*["-e"] * editable, f"{path}{added}"] if is_there else []
    if vcs := record.get("vcs_info"):
        url = f"{vcs['vcs']}+{url}@{vcs.get('requested_revision') or vcs['commit_id']}"
    return [f"{DISTRIBUTION}{added} @ {url}"] if url else []


# --- names loaded on first use ---------------------------------------------------------------------


def lazy_names(
    package: str, file: str, packages: Collection[str] = ()
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """``__getattr__``, ``__dir__`` and ``__all__`` of a package whose names stand in the ``.pyi`` beside its file.

    Each name is loaded when it is first used, as are the ``packages`` below it. One that needs a package that is not
    installed raises :class:`MissingPackageError`.
    """
    import ast

    stub = ast.parse(Path(file).with_suffix(".pyi").read_text(encoding="utf-8"))
    modules = {
        alias.name: f"{package}.{node.module}"
        for node in stub.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }

    def load(name: str) -> Any:
        if name in packages:
            return import_module(f"{package}.{name}")
        if name not in modules:
            raise AttributeError(f"No {package} attribute {name}")
        try:
            return getattr(import_module(modules[name]), name)
        except ModuleNotFoundError as error:
            raise explained(error, f"{package}.{name}") or error from None

    return load, lambda: sorted(modules), sorted(modules)


OUTSIDE = {  # may need an extra
    "results": "bench.runs.results_to_records:source_of",  # of the bench, in memory or in a folder
    "innovations": "bench.runs.results_to_records:innovations_of",  # of one run in a folder of results
    "report": "bench.pages:write_reports",  # of a folder of results
    "pilot": "bench.runs.sequential:pilots_in",  # runs in a folder of results, to plan by
    "pilot runs": "bench.runs.sequential:pilots_in_world",  # runs of a scenario, to plan by
    "columns": "bench.store.parquet:read_columns",  # of a Parquet file
}


def function_at(target: str) -> Callable[..., Any]:
    """The function that ``module:function`` names, of a module below ``consistency``."""
    module, name = target.split(":")
    function: Callable[..., Any] = getattr(import_module(f"consistency.{module}"), name)
    return function


def outside(name: str) -> Callable[..., Any]:
    """The function of that name.

    Raises
    ------
    ModuleNotFoundError
        A package of its extra is not installed.
    """
    return function_at(OUTSIDE[name])
