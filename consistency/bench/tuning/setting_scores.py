"""All runs at one setting: the same trials each time, on all workers."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from consistency.bench.filters.compiled import one_blas_thread
from consistency.bench.filters.stepping import name_of
from consistency.bench.protocols import Filter
from consistency.bench.runs.backends.local import worker_count
from consistency.bench.runs.compiling import compile_all
from consistency.bench.runs.isolation.isolating import Isolation
from consistency.bench.scenario import Belief
from consistency.bench.tuning.scores import Score, score_of
from consistency.bench.types import Trial
from consistency.referee.system.progress import say
from consistency.referee.types import Array

EVERY = 5.0  # seconds between lines of progress


@dataclass(frozen=True)
class Scores:
    """Of R runs of up to T steps at one setting."""

    log_density: Array  # (R, T), 0 in steps that a run does not have
    ratio: float  # total NIS or NEES over its degrees of freedom
    failures: tuple[str, ...]  # of runs that failed


class BeliefScorer:
    """Scores a filter on trials under any belief; to be used in a ``with``, whose end kills what still works.

    A filter that is not compiled keeps its processes from one setting to the next, with the modules that it imports.

    Parameters
    ----------
    belief : that a fit begins with
    by : one of :data:`consistency.tuning.scores.BY`
    timeout : seconds a trial of a filter that is not compiled
    """

    def __init__(
        self,
        filter_: Filter,
        trials: Sequence[Trial],
        belief: Belief,
        by: str,
        jobs: int = -1,
        timeout: float | None = None,
    ) -> None:
        self.filter, self.trials, self.by, self.timeout = filter_, list(trials), by, timeout
        self.workers = min(worker_count(jobs), len(self.trials))
        self.settings, self.began = 0, time.monotonic()
        self._told = self.began
        self._pool = ThreadPoolExecutor(self.workers)  # kernels release the GIL; other filters run in processes
        self._isolation = Isolation([filter_], belief, timeout)

    def __enter__(self) -> BeliefScorer:
        self._isolation.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._isolation.__exit__()
        self._pool.shutdown(cancel_futures=True)

    def compile(self) -> None:
        """Compile what the filter needs, and is not yet compiled."""
        compile_all([(self.filter, self.trials[0], self._isolation.belief)])

    def __call__(self, belief: Belief) -> Scores:
        """Scores of all runs.

        Raises
        ------
        InputError
            The filter reports no innovations, or needs what a trial does not have.
        """
        with one_blas_thread():
            scores = list(self._pool.map(lambda trial: self._score(trial, belief), self.trials))
        self.settings += 1
        now = time.monotonic()
        if now - self._told >= EVERY:
            self._told = now
            count = f"{self.settings} settings on {len(self.trials)} run{'s' * (len(self.trials) != 1)}"
            say(f"fitting {name_of(self.filter)} by {self.by}: {count} each, {now - self.began:.0f} s")
        density = np.zeros((len(scores), max(trial.steps for trial in self.trials)))
        for row, score in zip(density, scores, strict=True):
            row[: len(score.log_density)] = score.log_density
        dof = sum(score.dof for score in scores)
        ratio = sum(score.squares for score in scores) / dof if dof else np.nan
        failed = [(trial.run, score.failure) for trial, score in zip(self.trials, scores, strict=True) if score.failure]
        return Scores(density, ratio, tuple(f"run {run}, {reason}" for run, reason in failed))

    def _score(self, trial: Trial, belief: Belief) -> Score:
        [estimates] = self._isolation.run(trial, belief)
        return score_of(trial, estimates, self.by)
