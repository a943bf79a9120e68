"""How overconfident is a filter in a world? Scores of trials, on all workers."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from consistency.bench.filters.compiled import one_blas_thread
from consistency.bench.protocols import Filter
from consistency.bench.runs.isolation.filter_process import Isolation
from consistency.bench.runs.local_workers import worker_count
from consistency.bench.runs.missing_kernels import compile_all, first_trials
from consistency.bench.runs.run_outcome import outcome_of
from consistency.bench.scenario import Scenario
from consistency.bench.simulation import require_landmarks_in_view
from consistency.bench.simulation.world import World
from consistency.referee.column_names import POSE
from consistency.referee.errors import InputError

WORST = float(np.log(1e4))  # of a run that failed, and the most of one that did not
PATIENCE = 60.0  # s beyond the end of the search, after which a trial of a filter that is not compiled is killed
Job = tuple[Scenario, Sequence[int]]  # a world, and the trials in it


@dataclass(frozen=True)
class Done:
    """Scores of the trials of a world, fewer than were asked for where the time was up."""

    scores: tuple[float, ...]
    seconds: float  # of the fastest trial; others may have waited for a busy machine


class ChallengeScorer:
    """Scores one filter; to be used in a ``with``, which holds the workers.

    The score of a trial is log(mean NEES of the run / 3), which is 0 or a little less for a right filter. The
    logarithm keeps one diverged run among many from deciding which of two worlds is worse.
    """

    def __init__(self, filter_: Filter, jobs: int = -1) -> None:
        self.filter, self.workers = filter_, worker_count(jobs)
        # kernels release the GIL; other filters run in processes, for which threads wait
        self._pool = ThreadPoolExecutor(self.workers)

    def __enter__(self) -> ChallengeScorer:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def compile(self, worlds: Sequence[Scenario]) -> None:
        """Compile what the filter needs in these worlds, so that a search spends no time on it."""
        compile_all(first_trials((self.filter, world) for world in worlds), self.workers)

    def __call__(self, jobs: Sequence[Job], seed: int, until: float = np.inf) -> list[Done | None]:
        """Scores of each job in its order; None for a world in which no landmark comes into view.

        No trial begins after ``until``, a time of ``time.monotonic``.
        """
        with one_blas_thread():
            return list(self._pool.map(lambda job: _score(self.filter, job, seed, until), jobs))


def _score(filter_: Filter, job: Job, seed: int, until: float) -> Done | None:
    scenario, runs = job
    if time.monotonic() >= until:
        return Done((), 0.0)
    try:
        world = require_landmarks_in_view(scenario)
    except InputError:
        return None
    scores, fastest = [], np.inf
    timeout = until - time.monotonic() + PATIENCE if np.isfinite(until) else None
    with Isolation([filter_], scenario.belief, timeout) as isolation:
        for run in runs:
            began = time.monotonic()
            if began >= until:
                break
            scores.append(score_of_run(isolation, world, run, seed))
            fastest = min(fastest, time.monotonic() - began)
    return Done(tuple(scores), fastest if scores else 0.0)


def score_of_run(isolation: Isolation, world: World, run: int, seed: int) -> float:
    """log(mean NEES / 3) of a run of the one filter, in its own error; :data:`WORST` where it failed."""
    trial = world.trial(run, seed)
    outcome = outcome_of(trial, isolation.run(trial))
    if outcome.failures:
        return WORST
    [columns] = outcome.estimates.values()
    nees = np.asarray(columns.get("own_nees", columns["nees"]), float)
    nees = nees[np.isfinite(nees)]
    if not len(nees):
        return WORST
    with np.errstate(divide="ignore"):
        return float(np.clip(np.log(nees.mean() / len(POSE)), -WORST, WORST))
