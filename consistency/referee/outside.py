"""Functions that are loaded when they are called, by ``module:function``, and those of the bench by name."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

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
