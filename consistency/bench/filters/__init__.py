"""What the filter believes: SLAM filters by name.

A method is two files of one name: in ``textbook`` as a textbook writes it, in ``methods`` the parts that its kernel is
made of. Parts that several methods use are in ``methods.ekf`` or in ``parts``; ``kernel`` is what all share. Nothing
here knows the simulation.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any

from consistency.referee.errors import InputError
from consistency.referee.extras import MissingPackageError, remedy

DATA = {
    "xyz": "on points",
    "uvd": "on pixels",
    "xy": "in the plane, on relative positions",
    "rb": "in the plane, on range and bearing",
}
# method -> module of this folder that has it among its FILTERS, imported when asked for, what the method is, and the
# endings of its names by the data that it takes, DATA; none where the name is that of one filter
METHODS = {
    "kf": ("methods.kf", "Kalman filter of a linear world, exact: the positive control", ""),
    "ekf": ("methods.ekf", "Extended Kalman filter", "xyz uvd"),
    "predicted-ekf-xyz": ("methods.triangulated", "EKF on triangulated points, with their noise at the prediction", ""),
    "debiased-ekf-xyz": (
        "methods.triangulated",
        "EKF on triangulated points, with noise and bias at the prediction",
        "",
    ),
    "ukf": ("methods.ukf", "Unscented Kalman filter", "xyz uvd"),
    "ckf": ("methods.ukf", "Cubature Kalman filter", "xyz uvd"),
    "iekf": ("methods.iekf", "EKF with an iterated update", "xyz uvd"),
    "ispkf": ("methods.ispkf", "UKF with an iterated update", "xyz uvd"),
    "ri-ekf": ("methods.riekf", "EKF of a right-invariant error", "xyz uvd"),
    "fej-ekf": ("methods.fej", "EKF with first-estimates Jacobians", "xyz uvd"),
    "oc-ekf": ("methods.oc", "Observability-constrained EKF", "xyz uvd"),
    "ideal-ekf": ("methods.ideal", "EKF with Jacobians at the truth: a bound", "xyz uvd"),
    "anchored-ekf": ("methods.anchored", "EKF with anchored inverse depths", "xyz uvd"),
    "robocentric-ekf-uvd": ("methods.robocentric", "Robot-centred map of inverse ranges", ""),
    "parked-ekf-uvd": (
        "methods.robocentric",
        "robot-centred map, with landmarks out of sight parked at clones of the pose",
        "",
    ),
    "eqf-uvd": ("methods.equivariant", "Equivariant filter: robot-centred map with polar errors, on pixels", ""),
    "submap-ekf": ("textbook.submaps", "EKF in small maps that are joined", "xyz uvd"),
    "filterpy-ekf": ("external.filterpy", "EKF of the library filterpy", "xyz uvd"),
    "filterpy-ukf": ("external.filterpy", "UKF of the library filterpy", "xyz uvd"),
    "gtsam-batch-uvd": ("external.gtsam", "Smoother of gtsam, each pose by all data up to its step", ""),
    "gtsam-lag-uvd": ("external.gtsam", "Smoother of gtsam over the last steps", ""),
    "gtsam-map-uvd": ("external.gtsam", "Batch maximum a posteriori of gtsam: a bound", ""),
}
PLANAR = ("ekf", "ukf", "iekf", "ri-ekf", "fej-ekf", "oc-ekf", "ideal-ekf")  # methods on landmarks in the plane, too


def _names(method: str, data: str) -> dict[str, tuple[str, str]]:
    """Module and summary of each filter of a method, by name."""
    module, text, _ = METHODS[method]
    if not data:
        return {method: (module, text)}
    return {f"{method}-{each}": (module, f"{text}, {DATA[each]}") for each in data.split()}


MODULES: dict[str, tuple[str, str]] = {}
for _method in METHODS:
    MODULES |= _names(_method, METHODS[_method][2])
for _method in PLANAR:
    MODULES |= _names(_method, "xy rb")
# told the truth: ``realisable`` of these is False
BOUNDS = frozenset(name for name in MODULES if name.startswith("ideal-ekf-"))
SMOOTHERS = frozenset({"gtsam-map-uvd"})  # each pose by the data of the whole trial: ``causal`` of these is False
EXTRAS = {  # module -> the package it needs, and the extra that has it
    "external.filterpy": ("filterpy", "peers"),
    "external.gtsam": ("gtsam", "smoothing"),
}


def filter_names() -> list[str]:
    """Names of the built-in filters."""
    return list(MODULES)


def filter_summaries() -> dict[str, str]:
    """What each built-in filter is, in a few words, by name."""
    return {name: summary for name, (_, summary) in MODULES.items()}


def usable_names() -> list[str]:
    """Names of the built-in filters whose libraries are installed."""
    return [name for name, (module, _) in MODULES.items() if _missing(module) is None]


def get_filter(name: str) -> Any:
    """Built-in filter by name, behind a guard where the name ends in "+" and its kind.

    Raises
    ------
    InputError
        Unknown name or guard, a filter that cannot be guarded, or a filter of a library that is not installed.
    """
    inner, plus, kind = name.partition("+")
    if plus:
        from consistency.bench.filters.compiled import guarded

        return guarded(get_filter(inner), kind)
    if name not in MODULES:
        if "," in name:
            raise InputError(f"unknown filter '{name}'; give --filter once for each filter")
        if ".py" in name:
            example = "cs.run_trials(scenario, [MyFilter()])"
            raise InputError(f"unknown filter '{name}'; a filter of your own runs from Python: {example}")
        from consistency.bench.scenario.truth_and_belief import unknown

        raise InputError(unknown("filter", name, list(MODULES)))
    module, _ = MODULES[name]
    if (missing := _missing(module)) is not None:
        package, extra = missing
        raise MissingPackageError(f"filter '{name}' needs {remedy(extra, package=package)}")
    return import_module(f"consistency.bench.filters.{module}").FILTERS[name]


def _missing(module: str) -> tuple[str, str] | None:
    """Package that a module needs and that is not installed, and the extra that has it."""
    needed = EXTRAS.get(module)
    return needed if needed is not None and find_spec(needed[0]) is None else None
