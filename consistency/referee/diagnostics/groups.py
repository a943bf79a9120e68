"""Groups of runs and steps by the values of a column, and whether that column selects on the outcome.

The errors of a right estimator have the stated covariance in every group that was fixed before they were. Groups of
small and of large errors do not, nor do groups of the truth, of an estimate or of a sigma that was made from residuals.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from consistency.referee.types import Array, Indices

BINS = 5
MOST = 50  # groups: more would each have too little
MOVED = 0.05  # of the narrowest bin: how far an edge may be moved to have fewer digits
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


@dataclass(frozen=True)
class Column:
    """Values by which runs and steps are told apart; of words, their places among ``words``, in order."""

    name: str
    values: Array  # any shape, NaN where there is none
    words: tuple[str, ...] = ()
    outcome: str = ""  # why it selects on the outcome: "is a stated sigma"; "" where nothing shows that

    def __getitem__(self, rows: Any) -> Column:
        return replace(self, values=self.values[rows])


@dataclass(frozen=True)
class Groups:
    """The group of every value of a column."""

    column: str
    names: tuple[str, ...]  # of the groups: "n_matches <= 40", "40 < n_matches <= 120"; "weather is rain"
    index: Indices  # of the shape of the column, -1 where a value belongs to no group
    edges: tuple[float, ...] | None  # between the groups of numbers; None for words
    outcome: str = (
        ""  # why the column selects on the outcome, so that groups show and do not convict; "" if it does not
    )

    def __getitem__(self, rows: Any) -> Groups:
        return replace(self, index=self.index[rows])


def column_of(name: str, values: ArrayLike) -> Column:
    """Numbers as they are, NaN and infinity left out; anything else, truth values included, as words.

    Parameters
    ----------
    values : of any shape; None and "" stand for no value
    """
    cells = np.asarray(values)
    if cells.dtype.kind in "fiu":
        numbers = cells.astype(float)
        return Column(name, np.where(np.isfinite(numbers), numbers, np.nan))
    texts = ["" if _is_missing(cell) else str(cell) for cell in cells.ravel().tolist()]
    words = tuple(sorted({*texts} - {""}))
    place: dict[str, float] = {word: float(i) for i, word in enumerate(words)} | {"": float("nan")}
    return Column(name, np.array([place[text] for text in texts]).reshape(cells.shape), words)


def on_steps(values: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Values (runs, steps), or (runs,) of which each holds in all steps of its run, or (steps,) of a single run.

    Raises
    ------
    ValueError
        Values of another shape.
    """
    cells = np.asarray(values)
    if cells.ndim == 1 and len(cells) == shape[0]:
        cells = cells[:, None]
    if cells.shape not in (tuple(shape), (shape[0], 1), (shape[1],) if shape[0] == 1 else tuple(shape)):
        raise ValueError(f"has shape {cells.shape}, needs ({shape[0]}, {shape[1]}) or ({shape[0]},)")
    return np.broadcast_to(cells, shape)


def groups_of(column: Column, bins: int | Sequence[float] = BINS, counted: Array | None = None) -> Groups:
    """Cut a column into groups: numbers at quantiles of their values, or at edges; words as they are.

    A number that is an edge belongs to the group below it. Fewer groups than ``bins`` are made where many values are
    the same.

    Parameters
    ----------
    bins : number of quantile bins, or the edges between the groups, increasing; words need none
    counted : of the shape of the column, of bool: values whose quantiles count, and whose words make a group; None: all

    Raises
    ------
    ValueError
        The column has one value only, or none; more than 50 words; or bins that are none.
    """
    there = np.isfinite(column.values)
    if counted is not None:
        there = there & counted
    some = column.values[there]
    if column.words:
        return _by_words(column, some)
    edges = _edges(some, bins)
    if not edges or not len(some):
        raise ValueError(f"the column {_single(some)}; groups need different values")
    index = np.searchsorted(np.asarray(edges), column.values, side="left")
    index = np.where(np.isfinite(column.values), index, -1).astype(np.int64)
    names = tuple(range_name(column.name, *span) for span in spans_of(edges))
    return Groups(column.name, names, index, edges, column.outcome)


def spans_of(edges: Sequence[float]) -> list[tuple[float, float]]:
    """Lower and upper end of each group of numbers."""
    return list(itertools.pairwise((-np.inf, *edges, np.inf)))


def _by_words(column: Column, some: Array) -> Groups:
    """Words that are there, in order, each a group."""
    kept = np.unique(some).astype(np.int64)
    if len(kept) > MOST:
        raise ValueError(f"the column has {len(kept)} different words; at most {MOST} make groups")
    if len(kept) < 2:
        raise ValueError(f"the column {_single(some)}; groups need different values")
    index = np.full(column.values.shape, -1, np.int64)
    for i, place in enumerate(kept):
        index[column.values == place] = i
    return Groups(
        column.name, tuple(f"{column.name} is {column.words[place]}" for place in kept), index, None, column.outcome
    )


def _edges(values: Array, bins: int | Sequence[float]) -> tuple[float, ...]:
    """The edges that are given, or those of a number of quantile bins."""
    if isinstance(bins, (int, np.integer)):
        if not 2 <= bins <= MOST:
            raise ValueError(f"bins must be 2 to {MOST}, or edges between groups; got {bins}")
        return _quantiles(values, bins)
    edges = tuple(float(edge) for edge in bins)
    if not edges or not np.isfinite(edges).all() or (np.diff(edges) <= 0).any() or len(edges) >= MOST:
        raise ValueError(f"bins: edges between groups must be finite and increase, got {', '.join(map(str, bins))}")
    return edges


def _quantiles(values: Array, bins: int) -> tuple[float, ...]:
    """Values below which equal shares lie, with few digits; those that are the same once, and never the largest."""
    if not len(values):
        return ()
    ordered, different = np.sort(values), np.unique(values)
    if len(different) <= bins:
        return tuple(different[:-1].tolist())
    places = np.ceil(np.arange(1, bins) / bins * len(ordered)).astype(int) - 1
    edges = np.unique(ordered[places])
    edges = edges[edges < ordered[-1]]
    narrowest = np.diff([ordered[0], *edges, ordered[-1]])
    narrowest = narrowest[narrowest > 0].min(initial=np.inf)
    for digits in range(2, 17):
        rounded = np.array([float(f"{edge:.{digits}g}") for edge in edges])
        if (np.abs(rounded - edges) <= MOVED * narrowest).all():
            return tuple(rounded.tolist())
    return tuple(edges.tolist())


def range_name(column: str, low: float, high: float) -> str:
    """Values above ``low`` up to ``high``, either of which may be infinite: "40 < n_matches <= 120"."""
    if np.isneginf(low):
        return f"{column} <= {_number(high)}"
    if np.isposinf(high):
        return f"{column} > {_number(low)}"
    return f"{_number(low)} < {column} <= {_number(high)}"


def _number(edge: float) -> str:
    """An edge with all its digits: 40, 0.25, 1.7e+09."""
    return f"{edge:.0f}" if edge == round(edge) and abs(edge) < 1e15 else f"{edge!r}"


def _single(some: Array) -> str:
    """What is wrong with a column that makes no groups."""
    return "has one value only" if len(some) else "has no value where errors are judged"


def _is_missing(cell: object) -> bool:
    return cell is None or cell != cell or str(cell).strip() == ""


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
        below, above = parts  # a threshold leaves no gap between them, as unlike sets have
        if min(len(below), len(above)) < NEAR or above[0] < below[-1]:
            return False
        gaps = np.median(np.diff(below[-NEAR:])), np.median(np.diff(above[:NEAR]))
        return bool(above[0] - below[-1] <= TIMES * min(gaps))
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
