"""From the outcomes of runs, as they come, to results: in memory, or in a folder without holding them."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import astuple, dataclass
from itertools import pairwise, takewhile
from operator import itemgetter
from typing import Any

import numpy as np
import pandas as pd

from consistency.bench.runs.run_outcome import RunOutcome
from consistency.bench.store.folder_tables import with_tables
from consistency.bench.store.journal import Journal
from consistency.bench.store.parquet import OPTIONAL, Columns, Writer, write_table
from consistency.bench.store.results import JOINT, MAP_NUMBERS, NUMBERS, OWN_NUMBERS, Results, StoredResults, Tables
from consistency.bench.store.trial_tables import Rejected, noted_table, stacked_table
from consistency.referee.column_names import COLUMNS
from consistency.referee.errors import InputError
from consistency.referee.system.folders import NewFolder
from consistency.referee.system.provenance import this_machine
from consistency.referee.system.stopping import away_from_signals
from consistency.referee.types import Failure


class Gathered:
    """Outcomes of runs of some filters, kept in a journal, and their results, in memory or in a folder.

    Outcomes come in any order; what is in the journal already counts as theirs. ``errors`` has the convention of each
    filter's own error, where it is not the additive one; only then are there columns for it. ``previous`` are results
    to which they are added; of its runs those count that every filter has finished. Other ``machines`` than this one
    computed some of what is there.

    Raises
    ------
    InputError
        The previous results are damaged, or not in order of the runs: said before the work, which may take hours.
    """

    def __init__(
        self,
        filters: Sequence[str],
        errors: Mapping[str, str],
        journal: Journal,
        new: NewFolder | None = None,
        previous: Tables | None = None,
        machines: Sequence[dict[str, str]] = (),
    ) -> None:
        self.filters, self.errors = list(filters), dict(errors)
        self.journal, self.new, self.previous = journal, new, previous
        self.kept = frozenset[int]() if previous is None else frozenset(previous.finished_runs(filters))
        self.other_machines = list(machines)
        for name in ["", *self.filters]:
            for table in ("estimates", "map") if name else ("truth",):
                deque(self._before(table, name), maxlen=0)

    def require_more(self, runs: int) -> None:
        """Refuse a number of runs which the previous results exceed, unless there are more to hand over."""
        if self.kept and max(self.kept) >= runs and not self.journal.runs:
            raise InputError(f"runs must be at least {max(self.kept) + 1}: so many are there already, got {runs}")

    def add(self, outcome: RunOutcome) -> None:
        tables = {f"estimates {name}": columns for name, columns in outcome.estimates.items()}
        tables |= {f"map {name}": columns for name, columns in outcome.maps.items()}
        tables |= {} if outcome.truth is None else {"truth": outcome.truth}
        notes: dict[str, Any] = {"failures": [astuple(failure) for failure in outcome.failures]}
        notes |= {"rejections": outcome.rejections, "machine": outcome.machine}
        with nullcontext() if self.new is None else self.new.writing():
            self.journal.append(outcome.run, tables, {key: rows for key, rows in notes.items() if rows})

    @property
    def finished(self) -> set[int]:
        """Runs that are there, those of before too."""
        return self.journal.runs | self.kept

    @property
    def is_complete(self) -> bool:
        """Whether complete results are there and nothing else."""
        return self.previous is not None and bool(self.previous.manifest["complete"]) and not self.journal.runs

    def machines(self) -> list[dict[str, str]]:
        """The machines that computed the runs, of before and of now."""
        this, machines = this_machine(), list(self.other_machines)
        new_runs = sorted(self.journal.runs - self.kept)
        noted = [self.journal.notes.get(run, {}).get("machine", this) for run in new_runs]
        for machine in noted or [this]:
            if machine not in machines:
                machines.append(machine)
        return machines

    def pieces(self, table: str, filter_name: str = "") -> Iterator[Columns]:
        """Rows of ``estimates`` or ``map`` of a filter, or of ``truth``, run by run in order of the runs."""
        table_of_filter = f"{table} {filter_name}" if filter_name else table
        new_pieces = ((run, columns) for run, columns in self.journal.pieces(table_of_filter) if run not in self.kept)
        pieces_by_run = heapq.merge(self._before(table, filter_name), new_pieces, key=itemgetter(0))
        return (columns for _, columns in pieces_by_run if len(columns["run"]))

    def results(self, manifest: dict[str, Any], landmarks: pd.DataFrame | None) -> Results | StoredResults:
        """The results; a folder is written and put in its place, unless no run is finished."""
        failures, rejections = self.noted()
        manifest = manifest | {"failures": len(failures)}
        if self.new is not None and self.finished:
            return away_from_signals(self._stored, self.new, manifest, failures, landmarks, rejections)
        estimates = [(name, columns) for name in self.filters for columns in self.pieces("estimates", name)]
        maps = [(name, columns) for name in self.filters for columns in self.pieces("map", name)]
        truth = [("", columns) for columns in self.pieces("truth")]
        return Results(
            stacked_table("estimates", estimates, tuple(OPTIONAL["estimates"]) if self.errors else ()), failures,
            stacked_table("truth", truth) if truth else None, landmarks, manifest,
            stacked_table("map", maps, (JOINT,)) if maps else None, rejections,
        )  # fmt: skip

    def _stored(
        self, new: NewFolder, manifest: dict[str, Any], failures: pd.DataFrame, landmarks: pd.DataFrame | None,
        rejections: pd.DataFrame | None,
    ) -> StoredResults:  # fmt: skip
        with new.writing():
            new.path.mkdir(parents=True, exist_ok=True)
            self._write(new, "estimates", OWN_NUMBERS if self.errors else NUMBERS)
            self._write(new, "map", MAP_NUMBERS)
            self._write(new, "truth")
            for name, table in (("failures", failures), ("landmarks", landmarks), ("rejections", rejections)):
                if table is not None:
                    write_table(new.path / f"{name}.parquet", name, table)
        manifest = with_tables(new, manifest)
        new.put_in_place(manifest)
        return StoredResults(new.folder, failures, landmarks, manifest, rejections)

    def _write(self, new: NewFolder, table: str, columns: Sequence[str] = ()) -> None:
        """A table, one filter after the other; without a row none but ``estimates``."""
        names = [""] if table == "truth" else self.filters
        if table != "estimates" and all(next(self.pieces(table, name), None) is None for name in names):
            return
        with Writer(new.path / f"{table}.parquet", table, columns) as writer:
            for name in names:
                for piece in self.pieces(table, name):
                    writer.add(piece, filter=name)
                writer.end_group()

    def _before(self, table: str, filter_name: str) -> Iterator[tuple[int, Columns]]:
        """The kept runs of the previous results, one by one."""
        if self.previous is None:
            return
        columns = list(COLUMNS["truth"])
        if table == "map":
            columns = self.previous.map_numbers
        elif table == "estimates":
            columns = OWN_NUMBERS if filter_name in self.errors else NUMBERS
        last_run = -1
        for batch in self.previous.batches(table, columns, filter_name or None):
            for first_row, end_row in pairwise(np.flatnonzero(np.diff(batch["run"], prepend=-1, append=-1))):
                run = int(batch["run"][first_row])
                if run < last_run:
                    raise InputError(f"the {table} to resume must be in order of the runs, as they were written")
                last_run = run
                if run in self.kept:
                    yield run, {name: values[first_row:end_row] for name, values in batch.items()}

    def noted(self) -> tuple[pd.DataFrame, pd.DataFrame | None]:
        """Failures, and rejections where a filter has a guard, of before and of now, by filter and run."""
        filter_order, tables = {name: i for i, name in enumerate(self.filters)}, []
        for table_name, kind in (("failures", Failure), ("rejections", Rejected)):
            table_before: pd.DataFrame | None = None if self.previous is None else getattr(self.previous, table_name)
            rows = [] if table_before is None else [kind(*row) for row in table_before.itertuples(index=False)]
            rows = [row for row in rows if row.run in self.kept and row.filter in filter_order]
            for run, notes in self.journal.notes.items():
                rows += [kind(*row) for row in notes.get(table_name, ()) if run not in self.kept]
            tables.append(noted_table(table_name, sorted(rows, key=lambda row: (filter_order[row.filter], row.run))))
        failures, rejections = tables
        return failures, rejections if len(rejections) else None


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
        for name in self.filters if filter_name is None and table != "truth" else [filter_name or ""]:
            for piece in takewhile(lambda piece: piece["run"][0] < self.runs, self.gathered.pieces(table, name)):
                all_nan = np.full(len(piece["run"]), np.nan)
                yield {column: piece.get(column, all_nan) for column in columns}
