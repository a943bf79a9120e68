"""What the filter believes: SLAM filters by name.

One file a filter; rules, observation models and the loop over a trial are shared. Nothing here knows
the simulation.
"""

from __future__ import annotations

import difflib
import importlib
from typing import Any

from consistency.errors import InputError

# name -> module of this folder and the attribute in it; imported when asked for
MODULES = {
    "kf": ("kf", "FILTER"),
    "ekf-xyz": ("ekf_xyz", "FILTER"),
    "ekf-uvd": ("ekf_uvd", "FILTER"),
    "ukf-xyz": ("ukf_xyz", "FILTER"),
    "ukf-uvd": ("ukf_uvd", "FILTER"),
    "filterpy-ekf-xyz": ("filterpy_adapters", "EKF_XYZ"),
    "filterpy-ekf-uvd": ("filterpy_adapters", "EKF_UVD"),
    "filterpy-ukf-xyz": ("filterpy_adapters", "UKF_XYZ"),
    "filterpy-ukf-uvd": ("filterpy_adapters", "UKF_UVD"),
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
        if "," in name:
            raise InputError(f"unknown filter '{name}'; give --filter once for each filter")
        near = difflib.get_close_matches(name, MODULES, n=1)
        hint = f" (did you mean '{near[0]}'?)" if near else ""
        raise InputError(f"unknown filter '{name}'{hint}; known: {', '.join(MODULES)}")
    module, attribute = MODULES[name]
    return getattr(importlib.import_module(f"consistency.filters.{module}"), attribute)
