"""From result tables to the arrays that the diagnostics take, and to verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from consistency.diagnostics import Design, gate_runs, judge, required_runs, sequential_design
from consistency.errors import InputError
from consistency.geometry import pose_error
from consistency.recording import Recording
from consistency.results import POSE, Results, covariances
from consistency.types import Array, Failure, Indices, Verdict

CONFIDENCE = 0.95
OPTION = {
    "ratio": "detect",
    "false_alarm": "false-alarm",
    "max_runs": "max-runs",
}  # of the plan, as the command calls it


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


def analyse(
    results: Results, filters: Sequence[str] | None = None, confidence: float | None = None
) -> dict[str, Verdict]:
    """A verdict for every filter of the results, or for those named.

    Parameters
    ----------
    confidence : 1 less the false-alarm rate of a verdict; 0.95 where None. Results of a run until decided are then
        judged as the last look at them was.

    Raises
    ------
    InputError
        Unknown filter, or a confidence outside (0, 1).
    """
    design = None if confidence is not None else design_of(results)
    false_alarm = design.look_false_alarm if design else _false_alarm(confidence)
    verdicts = {}
    for name in filters or results.filters:
        verdict = verdict_of(curves(results, name), false_alarm)
        verdicts[name] = design.settle(verdict) if design else verdict
    return verdicts


def design_of(results: Results) -> Design | None:
    """The group-sequential plan that the results were run by, if they were."""
    plan = results.manifest.get("until_decided")
    try:
        return sequential_design(**plan) if plan else None
    except (TypeError, ValueError) as error:
        raise InputError(f"manifest.json: key 'until_decided': {error}") from None


def verdict_of(c: Curves, false_alarm: float) -> Verdict:
    """The verdict on one filter's arrays."""
    return judge(
        c.filter, c.error, c.covariance, c.nees, c.nis, c.nis_dof, c.failures, false_alarm,
        axes=POSE, run_numbers=c.runs,
    )  # fmt: skip


def analyse_recordings(
    recordings: Sequence[Recording], filters: Sequence[str] | None = None, confidence: float | None = None
) -> dict[str, Verdict]:
    """A verdict for every recording, or for those named; raises as :func:`analyse`."""
    false_alarm = _false_alarm(confidence)
    named = {recording.name: recording for recording in recordings}
    verdicts = {}
    for name in filters or named:
        if name not in named:
            raise InputError(f"--filter {name}: is not in these files; there are: {', '.join(named)}")
        r = named[name]
        verdict = judge(
            name, r.error, r.covariance, r.nees, r.nis, r.nis_dof, r.failures, false_alarm,
            dof=r.dof or None, axes=r.axes, run_numbers=r.runs,
        )  # fmt: skip
        said = {
            "axes": list(r.axes), "convention": r.convention or None, "notes": list(r.notes),
            "left_out_steps": r.left_out_steps,
        }  # fmt: skip
        verdicts[name] = replace(verdict, statistics=verdict.statistics | said)
    return verdicts


def plan(dof: int, detect: float, false_alarm: float, power: float, allow: str | None = None) -> dict[str, Any]:
    """Runs that a verdict takes (``runs``), those of one chi-square test (``one_step``), and the looks.

    Raises
    ------
    InputError
        A number out of its range.
    """
    if allow not in (None, "conservative"):
        raise InputError(f"--allow must be 'conservative', got '{allow}'")
    try:
        return {
            "dof": dof, "detect": detect, "false_alarm": false_alarm, "power": power, "allow": allow,
            "runs": gate_runs(dof, detect, false_alarm, power, allow),
            "one_step": required_runs(dof, detect, false_alarm, power, two_sided=allow is None),
            "looks": list(sequential_design(dof, detect, false_alarm, power).looks),
        }  # fmt: skip
    except ValueError as error:
        raise refused(error) from None


def refused(error: ValueError) -> InputError:
    """What a plan refuses, with the option of the command in place of the argument."""
    name, rest = str(error).split(" ", 1)
    return InputError(f"--{OPTION.get(name, name)} {rest}")


def _false_alarm(confidence: float | None) -> float:
    confidence = CONFIDENCE if confidence is None else confidence
    if not 0.0 < confidence < 1.0:
        raise InputError(f"confidence must lie between 0 and 1, got {confidence}")
    return 1.0 - confidence


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
