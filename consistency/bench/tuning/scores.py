"""How well a filter foresees what comes: the log density that it gives to its innovations, or to its errors."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiled import one_blas_thread
from consistency.bench.filters.stepping import name_of, rejects
from consistency.bench.protocols import Filter
from consistency.bench.runs.backends.local import worker_count
from consistency.bench.runs.compiling import compile_all
from consistency.bench.runs.isolation.filter_process import Isolation
from consistency.bench.scenario import Belief
from consistency.bench.store.trial_rows import outcome_of
from consistency.bench.types import Estimates, Trial
from consistency.referee.column_names import POSE
from consistency.referee.errors import InputError
from consistency.referee.system.progress import say
from consistency.referee.types import Array

BY = ("innovations", "nees")
EVERY = 5.0  # seconds between lines of progress


class Score(NamedTuple):
    """Of one run of T steps."""

    log_density: Array  # (T,), 0 in a step that says nothing
    squares: float  # sum of NIS or NEES,
    dof: float  # which has this expectation if the covariances are right
    failure: str  # why the run failed, or nothing


def require_scorable(filter_: Filter, by: str, has_truth: bool) -> None:
    """Refuse what cannot be scored before any run.

    Raises
    ------
    InputError
        An unknown score, no truth for the NEES, or a filter that leaves observations out: the likelihood of those
        that it keeps prefers a small noise, with which it keeps few.
    """
    if by not in BY:
        raise InputError(f"--by must be {' or '.join(BY)}, got '{by}'")
    if by == "nees" and not has_truth:
        raise InputError("--by nees needs the truth, and the log has none; take --by innovations")
    if by == "innovations" and (rejects(filter_) or getattr(filter_, "guard", None) is not None):
        raise InputError(
            f"filter '{name_of(filter_)}' leaves observations out, so that its innovations say too little of the "
            "noise; tune the filter without its guard, or by --by nees"
        )


def score_of(trial: Trial, estimates: Estimates, by: str) -> Score:
    """The score of a run.

    By innovations it is the likelihood of the observations (Schweppe 1965, IEEE Trans. Inf. Theory 11(1), eq. 9). What
    begins a landmark is left out of it, as in a diffuse likelihood: no density is stated for it. By NEES it is the
    logarithmic score (Good 1952) of the stated Gaussian at the error of the pose, in the error that the filter states
    the covariance of.

    Raises
    ------
    InputError
        The filter reports no innovations.
    """
    outcome = outcome_of(trial, [replace(estimates, map=None)])
    reason = "".join(f"step {failure.step}: {failure.reason}" for failure in outcome.failures)
    if by == "innovations":
        squares, dof = estimates.nis, estimates.nis_dof.astype(float)
        if not reason and (estimates.log_det is None or not np.isfinite(estimates.log_det).any()):
            raise InputError(
                f"filter '{estimates.filter}' reports no innovations: its update must return an Info with innovation "
                "and S; or fit the errors by --by nees"
            )
        log_det = np.full(len(squares), np.nan) if estimates.log_det is None else estimates.log_det
    else:
        [columns] = outcome.estimates.values()
        squares = np.full(trial.steps, np.nan)
        squares[: len(columns["step"])] = columns.get("own_nees", columns["nees"])
        P = estimates.covariance if estimates.own is None else estimates.own
        counted = np.isfinite(squares)
        log_det, dof = np.full(trial.steps, np.nan), np.full(trial.steps, float(len(POSE)))
        log_det[counted] = np.linalg.slogdet(P[counted])[1]
    known = np.isfinite(squares) & np.isfinite(log_det) & (dof > 0)
    density = np.where(known, -0.5 * (squares + log_det + dof * np.log(2.0 * np.pi)), 0.0)
    return Score(density, float(squares[known].sum()), float(dof[known].sum()), reason)


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
    by : one of :data:`BY`
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
