"""Rounds of runs: each has the runs of those before and more, and what they leave is gathered as it comes."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from typing import Any

import pandas as pd

from consistency.bench.filters.filter_declarations import name_of, optimal_gain
from consistency.bench.runs.outcomes_to_results import Gathered, SoFar
from consistency.bench.runs.trial_work import TrialWork, Workers
from consistency.bench.store.results import Results, StoredResults
from consistency.referee.system.progress import progress
from consistency.referee.system.provenance import manifest_of


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
                    self._do(todo)
        except KeyboardInterrupt:
            if self.gathered.journal.is_on_disk:
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
        runs_beyond = finished.difference(runs)
        total = max(runs_beyond) + 1 if runs_beyond else len(runs)
        fields = self._fields | {"machines": self.gathered.machines()}
        is_complete = len(finished) == total
        if not is_complete:
            fields["finished_runs"] = len(finished)
        wall = time.monotonic() - started
        manifest = manifest_of(wall=wall, complete=is_complete, runs=total, **fields)
        return self.gathered.results(manifest, self.landmarks)
