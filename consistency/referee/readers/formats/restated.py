"""Text files of estimates, written again with other covariances or bounds and no other change."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from consistency.referee.column_names import POSE
from consistency.referee.readers.formats.bounds import bound_columns
from consistency.referee.readers.formats.columns import covariance_columns, entry_name, pose_columns
from consistency.referee.readers.formats.file_kinds import (
    ARCHIVES,
    fields_of,
    files_of_runs,
    head_of,
    is_bag,
    is_plane,
    is_solution,
    is_spatial,
    separator_of,
    table_files,
    trajectory_files,
)
from consistency.referee.readers.formats.pose_rows import (
    DEVIATIONS,
    FULL,
    ORDERS,
    TRIANGLE,
    components_in,
    covariance_order,
)
from consistency.referee.readers.formats.pose_rows import POSE_NUMBERS as POSE_NUMBERS
from consistency.referee.readers.formats.text_blocks import opened
from consistency.referee.readers.options import Reading
from consistency.referee.readers.truth_matching import STATE

Factors = Mapping[str, tuple[float, float]]  # factor and floor of a component by name
Change = Callable[[int, str], Factors | None]  # by run and value of --by; None leaves a line out
QUOTED = r'(?=(?:[^"]*"[^"]*")*[^"]*$)'  # a place with an even number of quotes after it


@dataclass(frozen=True)
class TextFile:
    """A text file whose lines hold covariances, and where they stand."""

    path: Path
    entries: Mapping[int, tuple[str, str]]  # column to the components of its number
    squared: bool  # False where they are standard deviations
    run: int = 0  # that all of its lines are of
    run_column: int | None = None  # with the run of each line
    filter_column: int | None = None  # with the estimator of each line
    filter: str = ""  # whose lines are written
    by_column: int | None = None  # with the value of --by of each line
    added: Mapping[str, tuple[str, str]] = field(default_factory=dict)  # by name, to files that state none: as entries
    # ends of intervals by their column: the bound, and the columns whose mean the interval grows about
    ends: Mapping[int, tuple[str, tuple[int, ...]]] = field(default_factory=dict)

    def restated(self, change: Change) -> str:
        """The text with each covariance P as D P D + F, by the factors and floors of its run; without runs of None."""
        with opened(self.path) as file:
            lines = file.read().decode("utf-8-sig").splitlines(keepends=True)
        head = head_of(self.path)
        first = 0 if head is None else head.line
        text = lines[:first]
        if head is not None and not head.comment and self.added:
            text[-1] = _with(text[-1], self.added)
        for line in lines[first:]:
            text.append(self._line(line, change))
        return "".join(text)

    def _line(self, line: str, change: Change) -> str:
        """A line with its covariance restated, and no other change; "" where its run or estimator is left out."""
        text = line.rstrip("\r\n")
        separator = separator_of(text)
        between = re.escape(separator)
        if separator not in text:
            text = text.strip()
            between = r"\s+"
        if not text.strip() or text.lstrip().startswith("#"):
            return line
        if '"' in text:  # a separator between quotes is none
            between += QUOTED
        parts = re.split(f"({between})", text)
        restated = self._fields(parts[::2], change)
        if not restated:
            return ""
        many = len(parts[::2])
        parts[::2] = restated[:many]
        return _with(line.replace(text, "".join(parts), 1), restated[many:])

    def _fields(self, fields: list[str], change: Change) -> list[str]:
        """Fields of a line with its covariance restated; none where its run or estimator is left out."""
        bare = [field.strip(' "') for field in fields]
        if self.filter_column is not None and bare[self.filter_column] != self.filter:
            return []
        run = self.run
        value = ""
        if self.run_column is not None:
            run = int(float(bare[self.run_column]))
        if self.by_column is not None:
            value = bare[self.by_column]
        factors = change(run, value)
        if factors is None:
            return []
        restated = list(fields)
        for column, (a, b) in self.entries.items():
            if bare[column]:
                restated[column] = repr(self._number(float(bare[column]), a, b, factors))
        for column, (bound, about) in self.ends.items():
            if all(bare[each] for each in (column, *about)):
                middle = sum(float(bare[each]) for each in about) / len(about)
                size = self._number(abs(float(bare[column]) - middle), bound, bound, factors)
                restated[column] = repr(middle + float(np.copysign(size, float(bare[column]) - middle)))
        return restated + [repr(self._number(0.0, a, b, factors)) for a, b in self.added.values()]

    def _number(self, value: float, a: str, b: str, factors: Factors) -> float:
        """A number of the covariance of two components, restated."""
        factor, floor = factors.get(a, (1.0, 0.0))
        other, _ = factors.get(b, (1.0, 0.0))
        if not self.squared:
            return float(np.sqrt(factor * value * value + floor))
        product = value * float(np.sqrt(factor * other))
        return product + floor if a == b else product


def _with(line: str, fields: Iterable[str]) -> str:
    """A line with fields behind its own, which are separated as these are."""
    text = line.rstrip("\r\n")
    separator = separator_of(text)
    return (separator if separator in text else " ").join([text, *fields]) + line[len(text) :]


def text_files(estimates: Path, r: Reading, name: str = "") -> list[TextFile]:
    """The files that hold the covariances of estimates, in the order of runs; none where they are of another kind.

    Parameters
    ----------
    name : of the estimator, where a file holds several
    """
    if is_bag(estimates) or estimates.suffix.lower() in ARCHIVES or is_solution(estimates):
        return []
    declared = r.conventions
    if (r.components.columns and not r.statement.is_of_bounds) or declared.world or declared.body_axes:
        return []  # names and axes of the file are not the record's
    state = r.components.state
    found: list[TextFile | None] = []
    if estimates.is_dir() and table_files(estimates) and (state or not trajectory_files(estimates)):
        for run, path in enumerate(table_files(estimates)):
            found.append(_table(path, r, name, run))
    elif estimates.is_file() and estimates.suffix.lower() == ".csv" and (state or not is_spatial(estimates)):
        found.append(_table(estimates, r, name))
    elif is_plane(estimates):
        return []
    else:
        for run, (own, _, covariance) in enumerate(files_of_runs(estimates, r, r.sources.covariance)):
            found.append(_trajectory(own, run, r) if covariance is None else _numbers(covariance, 1, run, r))
    known = [each for each in found if each is not None]
    return known if len(known) == len(found) else []


def _table(path: Path, r: Reading, name: str, run: int | None = None) -> TextFile | None:
    """A table, whose first line names its columns; of one ``run`` where that is given."""
    of_bounds = r.statement.is_of_bounds
    head = head_of(path, r.components.columns if of_bounds else None)
    if head is None or any(column.startswith("own_P") for column in head.names):
        return None
    places = dict(zip(head.names, head.places, strict=True))
    run_column = by_column = None
    if run is None:
        run_column = places.get("run")
    if r.groups.own_column is not None:
        by_column = places.get(r.groups.own_column)
    if of_bounds:
        stated, ends = _bounds(places)
        return TextFile(path, stated, False, run or 0, run_column, places.get("filter"), name, by_column, ends=ends)
    axes = r.components.state or POSE
    covariance = covariance_columns(head.names, axes)
    added = {}
    for i, j in itertools.combinations_with_replacement(range(len(axes)), 2):
        added[entry_name(axes, i, j)] = (axes[i], axes[j])
    if covariance.places:
        added = {}
    elif not r.statement.unstated or head.comment or not set(axes) <= set(head.names):
        return None
    components = {place: (axes[i], axes[j]) for (i, j), place in covariance.places.items()}
    squared = covariance.squared or bool(added)
    return TextFile(path, components, squared, run or 0, run_column, places.get("filter"), name, by_column, added)


def _bounds(places: Mapping[str, int]) -> tuple[dict[int, tuple[str, str]], dict[int, tuple[str, tuple[int, ...]]]]:
    """Columns of bounds as entries of deviations, each a component by itself, and the ends of intervals."""
    stated: dict[int, tuple[str, str]] = {}
    ends: dict[int, tuple[str, tuple[int, ...]]] = {}
    for one in bound_columns(list(places)):
        columns = [places[name] for name in one.columns]
        if len(columns) == 1:
            stated[columns[0]] = (one.name, one.name)
            continue
        (component,) = one.components
        about = (places[component],) if component in places else tuple(columns)
        ends |= dict.fromkeys(columns, (one.name, about))
    return stated, ends


def _trajectory(path: Path, run: int, r: Reading) -> TextFile | None:
    """A trajectory with covariances in its lines."""
    head = head_of(path)
    found = None if head is None else pose_columns(head.names, path)
    if head is None or found is None or (head.comment and found.is_tum):
        return _numbers(path, POSE_NUMBERS, run, r)
    squared = found.squared or len(found.covariance) not in DEVIATIONS
    return _of_columns(path, found.covariance, run, r, squared)


def _numbers(path: Path, first: int, run: int, r: Reading) -> TextFile | None:
    """A file of numbers without names, whose covariances begin in column ``first``."""
    width = 0
    with opened(path) as file:
        for raw in file:
            line = raw.decode("utf-8-sig").strip()
            if line and not line.startswith("#"):
                width = len(fields_of(line))
                break
    many = width - first
    if many == 0 and r.statement.unstated:
        return TextFile(path, {}, True, run, added={f"P {a} {b}": (a, b) for a in STATE[:6] for b in STATE[:6]})
    if many not in (6, TRIANGLE, FULL):
        return None
    return _of_columns(path, range(first, width), run, r, many != 6)


def _of_columns(path: Path, columns: Sequence[int], run: int, r: Reading, squared: bool) -> TextFile | None:
    """A file with n^2 numbers of a covariance in a row, its upper triangle, or n of a diagonal, n = 6, 9 or 15."""
    many = len(columns)
    n = components_in(many)
    if n is None:
        return None
    order = covariance_order(n, r.conventions.covariance_order or ORDERS[0])
    names = [STATE[order.index(place)] for place in range(n)]
    pairs = list(itertools.combinations_with_replacement(names, 2))
    if many == n * n:
        pairs = list(itertools.product(names, names))
    elif many == n:
        pairs = list(zip(names, names, strict=True))
    return TextFile(path, dict(zip(columns, pairs, strict=True)), squared, run)
