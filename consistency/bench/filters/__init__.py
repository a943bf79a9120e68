"""What the filter believes: SLAM filters by name.

A method is two files of one name: in ``textbook`` as a textbook writes it, in ``methods`` the parts that its kernel is
made of. Parts that several methods use are in ``methods.ekf`` or in a folder for each role; ``kernel`` is what all
share. Nothing here knows the simulation.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any

from consistency.referee.errors import InputError
from consistency.referee.extras import MissingPackageError, remedy

# name -> module of this folder, the attribute in it, imported when asked for, and what the filter is
MODULES: dict[str, tuple[str, str, str]] = {
    "kf": ("methods.kf", "FILTER", "Kalman filter of a linear world, exact: the positive control"),
    "ekf-xyz": ("methods.ekf", "XYZ", "Extended Kalman filter on points in m"),
    "ekf-uvd": ("methods.ekf", "UVD", "Extended Kalman filter on pixels and disparity"),
    "predicted-ekf-xyz": (
        "methods.triangulated",
        "PREDICTED",
        "EKF on triangulated points, with their noise at the prediction",
    ),
    "debiased-ekf-xyz": (
        "methods.triangulated",
        "DEBIASED",
        "EKF on triangulated points, with noise and bias at the prediction",
    ),
    "ukf-xyz": ("methods.ukf", "XYZ", "Unscented Kalman filter on points"),
    "ukf-uvd": ("methods.ukf", "UVD", "Unscented Kalman filter on pixels"),
    "ckf-xyz": ("methods.ukf", "CKF_XYZ", "Cubature Kalman filter on points"),
    "ckf-uvd": ("methods.ukf", "CKF_UVD", "Cubature Kalman filter on pixels"),
    "iekf-xyz": ("methods.iekf", "XYZ", "EKF with an iterated update, on points"),
    "iekf-uvd": ("methods.iekf", "UVD", "EKF with an iterated update, on pixels"),
    "ispkf-xyz": ("methods.ispkf", "XYZ", "UKF with an iterated update, on points"),
    "ispkf-uvd": ("methods.ispkf", "UVD", "UKF with an iterated update, on pixels"),
    "ri-ekf-xyz": ("methods.riekf", "XYZ", "EKF of a right-invariant error, on points"),
    "ri-ekf-uvd": ("methods.riekf", "UVD", "EKF of a right-invariant error, on pixels"),
    "fej-ekf-xyz": ("methods.fej", "XYZ", "EKF with first-estimates Jacobians, on points"),
    "fej-ekf-uvd": ("methods.fej", "UVD", "EKF with first-estimates Jacobians, on pixels"),
    "oc-ekf-xyz": ("methods.oc", "XYZ", "Observability-constrained EKF, on points"),
    "oc-ekf-uvd": ("methods.oc", "UVD", "Observability-constrained EKF, on pixels"),
    "ideal-ekf-xyz": ("methods.ideal", "XYZ", "EKF with Jacobians at the truth, on points: a bound"),
    "ideal-ekf-uvd": ("methods.ideal", "UVD", "EKF with Jacobians at the truth, on pixels: a bound"),
    "anchored-ekf-xyz": ("methods.anchored", "XYZ", "EKF with anchored inverse depths, on points"),
    "anchored-ekf-uvd": ("methods.anchored", "UVD", "EKF with anchored inverse depths, on pixels"),
    "robocentric-ekf-uvd": ("methods.robocentric", "ROBOCENTRIC", "Robot-centred map of inverse ranges"),
    "parked-ekf-uvd": (
        "methods.robocentric",
        "PARKED",
        "robot-centred map, with landmarks out of sight parked at clones of the pose",
    ),
    "eqf-uvd": ("methods.equivariant", "FILTER", "Equivariant filter: robot-centred map with polar errors, on pixels"),
    "submap-ekf-xyz": ("textbook.submaps", "XYZ", "EKF in small maps that are joined, on points"),
    "submap-ekf-uvd": ("textbook.submaps", "UVD", "EKF in small maps that are joined, on pixels"),
    "filterpy-ekf-xyz": ("external.filterpy", "EKF_XYZ", "EKF of the library filterpy, on points"),
    "filterpy-ekf-uvd": ("external.filterpy", "EKF_UVD", "EKF of the library filterpy, on pixels"),
    "filterpy-ukf-xyz": ("external.filterpy", "UKF_XYZ", "UKF of the library filterpy, on points"),
    "filterpy-ukf-uvd": ("external.filterpy", "UKF_UVD", "UKF of the library filterpy, on pixels"),
    "gtsam-batch-uvd": ("external.gtsam", "BATCH_UVD", "Smoother of gtsam, each pose by all data up to its step"),
    "gtsam-lag-uvd": ("external.gtsam", "LAG_UVD", "Smoother of gtsam over the last steps"),
    "gtsam-map-uvd": ("external.gtsam", "MAP_UVD", "Batch maximum a posteriori of gtsam: a bound"),
}
# methods on landmarks in the plane: METHOD-xy (relative-xy), METHOD-rb (range-bearing); file, and what it is
PLANAR = {
    "ekf": ("ekf", "Extended Kalman filter"),
    "ukf": ("ukf", "Unscented Kalman filter"),
    "iekf": ("iekf", "EKF with an iterated update"),
    "ri-ekf": ("riekf", "EKF of a right-invariant error"),
    "fej-ekf": ("fej", "EKF with first-estimates Jacobians"),
    "oc-ekf": ("oc", "Observability-constrained EKF"),
    "ideal-ekf": ("ideal", "EKF with Jacobians at the truth: a bound"),
}
MODULES |= {
    f"{method}-{suffix}": (f"methods.{file}", suffix.upper(), f"{text}, in the plane, {data}")
    for method, (file, text) in PLANAR.items()
    for suffix, data in (("xy", "on relative positions"), ("rb", "on range and bearing"))
}
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
    return {name: summary for name, (_, _, summary) in MODULES.items()}


def usable_names() -> list[str]:
    """Names of the built-in filters whose libraries are installed."""
    return [name for name, (module, _, _) in MODULES.items() if _missing(module) is None]


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
    module, attribute, _ = MODULES[name]
    if (missing := _missing(module)) is not None:
        package, extra = missing
        raise MissingPackageError(f"filter '{name}' needs {remedy(extra, package=package)}")
    return getattr(import_module(f"consistency.bench.filters.{module}"), attribute)


def _missing(module: str) -> tuple[str, str] | None:
    """Package that a module needs and that is not installed, and the extra that has it."""
    needed = EXTRAS.get(module)
    return needed if needed is not None and find_spec(needed[0]) is None else None
