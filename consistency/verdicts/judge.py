"""From result tables to the arrays that the diagnostics take, and to verdicts."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import stats

from consistency.diagnostics import (
    Design,
    Evidence,
    Settings,
    Verdict,
    follow,
    gate_runs,
    judge,
    pilot_plan,
    required_runs,
    sequential_design,
)
from consistency.diagnostics.scale import FEW
from consistency.errors import InputError
from consistency.geometry import pose_error
from consistency.recording import Recording
from consistency.store.parquet import COLUMNS, COVARIANCE
from consistency.store.results import NUMBERS, POSE, Tables
from consistency.types import Array, Failure, Indices

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
    covariance: Array  # (R, T, 3, 3)
    error: Array | None  # (R, T, 3), truth minus estimate, heading wrapped
    nees: Array | None  # (R, T)
    nis: Array  # (R, T)
    nis_dof: Indices  # (R, T)
    failures: tuple[Failure, ...]
    optimal_gain: bool = False  # declared by the filter


def curves(results: Tables, filter_name: str, steps: int | None = None) -> Curves:
    """Arrays of one filter; of results in a folder nothing else is read but, unless ``steps`` is known, the steps.

    Raises
    ------
    InputError
        The results hold no such filter.
    """
    if filter_name not in results.filters:
        raise InputError(f"filter '{filter_name}' is not in these results; there are: {', '.join(results.filters)}")
    broken = results.failures[results.failures["filter"] == filter_name]
    runs = results.runs_of(filter_name)
    steps = _steps(results) if steps is None else steps
    pose, covariance = np.full((len(runs), steps, 3), np.nan), np.full((len(runs), steps, 3, 3), np.nan)
    nis, nis_dof = np.full(pose.shape[:2], np.nan), np.zeros(pose.shape[:2], np.int64)
    nees = np.full(pose.shape[:2], np.nan) if results.has_truth else None
    t = np.full(steps, np.nan)
    for batch in results.batches("estimates", NUMBERS, filter_name):
        if (batch["step"] < 1).any():
            raise InputError(f"estimates of '{filter_name}': column 'step' must be at least 1")
        at = np.searchsorted(runs, batch["run"]), batch["step"] - 1
        for i, axis in enumerate(POSE):
            pose[*at, i] = batch[axis]
        for name, (i, j) in COVARIANCE.items():
            covariance[*at, i, j] = covariance[*at, j, i] = batch[name]
        nis[at], nis_dof[at], t[at[1]] = batch["nis"], batch["nis_dof"], batch["t"]
        if nees is not None:
            nees[at] = batch["nees"]
    failures = tuple(Failure(filter_name, int(r), int(s), str(why)) for _, r, s, why in broken.itertuples(index=False))
    error = _errors(results, runs, pose, t) if results.has_truth else None
    optimal = filter_name in results.manifest.get("optimal_gain", [])
    return Curves(filter_name, runs, t, covariance, error, nees, nis, nis_dof, failures, optimal)


def _errors(results: Tables, runs: Indices, pose: Array, t: Array) -> Array:
    """Truth minus estimate in the place of ``pose``; NaN without truth. Fills ``t`` where every run had failed."""
    known = np.zeros(pose.shape[:2], bool)
    for batch in results.batches("truth", list(COLUMNS["truth"])):
        chosen = (batch["step"] > 0) & np.isin(batch["run"], runs)
        row, column = np.searchsorted(runs, batch["run"][chosen]), batch["step"][chosen] - 1
        t[column] = np.where(np.isnan(t[column]), batch["t"][chosen], t[column])
        true = np.stack([batch[axis][chosen] for axis in POSE], axis=-1)
        pose[row, column] = pose_error(true, pose[row, column])
        known[row, column] = True
    pose[~known] = np.nan
    return pose


def run_means(c: Curves) -> Array:
    """Mean NEES of each run over its judged steps, shape (R,); infinite for a failed run."""
    assert c.nees is not None
    counted = np.isfinite(c.nees)
    total = np.where(counted, c.nees, 0.0).sum(axis=1)
    means = np.where(counted.any(axis=1), total / np.maximum(counted.sum(axis=1), 1), np.inf)
    means[np.isin(c.runs, [failure.run for failure in c.failures])] = np.inf
    return np.asarray(means)


def wins(a: Curves, b: Curves) -> tuple[int, float]:
    """Runs in which ``a`` has the lower mean NEES than ``b``, and the two-sided p value of a sign test without ties."""
    better, worse = (int((run_means(x) < run_means(y)).sum()) for x, y in ((a, b), (b, a)))
    return better, float(stats.binomtest(better, better + worse).pvalue) if better + worse else 1.0


def settings_of(confidence: float | None = None, **given: Any) -> Settings:
    """Settings of a verdict from the options of a command; those that are None keep their defaults.

    Raises
    ------
    InputError
        A value out of its range, or both a confidence and a false-alarm rate.
    """
    given = {name: value for name, value in given.items() if value is not None}
    if confidence is not None:
        if "false_alarm" in given:
            raise InputError("--confidence is 1 less --false-alarm; give one of them")
        if not 0.0 < confidence < 1.0:
            raise InputError(f"confidence must lie between 0 and 1, got {confidence}")
        given["false_alarm"] = 1.0 - confidence
    try:
        return Settings(**given)
    except ValueError as error:
        raise refused(error) from None


def analyse(
    results: Tables,
    filters: Sequence[str] | None = None,
    confidence: float | None = None,
    settings: Settings | None = None,
) -> dict[str, Verdict]:
    """A verdict for every filter of the results, or for those named.

    Parameters
    ----------
    confidence : 1 less the false-alarm rate of a verdict, in place of ``settings``
    settings : what to ask; the defaults of :class:`Settings` where None. Results of a run until decided are then
        judged as that run was.

    Raises
    ------
    InputError
        Unknown filter, or a confidence outside (0, 1).
    """
    design = design_of(results) if settings is None and confidence is None else None
    settings = settings_of(confidence) if settings is None else settings
    verdicts, steps = {}, _steps(results)
    for name in filters or results.filters:
        c = curves(results, name, steps)
        verdicts[name] = judge(evidence_of(c), settings) if design is None else until_decided(c, design)
    return verdicts


def design_of(results: Tables) -> Design | None:
    """The plan of looks that the results were run by, if they were."""
    plan = results.manifest.get("until_decided")
    try:
        return sequential_design(**plan) if plan else None
    except (TypeError, ValueError) as error:
        raise InputError(f"manifest.json: key 'until_decided': {error}") from None


def evidence_of(c: Curves, runs: int | None = None) -> Evidence:
    """One filter's arrays as the referee takes them; only runs 0 to ``runs`` - 1, where that is given."""
    some = slice(None if runs is None else int(np.searchsorted(c.runs, runs)))
    numbers = c.runs[some]
    return Evidence(
        c.filter,
        None if c.error is None else c.error[some],
        c.covariance[some],
        None if c.nees is None else c.nees[some],
        nis=c.nis[some],
        nis_dof=c.nis_dof[some],
        optimal_gain=c.optimal_gain,
        failures=tuple(f for f in c.failures if f.run in numbers),
        axes=POSE,
        run_numbers=numbers,
    )


def until_decided(c: Curves, design: Design) -> Verdict:
    """The verdict of the look that decided, or of the last one."""
    return follow(design, lambda runs: evidence_of(c, runs), len(c.runs))[0]


def analyse_recordings(
    recordings: Sequence[Recording],
    filters: Sequence[str] | None = None,
    settings: Settings | None = None,
    optimal_gain: bool = False,
) -> dict[str, Verdict]:
    """A verdict for every recording, or for those named; raises as :func:`analyse`.

    Parameters
    ----------
    optimal_gain : the filters declare one, so that their innovations are judged
    """
    settings = settings or Settings()
    named = {recording.name: recording for recording in recordings}
    verdicts = {}
    for name in filters or named:
        if name not in named:
            raise InputError(f"--filter {name}: is not in these files; there are: {', '.join(named)}")
        r = named[name]
        evidence = Evidence(
            name, r.error, r.covariance, r.nees, r.dof or None, r.nis, r.nis_dof, optimal_gain=optimal_gain,
            failures=r.failures, axes=r.axes, run_numbers=r.runs,
        )  # fmt: skip
        verdicts[name] = replace(
            judge(evidence, settings),
            convention=r.convention or None,
            notes=tuple(r.notes),
            left_out_steps=tuple(r.left_out_steps),
        )
    return verdicts


def plan(
    dof: int,
    detect: float,
    false_alarm: float,
    power: float,
    allow: str | None = None,
    pilots: Mapping[str, Curves] | None = None,
) -> dict[str, Any]:
    """Runs that a verdict takes (``runs``), those of one chi-square test (``one_step``), and the first looks.

    Parameters
    ----------
    pilots : a few runs of each filter; ``like`` then has the runs that filters take whose steps depend on each other
        as theirs do

    Raises
    ------
    InputError
        A number out of its range, or pilots without truth.
    """
    if allow not in (None, "conservative"):
        raise InputError(f"--allow must be 'conservative', got '{allow}'")
    if pilots is not None and dof != len(POSE):
        raise InputError(f"--dof {dof}: results of the bench have {len(POSE)} dimensions; leave it out")
    try:
        runs = gate_runs(dof, detect, false_alarm, power, allow)
        looks = list(itertools.takewhile(lambda n: n < runs, (n for n, spent in Design(dof).inspections() if spent)))
        planned: dict[str, Any] = {
            "dof": dof, "detect": detect, "false_alarm": false_alarm, "power": power, "allow": allow, "runs": runs,
            "one_step": required_runs(dof, detect, false_alarm, power, two_sided=allow is None), "looks": looks,
        }  # fmt: skip
        if pilots is not None:
            planned["like"] = {
                name: vars(pilot_plan(_pilot_means(c), dof, c.t.size, detect, false_alarm, power, allow))
                for name, c in pilots.items()
            }
        return planned
    except ValueError as error:
        raise error if isinstance(error, InputError) else refused(error) from None


def pilots_of(results: Tables, filters: Sequence[str] | None = None) -> dict[str, Curves]:
    """Results as pilots of :func:`plan`, of every filter or of those named."""
    return {name: curves(results, name) for name in filters or results.filters}


def _pilot_means(c: Curves) -> Array:
    """Mean NEES over dof of the runs that did not fail, (runs,)."""
    if c.nees is None:
        raise InputError(f"{c.filter}: has no truth; only runs with a NEES tell how their steps depend on each other")
    means = run_means(c)
    means = means[np.isfinite(means)] / len(POSE)
    if len(means) < FEW:
        raise InputError(f"{c.filter}: a pilot needs at least {FEW} runs that did not fail, got {len(means)}")
    return np.asarray(means)


def refused(error: ValueError) -> InputError:
    """What a plan refuses, with the option of the command in place of the argument."""
    name, rest = str(error).split(" ", 1)
    return InputError(f"--{OPTION.get(name, name)} {rest}")


def _steps(results: Tables) -> int:
    """Steps of the longest run, failed steps counted."""
    last = int(results.failures["step"].max()) if len(results.failures) else 0
    for table in ("estimates", "truth"):
        for batch in results.batches(table, ["step"]):
            last = max(last, int(batch["step"].max(initial=0)))
    return last
