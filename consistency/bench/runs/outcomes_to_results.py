"""From the outcomes of runs, as they come, to results.

Runs come in rounds of more and more, and a study is resumed where a folder has some already.
"""

from __future__ import annotations

import heapq
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import astuple, dataclass
from itertools import pairwise, takewhile
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from consistency.bench.protocols import name_of, optimal_gain
from consistency.bench.runs.run_outcome import RunOutcome, TrialWork, Workers
from consistency.bench.store.journal import IN_MEMORY, Journal, Unfinished
from consistency.bench.store.parquet import (
    OPTIONAL,
    Columns,
    Rejected,
    Writer,
    noted_table,
    stacked_table,
    with_tables,
    write_table,
)
from consistency.bench.store.results import (
    JOINT,
    MAP_NUMBERS,
    NUMBERS,
    OWN_NUMBERS,
    Results,
    StoredResults,
    Tables,
    open_results,
)
from consistency.referee.column_names import COLUMNS
from consistency.referee.errors import InputError
from consistency.referee.system import NewFolder, away_from_signals, in_words, manifest_of, progress, say, this_machine
from consistency.referee.types import Failure

PLAN = "until_decided"
KEYS = {
    "scenario_hash": "scenario", "log_sha256": "log", "filters": "filter", "error": "error of a filter", "seed": "seed",
    "screening": "--screen", PLAN: "plan of looks",
}  # fmt: skip


class Interrupted(KeyboardInterrupt):
    """Ctrl-C in :func:`run_trials` without a folder; ``results`` holds the runs that were finished."""

    def __init__(self, results: Results | StoredResults) -> None:
        super().__init__("interrupted")
        self.results = results


class StudyRounds:
    """Runs that are done and gathered.

    Parameters
    ----------
    workers, work : who does the runs, and what is done for each
    gathered : where outcomes go, and what is there
    fields : of the manifest
    landmarks : table of those of the world, where they are known
    """

    def __init__(
        self,
        workers: Workers,
        work: TrialWork,
        gathered: Gathered,
        fields: Mapping[str, Any],
        landmarks: pd.DataFrame | None,
    ) -> None:
        self.workers, self.work, self.gathered, self.landmarks = workers, work, gathered, landmarks
        gains = [name_of(f) for f in work.filters if optimal_gain(f)]
        machines, filters = gathered.other_machines, gathered.filters
        self._fields = dict(fields) | {"machines": machines, "filters": filters, "optimal_gain": gains}
        if gathered.errors:
            self._fields["error"] = gathered.errors

    def so_far(self, runs: int) -> SoFar:
        """Runs 0 to ``runs`` - 1 of what is there, to be read while more come."""
        failures, rejections = self.gathered.noted()
        return SoFar(
            self.gathered, runs, self._fields, failures[failures["run"] < runs], self.landmarks,
            None if rejections is None else rejections[rejections["run"] < runs],
        )  # fmt: skip

    def finish(self, rounds: Iterable[Sequence[int]]) -> Results | StoredResults:
        """Do the runs of each round that are not there, one round after the other, and hand over the results.

        Each round has the runs of those before, too. What is there can be read before the next one is asked for.
        A journal may hold more runs than the rounds ask for; they are handed over with the others.

        Raises
        ------
        Interrupted
            Ctrl-C, where no journal keeps what there is.
        """
        runs: Sequence[int] = ()
        started, is_ready = time.monotonic(), False
        try:
            for runs in rounds:
                todo = sorted(set(runs) - self.gathered.finished)
                if todo and not is_ready:
                    self.workers.prepare(self.work, todo[0])
                    started, is_ready = time.monotonic(), True
                if todo:
                    with (
                        closing(self.workers.outcomes(self.work, todo)) as outcomes,
                        progress("runs", len(todo)) as advance,
                    ):
                        for outcome in outcomes:
                            self.gathered.add(outcome)
                            advance(1)
        except KeyboardInterrupt:
            if self.gathered.journal.is_on_disk:
                raise
            raise Interrupted(self._results(runs, started)) from None
        return self._results(runs, started)

    def _results(self, runs: Sequence[int], started: float) -> Results | StoredResults:
        """The results of what is there, of which ``runs`` were asked for."""
        finished = self.gathered.finished
        runs_beyond = finished.difference(runs)
        total = max(runs_beyond) + 1 if runs_beyond else len(runs)
        fields = self._fields | {"machines": self.gathered.machines()}
        is_complete = len(finished) == total
        if not is_complete:
            fields["finished_runs"] = len(finished)
        wall = time.monotonic() - started
        manifest = manifest_of(wall=wall, complete=is_complete, runs=total, **fields)
        return self.gathered.results(manifest, self.landmarks)


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
                    writer.add(piece, name)
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


@contextmanager
def gathered_in(
    study: Mapping[str, Any],
    out: Path | None,
    previous: Tables | None,
    resume: bool,
    overwrite: bool,
    journal: Journal | None = None,
) -> Iterator[Gathered]:
    """Yield what there is of a ``study``, which is known by :data:`KEYS`, to be continued.

    Results go to ``out``, or stay in memory. A ``journal`` in its place keeps the finished runs of results in memory.
    With ``resume``, or where ``previous`` are the results in ``out``, what is in ``out`` and in its journal is
    continued, and whatever else is in the folder stays.

    Raises
    ------
    InputError
        What is there is of another study; ``out`` cannot be written, or is taken; unfinished work is in the way.
    """
    if journal is not None:
        yield Gathered(study["filters"], study["error"], journal)
        return
    if out is None:
        with closing(Journal(IN_MEMORY)) as in_memory:
            yield _gathered(study, in_memory, None, previous)
        return
    resume = resume or (isinstance(previous, StoredResults) and previous.folder.resolve() == out.resolve())
    with Unfinished(out, resume, overwrite) as unfinished:
        before = unfinished.journal.study
        replaces = bool(before.get("overwrite", overwrite and not resume))
        if resume and not out.exists() and unfinished.is_new:
            raise InputError(f"--out {out}: there is nothing to resume; leave --resume out")
        if resume and previous is None and not replaces and out.exists():
            previous = open_results(out)
        goes_on = resume and not replaces and out.exists()
        with NewFolder(out, "results", replaces or goes_on, goes_on, within=unfinished.path) as new:
            gathered = _gathered(study, unfinished.journal, new, previous)
            machines = [*gathered.other_machines, this_machine()]
            unfinished.journal.begin(dict(study) | {"overwrite": replaces, "machines": machines})
            try:
                yield gathered
            except InputError as error:
                finished = len(gathered.finished)
                if new.is_placed or not finished or not isinstance(error.__cause__, OSError):
                    raise
                raise InputError(
                    f"{error}; {finished} finished runs are kept, and the same command with --resume continues"
                ) from error.__cause__
            finally:
                unfinished.is_over = new.is_placed


def _gathered(study: Mapping[str, Any], journal: Journal, new: NewFolder | None, previous: Tables | None) -> Gathered:
    sources = [{}] if previous is None else [previous.manifest]
    sources += [journal.study] if journal.runs else []
    machines: list[dict[str, str]] = []
    for source in sources:
        for key, what_differs in KEYS.items() if source else ():
            value_now, value_before = study.get(key), source.get(key, {} if key == "error" else None)
            # a study with a fixed number of runs has no plan to differ
            if value_now != value_before and not (key == PLAN and None in (value_now, value_before)):
                raise InputError(f"the results to resume have another {what_differs}; use the same command as before")
        machines += [machine for machine in source.get("machines", []) if machine not in machines]
    this = this_machine()
    if others := [machine for machine in machines if machine != this]:
        say(
            f"consistency: {in_words(others)} computed the runs that are there, this is {in_words([this])}: "
            "the last digits of the others may differ from those of one machine"
        )
    return Gathered(study["filters"], study["error"], journal, new, previous, others)
