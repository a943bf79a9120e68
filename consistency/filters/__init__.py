"""What the filter believes: SLAM filters by name.

One file a filter; rules, observation models and the loop over a trial are shared. Nothing here knows
the simulation.
"""

from __future__ import annotations

import difflib
import importlib
from typing import Any

from consistency.errors import InputError

MODULES = {
    "kf": "kf",
    "ekf-xyz": "ekf_xyz",
    "ekf-uvd": "ekf_uvd",
    "ukf-xyz": "ukf_xyz",
    "ukf-uvd": "ukf_uvd",
    "filterpy-ekf-xyz": "filterpy_ekf_xyz",
    "filterpy-ekf-uvd": "filterpy_ekf_uvd",
    "filterpy-ukf-xyz": "filterpy_ukf_xyz",
    "filterpy-ukf-uvd": "filterpy_ukf_uvd",
}


def filter_names() -> list[str]:
    """Names of the built-in filters."""
    return list(MODULES)


def get_filter(name: str) -> Any:
    """Built-in filter by name.

    Raises
    ------
    InputError
        Unknown name.
    """
    if name not in MODULES:
        near = difflib.get_close_matches(name, MODULES, n=1)
        hint = f"; did you mean '{near[0]}'?" if near else "."
        raise InputError(f"unknown filter '{name}'{hint} Known: {', '.join(MODULES)}")
    return importlib.import_module(f"consistency.filters.{MODULES[name]}").FILTER
