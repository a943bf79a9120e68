"""Results of filters over runs: tables from arrays, kept in a folder and read back."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from pydantic import ValidationError

from consistency.bench.filters.compiled import one_blas_thread
from consistency.bench.filters.kernel.linalg import definiteness
from consistency.bench.scenario import Scenario, explain
from consistency.bench.store.parquet import OPTIONAL, Columns, columns_of, read_batches, read_parquet, require_table
from consistency.bench.store.soundness import require_manifest, require_rows
from consistency.bench.store.storage import require_unchanged, write_folder
from consistency.bench.types import Estimates, Map, Trial
from consistency.referee.diagnostics.landmarks import joint_nees
from consistency.referee.diagnostics.whitening import whiten
from consistency.referee.errors import InputError
from consistency.referee.geometry import pose_error
from consistency.referee.geometry.conventions import ADDITIVE, PLANAR, planar_error, planar_map_error
from consistency.referee.parsing import LARGEST_NUMBER
from consistency.referee.parsing.columns import COLUMNS, COVARIANCE, OWN_COVARIANCE, POINT_COVARIANCE, POSE
from consistency.referee.system.folders import read_manifest
from consistency.referee.types import Array, Failure, Indices

NUMBERS = [column for column in COLUMNS["estimates"] if column != "filter"]
OWN_NUMBERS = [*NUMBERS, *OPTIONAL["estimates"]]  # of a filter whose error is not the additive one
JOINT = "joint_nees"  # of a landmark, given the pose and the landmarks above it in the map of its run
MAP_NUMBERS = [*(column for column in COLUMNS["map"] if column != "filter"), JOINT]


class Rejected(NamedTuple):
    """How many observations a guard was offered in a run, and what it rejected; a row of ``rejections``."""

    filter: str
    run: int
    offered: int
    spurious: int
    rejected: int
    rejected_spurious: int


@dataclass(frozen=True)
class RunOutcome:
    """Results of one run: rows of the tables, by filter, and failures; ``machine`` did it, None for this one."""

    run: int
    estimates: dict[str, Columns]
    truth: Columns | None
    failures: tuple[Failure, ...]
    maps: dict[str, Columns] = field(default_factory=dict)
    rejections: tuple[Rejected, ...] = ()
    machine: dict[str, str] | None = None


class Tables(ABC):
    """Tables of the estimates of filters over a number of runs, in memory or in a folder."""

    manifest: dict[str, Any]
    failures: pd.DataFrame
    landmarks: pd.DataFrame | None
    rejections: pd.DataFrame | None  # of filters with a guard, None where there is none

    @abstractmethod
    def batches(self, table: str, columns: Sequence[str], filter_name: str | None = None) -> Iterator[Columns]:
        """Columns of ``estimates`` or ``map`` (of one filter) or ``truth``, some rows at a time; none without it."""

    @property
    @abstractmethod
    def has_truth(self) -> bool: ...

    @property
    @abstractmethod
    def has_joint(self) -> bool:
        """Whether maps are kept with their joint NEES, which older folders lack."""

    @property
    def map_numbers(self) -> list[str]:
        """Columns of ``map`` that hold numbers."""
        return [column for column in MAP_NUMBERS if column != JOINT or self.has_joint]

    @property
    def filters(self) -> list[str]:
        return list(self.manifest["filters"])

    def error_of(self, filter_name: str) -> str:
        """Convention of a filter's own error, "so2" unless the manifest says otherwise.

        Raises
        ------
        InputError
            The manifest names no such convention.
        """
        errors = self.manifest.get("error", {})
        error = errors.get(filter_name, ADDITIVE) if isinstance(errors, dict) else errors
        if error not in PLANAR:
            allowed = ", ".join(PLANAR)
            raise InputError(f"manifest.json: key 'error': must be one of {allowed} for each filter, got {error!r}")
        return str(error)

    def numbers_of(self, filter_name: str) -> list[str]:
        """Columns of ``estimates`` that hold numbers of a filter."""
        return NUMBERS if self.error_of(filter_name) == ADDITIVE else OWN_NUMBERS

    @property
    def scenario(self) -> Scenario | None:
        """The scenario, or None for a recorded log."""
        data = self.manifest.get("scenario")
        try:
            return Scenario.model_validate(data) if data else None
        except ValidationError as error:
            raise InputError(f"manifest.json: key 'scenario': {explain(error, Scenario)}") from None
        except (OverflowError, RecursionError) as error:
            raise InputError(f"manifest.json: key 'scenario': holds what cannot be used ({error})") from None

    def _repr_html_(self) -> str:
        """Summary of the results for a notebook; ``consistency.analyse`` judges them."""
        world = self.manifest.get("scenario") or {}
        title = f"Results of {world.get('name') or self.manifest.get('log') or 'runs'}"
        rows = "".join(
            f"<tr><th style='text-align:left'>{escape(name)}</th><td>{len(self.runs_of(name))}</td>"
            f"<td>{int((self.failures['filter'] == name).sum())}</td></tr>"
            for name in self.filters
        )
        truth = "with truth" if self.has_truth else "without truth"
        return (
            f"<div><p><strong>{escape(str(title))}</strong>, {truth}, seed {escape(str(self.manifest.get('seed')))}</p>"
            f"<table><tr><th>filter</th><th>runs</th><th>failed</th></tr>{rows}</table></div>"
        )

    def finished_runs(self, filters: Sequence[str]) -> set[int]:
        """Runs that every one of ``filters`` has finished, well or not."""
        per_filter = [{int(run) for run in self.runs_of(name)} for name in filters]
        return set.intersection(*per_filter) if per_filter else set()

    def runs_of(self, filter_name: str) -> Indices:
        """Numbers of the runs of one filter, failed ones too, sorted."""
        parts = [np.unique(batch["run"]) for batch in self.batches("estimates", ["run"], filter_name)]
        parts.append(self.failures.loc[self.failures["filter"] == filter_name, "run"].to_numpy())
        return np.unique(np.concatenate(parts)).astype(np.int64)


@dataclass(frozen=True)
class Results(Tables):
    """Estimates of filters over a number of runs, as tables in memory, laid out as in the files."""

    estimates: pd.DataFrame
    failures: pd.DataFrame
    truth: pd.DataFrame | None
    landmarks: pd.DataFrame | None
    manifest: dict[str, Any]
    map: pd.DataFrame | None = None
    rejections: pd.DataFrame | None = None

    @property
    def has_truth(self) -> bool:
        return self.truth is not None

    @property
    def has_joint(self) -> bool:
        return self.map is not None and JOINT in self.map

    def batches(self, table: str, columns: Sequence[str], filter_name: str | None = None) -> Iterator[Columns]:
        rows = {"truth": self.truth, "estimates": self.estimates, "map": self.map}[table]
        if rows is not None:
            selection = slice(None) if filter_name is None else (rows["filter"] == filter_name).to_numpy()
            yield {column: rows[column].to_numpy()[selection] for column in columns}

    def write(self, folder: Path, overwrite: bool = False, keep_others: bool = False) -> None:
        """Write the folder at once, as :func:`write_folder`: it appears complete or not at all."""
        tables = {"estimates": self.estimates, "failures": self.failures}
        optional = {
            "truth": self.truth, "landmarks": self.landmarks, "map": self.map, "rejections": self.rejections,
        }  # fmt: skip
        tables |= {name: table for name, table in optional.items() if table is not None}
        write_folder(folder, tables, self.manifest, overwrite=overwrite, keep_others=keep_others)


@dataclass(frozen=True)
class StoredResults(Tables):
    """Results in a folder: ``estimates``, ``truth`` and ``map`` are read at each access."""

    folder: Path
    failures: pd.DataFrame
    landmarks: pd.DataFrame | None
    manifest: dict[str, Any]
    rejections: pd.DataFrame | None = None

    @property
    def has_truth(self) -> bool:
        return "truth" in self.manifest.get("tables", [])

    @property
    def has_joint(self) -> bool:
        return "map" in self.manifest.get("tables", []) and JOINT in columns_of(self.folder, "map")

    @property
    def estimates(self) -> pd.DataFrame:
        return read_parquet(self.folder, "estimates")

    @property
    def truth(self) -> pd.DataFrame | None:
        return read_parquet(self.folder, "truth") if self.has_truth else None

    @property
    def map(self) -> pd.DataFrame | None:
        return read_parquet(self.folder, "map") if "map" in self.manifest.get("tables", []) else None

    def batches(self, table: str, columns: Sequence[str], filter_name: str | None = None) -> Iterator[Columns]:
        if table == "estimates" or table in self.manifest.get("tables", []):
            yield from read_batches(self.folder, table, columns, filter_name)


def joined(parts: Sequence[Results]) -> Results:
    """Results of several filters on the same trials as one."""
    manifest = parts[0].manifest | {
        "filters": [name for part in parts for name in part.filters],
        "optimal_gain": [name for part in parts for name in part.manifest.get("optimal_gain", [])],
        "failures": sum(len(part.failures) for part in parts),
        "wall_time_s": round(sum(part.manifest["wall_time_s"] for part in parts), 3),
    }
    errors = {name: error for part in parts for name, error in part.manifest.get("error", {}).items()}
    manifest |= {"error": errors} if errors else {}
    estimates = pd.concat([part.estimates for part in parts], ignore_index=True)
    maps = [part.map for part in parts if part.map is not None]
    map_ = pd.concat(maps, ignore_index=True) if maps else None
    failures = pd.concat([p.failures for p in parts if len(p.failures)] or [parts[0].failures], ignore_index=True)
    guarded = [part.rejections for part in parts if part.rejections is not None]
    rejections = pd.concat(guarded, ignore_index=True) if guarded else None
    return replace(parts[0], estimates=estimates, failures=failures, manifest=manifest, map=map_, rejections=rejections)


def outcome_of(trial: Trial, estimates: Sequence[Estimates]) -> RunOutcome:
    """Rows of the tables for one trial; a failed run has none from the failed step on.

    A run whose pose, covariance, NEES or NIS is beyond :data:`LARGEST_NUMBER` has failed in that step.
    """
    rows = [_rows(trial, e) for e in estimates]
    estimates = [e for e, _ in rows]
    return RunOutcome(
        trial.run,
        {e.filter: columns for e, columns in rows},
        None if trial.truth is None else _truth_columns(trial, trial.truth),
        tuple(e.failure for e in estimates if e.failure),
        {e.filter: _map_columns(trial, e, e.map) for e in estimates if e.map is not None and e.failure is None},
        tuple(_rejected(trial, e, e.rejected) for e in estimates if e.rejected is not None),
    )


def _rejected(trial: Trial, estimates: Estimates, rejected: Array) -> Rejected:
    """Counts over the observations up to the end of the run, or to the step before its failure."""
    rows = slice(trial.first[_last(trial, estimates)])
    spurious, rejected = trial.spurious[rows], rejected[rows]
    counts = (len(rejected), spurious.sum(), rejected.sum(), (rejected & spurious).sum())
    return Rejected(estimates.filter, trial.run, *(int(count) for count in counts))


def _rows(trial: Trial, estimates: Estimates) -> tuple[Estimates, Columns]:
    """Rows of ``estimates``, with what they are of: a run fails in the first step with a number that is too large."""
    last, own = _last(trial, estimates), estimates.own
    first = _full_rank((estimates.covariance if own is None else own)[:last])
    columns = _columns(trial, estimates, last, first)
    step, reason = _first_failure(columns, first, trial.truth is not None)
    if not step and estimates.map is not None and not _is_bounded(estimates.map):
        step, reason = last, f"a number in the map is beyond {LARGEST_NUMBER:g}"
    if not step:
        return estimates, columns
    failure = Failure(estimates.filter, estimates.run, step, reason)
    return replace(estimates, failure=failure, map=None), {key: values[: step - 1] for key, values in columns.items()}


def _first_failure(columns: Columns, first: int, has_truth: bool) -> tuple[int, str]:
    """First step with a number that is too large, and which; 0 without one. A NEES counts after step ``first``."""
    judged = columns["step"] > first if has_truth else np.zeros(len(columns["step"]), bool)
    everywhere = np.ones(len(judged), bool)
    numbers = {
        "NEES": (("nees", "own_nees"), judged), "NIS": (("nis",), columns["nis_dof"] > 0),
        "pose": (POSE, everywhere), "covariance": ((*COVARIANCE, *OWN_COVARIANCE), everywhere),
    }  # fmt: skip
    faults = []
    for kind, (names, counted) in numbers.items():
        size = np.max([np.abs(columns[name]) for name in names if name in columns], axis=0)  # NaN of any NaN
        bad = counted & ~(size <= LARGEST_NUMBER)
        if bad.any():
            at = int(bad.argmax())
            beyond = f"is beyond {LARGEST_NUMBER:g}" if np.isfinite(size[at]) else "is not finite"
            faults.append((at + 1, f"the {kind} {beyond}"))
    return min(faults, key=lambda fault: fault[0], default=(0, ""))


def _is_bounded(map_: Map) -> bool:
    return all(bool((np.abs(values) <= LARGEST_NUMBER).all()) for values in (map_.mean, map_.covariance))


def _last(trial: Trial, estimates: Estimates) -> int:
    """Steps with an estimate."""
    return estimates.failure.step - 1 if estimates.failure else trial.steps


def _columns(trial: Trial, estimates: Estimates, last: int, first: int) -> Columns:
    """Columns of steps 1..``last``; there is a NEES after step ``first``."""
    pose, P = estimates.pose[:last], estimates.covariance[:last]
    true = None if trial.truth is None else trial.truth[1 : last + 1]
    columns = {
        "run": np.full(last, estimates.run),
        "step": np.arange(1, last + 1),
        "t": trial.t[1 : last + 1],
        **dict(zip(POSE, pose.T, strict=True)),
        **{name: P[:, i, j] for name, (i, j) in COVARIANCE.items()},
        "nees": _nees(None if true is None else pose_error(true, pose), P, first),
        "nis": estimates.nis[:last],
        "nis_dof": estimates.nis_dof[:last],
    }
    if estimates.own is not None:
        P, error = estimates.own[:last], None if true is None else planar_error(true, pose, estimates.error)
        columns |= {name: P[:, i, j] for name, (i, j) in OWN_COVARIANCE.items()} | {"own_nees": _nees(error, P, first)}
    return columns


def _full_rank(P: Array) -> int:
    """First of the covariances (T, 3, 3) that has full rank, or T.

    That of the filter's own error decides: an additive one that is computed from it has small variances where there
    are none, left by rounding.
    """
    return next((k for k in range(len(P)) if definiteness(P[k]) == 1), len(P))


def _nees(error: Array | None, P: Array, first: int) -> Array:
    """NEES of one run, (T, 3) and (T, 3, 3) -> (T,); NaN before step ``first``."""
    value = np.full(len(P), np.nan)
    if error is not None:
        # the filter has answered for P: what nees() checks need not be checked again
        with np.errstate(over="ignore"):
            w = whiten(error[first:], P[first:])
            value[first:] = np.einsum("ki,ki->k", w, w)
    return value


def is_flat(covariance: Array) -> bool:
    """Whether landmarks (K, 3, 3) are in a plane: their heights are no variables."""
    return not covariance[:, 2].any()


def _map_columns(trial: Trial, estimates: Estimates, map_: Map) -> Columns:
    """Rows of ``map.parquet``; without NEES where the id is no landmark of the world, or its place is not known."""
    ids, count = map_.landmarks, len(map_.landmarks)
    nees, joint = np.full(count, np.nan), np.full(count, np.nan)
    if trial.landmarks is not None:
        judged = (ids < len(trial.landmarks)) & ~np.isin(ids, trial.things)
        n = 2 if is_flat(map_.covariance) else 3
        error = trial.landmarks[ids[judged]] - map_.mean[judged]
        w = whiten(error[:, :n], map_.covariance[judged, :n, :n])
        with np.errstate(over="ignore"):
            nees[judged] = _capped(np.einsum("ki,ki->k", w, w))
        joint[judged] = _joint_nees(trial, estimates, map_, judged)
    return {
        "run": np.full(count, trial.run),
        "landmark": ids if trial.labels is None else trial.labels[ids],
        **dict(zip("xyz", map_.mean.T, strict=True)),
        **{name: map_.covariance[:, i, j] for name, (i, j) in POINT_COVARIANCE.items()},
        "nees": nees,
        JOINT: np.where(np.isinf(joint), joint, _capped(joint)),
    }


def _capped(nees: Array) -> Array:
    """NEES of landmarks, no more than a table may hold."""
    return np.minimum(nees, LARGEST_NUMBER)


def _joint_nees(trial: Trial, estimates: Estimates, map_: Map, judged: Array) -> Array:
    """Parts (K,) of the joint NEES, in the filter's own error, of the landmarks that are ``judged``; NaN if not known.

    The part of a landmark is that given the pose and the landmarks before it: independent of the others, and
    chi-square with 3 degrees of freedom, or 2 in the plane, if the joint covariance is right.
    """
    if map_.joint is None or trial.truth is None or trial.landmarks is None:
        return np.full(int(judged.sum()), np.nan)
    ids, P = map_.landmarks[judged], map_.joint
    if not judged.all():
        kept = np.repeat(np.append(True, judged), 3)
        P = P[np.ix_(kept, kept)]
    with one_blas_thread():
        error, P = planar_map_error(
            trial.truth[-1], trial.landmarks[ids], estimates.pose[-1], map_.mean[judged], P, estimates.error
        )
        if is_flat(map_.covariance):
            flat = np.flatnonzero(np.append([1, 1, 1], np.tile([1, 1, 0], len(ids))))
            return joint_nees(error[flat], P[np.ix_(flat, flat)], dof=2)[1:]
        return joint_nees(error, P)[1:]


def _truth_columns(trial: Trial, path: Array) -> Columns:
    return {
        "run": np.full(len(path), trial.run),
        "step": np.arange(len(path)),
        "t": trial.t,
        **dict(zip(POSE, path.T, strict=True)),
    }


def estimates_table(parts: Sequence[tuple[str, Columns]], own: bool = False) -> pd.DataFrame:
    """``estimates.parquet`` of (filter, columns), one below the other; ``own``: with the columns of own errors."""
    table = _by_filter("estimates", parts)
    missing = [column for column in OPTIONAL["estimates"] if own and column not in table]
    return table.assign(**dict.fromkeys(missing, np.nan)) if missing else table


def map_table(parts: Sequence[tuple[str, Columns]]) -> pd.DataFrame | None:
    """``map.parquet`` of (filter, columns), one below the other; None without a row."""
    table = _by_filter("map", parts)
    return (table if JOINT in table else table.assign(**{JOINT: np.nan})) if len(table) else None


def _by_filter(name: str, parts: Sequence[tuple[str, Columns]]) -> pd.DataFrame:
    if not parts:
        return _empty(name)
    rows = [len(columns["run"]) for _, columns in parts]
    names = pd.Series([each for each, _ in parts], dtype="str").repeat(rows).reset_index(drop=True)
    return _table({"filter": names} | _stacked([columns for _, columns in parts]))


def _stacked(parts: Sequence[Columns]) -> Columns:
    """Columns of all parts, one below the other; NaN where a part lacks one."""
    names = dict.fromkeys(column for part in parts for column in part)
    return {
        column: np.concatenate([part[column] if column in part else _nothing(part) for part in parts])
        for column in names
    }


def _nothing(part: Columns) -> Array:
    return np.full(len(part["run"]), np.nan)


def _table(columns: dict[str, Any]) -> pd.DataFrame:
    """A table around columns that nobody else has: pandas would copy them, at millions of rows half the memory."""
    return pd.DataFrame(columns, copy=False)


def truth_table(parts: Sequence[Columns]) -> pd.DataFrame:
    """``truth.parquet`` of the columns of several runs."""
    return _table(_stacked(parts)) if parts else _empty("truth")


def truth_of(trials: Sequence[Trial]) -> pd.DataFrame:
    """``truth.parquet`` of the trials that have truth."""
    return truth_table([_truth_columns(trial, trial.truth) for trial in trials if trial.truth is not None])


def controls_table(trials: Sequence[Trial]) -> pd.DataFrame:
    """``controls.parquet``."""
    return pd.concat(
        [
            pd.DataFrame(
                {
                    "run": np.full(t.steps, t.run),
                    "step": np.arange(1, t.steps + 1),
                    **dict(zip(["dt", "v", "omega"], t.controls.T, strict=True)),
                }
            )
            for t in trials
        ],
        ignore_index=True,
    )


def observations_table(trials: Sequence[Trial]) -> pd.DataFrame:
    """``observations.parquet``; with a column ``source`` if a row is not of the landmark that it says."""
    labelled = any(t.source is not None for t in trials)
    return pd.concat(
        [
            pd.DataFrame(
                {
                    "run": np.full(len(t.landmark), t.run),
                    "step": np.repeat(np.arange(1, t.steps + 1), np.diff(t.first)),
                    "landmark": t.landmark,
                    **dict(zip(["z0", "z1", "z2"], t.z.T, strict=False)),
                    **({"source": t.landmark if t.source is None else t.source} if labelled else {}),
                }
            )
            for t in trials
        ],
        ignore_index=True,
    )


def failures_table(failures: Sequence[Failure]) -> pd.DataFrame:
    """``failures.parquet``."""
    if not failures:
        return _empty("failures")
    rows = [(f.filter, f.run, f.step, f.reason) for f in failures]
    return pd.DataFrame(rows, columns=list(COLUMNS["failures"])).astype(COLUMNS["failures"])


def rejections_table(rows: Sequence[Rejected]) -> pd.DataFrame | None:
    """``rejections.parquet``; None without a row."""
    if not rows:
        return None
    return pd.DataFrame(rows, columns=list(COLUMNS["rejections"])).astype(COLUMNS["rejections"])


def _empty(name: str) -> pd.DataFrame:
    return pd.DataFrame({column: pd.Series(dtype=kind) for column, kind in COLUMNS[name].items()})


def open_results(folder: str | Path) -> StoredResults:
    """A folder written by ``consistency run``, whose large tables stay on disk.

    Raises
    ------
    InputError
        A file is missing, cut short, not as it was written, or lacks a column, a filter, a run or a step; the numbers
        in its rows are checked when they are read.
    """
    folder = Path(folder)
    manifest = read_manifest(folder)
    require_manifest(folder, manifest)
    written = manifest["tables"]
    for name in ("estimates", *(name for name in ("truth", "map") if name in written)):
        require_table(folder, name)
    require_unchanged(folder, manifest)
    landmarks = read_parquet(folder, "landmarks") if "landmarks" in written else None
    rejections = read_parquet(folder, "rejections") if "rejections" in written else None
    results = StoredResults(folder, read_parquet(folder, "failures"), landmarks, manifest, rejections)
    if OWN_NUMBERS in map(results.numbers_of, results.filters):
        require_table(folder, "estimates", OWN_NUMBERS)
    require_rows(folder, manifest, results.scenario, results.failures, rejections, landmarks)
    return results


def read_results(folder: str | Path) -> Results:
    """Read a folder written by ``consistency run`` into memory.

    Raises
    ------
    InputError
        A file is missing, cut short, or lacks a column.
    """
    stored = open_results(folder)
    return Results(
        stored.estimates, stored.failures, stored.truth, stored.landmarks, stored.manifest, stored.map,
        stored.rejections,
    )  # fmt: skip
