"""How well a filter predicts its observations: the log density that it gives to its innovations."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiled import one_blas_thread
from consistency.bench.filters.filter_declarations import name_of, rejects
from consistency.bench.protocols import Filter
from consistency.bench.runs.isolation.filter_process import Isolation
from consistency.bench.runs.local_workers import worker_count
from consistency.bench.runs.missing_kernels import compile_all
from consistency.bench.runs.run_outcome import outcome_of
from consistency.bench.scenario import Belief
from consistency.bench.types import Estimates, Trial
from consistency.referee.errors import InputError
from consistency.referee.system.progress import say
from consistency.referee.types import Array

EVERY = 5.0  # seconds between lines of progress


class RunScore(NamedTuple):
    """Score of one run of T steps."""

    log_density: Array  # (T,), 0 in a step without an innovation
    nis: float  # sum over the steps,
    dof: float  # which has this expectation if the covariances are right
    failure: str  # why the run failed, or nothing


def require_scorable(filter_: Filter) -> None:
    """Refuse a filter that leaves observations out: the likelihood of those it keeps prefers a small noise.

    Raises
    ------
    InputError
        It has a gate or a guard.
    """
    if rejects(filter_) or getattr(filter_, "guard", None) is not None:
        raise InputError(
            f"filter '{name_of(filter_)}' leaves observations out, so that its innovations say too little of the "
            "noise; tune the filter without its guard"
        )


def score_of_run_by_innovations(trial: Trial, estimates: Estimates) -> RunScore:
    """Return the likelihood of the observations of a run (Schweppe 1965, IEEE Trans. Inf. Theory 11(1), eq. 9).

    The observation that begins a landmark is left out, as in a diffuse likelihood: no density is stated for it.

    Raises
    ------
    InputError
        The filter reports no innovations.
    """
    outcome = outcome_of(trial, [replace(estimates, map=None)])
    failure = "".join(f"step {failure.step}: {failure.reason}" for failure in outcome.failures)
    nis, dof, log_det = estimates.nis, estimates.nis_dof.astype(float), estimates.log_det
    if log_det is None or not np.isfinite(log_det).any():
        if not failure:
            raise InputError(
                f"filter '{estimates.filter}' reports no innovations: its update must return an Info with innovation "
                "and S"
            )
        log_det = np.full(len(nis), np.nan)
    has_innovation = np.isfinite(nis) & np.isfinite(log_det) & (dof > 0)
    density = np.where(has_innovation, -0.5 * (nis + log_det + dof * np.log(2.0 * np.pi)), 0.0)
    return RunScore(density, float(nis[has_innovation].sum()), float(dof[has_innovation].sum()), failure)


@dataclass(frozen=True)
class Scores:
    """Scores of R runs of up to T steps at one setting."""

    log_density: Array  # (R, T), 0 in steps that a run does not have
    ratio: float  # total NIS over its degrees of freedom
    failures: tuple[str, ...]  # of runs that failed


class BeliefScorer:
    """Scores a filter on trials under any belief; to be used in a ``with``, whose end kills what still works.

    A filter that is not compiled keeps its processes from one setting to the next, with the modules that it imports.

    Parameters
    ----------
    belief : that a fit begins with
    timeout : seconds a trial of a filter that is not compiled
    """

    def __init__(
        self, filter_: Filter, trials: Sequence[Trial], belief: Belief, jobs: int = -1, timeout: float | None = None
    ) -> None:
        self.filter, self.trials = filter_, list(trials)
        self.settings, self.began = 0, time.monotonic()
        self._told = self.began
        # kernels release the GIL; other filters run in processes
        self._pool = ThreadPoolExecutor(min(worker_count(jobs), len(self.trials)))
        self._isolation = Isolation([filter_], belief, timeout)

    def __enter__(self) -> BeliefScorer:
        self._isolation.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._isolation.__exit__()
        self._pool.shutdown(cancel_futures=True)

    def compile(self) -> None:
        """Compile the filter, so that its first setting takes no longer than others."""
        compile_all([(self.filter, self.trials[0], self._isolation.belief)])

    def __call__(self, belief: Belief) -> Scores:
        """Return the scores of all runs.

        Raises
        ------
        InputError
            The filter reports no innovations, or needs what a trial does not have.
        """
        with one_blas_thread():
            scores = list(self._pool.map(lambda trial: self._score(trial, belief), self.trials))
        self.settings += 1
        self._tell()
        density = np.zeros((len(scores), max(trial.steps for trial in self.trials)))
        failures = []
        for row, trial, score in zip(density, self.trials, scores, strict=True):
            row[: len(score.log_density)] = score.log_density
            if score.failure:
                failures.append(f"run {trial.run}, {score.failure}")
        dof = sum(score.dof for score in scores)
        ratio = sum(score.nis for score in scores) / dof if dof else np.nan
        return Scores(density, ratio, tuple(failures))

    def _score(self, trial: Trial, belief: Belief) -> RunScore:
        [estimates] = self._isolation.run(trial, belief)
        return score_of_run_by_innovations(trial, estimates)

    def _tell(self) -> None:
        """Print a line of progress, every few seconds."""
        now = time.monotonic()
        if now - self._told < EVERY:
            return
        self._told = now
        say(
            f"fitting {name_of(self.filter)}: {self.settings} settings on each of {len(self.trials)} runs, "
            f"{now - self.began:.0f} s"
        )
