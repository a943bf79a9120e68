"""Groups of runs and steps by the values of a column: quantile bins of numbers, or the words themselves."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from consistency.referee.types import Array, Indices

BINS = 5
MOST = 50  # groups: more would each have too little
MOVED = 0.05  # of the narrowest bin: how far an edge may be moved to have fewer digits


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

    def in_pieces(self, steps: slice, pieces: int) -> Groups:
        """Some steps of one run, (1, steps), as runs of equal length, (pieces, length)."""
        return replace(self, index=self.index[0, steps].reshape(pieces, -1))


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
    edges = _checked_edges(bins)
    if edges is None:
        assert isinstance(bins, int)
        edges = _quantiles(some, bins)
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


def _checked_edges(bins: int | Sequence[float]) -> tuple[float, ...] | None:
    """The edges that are given; None where bins are a number of quantile bins."""
    if isinstance(bins, (int, np.integer)):
        if not 2 <= bins <= MOST:
            raise ValueError(f"bins must be 2 to {MOST}, or edges between groups; got {bins}")
        return None
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
