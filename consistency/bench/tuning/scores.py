"""How well a filter foresees what comes: the log density that it gives to its innovations, or to its errors."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from consistency.bench.filters.stepping import name_of, rejects
from consistency.bench.protocols import Filter
from consistency.bench.store.trial_rows import outcome_of
from consistency.bench.types import Estimates, Trial
from consistency.referee.column_names import POSE
from consistency.referee.errors import InputError
from consistency.referee.types import Array

BY = ("innovations", "nees")


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
