"""A number of runs, done by a backend and kept as they come, until there are enough of them."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from typing import Any

import pandas as pd

from consistency.bench.filters.stepping import error_of, name_of, optimal_gain
from consistency.bench.protocols import Filter
from consistency.bench.runs.gather import Gathered, SoFar
from consistency.bench.runs.resuming import ResultsPlace
from consistency.bench.runs.trial_work import Backend, TrialWork
from consistency.bench.store.results import Results, StoredResults
from consistency.referee.geometry.conventions import ADDITIVE
from consistency.referee.system.progress import progress
from consistency.referee.system.provenance import manifest_of
from consistency.referee.system.stopping import Stop, stoppable


class Interrupted(KeyboardInterrupt):
    """Ctrl-C in :func:`run_trials`; ``results`` holds the runs that were finished, ``status`` is for the exit."""

    def __init__(self, results: Results | StoredResults, status: int = 130) -> None:
        super().__init__("interrupted")
        self.results, self.status = results, status


class Campaign:
    """Runs that are done and gathered.

    Parameters
    ----------
    backend, work : who does the runs, and what is done for each
    place : where results go, and what is there
    fields : of the manifest
    landmarks : table of those of the world, where they are known
    """

    def __init__(
        self,
        backend: Backend,
        work: TrialWork,
        place: ResultsPlace,
        fields: Mapping[str, Any],
        landmarks: pd.DataFrame | None,
    ) -> None:
        self.backend, self.work, self.place, self.landmarks = backend, work, place, landmarks
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

        Raises
        ------
        Interrupted
            Ctrl-C, or a signal that is taken as such, with what there is.
        """
        runs: Sequence[int] = ()
        with stoppable() as stop:
            started, complete, is_ready = time.monotonic(), True, False
            try:
                for runs in rounds:
                    todo = sorted(set(runs) - self.gathered.finished)
                    if todo and not is_ready:
                        self.backend.prepare(self.work, todo[0])
                        started, is_ready = time.monotonic(), True
                    if todo:
                        self._do(todo, stop)
            except KeyboardInterrupt:
                complete = False
            except Exception:
                if stop.number is None:
                    raise
                complete = False
            wall = time.monotonic() - started
            machines = self.gathered.machines(self.place.machines[:-1])
            manifest = manifest_of(
                wall=wall, complete=complete, runs=len(runs), **self._fields | {"machines": machines}
            )  # fmt: skip
            if complete:
                return self.gathered.results(manifest, self.landmarks)
            manifest |= {"finished_runs": len(self.gathered.finished)}
            raise Interrupted(self.gathered.results(manifest, self.landmarks), stop.status)

    def _do(self, runs: Sequence[int], stop: Stop) -> None:
        with closing(self.backend.outcomes(self.work, runs)) as outcomes, progress("runs", len(runs)) as advance:
            for outcome in outcomes:
                self.gathered.add(outcome)
                advance(1)
                if stop.number is not None:  # and whoever was called took it for an error of its own
                    raise KeyboardInterrupt


def own_errors(filters: Sequence[Filter]) -> dict[str, str]:
    """Convention of each filter's own error, of those where it is not the additive one."""
    errors = {name_of(f): error_of(f) for f in filters}
    return {name: error for name, error in errors.items() if error != ADDITIVE}
