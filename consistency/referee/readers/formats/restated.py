"""Text files of estimates, written again with other covariances and no other change."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from consistency.referee.readers.formats.file_head import fields_of, head_of
from consistency.referee.readers.formats.file_kinds import (
    ARCHIVES,
    is_bag,
    is_plane,
    is_solution,
    is_spatial,
    table_files,
    trajectory_files,
)
from consistency.referee.readers.formats.named_columns import DEVIATIONS, roles_of
from consistency.referee.readers.formats.other_names import covariance_places
from consistency.referee.readers.formats.pose_covariances import ORDERS, components_in, covariance_order
from consistency.referee.readers.formats.pose_rows import DEVIATED, FULL, TRIANGLE
from consistency.referee.readers.formats.pose_rows import DEVIATIONS as SIZES
from consistency.referee.readers.formats.pose_rows import POSE as POSE_COLUMNS
from consistency.referee.readers.formats.table_columns import LOWER_NAMES, OWN_NAMES, POSE
from consistency.referee.readers.formats.text_blocks import opened
from consistency.referee.readers.formats.tum import files_of_runs
from consistency.referee.readers.options import Reading
from consistency.referee.readers.truth_matching import STATE

Change = Callable[[int, str], Mapping[str, tuple[float, float]] | None]  # run, value of --by: factors of components
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

    def restated(self, change: Change) -> str:
        """The text with each covariance P as D P D + F, by the factors and floors of its run; without runs of None."""
        with opened(self.path) as file:
            lines = file.read().decode("utf-8-sig").splitlines(keepends=True)
        head = head_of(self.path)
        first = 0 if head is None else head.line
        return "".join([*lines[:first], *(self._line(line, change) for line in lines[first:])])

    def _line(self, line: str, change: Change) -> str:
        """A line with its covariance restated, and no other change; "" where its run or estimator is left out."""
        text = line.rstrip("\r\n")
        separator = max(",;\t", key=text.count)
        between = re.escape(separator)
        if separator not in text:
            text = text.strip()
            between = r"\s+"
        if not text.strip() or text.lstrip().startswith("#"):
            return line
        if '"' in text:  # a separator between quotes is none
            between += QUOTED
        parts = re.split(f"({between})", text)
        restated = self._restated(parts[::2], change)
        if not restated:
            return ""
        parts[::2] = restated
        return line.replace(text, "".join(parts), 1)

    def _restated(self, fields: list[str], change: Change) -> list[str]:
        """Fields of a line with its covariance restated; none where its run or estimator is left out."""
        bare = [field.strip(' "') for field in fields]
        if self.filter_column is not None and bare[self.filter_column] != self.filter:
            return []
        run = self.run if self.run_column is None else int(float(bare[self.run_column]))
        of = change(run, "" if self.by_column is None else bare[self.by_column])
        if of is None:
            return []
        out = list(fields)
        for column, (a, b) in self.entries.items():
            if not bare[column]:
                continue
            value = float(bare[column])
            (factor, floor), (other, _) = of.get(a, (1.0, 0.0)), of.get(b, (1.0, 0.0))
            if not self.squared:
                value = float(np.sqrt(factor * value**2 + floor))
            else:
                value *= float(np.sqrt(factor * other))
                if a == b:
                    value += floor
            out[column] = repr(value)
        return out


def text_files(estimates: Path, r: Reading, name: str = "") -> list[TextFile]:
    """The files that hold the covariances of estimates, in the order of runs; none where they are of another kind.

    Parameters
    ----------
    name : of the estimator, where a file holds several
    """
    if is_bag(estimates) or estimates.suffix.lower() in ARCHIVES or is_solution(estimates):
        return []
    if r.columns or r.world or r.body_axes:  # names and axes of the file are not those of the record
        return []
    by = r.by if r.by_file is None else None
    axes = tuple(r.state or POSE)
    if estimates.is_dir() and table_files(estimates) and (r.state or not trajectory_files(estimates)):
        found = [_table(path, axes, name, by, run) for run, path in enumerate(table_files(estimates))]
    elif estimates.is_file() and estimates.suffix.lower() == ".csv" and (r.state or not is_spatial(estimates)):
        found = [_table(estimates, axes, name, by)]
    elif is_plane(estimates):
        return []
    elif r.covariance is not None:
        runs = files_of_runs(estimates, r, r.covariance)
        found = [_covariances(path, run, r) for run, (_, _, path) in enumerate(runs) if path is not None]
    else:
        found = [_trajectory(own, run, r) for run, (own, _, _) in enumerate(files_of_runs(estimates, r, None))]
    known = [each for each in found if each is not None]
    return known if len(known) == len(found) else []


def _table(path: Path, axes: tuple[str, ...], name: str, by: str | None, run: int | None = None) -> TextFile | None:
    """A table, whose first line names its columns; of one ``run`` where that is given."""
    head = head_of(path)
    if head is None:
        return None
    names = head.names
    if any(name.startswith("own_P") for name in names):
        return None
    runs, of, value = (names.index(key) if key in names else None for key in ("run", "filter", by))
    if run is not None:
        runs = None
    bare = TextFile(path, {}, True, run=run or 0, run_column=runs, filter_column=of, filter=name, by_column=value)
    places = {name: i for i, name in enumerate(names)} | covariance_places(names, axes)
    entries: dict[int, tuple[str, str]] = {}
    for a, b in itertools.product(axes, repeat=2):
        spelled = [f"P_{a}_{b}"]
        if axes == POSE:
            spelled += [OWN_NAMES.get((a, b), ""), LOWER_NAMES.get((a, b), "")]
        entries |= {places[name]: (a, b) for name in spelled if name in places}
    if entries:
        return replace(bare, entries=entries)
    for spelling in (*DEVIATIONS, "sigma_{}"):
        if all(spelling.format(a) in places for a in axes):
            entries = {places[spelling.format(a)]: (a, a) for a in axes}
            return replace(bare, entries=entries, squared=False)
    return None


def _trajectory(path: Path, run: int, r: Reading) -> TextFile | None:
    """A trajectory with covariances in its lines."""
    head = head_of(path)
    roles = None if head is None else roles_of(head.names, path)
    if head is not None and roles is not None and not (head.comment and roles.is_tum):
        deviations = len(roles.covariance) in SIZES and not roles.squared
        return _of_numbers(path, roles.covariance, run, r, not deviations)
    width = _width(path)
    if width not in (DEVIATED, POSE_COLUMNS + FULL, POSE_COLUMNS + TRIANGLE):
        return None
    return _of_numbers(path, range(POSE_COLUMNS, width), run, r, width != DEVIATED)


def _covariances(path: Path, run: int, r: Reading) -> TextFile | None:
    """A file of lines of t and a covariance."""
    width = _width(path)
    return _of_numbers(path, range(1, width), run, r, True) if width in (1 + FULL, 1 + TRIANGLE) else None


def _width(path: Path) -> int:
    """Numbers in the first row of a file."""
    with opened(path) as file:
        for raw in file:
            line = raw.decode("utf-8-sig").strip()
            if line and not line.startswith("#"):
                return len(fields_of(line))
    return 0


def _of_numbers(path: Path, columns: Sequence[int], run: int, r: Reading, squared: bool) -> TextFile | None:
    """A file with n^2 numbers of a covariance in a row, its upper triangle, or n of a diagonal, n = 6, 9 or 15."""
    many = len(columns)
    n = components_in(many)
    if n is None:
        return None
    order = covariance_order(n, r.covariance_order or ORDERS[0])
    names = [STATE[order.index(place)] for place in range(n)]
    pairs = [(a, a) for a in names]
    if many == n * n:
        pairs = [(a, b) for a in names for b in names]
    elif many > n:
        pairs = list(itertools.combinations_with_replacement(names, 2))
    return TextFile(path, dict(zip(columns, pairs, strict=True)), squared, run)
