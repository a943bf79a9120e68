"""Results of the bench as records of the referee, verdicts on them, and what they say run by run.

Beside the error of its own, which a filter states the covariance of, a record has the additive one of the pose in the
world. Maps are read when they are asked for.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from scipy import stats

from consistency.bench.store.parquet import Columns
from consistency.bench.store.results import JOINT, Tables, open_results
from consistency.referee.column_names import COLUMNS, COVARIANCE, OWN_COVARIANCE, POINT_COVARIANCE, POSE
from consistency.referee.diagnostics import scale
from consistency.referee.diagnostics.planning import Design, sequential_design
from consistency.referee.diagnostics.record import (
    Errors,
    InnovationRecord,
    JointNees,
    Map,
    MapRecord,
    Record,
    Rejections,
    Runs,
    Skip,
    TruthFit,
)
from consistency.referee.diagnostics.verdict import Verdict
from consistency.referee.diagnostics.verdict_parts import Settings
from consistency.referee.diagnostics.whitening import by_runs, by_steps
from consistency.referee.errors import InputError
from consistency.referee.geometry import ADDITIVE, planar_error
from consistency.referee.parsing import LARGEST_NUMBER, one_line
from consistency.referee.readers.formats.innovation_files import NisLog, choose
from consistency.referee.readers.formats.sheet import checked_dof
from consistency.referee.types import Array, Failure, Indices
from consistency.referee.verdicts.judge_sources import Source, judge_all

INNOVATIONS = ["run", "step", "t", "nis", "nis_dof"]
POINT = ("x", "y", "z")

if TYPE_CHECKING:
    from consistency.bench.store.results import Tables

    AnyResults = Source | Sequence[Record] | Tables | str | Path


def analyse(
    results: AnyResults,
    filters: Sequence[str] | None = None,
    confidence: float | None = None,
    settings: Settings | None = None,
    skip: str | float | Skip | None = None,
    optimal_gain: bool = False,
) -> dict[str, Verdict]:
    """Judge every filter of the results, or those named.

    Parameters
    ----------
    results : of ``consistency.run_trials``, a folder of them, or a sequence of records
    confidence : 1 - the false-alarm rate of a verdict, in place of ``settings``
    settings : what to ask; the defaults of :class:`Settings` where None. Results of a run until decided are then
        judged as that run was.
    skip : first steps (20) or seconds ("2s") of each run to leave out of the statistics, chosen on other data
    optimal_gain : the filters declare one, so that their innovations are judged; results say it themselves

    Raises
    ------
    InputError
        Unknown filter, a confidence outside (0, 1), or nothing is left.
    """
    if isinstance(results, Source | list | tuple):
        source: Source | Sequence[Record] = results
    else:
        source = results_source(cast("Tables | str | Path", results))
    return judge_all(source, filters, confidence, settings, skip, optimal_gain)


def records_of_results(results: Tables, filters: Sequence[str] | None = None) -> Iterator[Record]:
    """A record for every filter of the results, or for those named, each read when it is asked for."""
    steps = longest_run(results)
    return (record_of(results, name, steps) for name in filters or results.filters)


def record_of(results: Tables, filter_name: str, steps: int | None = None) -> Record:
    """One filter; of results in a folder nothing else is read but, unless ``steps`` is known, the steps.

    Raises
    ------
    InputError
        The results hold no such filter, or lack the covariance of its own error.
    """
    if filter_name not in results.filters:
        raise InputError(f"filter '{filter_name}' is not in these results; there are: {', '.join(results.filters)}")
    failed_runs = results.failures[results.failures["filter"] == filter_name]
    convention, runs = results.error_of(filter_name), results.runs_of(filter_name)
    steps = longest_run(results) if steps is None else steps
    shape = len(runs), steps
    pose, covariance = np.full((*shape, 3), np.nan), np.full((*shape, 3, 3), np.nan)
    own_covariance = None if convention == ADDITIVE else covariance.copy()
    nis, nis_dof = np.full(shape, np.nan), np.zeros(shape, np.int64)
    nees = np.full(shape, np.nan) if results.has_truth else None
    own_nees = None if own_covariance is None or nees is None else nees.copy()
    t = np.full(steps, np.nan)
    for batch in results.batches("estimates", results.numbers_of(filter_name), filter_name):
        if (batch["step"] < 1).any():
            raise InputError(f"estimates of '{filter_name}': column 'step' must be at least 1")
        at = _places_of(runs, steps, batch)
        for i, axis in enumerate(POSE):
            pose.reshape(-1, 3)[at, i] = batch[axis]
        _fill(covariance, at, batch, COVARIANCE)
        nis.reshape(-1)[at], nis_dof.reshape(-1)[at], t[batch["step"] - 1] = batch["nis"], batch["nis_dof"], batch["t"]
        if nees is not None:
            nees.reshape(-1)[at] = batch["nees"]
        if own_covariance is not None:
            _require_own(batch, filter_name)
            _fill(own_covariance, at, batch, OWN_COVARIANCE)
        if own_nees is not None:
            own_nees.reshape(-1)[at] = batch["own_nees"]
    failures = tuple(
        Failure(filter_name, int(run), int(step), one_line(reason, 2000))
        for _, run, step, reason in failed_runs.itertuples(index=False)
    )
    dof = len(POSE) if results.has_truth else 0
    own_error = _errors(results, runs, pose.copy(), t, convention) if own_nees is not None else None
    error = _errors(results, runs, pose, t) if results.has_truth else None
    record = Record(
        filter_name,
        Errors(error, covariance, nees, dof, POSE),
        InnovationRecord(nis, nis_dof, optimal_gain=filter_name in results.manifest.get("optimal_gain", [])),
        Runs(runs, t=t),
        failures,
        fit=TruthFit(align=""),
        map=Map(partial(map_of, results, filter_name, runs, failures), _rejections(results, filter_name)),
    )
    _require_agreement(record)
    _require_all(record, "nees", covariance if own_covariance is None else own_covariance)
    if own_covariance is not None:
        own_errors = Errors(own_error, own_covariance, own_nees, dof, POSE, convention=convention)
        record = replace(record, errors=own_errors, world=record.errors)
        _require_agreement(record)
        _require_all(record, "own_nees", own_covariance)
    _require_nis(filter_name, runs, nis, nis_dof)
    return record


def _places_of(runs: Indices, steps: int, batch: Columns) -> Any:
    """Where rows stand among the values of ``runs`` with ``steps`` each: a slice if one comes after the other."""
    rows = np.searchsorted(runs, batch["run"]) * steps + batch["step"] - 1
    return slice(int(rows[0]), int(rows[-1]) + 1) if len(rows) and (np.diff(rows) == 1).all() else rows


def _fill(covariance: Array, at: Any, batch: Columns, columns: dict[str, tuple[int, int]]) -> None:
    for name, (i, j) in columns.items():
        covariance.reshape(-1, 3, 3)[at, i, j] = batch[name]
        covariance.reshape(-1, 3, 3)[at, j, i] = batch[name]


def _require_own(batch: Columns, filter_name: str) -> None:
    for column in OWN_COVARIANCE:
        if np.isnan(batch[column]).any():
            raise InputError(
                f"estimates of '{filter_name}': column '{column}' is null, but manifest.json says that it has an "
                "error of its own; run it again"
            )


def _require_agreement(r: Record) -> None:
    """Refuse an error of so many standard deviations that no NEES can go with it: its square would overflow."""
    if r.errors.error is None or r.errors.covariance is None or r.errors.nees is None:
        return

    def beyond(error: Array, covariance: Array, nees: Array) -> Array:
        variance = np.diagonal(covariance, axis1=-2, axis2=-1)
        too_large = np.abs(error) > np.sqrt(LARGEST_NUMBER * np.maximum(variance, 0.0))
        return np.asarray(np.isfinite(nees) & (too_large & (variance > 0)).any(axis=-1))

    impossible = by_runs(beyond, r.errors.error, r.errors.covariance, r.errors.nees)
    if impossible.any():
        run_row, step = np.argwhere(impossible)[0]
        raise InputError(
            f"estimates of '{r.name}', run {r.run_numbers[run_row]}, step {step + 1}: the NEES is not that of the "
            "error and its covariance; the tables were changed or damaged; write them again"
        )


def _require_all(r: Record, column: str, covariance: Array) -> None:
    """Refuse a missing NEES from the first step on whose covariance, of the filter's own error, has full rank."""
    if r.errors.nees is None:
        return
    from consistency.bench.filters.kernel.linalg import definiteness  # loads Numba

    steps = np.isfinite(covariance[..., 0, 0]).sum(axis=1)  # with an estimate, of each run
    first = by_runs(_first_number, r.errors.nees)
    missing = np.isfinite(r.errors.nees).sum(axis=1) < steps - np.minimum(first, steps)
    for row in np.flatnonzero((first > 0) & (steps > 0)):  # the last step without a NEES before those with one
        last = min(int(first[row]), int(steps[row])) - 1
        missing[row] |= definiteness(covariance[row, last]) == 1
    if missing.any():
        run = r.run_numbers[int(np.argmax(missing))]
        raise InputError(
            f"estimates of '{r.name}', run {run}: column '{column}' is null or NaN in a step whose covariance has "
            "full rank; the tables were changed or damaged; write them again"
        )


def _first_number(values: Array) -> Array:
    """Column of the first number in each row, the number of columns where none is."""
    is_number = np.isfinite(values)
    if not values.size:
        return np.zeros(len(values))
    return np.asarray(np.where(is_number.any(axis=1), is_number.argmax(axis=1), values.shape[1]))


def _require_nis(filter_name: str, runs: Indices, nis: Array, nis_dof: Indices) -> None:
    """Refuse a missing NIS in a step with degrees of freedom."""
    missing = by_runs(lambda nis, dof: np.asarray((np.isnan(nis) & (dof > 0)).any(axis=1)), nis, nis_dof)
    if missing.any():
        raise InputError(
            f"estimates of '{filter_name}', run {runs[int(np.argmax(missing))]}: column 'nis' is null or NaN in a step "
            "whose nis_dof is not 0; the tables were changed or damaged; write them again"
        )


def _errors(results: Tables, runs: Indices, pose: Array, t: Array, convention: str = ADDITIVE) -> Array:
    """Errors in the place of ``pose``; NaN without truth. Fills ``t`` where every run had failed."""
    has_truth = np.zeros(pose.shape[:2], bool)
    for batch in results.batches("truth", list(COLUMNS["truth"])):
        after_start = (batch["step"] > 0) & np.isin(batch["run"], runs)
        row, column = np.searchsorted(runs, batch["run"][after_start]), batch["step"][after_start] - 1
        t[column] = np.where(np.isnan(t[column]), batch["t"][after_start], t[column])
        true_pose = np.stack([batch[axis][after_start] for axis in POSE], axis=-1)
        pose[row, column] = planar_error(true_pose, pose[row, column], convention)
        has_truth[row, column] = True
    pose[~has_truth] = np.nan
    return pose


def map_of(
    results: Tables, filter_name: str, of_poses: Indices, failures: tuple[Failure, ...] = ()
) -> MapRecord | None:
    """Landmarks in the maps of one filter; None where no run has a map.

    Parameters
    ----------
    of_poses : (runs,), numbers of the runs of its poses

    Raises
    ------
    InputError
        The file is damaged.
    """
    batches = list(results.batches("map", results.map_numbers, filter_name))
    if not sum(len(batch["run"]) for batch in batches):
        return None
    rows = {column: np.concatenate([batch.pop(column) for batch in batches]) for column in results.map_numbers}
    covariance = np.empty((len(rows["run"]), 3, 3))
    for name, (i, j) in POINT_COVARIANCE.items():
        covariance[:, i, j] = covariance[:, j, i] = rows.pop(name)
    error = _places(results, rows["landmark"])
    for i, axis in enumerate("xyz"):
        error[:, i] -= rows.pop(axis)
    joint = rows.get(JOINT)  # not kept in older folders
    dof = 3 if covariance[:, 2].any() else 2

    def record(last: Array | None) -> Record | None:
        """The landmarks that are judged, in the place of steps; None where none is.

        Landmarks that every map holds stand with their errors. Which runs saw the others depends on where the robot
        was, and so on the error: those count in the joint NEES only, unless there are no others.
        """
        judged = np.isfinite(rows["nees"])
        if not judged.any():
            return None
        judged_rows: Any = slice(None) if judged.all() else judged  # a slice is not a copy
        runs, row = np.unique(rows["run"][judged_rows], return_inverse=True)
        labels, column = np.unique(rows["landmark"][judged_rows], return_inverse=True)
        nees = np.full((len(runs), len(labels)), np.nan)
        nees[row, column] = rows["nees"][judged_rows]
        errors, covariances = np.full((*nees.shape, dof), np.nan), np.full((*nees.shape, dof, dof), np.nan)
        errors[row, column] = error[judged_rows, :dof]
        covariances[row, column] = covariance[judged_rows, :dof, :dof]
        common = np.isfinite(nees).all(axis=0)
        landmarks_kept = common if common.any() else np.full(len(labels), True)
        at: Any = slice(None) if landmarks_kept.all() else landmarks_kept
        has_errors = common.any() and bool(np.isfinite(errors[:, at]).all())
        joint_nees = None
        if last is not None and joint is not None:
            pose_nees = last[np.searchsorted(of_poses, runs)]
            joint_nees = _joint(pose_nees, joint[judged_rows], dof, row, column, landmarks_kept)
        own = Errors(nees=nees[:, at], dof=dof, axes=POINT[:dof])
        if has_errors:
            own = replace(own, error=errors[:, at], covariance=covariances[:, at])
        of_map = Map(landmarks=labels[landmarks_kept], joint=joint_nees)
        return Record(filter_name, own, runs=Runs(runs), failures=failures, map=of_map)

    return MapRecord(rows["run"], rows["nees"], dof, record)


def _joint(pose: Array, joint: Array, width: int, row: Indices, column: Indices, kept: Array) -> JointNees | None:
    """NEES of pose and map together, of landmarks that stand in these rows and columns; None where it was not kept."""
    if np.isnan(joint).all():
        return None
    parts = np.full((len(pose), len(kept)), np.nan)
    parts[row, column] = joint
    return JointNees(pose, np.bincount(row, joint), width * np.bincount(row), parts[:, kept], width)


def _rejections(results: Tables, filter_name: str) -> Rejections | None:
    if results.rejections is None:
        return None
    rows = results.rejections[results.rejections["filter"] == filter_name].drop(columns="filter")
    return Rejections(*(rows[column].to_numpy() for column in rows)) if len(rows) else None


def _places(results: Tables, labels: Indices) -> Array:
    """True positions (M, 3) of landmarks (M,), m; NaN where they are not known."""
    places = np.full((len(labels), 3), np.nan)
    if results.landmarks is not None and len(results.landmarks):
        landmark_table = results.landmarks.sort_values("landmark")
        known_landmarks = landmark_table["landmark"].to_numpy()
        nearest = np.minimum(np.searchsorted(known_landmarks, labels), len(known_landmarks) - 1)
        is_known = known_landmarks[nearest] == labels
        places[is_known] = landmark_table[list("xyz")].to_numpy()[nearest[is_known]]
    return places


def longest_run(results: Tables) -> int:
    """Steps of the longest run, failed steps counted."""
    last = int(results.failures["step"].max()) if len(results.failures) else 0
    for table in ("estimates", "truth"):
        for batch in results.batches(table, ["step"]):
            last = max(last, int(batch["step"].max(initial=0)))
    return last


def design_of(results: Tables) -> Design | None:
    """The plan of looks that the results were run by, if they were."""
    plan = results.manifest.get("until_decided")
    try:
        return sequential_design(**plan) if plan else None
    except (TypeError, ValueError) as error:
        raise InputError(f"manifest.json: key 'until_decided': {error}") from None


def results_source(results: Tables | str | Path) -> Source:
    """Return results of a run, in memory or in a folder, as a source of records.

    Raises
    ------
    InputError
        The folder is damaged; the records raise as :func:`record_of`.
    """
    tables = results if isinstance(results, Tables) else open_results(results)
    manifest, steps = tables.manifest, cache(partial(longest_run, tables))
    unfinished = ""
    if not manifest.get("complete", True):
        unfinished = f"only {manifest['finished_runs']} of {manifest['runs']} runs are there"
    world = manifest.get("scenario_hash") or manifest.get("log_sha256")
    return Source(
        tables.filters,
        lambda name: record_of(tables, name, steps()),
        partial(design_of, tables),
        tables.has_truth,
        scenario=(manifest.get("scenario") or {}).get("name"),
        trials=(world, manifest.get("seed")),
        unfinished=unfinished,
    )


def innovations_of(folder: Path, filter_name: str | None, run: int | None) -> NisLog:
    """Innovations of one run in a folder of results.

    Raises
    ------
    InputError
        There are several filters or runs and none is named, or a value is missing.
    """
    results = open_results(folder)
    name = choose(folder, "filter", results.filters, filter_name)
    run_number = choose(folder, "run", results.runs_of(name).tolist(), run)
    nis_parts = []
    for batch in results.batches("estimates", INNOVATIONS, name):
        rows = batch["run"] == run_number
        nis_parts.append(np.stack([batch[column][rows].astype(float) for column in INNOVATIONS[1:]]))
    step, t, nis, dof = np.concatenate(nis_parts, axis=1) if nis_parts else np.empty((4, 0))
    if not len(step):
        raise InputError(f"{folder}: run {run_number} of '{name}' failed before its first estimate")
    order = np.argsort(step, kind="stable")
    step, t, nis, dof = step[order], t[order], nis[order], dof[order]
    return NisLog(
        name, step, t, nis, checked_dof(nis, dof, lambda row: f"{folder}, run {run_number}, step {step[row]:g}")
    )


def log_rmse(of: Record, axes: Sequence[int]) -> Array:
    """log RMSE of some axes of the pose together in each run, in the world, shape (R,); NaN where it failed."""
    error = of.in_world.errors.error
    assert error is not None
    value: Array = 0.5 * np.log(np.square(error[:, :, list(axes)]).sum(axis=2).mean(axis=1))
    return value


def mean_nees_of_runs(of: Record) -> Array:
    """Mean NEES of each run over its judged steps, in the filter's own error, shape (R,); infinite for a failed run."""
    assert of.errors.nees is not None
    means, count = scale.run_means(of.errors.nees)
    means[count == 0] = np.inf
    means[np.isin(of.run_numbers, [failure.run for failure in of.failures])] = np.inf
    return np.asarray(means)


def nis_ratio(of: Record, runs: int) -> Array:
    """NIS of the first ``runs`` runs over their degrees of freedom in each step, (T,)."""
    assert of.innovations.nis is not None
    assert of.innovations.nis_dof is not None
    return by_steps(_ratio, of.innovations.nis[:runs], of.innovations.nis_dof[:runs])


def _ratio(nis: Array, nis_dof: Array) -> Array:
    has_nis = np.isfinite(nis) & (nis_dof > 0)
    dof = np.where(has_nis, nis_dof, 0).sum(axis=0)
    total = np.where(has_nis, nis, 0.0).sum(axis=0)
    return np.asarray(np.where(dof > 0, total / np.maximum(dof, 1), np.nan))


def wins(a: Record, b: Record) -> tuple[int, float]:
    """Runs in which ``a`` has the lower mean NEES than ``b``, and the two-sided p value of a sign test without ties."""
    better, worse = (int((mean_nees_of_runs(x) < mean_nees_of_runs(y)).sum()) for x, y in ((a, b), (b, a)))
    return better, float(stats.binomtest(better, better + worse).pvalue) if better + worse else 1.0
