"""From result tables to the arrays that the diagnostics take, and to verdicts."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from consistency.bench.store.curves import Curves, Ends, Landmarks, curves, landmarks_of, run_means, steps_of
from consistency.bench.store.results import Tables
from consistency.referee.diagnostics import (
    Design,
    Evidence,
    JointNees,
    Settings,
    Verdict,
    follow,
    judge,
    map_score,
    rejection_score,
    sequential_design,
)
from consistency.referee.diagnostics.scale import FEW
from consistency.referee.diagnostics.skipping import Skip
from consistency.referee.diagnostics.symmetric import Symmetric
from consistency.referee.errors import InputError
from consistency.referee.reading.columns import POSE
from consistency.referee.types import Array, Indices
from consistency.referee.verdicts.options import settings_of, skip_asked

POINT = ("x", "y", "z")


def analyse(
    results: Tables,
    filters: Sequence[str] | None = None,
    confidence: float | None = None,
    settings: Settings | None = None,
    skip: str | float | Skip | None = None,
) -> dict[str, Verdict]:
    """A verdict for every filter of the results, or for those named.

    Parameters
    ----------
    confidence : 1 less the false-alarm rate of a verdict, in place of ``settings``
    settings : what to ask; the defaults of :class:`Settings` where None. Results of a run until decided are then
        judged as that run was.
    skip : first steps (20) or seconds ("2s") of each run to leave out of the statistics, chosen on other data

    Raises
    ------
    InputError
        Unknown filter, a confidence outside (0, 1), or nothing is left.
    """
    design = design_of(results) if settings is None and confidence is None else None
    settings = settings_of(confidence) if settings is None else settings
    first = skip_asked(skip)
    verdicts, steps = {}, steps_of(results)
    for name in filters or results.filters:
        verdict, ends = _of_poses(curves(results, name, steps, maps=False).without_first(first), settings, design)
        verdicts[name] = with_map(verdict, results, ends, settings, design)
    return verdicts


def _of_poses(c: Curves, settings: Settings, design: Design | None) -> tuple[Verdict, Ends]:
    """A verdict without the maps; the arrays are free before those are read."""
    return verdict_by(c, settings, design), c.ends


def verdict_by(c: Curves, settings: Settings, design: Design | None) -> Verdict:
    """The verdict of one filter, as that run was looked at where there is a ``design``."""
    return verdict_of(c, settings) if design is None else until_decided(c, design)


def verdict_of(c: Curves, settings: Settings) -> Verdict:
    """The verdict of one filter in its own error, with that in the additive error and the map beside it."""
    world = None if c.own is None else judge(evidence_of(c, additive=True), settings)
    verdict = replace(judge(evidence_of(c), settings), world=world, convention=own_convention(c))
    return _with_map(with_rejections(verdict, c), c.landmarks, c.ends, settings)


def with_map(verdict: Verdict, results: Tables, ends: Ends, settings: Settings, design: Design | None) -> Verdict:
    """The verdict with that on the maps, which are read for it, or with their scores where there is a ``design``."""
    landmarks = landmarks_of(results, ends.filter)
    if design is not None:
        looked_at = ends.runs[: verdict.runs]
        return with_map_score(verdict, landmarks, 1 + int(looked_at.max(initial=-1)))
    return _with_map(verdict, landmarks, ends, settings)


def _with_map(verdict: Verdict, landmarks: Landmarks | None, ends: Ends, settings: Settings) -> Verdict:
    evidence = map_evidence(ends, landmarks)
    return with_map_score(verdict, landmarks, map_verdict=None if evidence is None else judge(evidence, settings))


def own_convention(c: Curves) -> str | None:
    """Convention of the filter's own error, None where it is the additive one."""
    return None if c.own is None else c.convention


def with_rejections(verdict: Verdict, c: Curves, runs: int | None = None) -> Verdict:
    """The verdict with the scores of a guard in runs 0 to ``runs`` - 1, or in all."""
    if c.rejections is None:
        return verdict
    return replace(verdict, rejection=rejection_score(*c.rejections.of_runs(runs)[1:]))


def with_map_score(
    verdict: Verdict, landmarks: Landmarks | None, runs: int | None = None, map_verdict: Verdict | None = None
) -> Verdict:
    """The verdict with the score of the maps of runs 0 to ``runs`` - 1, or of all, and with the verdict on them."""
    if landmarks is None:
        return verdict
    some = landmarks if runs is None else landmarks.of_runs(runs)
    return replace(verdict, map=replace(map_score(some.run, some.nees, landmarks.dof), verdict=map_verdict))


def map_evidence(ends: Ends, landmarks: Landmarks | None) -> Evidence | None:
    """The maps of one filter as the referee takes them, landmarks in the place of steps; None where none is judged.

    Landmarks that every map holds stand with their errors. Which runs saw the others depends on where the robot was,
    and so on the error: those count in the joint NEES only, unless there are no others.
    """
    if landmarks is None or not np.isfinite(landmarks.nees).any():
        return None
    judged, dof = np.isfinite(landmarks.nees), landmarks.dof
    some = landmarks if judged.all() else landmarks.where(judged)
    runs, row = np.unique(some.run, return_inverse=True)
    labels, column = np.unique(some.label, return_inverse=True)
    nees = np.full((len(runs), len(labels)), np.nan)
    nees[row, column] = some.nees
    error, covariance = np.full((*nees.shape, dof), np.nan), Symmetric.filled(nees.shape, dof)
    error[row, column] = some.error[:, :dof]
    for i, j in itertools.combinations_with_replacement(range(dof), 2):
        covariance.entry(i, j)[row, column] = some.covariance.entry(i, j)
    common = np.isfinite(nees).all(axis=0)
    kept = common if common.any() else np.full(len(labels), True)
    at: Any = slice(None) if kept.all() else kept  # a slice is no copy
    known = common.any() and bool(np.isfinite(error[:, at]).all())
    return Evidence(
        ends.filter,
        error[:, at] if known else None,
        covariance[:, at] if known else None,
        nees[:, at],
        dof=dof,
        failures=ends.failures,
        axes=POINT[:dof],
        runs=runs,
        landmarks=labels[kept],
        joint=_joint(ends, some, dof, runs, row, column, kept),
    )


def _joint(
    ends: Ends, some: Landmarks, width: int, runs: Indices, row: Indices, column: Indices, kept: Array
) -> JointNees | None:
    """NEES of pose and map together of ``runs``, in whose rows and columns the landmarks stand; None where not kept."""
    if ends.nees is None or np.isnan(some.joint).all():
        return None
    parts = np.full((len(runs), len(kept)), np.nan)
    parts[row, column] = some.joint
    pose = ends.nees[np.searchsorted(ends.runs, runs)]
    return JointNees(pose, np.bincount(row, some.joint), width * np.bincount(row), parts[:, kept], width)


def design_of(results: Tables) -> Design | None:
    """The plan of looks that the results were run by, if they were."""
    plan = results.manifest.get("until_decided")
    try:
        return sequential_design(**plan) if plan else None
    except (TypeError, ValueError) as error:
        raise InputError(f"manifest.json: key 'until_decided': {error}") from None


def evidence_of(c: Curves, runs: int | None = None, additive: bool = False) -> Evidence:
    """One filter's arrays as the referee takes them, in the filter's own error or in the additive one of the world.

    Only runs 0 to ``runs`` - 1, where that is given.
    """
    of = c.additive if additive else c.judged
    some = slice(None if runs is None else int(np.searchsorted(c.runs, runs)))
    numbers = c.runs[some]
    return Evidence(
        c.filter,
        None if of.error is None else of.error[some],
        of.covariance[some],
        None if of.nees is None else of.nees[some],
        nis=c.nis[some],
        nis_dof=c.nis_dof[some],
        optimal_gain=c.optimal_gain,
        failures=tuple(f for f in c.failures if f.run in numbers),
        axes=POSE,
        runs=numbers,
        skipped=c.skipped,
    )


def until_decided(c: Curves, design: Design) -> Verdict:
    """The verdict of the look that decided, or of the last one."""
    verdict, runs = follow(design, lambda runs: evidence_of(c, runs), len(c.runs))
    return beside(verdict, c, design, runs)


def beside(verdict: Verdict, c: Curves, design: Design, runs: int) -> Verdict:
    """The verdict of a look with what the same ``runs`` say in the additive error, looked at likewise, and the map."""
    world = None if c.own is None else follow(design, lambda n: evidence_of(c, n, additive=True), runs)[0]
    verdict = with_rejections(replace(verdict, world=world, convention=own_convention(c)), c, runs)
    return with_map_score(verdict, c.landmarks, runs)


def pilots_of(results: Tables, filters: Sequence[str] | None = None) -> dict[str, tuple[Array, int]]:
    """Results as pilots of :func:`consistency.referee.verdicts.options.plan`, of every filter or of those named."""
    return {
        c.filter: (_pilot_means(c), c.t.size) for c in (curves(results, name) for name in filters or results.filters)
    }


def _pilot_means(c: Curves) -> Array:
    """Mean NEES over dof of the runs that did not fail, (runs,)."""
    if c.judged.nees is None:
        raise InputError(f"{c.filter}: has no truth; only runs with a NEES tell how their steps depend on each other")
    means = run_means(c)
    means = means[np.isfinite(means)] / len(POSE)
    if len(means) < FEW:
        raise InputError(f"{c.filter}: a pilot needs at least {FEW} runs that did not fail, got {len(means)}")
    return np.asarray(means)
