"""A number of runs, done by a backend and kept in their place as they come, beside those of before."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from consistency.bench.filters.stepping import error_of, name_of, optimal_gain
from consistency.bench.protocols import Filter
from consistency.bench.runs.gather import Gathered, SoFar
from consistency.bench.runs.trial_work import TrialWork, Workers
from consistency.bench.store.journal import Journal, Unfinished
from consistency.bench.store.results import Results, StoredResults, Tables, open_results
from consistency.referee.errors import InputError
from consistency.referee.geometry.conventions import ADDITIVE
from consistency.referee.system.folders import NewFolder
from consistency.referee.system.progress import progress, say
from consistency.referee.system.provenance import in_words, manifest_of, this_machine

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


class Campaign:
    """Runs that are done and gathered.

    Parameters
    ----------
    workers, work : who does the runs, and what is done for each
    place : where results go, and what is there
    fields : of the manifest
    landmarks : table of those of the world, where they are known
    """

    def __init__(
        self,
        workers: Workers,
        work: TrialWork,
        place: ResultsPlace,
        fields: Mapping[str, Any],
        landmarks: pd.DataFrame | None,
    ) -> None:
        self.workers, self.work, self.place, self.landmarks = workers, work, place, landmarks
        names, errors = [name_of(f) for f in work.filters], own_errors(work.filters)
        self.gathered = Gathered(names, errors, place.new, place.journal, place.previous, place.kept)
        gains = [name_of(f) for f in work.filters if optimal_gain(f)]
        self._fields = dict(fields) | {"machines": place.machines, "filters": names, "optimal_gain": gains}
        self._fields |= {"error": errors} if errors else {}

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
                    self._do(todo)
        except KeyboardInterrupt:
            if self.place.journal is not None:
                raise
            raise Interrupted(self._results(runs, started)) from None
        return self._results(runs, started)

    def _do(self, runs: Sequence[int]) -> None:
        with closing(self.workers.outcomes(self.work, runs)) as outcomes, progress("runs", len(runs)) as advance:
            for outcome in outcomes:
                self.gathered.add(outcome)
                advance(1)

    def _results(self, runs: Sequence[int], started: float) -> Results | StoredResults:
        """The results of what is there, of which ``runs`` were asked for."""
        finished = self.gathered.finished
        beyond = finished.difference(runs)
        total = max(beyond) + 1 if beyond else len(runs)
        fields = self._fields | {"machines": self.gathered.machines(self.place.machines[:-1])}
        is_complete = len(finished) == total
        if not is_complete:
            fields["finished_runs"] = len(finished)
        wall = time.monotonic() - started
        manifest = manifest_of(wall=wall, complete=is_complete, runs=total, **fields)
        return self.gathered.results(manifest, self.landmarks)


def own_errors(filters: Sequence[Filter]) -> dict[str, str]:
    """Convention of each filter's own error, of those where it is not the additive one."""
    errors = {name_of(f): error_of(f) for f in filters}
    return {name: error for name, error in errors.items() if error != ADDITIVE}


@dataclass(frozen=True)
class ResultsPlace:
    """Place of the results, with the runs ``kept`` of previous results, and those in the journal.

    ``machines`` are those that computed a part of the results, this one last.
    """

    new: NewFolder | None
    journal: Journal | None
    previous: Tables | None
    kept: frozenset[int]
    machines: list[dict[str, str]]

    @property
    def is_complete(self) -> bool:
        """Whether the place holds complete results and nothing else."""
        more = self.journal is not None and self.journal.runs
        return self.previous is not None and bool(self.previous.manifest["complete"]) and not more


@contextmanager
def place_for(
    study: Mapping[str, Any], out: Path | None, previous: Tables | None, resume: bool, overwrite: bool
) -> Iterator[ResultsPlace]:
    """The place of the results of a ``study``, which is known by :data:`KEYS`; nothing but memory without ``out``.

    With ``resume``, or where ``previous`` are the results in ``out``, what is in ``out`` and in its journal is gone on
    with, and whatever else is in the folder stays.

    Raises
    ------
    InputError
        What is there is of another study; ``out`` cannot be written, or is taken; unfinished work is in the way.
    """
    if out is None:
        yield _place(study, None, None, previous)
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
            place = _place(study, new, unfinished.journal, previous)
            unfinished.journal.begin(dict(study) | {"overwrite": replaces, "machines": place.machines})
            try:
                yield place
            except InputError as error:
                finished = len(place.kept | unfinished.journal.runs)
                if new.is_placed or not finished or not isinstance(error.__cause__, OSError):
                    raise
                raise InputError(
                    f"{error}; {finished} finished runs are kept, and the same command with --resume continues"
                ) from error.__cause__
            finally:
                unfinished.is_over = new.is_placed


def _place(
    study: Mapping[str, Any], new: NewFolder | None, journal: Journal | None, previous: Tables | None
) -> ResultsPlace:
    sources = [{}] if previous is None else [previous.manifest]
    sources += [] if journal is None or not journal.runs else [journal.study]
    machines: list[dict[str, str]] = []
    for source in sources:
        _require_same(study, source)
        machines += [machine for machine in source.get("machines", []) if machine not in machines]
    here = this_machine()
    if others := [machine for machine in machines if machine != here]:
        say(
            f"consistency: {in_words(others)} computed the runs that are there, this is {in_words([here])}: "
            "the last digits of the others may differ from those of one machine"
        )
    kept = frozenset() if previous is None else frozenset(previous.finished_runs(study["filters"]))
    return ResultsPlace(new, journal, previous, kept, [*others, here])


def _require_same(study: Mapping[str, Any], before: Mapping[str, Any]) -> None:
    """Refuse to continue from runs of something else; a study with a fixed number of runs has no plan to differ."""
    for key, text in KEYS.items() if before else ():
        now, then = study.get(key), before.get(key, {} if key == "error" else None)
        if now != then and not (key == PLAN and None in (now, then)):
            raise InputError(f"the results to resume have another {text}; use the same command as before")
