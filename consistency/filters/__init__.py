"""What the filter believes: SLAM filters by name.

A method is one file in ``methods``: the parts that its kernel is made of, and its plain twin. Parts that several
methods use have a folder for each role; ``kernel`` is what all share. Nothing here knows the simulation.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
from typing import Any

from consistency.errors import InputError

# name -> module of this folder and the attribute in it; imported when asked for
MODULES = {
    "kf": ("methods.kf", "FILTER"),
    "ekf-xyz": ("methods.ekf", "XYZ"),
    "ekf-uvd": ("methods.ekf", "UVD"),
    "ukf-xyz": ("methods.ukf", "XYZ"),
    "ukf-uvd": ("methods.ukf", "UVD"),
    "ckf-xyz": ("methods.ckf", "XYZ"),
    "ckf-uvd": ("methods.ckf", "UVD"),
    "iekf-xyz": ("methods.iekf", "XYZ"),
    "iekf-uvd": ("methods.iekf", "UVD"),
    "ri-ekf-xyz": ("methods.riekf", "XYZ"),
    "ri-ekf-uvd": ("methods.riekf", "UVD"),
    "fej-ekf-xyz": ("methods.fej", "XYZ"),
    "fej-ekf-uvd": ("methods.fej", "UVD"),
    "oc-ekf-xyz": ("methods.oc", "XYZ"),
    "oc-ekf-uvd": ("methods.oc", "UVD"),
    "ideal-ekf-xyz": ("methods.ideal", "XYZ"),
    "ideal-ekf-uvd": ("methods.ideal", "UVD"),
    "anchored-ekf-xyz": ("methods.anchored", "XYZ"),
    "anchored-ekf-uvd": ("methods.anchored", "UVD"),
    "robocentric-ekf-uvd": ("methods.robocentric", "ROBOCENTRIC"),
    "parked-ekf-uvd": ("methods.robocentric", "PARKED"),
    "filterpy-ekf-xyz": ("external.filterpy", "EKF_XYZ"),
    "filterpy-ekf-uvd": ("external.filterpy", "EKF_UVD"),
    "filterpy-ukf-xyz": ("external.filterpy", "UKF_XYZ"),
    "filterpy-ukf-uvd": ("external.filterpy", "UKF_UVD"),
    "gtsam-batch-uvd": ("external.gtsam", "BATCH_UVD"),
    "gtsam-lag-uvd": ("external.gtsam", "LAG_UVD"),
    "gtsam-map-uvd": ("external.gtsam", "MAP_UVD"),
}
BOUNDS = frozenset({"ideal-ekf-xyz", "ideal-ekf-uvd"})  # told the truth: ``realisable`` of these is False
SMOOTHERS = frozenset({"gtsam-map-uvd"})  # each pose by the data of the whole trial: ``causal`` of these is False
EXTRAS = {"external.gtsam": ("gtsam", "smoothing")}  # module -> the package it needs, and the extra that has it


def filter_names() -> list[str]:
    """Names of the built-in filters."""
    return list(MODULES)


def usable_names() -> list[str]:
    """Names of the built-in filters whose libraries are installed."""
    return [name for name, (module, _) in MODULES.items() if _missing(module) is None]


def get_filter(name: str) -> Any:
    """Built-in filter by name.

    Raises
    ------
    InputError
        Unknown name, or a filter of a library that is not installed.
    """
    if name not in MODULES:
        if "," in name:
            raise InputError(f"unknown filter '{name}'; give --filter once for each filter")
        near = difflib.get_close_matches(name, MODULES, n=1)
        hint = f" (did you mean '{near[0]}'?)" if near else ""
        raise InputError(f"unknown filter '{name}'{hint}; known: {', '.join(MODULES)}")
    module, attribute = MODULES[name]
    if (missing := _missing(module)) is not None:
        package, extra = missing
        raise InputError(f"filter '{name}' needs {package}: pip install 'filter-consistency[{extra}]'")
    return getattr(importlib.import_module(f"consistency.filters.{module}"), attribute)


def _missing(module: str) -> tuple[str, str] | None:
    """Package that a module needs and that is not installed, and the extra that has it."""
    needed = EXTRAS.get(module)
    return needed if needed is not None and importlib.util.find_spec(needed[0]) is None else None
