"""What the referee calls outside of itself, by name: each is loaded when it is met, and may need an extra."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

OUTSIDE = {
    "results": "consistency.bench.runs.records:source_of",  # of the bench, in memory or in a folder
    "innovations": "consistency.bench.runs.records:innovations_of",  # of one run in a folder of results
    "report": "consistency.bench.pages:write_reports",  # of a folder of results
    "pilot": "consistency.bench.runs.pilots:pilots_in",  # runs in a folder of results, to plan by
    "pilot runs": "consistency.bench.runs.pilots:pilots_in_world",  # runs of a scenario, to plan by
    "columns": "consistency.bench.store.parquet:read_columns",  # of a Parquet file
}


def outside(name: str) -> Callable[..., Any]:
    """The function of that name.

    Raises
    ------
    ModuleNotFoundError
        A package of its extra is not installed.
    """
    module, attribute = OUTSIDE[name].split(":")
    function: Callable[..., Any] = getattr(import_module(module), attribute)
    return function
