"""From the outcomes of runs, as they come, to results: in memory, or in a folder without holding them."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import astuple, dataclass
from itertools import pairwise, takewhile
from operator import itemgetter
from typing import Any, Protocol

import numpy as np
import pandas as pd

from consistency.bench.store.data_frames import (
    estimates_table,
    failures_table,
    map_table,
    rejections_table,
    truth_table,
)
from consistency.bench.store.folder_tables import with_tables
from consistency.bench.store.journal import Journal
from consistency.bench.store.parquet import Columns, Writer, write_table
from consistency.bench.store.results import MAP_NUMBERS, NUMBERS, OWN_NUMBERS, Results, StoredResults, Tables
from consistency.bench.store.trial_rows import Rejected, RunOutcome
from consistency.referee.column_names import COLUMNS
from consistency.referee.errors import InputError
from consistency.referee.system.folders import NewFolder
from consistency.referee.system.provenance import this_machine
from consistency.referee.system.stopping import undisturbed
from consistency.referee.types import Failure


class Keeps(Protocol):
    """Runs, each with the columns of its parts by name, and with notes."""

    notes: dict[int, dict[str, Any]]

    @property
    def runs(self) -> set[int]: ...
    def append(self, run: int, parts: Mapping[str, Columns], notes: Mapping[str, Any], /) -> None: ...
    def pieces(self, name: str, /) -> Iterator[tuple[int, Columns]]: ...


class InMemory:
    """What a :class:`Journal` keeps, in memory."""

    def __init__(self) -> None:
        self.notes: dict[int, dict[str, Any]] = {}
        self._parts: dict[int, Mapping[str, Columns]] = {}

    @property
    def runs(self) -> set[int]:
        return set(self._parts)

    def append(self, run: int, parts: Mapping[str, Columns], notes: Mapping[str, Any], /) -> None:
        if notes:
            self.notes[run] = dict(notes)
        self._parts[run] = parts

    def pieces(self, name: str, /) -> Iterator[tuple[int, Columns]]:
        return ((run, self._parts[run][name]) for run in sorted(self._parts) if name in self._parts[run])


class Gathered:
    """Outcomes of runs of some filters, kept in memory, or where a folder and a journal are given on disk.

    Outcomes come in any order; what is in the journal already counts as theirs. ``errors`` has the convention of each
    filter's own error, where it is not the additive one; only then are there columns for it. ``previous`` are results
    to which they are added, of which the runs ``kept`` count.

    Raises
    ------
    InputError
        The previous results are damaged, or not in order of the runs: said before the work, which may take hours.
    """

    def __init__(
        self,
        filters: Sequence[str],
        errors: Mapping[str, str],
        new: NewFolder | None = None,
        journal: Journal | None = None,
        previous: Tables | None = None,
        kept: Iterable[int] = (),
    ) -> None:
        self.filters, self.new, self.previous, self.kept = list(filters), new, previous, frozenset(kept)
        self.errors = dict(errors)
        self._require_readable()
        self._now: Keeps = InMemory() if journal is None else journal

    def add(self, outcome: RunOutcome) -> None:
        """Keep what a run left."""
        parts = {f"estimates {name}": columns for name, columns in outcome.estimates.items()}
        parts |= {f"map {name}": columns for name, columns in outcome.maps.items()}
        parts |= {} if outcome.truth is None else {"truth": outcome.truth}
        notes: dict[str, Any] = {"failures": [astuple(failure) for failure in outcome.failures]}
        notes |= {"rejections": outcome.rejections, "machine": outcome.machine}
        with nullcontext() if self.new is None else self.new.writing():
            self._now.append(outcome.run, parts, {key: rows for key, rows in notes.items() if rows})

    @property
    def finished(self) -> set[int]:
        """Runs that are there, those of before too."""
        return self._now.runs | self.kept

    def machines(self, before: Sequence[dict[str, str]]) -> list[dict[str, str]]:
        """Those that computed the runs: the ones ``before``, and the ones of now."""
        now = self._now.runs - self.kept
        noted = [self._now.notes.get(run, {}).get("machine", this_machine()) for run in sorted(now)]
        machines = [*before, *(noted or [this_machine()])]
        return [machine for i, machine in enumerate(machines) if machine not in machines[:i]]

    def so_far(self, runs: int, manifest: dict[str, Any], landmarks: pd.DataFrame | None) -> SoFar:
        """Runs 0 to ``runs`` - 1 of what is there, to be read while more come."""
        failures, rejections = self._all_failures(), self._all_rejections()
        return SoFar(
            self, runs, manifest, failures[failures["run"] < runs], landmarks,
            None if rejections is None else rejections[rejections["run"] < runs],
        )  # fmt: skip

    def pieces(self, table: str, filter_name: str) -> Iterator[Columns]:
        """Rows of ``estimates`` or ``map`` of a filter, or of ``truth``, run by run in order of the runs."""
        return self._true() if table == "truth" else (self._of if table == "estimates" else self._map_of)(filter_name)

    def results(self, manifest: dict[str, Any], landmarks: pd.DataFrame | None) -> Results | StoredResults:
        """The results; a folder is written and put in its place, unless no run is finished."""
        failures = self._all_failures()
        manifest = manifest | {"failures": len(failures)}
        if self.new is not None and self.finished:
            with undisturbed():
                return self._stored(self.new, manifest, failures, landmarks)
        estimates = [(name, columns) for name in self.filters for columns in self._of(name)]
        maps = [(name, columns) for name in self.filters for columns in self._map_of(name)]
        truth = truth_table(list(self._true()))
        return Results(
            estimates_table(estimates, bool(self.errors)), failures, truth if len(truth) else None, landmarks, manifest,
            map_table(maps), self._all_rejections(),
        )  # fmt: skip

    def _stored(
        self, new: NewFolder, manifest: dict[str, Any], failures: pd.DataFrame, landmarks: pd.DataFrame | None
    ) -> StoredResults:
        with new.writing():
            new.path.mkdir(parents=True, exist_ok=True)
            self._write(new, "estimates", self._of, OWN_NUMBERS if self.errors else NUMBERS)
            if any(next(self._map_of(name), None) is not None for name in self.filters):
                self._write(new, "map", self._map_of, MAP_NUMBERS)
            true = self._true()
            if (first := next(true, None)) is not None:
                with Writer(new.path / "truth.parquet", "truth") as writer:
                    writer.add(first)
                    for columns in true:
                        writer.add(columns)
                    writer.end_group()
            write_table(new.path / "failures.parquet", "failures", failures)
            if landmarks is not None:
                write_table(new.path / "landmarks.parquet", "landmarks", landmarks)
            if (rejections := self._all_rejections()) is not None:
                write_table(new.path / "rejections.parquet", "rejections", rejections)
        manifest = with_tables(new, manifest)
        new.put_in_place(manifest)
        return StoredResults(new.folder, failures, landmarks, manifest, rejections)

    def _write(
        self, new: NewFolder, table: str, of: Callable[[str], Iterator[Columns]], columns: Sequence[str] = ()
    ) -> None:
        """A table of each filter's rows, one filter after the other."""
        with Writer(new.path / f"{table}.parquet", table, columns) as writer:
            for name in self.filters:
                for rows in of(name):
                    writer.add(rows, filter=name)
                writer.end_group()

    def _of(self, filter_name: str) -> Iterator[Columns]:
        return self._merged(self._estimates_before(filter_name), f"estimates {filter_name}")

    def _map_of(self, filter_name: str) -> Iterator[Columns]:
        return self._merged(self._maps_before(filter_name), f"map {filter_name}")

    def _true(self) -> Iterator[Columns]:
        return self._merged(self._true_before(), "truth")

    def _merged(self, before: Iterator[tuple[int, Columns]], part: str) -> Iterator[Columns]:
        """Pieces of before and of now in order of their runs, without those that have no row."""
        now = ((run, columns) for run, columns in self._now.pieces(part) if run not in self.kept)
        merged = heapq.merge(before, now, key=itemgetter(0))
        return (columns for _, columns in merged if len(columns["run"]))

    def _noted(self, key: str) -> Iterator[Any]:
        """Rows of a table that the runs of now left as notes."""
        return (row for run, notes in self._now.notes.items() if run not in self.kept for row in notes.get(key, ()))

    def _require_readable(self) -> None:
        for name in self.filters:
            deque(self._estimates_before(name), maxlen=0)
            deque(self._maps_before(name), maxlen=0)
        deque(self._true_before(), maxlen=0)

    def _estimates_before(self, filter_name: str) -> Iterator[tuple[int, Columns]]:
        return self._before("estimates", OWN_NUMBERS if filter_name in self.errors else NUMBERS, filter_name)

    def _maps_before(self, filter_name: str) -> Iterator[tuple[int, Columns]]:
        columns = [] if self.previous is None else self.previous.map_numbers
        return self._before("map", columns, filter_name)

    def _true_before(self) -> Iterator[tuple[int, Columns]]:
        return self._before("truth", list(COLUMNS["truth"]))

    def _before(self, table: str, columns: list[str], filter_name: str | None = None) -> Iterator[tuple[int, Columns]]:
        """The kept runs of the previous results, one by one."""
        last = -1
        for batch in [] if self.previous is None else self.previous.batches(table, columns, filter_name):
            for start, end in pairwise(np.flatnonzero(np.diff(batch["run"], prepend=-1, append=-1))):
                run = int(batch["run"][start])
                if run < last:
                    raise InputError(f"the {table} to resume must be in order of the runs, as they were written")
                last = run
                if run in self.kept:
                    yield run, {name: values[start:end] for name, values in batch.items()}

    def _all_failures(self) -> pd.DataFrame:
        """By filter, run and step."""
        rank = {name: i for i, name in enumerate(self.filters)}
        before = [] if self.previous is None else self.previous.failures.itertuples(index=False)
        failures = [f for f in (Failure(*row) for row in before) if f.run in self.kept and f.filter in rank]
        failures += [Failure(*row) for row in self._noted("failures")]
        return failures_table(sorted(failures, key=lambda f: (rank[f.filter], f.run, f.step)))

    def _all_rejections(self) -> pd.DataFrame | None:
        """By filter and run; None where no filter has a guard."""
        rank = {name: i for i, name in enumerate(self.filters)}
        before = None if self.previous is None else self.previous.rejections
        rows = [] if before is None else [Rejected(*row) for row in before.itertuples(index=False)]
        rows = [row for row in rows if row.run in self.kept and row.filter in rank]
        rows += [Rejected(*row) for row in self._noted("rejections")]
        return rejections_table(sorted(rows, key=lambda row: (rank[row.filter], row.run)))


@dataclass(frozen=True)
class SoFar(Tables):
    """The first runs of what is gathered; the tables are read each time they are asked for, a run at a time."""

    gathered: Gathered
    runs: int
    manifest: dict[str, Any]
    failures: pd.DataFrame
    landmarks: pd.DataFrame | None
    rejections: pd.DataFrame | None = None

    @property
    def has_truth(self) -> bool:
        return next(self.batches("truth", ["run"]), None) is not None

    @property
    def has_joint(self) -> bool:
        return True  # NaN in runs of older results, which lack it

    def batches(self, table: str, columns: Sequence[str], filter_name: str | None = None) -> Iterator[Columns]:
        """See :meth:`Tables.batches`."""
        names = self.filters if filter_name is None and table != "truth" else [filter_name or ""]
        for name in names:
            for piece in takewhile(lambda piece: piece["run"][0] < self.runs, self.gathered.pieces(table, name)):
                nothing = np.full(len(piece["run"]), np.nan)
                yield {column: piece.get(column, nothing) for column in columns}
