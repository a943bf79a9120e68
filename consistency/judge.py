"""From result tables to the arrays that the diagnostics take, and to verdicts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import stats

from consistency.diagnostics import judge
from consistency.errors import InputError
from consistency.geometry import pose_error
from consistency.results import POSE, Results, covariances
from consistency.types import Array, Failure, Indices, Verdict


@dataclass(frozen=True)
class Curves:
    """One filter's results as arrays over (runs, steps); NaN where a run has no value."""

    filter: str
    runs: Indices  # (R,), run numbers
    t: Array  # (T,)
    pose: Array  # (R, T, 3)
    covariance: Array  # (R, T, 3, 3)
    error: Array | None  # (R, T, 3), truth minus estimate, heading wrapped
    nees: Array | None  # (R, T)
    nis: Array  # (R, T)
    nis_dof: Indices  # (R, T)
    failures: tuple[Failure, ...]


def curves(results: Results, filter_name: str) -> Curves:
    """Arrays of one filter.

    Raises
    ------
    InputError
        The results hold no such filter.
    """
    if filter_name not in results.filters:
        raise InputError(f"filter '{filter_name}' is not in these results; there are: {', '.join(results.filters)}")
    table = results.estimates[results.estimates["filter"] == filter_name]
    broken = results.failures[results.failures["filter"] == filter_name]
    runs = np.unique(np.concatenate([table["run"], broken["run"]])).astype(np.int64)
    steps = _steps(results)
    row, column = np.searchsorted(runs, table["run"]), table["step"].to_numpy() - 1

    def grid(values: Array) -> Array:
        out = np.full((len(runs), steps, *values.shape[1:]), np.nan)
        out[row, column] = values
        return out

    pose = grid(table[POSE].to_numpy())
    t = np.full(steps, np.nan)
    for timed in (results.truth, table):  # where every run of this filter has failed only the truth goes on
        if timed is not None:
            after_start = timed[timed["step"] > 0]
            t[after_start["step"] - 1] = after_start["t"]
    dof = grid(table["nis_dof"].to_numpy(float))
    error = nees = None
    if results.truth is not None:
        error = pose_error(_true_pose(results.truth, runs, steps), pose)
        nees = grid(table["nees"].to_numpy())
    failures = tuple(Failure(filter_name, int(r), int(s), str(why)) for _, r, s, why in broken.itertuples(index=False))
    return Curves(
        filter_name, runs, t, pose, grid(covariances(table)), error, nees,
        grid(table["nis"].to_numpy()), np.nan_to_num(dof).astype(np.int64), failures,
    )  # fmt: skip


def run_means(c: Curves) -> Array:
    """Mean NEES of each run over its judged steps, shape (R,); infinite for a failed run."""
    assert c.nees is not None
    counted = np.isfinite(c.nees)
    total = np.where(counted, c.nees, 0.0).sum(axis=1)
    means = np.where(counted.any(axis=1), total / np.maximum(counted.sum(axis=1), 1), np.inf)
    means[np.isin(c.runs, [failure.run for failure in c.failures])] = np.inf
    return np.asarray(means)


def wins(a: Curves, b: Curves) -> tuple[int, float]:
    """Runs in which ``a`` has the lower mean NEES than ``b``, and the two-sided p value of a sign test."""
    better, worse = (int((run_means(x) < run_means(y)).sum()) for x, y in ((a, b), (b, a)))
    return better, float(stats.binomtest(better, better + worse).pvalue)


def analyse(results: Results, filters: list[str] | None = None, confidence: float = 0.95) -> dict[str, Verdict]:
    """A verdict for every filter of the results, or for those named.

    Raises
    ------
    InputError
        Unknown filter, or a confidence outside (0, 1).
    """
    if not 0.0 < confidence < 1.0:
        raise InputError(f"confidence must lie between 0 and 1, got {confidence}")
    verdicts = {}
    for name in filters or results.filters:
        c = curves(results, name)
        verdicts[name] = verdict_of(c, 1.0 - confidence)
    return verdicts


def verdict_of(c: Curves, false_alarm: float) -> Verdict:
    """The verdict on one filter's arrays."""
    verdict = judge(c.filter, c.error, c.covariance, c.nees, c.nis, c.nis_dof, c.failures, false_alarm, axes=POSE)
    outlier = verdict.statistics.get("outlier")
    if outlier and outlier["row"] >= 0:
        outlier["run"] = int(c.runs[outlier["row"]])
    return verdict


def _steps(results: Results) -> int:
    """Steps of the longest run, failed steps counted."""
    tables = [results.estimates["step"], results.failures["step"]]
    if results.truth is not None:
        tables.append(results.truth["step"])
    return int(max((column.max() for column in tables if len(column)), default=0))


def _true_pose(truth: pd.DataFrame, runs: Indices, steps: int) -> Array:
    out = np.full((len(runs), steps, 3), np.nan)
    table = truth[(truth["step"] > 0) & truth["run"].isin(runs)]
    out[np.searchsorted(runs, table["run"]), table["step"].to_numpy() - 1] = table[POSE].to_numpy()
    return out
