"""Whether a column is made from the errors, or selects on the outcome: by its name, or by its values.

The errors of a right estimator have the stated covariance in every group that was fixed before they were. Groups of
small and of large errors do not, nor do groups of the truth, of an estimate or of a sigma that was made from residuals.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

import numpy as np

from consistency.referee.diagnostics.records.groups_by_column import Column
from consistency.referee.types import Array

OF_ERRORS = {"nees", "anees", "error", "errors", "err", "ate", "ape", "rpe"}
OF_SIGMAS = {"sigma", "std", "stddev", "stdev", "cov", "covariance", "variance", "var"}
OF_POSES = {"position", "pos", "rotation", "attitude", "pose", "stated", "own"}
OF_TRUTH = {"true", "truth", "gt", "groundtruth"}
OF_ESTIMATE = {"est", "estimate", "estimated", "state"}
OF_TIME = {"t", "time", "timestamp", "step", "run"}
UNITS = (1.0, 2.0, 3.0, 100.0, 1000.0, 180.0 / np.pi)  # in which a sigma may stand: multiples, cm, mm, degrees
ALIKE = 1e-3  # of the spread of a column: how well it is a function of something else
FEWEST = 20  # values that show anything
SAMPLE = 500  # values that are compared in pairs
NEAR, TIMES = 10, 10.0  # values on either side of a threshold, and how many of their gaps it may lie in


def made_from_errors(name: str, values: Array, error: Array | None, nees: Array) -> str:
    """Why a column is made from the errors; "" where nothing shows it.

    Parameters
    ----------
    values : (k,), NaN where there is none
    error : (k, n)
    nees : (k,)
    """
    if named := _words_of(name) & OF_ERRORS:
        return f"its name says '{sorted(named)[0]}'"
    there = np.isfinite(values) & np.isfinite(nees)
    for what, size in _sizes(error, nees):
        if _is_ordered_by(values[there], size[there]):
            return f"its values are those of {what}, in the same order"
    return ""


def selects_on_outcome(
    column: Column,
    axes: Sequence[str],
    truth: Array | None = None,
    estimate: Array | None = None,
    covariance: Array | None = None,
) -> str:
    """Why a column selects on the outcome: it is a judged component, or a stated sigma; "" where nothing shows it.

    Parameters
    ----------
    column : values (...)
    axes : names of the judged components
    truth, estimate : (..., m), their values, where they are known
    covariance : (..., n, n)
    """
    name = column.name
    values = column.values.ravel()
    words = _words_of(column.name)
    if words and words <= OF_TIME:
        return ""
    components = {axis.lower() for axis in axes}
    is_stated = words & OF_SIGMAS and words <= OF_SIGMAS | OF_POSES | components
    if is_stated or re.match(r"(own_)?P_", name):
        return "is a stated sigma"
    for of, what in ((OF_TRUTH, "truth"), (OF_ESTIMATE, "estimate")):
        if words & of and words - of and words - of <= components:
            return f"is a component of the {what}"
    if name in axes:
        return "is a component of the estimate"
    if column.words:
        return ""
    if covariance is not None and any(
        _is_same(values, sigma) for sigma in _sigmas(covariance.reshape(-1, *covariance.shape[-2:]))
    ):
        return "is a stated sigma"
    for state, what in ((truth, "truth"), (estimate, "estimate")):
        if state is not None and any(_is_linear(values, size) for size in _components(state)):
            return f"is a component of the {what}"
    return ""


def _words_of(name: str) -> set[str]:
    """Words of a name: "posErr_x" -> pos, err, x."""
    parted = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name)
    return {word.lower() for word in re.split(r"[^A-Za-z]+", parted) if word}


# --- what a column may be made from -------------------------------------------------------------------


def _sizes(error: Array | None, nees: Array) -> Iterator[tuple[str, Array]]:
    yield "the NEES", nees
    if error is None:
        return
    yield "the size of the error", np.linalg.norm(error, axis=1)
    for width in {min(2, error.shape[1]), min(3, error.shape[1])}:
        yield "the size of the error", np.linalg.norm(error[:, :width], axis=1)
    for component in error.T:
        yield "an error", component
        yield "the size of an error", np.abs(component)


def _sigmas(covariance: Array) -> Iterator[Array]:
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    for variance in (*variances.T, variances.sum(axis=1)):
        yield variance
        with np.errstate(invalid="ignore"):
            sigma = np.sqrt(variance)
        yield from (unit * sigma for unit in UNITS)


def _components(state: Array) -> Iterator[Array]:
    for component in state.T:
        yield from (component, np.abs(component), component**2)
    for width in {min(2, state.shape[1]), min(3, state.shape[1]), state.shape[1]}:
        yield np.linalg.norm(state[:, :width], axis=1)


# --- how values show it -------------------------------------------------------------------------------


def _is_same(values: Array, other: Array) -> bool:
    both = np.isfinite(values) & np.isfinite(other)
    v = values[both]
    o = other[both]
    return len(v) >= FEWEST and len(np.unique(v)) > 2 and bool((np.abs(v - o) <= ALIKE * np.abs(o)).all())


def _is_linear(values: Array, other: Array) -> bool:
    """Is a column something else in other units, to rounding?"""
    both = np.isfinite(values) & np.isfinite(other)
    v = values[both] - values[both].mean()
    o = other[both] - other[both].mean()
    if len(v) < FEWEST or len(np.unique(v)) <= 2 or not o.any() or _goes_one_way(v):
        return False
    rest = v - o * (v @ o) / (o @ o)
    return bool(rest.std() <= ALIKE * v.std())


def _is_ordered_by(values: Array, size: Array) -> bool:
    """Is a column an increasing or falling function of something that is continuous, or a threshold on it?"""
    if len(values) < FEWEST or _goes_one_way(values):
        return False
    different = np.unique(values)
    if len(different) == 2:
        parts = sorted((np.sort(size[values == value]) for value in different), key=lambda part: float(part[0]))
        return _is_threshold(*parts)
    if len(different) < FEWEST:
        return False
    some = np.linspace(0, len(values) - 1, min(SAMPLE, len(values))).astype(int)
    signs = np.sign(values[some, None] - values[some]) * np.sign(size[some, None] - size[some])
    untied = np.abs(signs).sum()
    return bool(untied and np.abs(signs.sum()) >= (1.0 - ALIKE) * untied)


def _goes_one_way(values: Array) -> bool:
    """Does a column only grow, or only fall, as the time and the way of one run do? So may the errors of a drift."""
    steps = np.diff(values)
    return bool((steps >= 0).all() or (steps <= 0).all())


def _is_threshold(below: Array, above: Array) -> bool:
    """Do two sets of sorted values meet at a threshold, without a gap as between unlike sets?"""
    if min(len(below), len(above)) < NEAR or above[0] < below[-1]:
        return False
    gaps = np.median(np.diff(below[-NEAR:])), np.median(np.diff(above[:NEAR]))
    return bool(above[0] - below[-1] <= TIMES * min(gaps))
