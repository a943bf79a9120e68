"""From result tables to one filter's arrays over runs and steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from consistency.bench.filters.kernel.linalg import definiteness
from consistency.bench.store.parquet import Columns
from consistency.bench.store.results import JOINT, Tables
from consistency.referee.diagnostics import scale
from consistency.referee.diagnostics.blocks import by_runs, by_steps
from consistency.referee.diagnostics.skipping import Skip, Skipped, without_first
from consistency.referee.diagnostics.symmetric import Symmetric
from consistency.referee.errors import InputError
from consistency.referee.geometry.conventions import ADDITIVE, planar_error
from consistency.referee.reading import LARGEST_NUMBER, one_line
from consistency.referee.reading.columns import COLUMNS, COVARIANCE, OWN_COVARIANCE, POINT_COVARIANCE, POSE
from consistency.referee.types import Array, Failure, Indices


class Errors(NamedTuple):
    """Errors in one convention, with their covariance and NEES; R runs, T steps, NaN where a run has no value."""

    error: Array | None  # (R, T, 3), truth minus estimate; None without truth
    covariance: Symmetric  # (R, T, 3, 3)
    nees: Array | None  # (R, T)


class Landmarks(NamedTuple):
    """Landmarks in the maps after the last step; M of all runs."""

    run: Indices  # (M,)
    nees: Array  # (M,), NaN where the landmark is not judged
    label: Indices  # (M,)
    error: Array  # (M, 3), truth minus estimate, NaN where the truth is not known
    covariance: Symmetric  # (M, 3, 3)
    joint: Array  # (M,), NEES given the pose and the landmarks above it in its run; NaN where it was not kept

    @property
    def dof(self) -> int:
        """Degrees of freedom of a landmark: 3, or 2 in the plane."""
        return 3 if any(self.covariance.entry(2, j).any() for j in range(3)) else 2

    def of_runs(self, runs: int | None) -> Landmarks:
        """Those of runs 0 to ``runs`` - 1, or of all."""
        return self.where(self.run < (np.inf if runs is None else runs))

    def where(self, some: Array) -> Landmarks:
        """Rows for which ``some`` (M,) is true."""
        columns: tuple[Any, ...] = self
        return Landmarks(*(column[some] for column in columns))


class Rejections(NamedTuple):
    """What a guard did in each of N runs: counts of observations, (N,) each."""

    run: Indices
    offered: Indices
    spurious: Indices
    rejected: Indices
    hits: Indices  # rejected and spurious

    def of_runs(self, runs: int | None) -> Rejections:
        """Those of runs 0 to ``runs`` - 1, or of all."""
        some = self.run < (np.inf if runs is None else runs)
        return Rejections(*(column[some] for column in self))


class Ends(NamedTuple):
    """One filter's R runs, each by its last step."""

    filter: str
    runs: Indices  # (R,), run numbers
    nees: Array | None  # (R,), of the pose in the filter's own error, in the last step that has one
    failures: tuple[Failure, ...]


@dataclass(frozen=True)
class Curves:
    """One filter's results as arrays over (runs, steps); NaN where a run has no value."""

    filter: str
    runs: Indices  # (R,), run numbers
    t: Array  # (T,)
    covariance: Symmetric  # (R, T, 3, 3)
    error: Array | None  # (R, T, 3), truth minus estimate, heading wrapped
    nees: Array | None  # (R, T)
    nis: Array  # (R, T)
    nis_dof: Indices  # (R, T)
    failures: tuple[Failure, ...]
    optimal_gain: bool = False  # declared by the filter
    convention: str = ADDITIVE  # of the filter's own error
    own: Errors | None = None  # in that convention, where it is not the additive one
    landmarks: Landmarks | None = None  # None where no run has a map, or where they were not asked for
    rejections: Rejections | None = None  # None of a filter without a guard
    skipped: Skipped | None = None  # first steps that are left out, and NaN in all but the errors

    def without_first(self, skip: Skip | None) -> Curves:
        """The first steps of each run left out of the statistics; maps, which are of the last step, stay.

        Raises
        ------
        InputError
            Nothing is left.
        """
        own = self.own or Errors(None, None, None)  # type: ignore[arg-type]
        arrays = {"covariance": self.covariance, "nees": self.nees, "nis": self.nis, "nis_dof": self.nis_dof}
        arrays |= {"own_covariance": own.covariance, "own_nees": own.nees}
        try:
            rest, skipped = without_first(skip, arrays, self.filter, self.t)
        except ValueError as error:
            raise InputError(f"--{error}") from None
        new_own = Errors(own.error, rest.pop("own_covariance"), rest.pop("own_nees"))
        return replace(self, **rest, own=None if self.own is None else new_own, skipped=skipped)

    def of_run(self, run: int) -> Curves:
        """One run alone, R = 1, or none where there is no such run; maps and rejections are left out."""
        at = np.flatnonzero(self.runs == run)

        def some(values: Array | Symmetric | None) -> Any:
            return None if values is None else values[at]

        own = None if self.own is None else Errors(*map(some, self.own))
        return replace(
            self, runs=self.runs[at], covariance=self.covariance[at], error=some(self.error), nees=some(self.nees),
            nis=self.nis[at], nis_dof=self.nis_dof[at], own=own, landmarks=None, rejections=None,
            failures=tuple(failure for failure in self.failures if failure.run == run),
        )  # fmt: skip

    @property
    def ends(self) -> Ends:
        """What a verdict on the maps needs of the poses."""
        nees = self.judged.nees
        return Ends(self.filter, self.runs, None if nees is None else by_runs(_last_value, nees), self.failures)

    @property
    def additive(self) -> Errors:
        """The additive errors of the pose in the world."""
        return Errors(self.error, self.covariance, self.nees)

    @property
    def judged(self) -> Errors:
        """The errors that the filter states the covariance of."""
        return self.additive if self.own is None else self.own


def _last_value(nees: Array) -> Array:
    """The last value of each run that is a number, (runs, steps) -> (runs,); NaN where none is."""
    if not nees.size:
        return np.full(len(nees), np.nan)
    last = nees.shape[1] - 1 - np.argmax(np.isfinite(nees[:, ::-1]), axis=1)
    return np.asarray(nees[np.arange(len(nees)), last])


def curves(results: Tables, filter_name: str, steps: int | None = None, maps: bool = True) -> Curves:
    """Arrays of one filter; of results in a folder nothing else is read but, unless ``steps`` is known, the steps.

    Parameters
    ----------
    maps : False leaves the landmarks out, for :func:`landmarks_of` when the other arrays are needed no more

    Raises
    ------
    InputError
        The results hold no such filter, or lack the covariance of its own error.
    """
    if filter_name not in results.filters:
        raise InputError(f"filter '{filter_name}' is not in these results; there are: {', '.join(results.filters)}")
    broken = results.failures[results.failures["filter"] == filter_name]
    convention, runs = results.error_of(filter_name), results.runs_of(filter_name)
    steps = steps_of(results) if steps is None else steps
    shape = len(runs), steps
    pose, covariance = np.full((*shape, 3), np.nan), Symmetric.filled(shape, 3)
    own = None if convention == ADDITIVE else Symmetric.filled(shape, 3)
    nis, nis_dof = np.full(shape, np.nan), np.zeros(shape, np.int64)
    nees = np.full(shape, np.nan) if results.has_truth else None
    own_nees = None if own is None or nees is None else nees.copy()
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
        if own is not None:
            _require_own(batch, filter_name)
            _fill(own, at, batch, OWN_COVARIANCE)
        if own_nees is not None:
            own_nees.reshape(-1)[at] = batch["own_nees"]
    failures = tuple(
        Failure(filter_name, int(r), int(s), one_line(why, 2000)) for _, r, s, why in broken.itertuples(index=False)
    )
    own_error = _errors(results, runs, pose.copy(), t, convention) if own_nees is not None else None
    error = _errors(results, runs, pose, t) if results.has_truth else None
    _require_agreement(filter_name, runs, Errors(error, covariance, nees))
    _require_all(filter_name, runs, "nees", nees, covariance if own is None else own)
    if own is not None:
        _require_agreement(filter_name, runs, Errors(own_error, own, own_nees))
        _require_all(filter_name, runs, "own_nees", own_nees, own)
    _require_nis(filter_name, runs, nis, nis_dof)
    return Curves(
        filter_name, runs, t, covariance, error, nees, nis, nis_dof, failures,
        optimal_gain=filter_name in results.manifest.get("optimal_gain", []),
        convention=convention,
        own=None if own is None else Errors(own_error, own, own_nees),
        landmarks=landmarks_of(results, filter_name) if maps else None,
        rejections=_rejections(results, filter_name),
    )  # fmt: skip


def _places_of(runs: Indices, steps: int, batch: Columns) -> Any:
    """Where rows stand among the values of ``runs`` with ``steps`` each: a slice if one comes after the other."""
    at = np.searchsorted(runs, batch["run"]) * steps + batch["step"] - 1
    return slice(int(at[0]), int(at[-1]) + 1) if len(at) and (np.diff(at) == 1).all() else at


def _fill(covariance: Symmetric, at: Any, batch: Columns, columns: dict[str, tuple[int, int]]) -> None:
    for name, (i, j) in columns.items():
        covariance.entry(i, j).reshape(-1)[at] = batch[name]


def _require_own(batch: Columns, filter_name: str) -> None:
    for column in OWN_COVARIANCE:
        if np.isnan(batch[column]).any():
            raise InputError(
                f"estimates of '{filter_name}': column '{column}' is null, but manifest.json says that it has an "
                "error of its own; run it again"
            )


def _require_agreement(filter_name: str, runs: Indices, errors: Errors) -> None:
    """Refuse an error of so many standard deviations that no NEES can go with it: its square would overflow."""
    if errors.error is None or errors.nees is None:
        return

    def beyond(error: Array, covariance: Array, nees: Array) -> Array:
        variance = np.diagonal(covariance, axis1=-2, axis2=-1)
        too_large = np.abs(error) > np.sqrt(LARGEST_NUMBER * np.maximum(variance, 0.0))
        return np.asarray(np.isfinite(nees) & (too_large & (variance > 0)).any(axis=-1))

    bad = by_runs(beyond, errors.error, errors.covariance, errors.nees)
    if bad.any():
        row, step = np.argwhere(bad)[0]
        raise InputError(
            f"estimates of '{filter_name}', run {runs[row]}, step {step + 1}: the NEES is not that of the error and "
            "its covariance; the tables were changed or damaged; write them again"
        )


def _require_all(filter_name: str, runs: Indices, column: str, nees: Array | None, covariance: Symmetric) -> None:
    """Refuse a missing NEES from the first step on whose covariance, of the filter's own error, has full rank."""
    if nees is None:
        return
    steps = np.isfinite(covariance.entry(0, 0)).sum(axis=1)  # with an estimate, of each run
    first = by_runs(_first_number, nees)
    missing = np.isfinite(nees).sum(axis=1) < steps - np.minimum(first, steps)
    for row in np.flatnonzero((first > 0) & (steps > 0)):  # the last step without a NEES before those with one
        last = min(int(first[row]), int(steps[row])) - 1
        missing[row] |= definiteness(np.asarray(covariance[row, last])) == 1
    if missing.any():
        run = runs[int(np.argmax(missing))]
        raise InputError(
            f"estimates of '{filter_name}', run {run}: column '{column}' is null or NaN in a step whose covariance has "
            "full rank; the tables were changed or damaged; write them again"
        )


def _first_number(values: Array) -> Array:
    """Column of the first number in each row, the number of columns where none is."""
    there = np.isfinite(values)
    return np.where(there.any(axis=1), there.argmax(axis=1), values.shape[1]) if values.size else np.zeros(len(values))


def _require_nis(filter_name: str, runs: Indices, nis: Array, nis_dof: Indices) -> None:
    """Refuse a missing NIS in a step with degrees of freedom."""
    missing = by_runs(_lacks_nis, nis, nis_dof)
    if missing.any():
        raise InputError(
            f"estimates of '{filter_name}', run {runs[int(np.argmax(missing))]}: column 'nis' is null or NaN in a step "
            "whose nis_dof is not 0; the tables were changed or damaged; write them again"
        )


def _lacks_nis(nis: Array, nis_dof: Indices) -> Array:
    return np.asarray((np.isnan(nis) & (nis_dof > 0)).any(axis=1))


def _errors(results: Tables, runs: Indices, pose: Array, t: Array, convention: str = ADDITIVE) -> Array:
    """Errors in the place of ``pose``; NaN without truth. Fills ``t`` where every run had failed."""
    known = np.zeros(pose.shape[:2], bool)
    for batch in results.batches("truth", list(COLUMNS["truth"])):
        rows = (batch["step"] > 0) & np.isin(batch["run"], runs)
        row, column = np.searchsorted(runs, batch["run"][rows]), batch["step"][rows] - 1
        t[column] = np.where(np.isnan(t[column]), batch["t"][rows], t[column])
        true = np.stack([batch[axis][rows] for axis in POSE], axis=-1)
        pose[row, column] = planar_error(true, pose[row, column], convention)
        known[row, column] = True
    pose[~known] = np.nan
    return pose


def landmarks_of(results: Tables, filter_name: str) -> Landmarks | None:
    """Landmarks in the maps of one filter; None where no run has a map.

    Raises
    ------
    InputError
        The file is damaged.
    """
    batches = list(results.batches("map", results.map_numbers, filter_name))
    if not sum(len(batch["run"]) for batch in batches):
        return None
    rows = {column: np.concatenate([batch.pop(column) for batch in batches]) for column in results.map_numbers}
    entries = {place: rows[name] for name, place in POINT_COVARIANCE.items()}
    covariance = Symmetric([[entries[min(i, j), max(i, j)] for j in range(3)] for i in range(3)])
    error = _places(results, rows["landmark"])
    for i, axis in enumerate("xyz"):
        error[:, i] -= rows.pop(axis)
    joint = rows.get(JOINT, np.full(len(error), np.nan))
    return Landmarks(rows["run"], rows["nees"], rows["landmark"], error, covariance, joint)


def _rejections(results: Tables, filter_name: str) -> Rejections | None:
    if results.rejections is None:
        return None
    rows = results.rejections[results.rejections["filter"] == filter_name].drop(columns="filter")
    return Rejections(*(rows[column].to_numpy() for column in rows)) if len(rows) else None


def _places(results: Tables, labels: Indices) -> Array:
    """True positions (M, 3) of landmarks (M,), m; NaN where they are not known."""
    places = np.full((len(labels), 3), np.nan)
    if results.landmarks is not None and len(results.landmarks):
        table = results.landmarks.sort_values("landmark")
        known = table["landmark"].to_numpy()
        at = np.minimum(np.searchsorted(known, labels), len(known) - 1)
        here = known[at] == labels
        places[here] = table[list("xyz")].to_numpy()[at[here]]
    return places


def log_rmse(c: Curves, axes: Sequence[int]) -> Array:
    """log RMSE of some axes of the pose together in each run, in the world, shape (R,); NaN where it failed."""
    error = c.additive.error
    assert error is not None
    value: Array = 0.5 * np.log(np.square(error[:, :, list(axes)]).sum(axis=2).mean(axis=1))
    return value


def run_means(c: Curves) -> Array:
    """Mean NEES of each run over its judged steps, in the filter's own error, shape (R,); infinite for a failed run."""
    nees = c.judged.nees
    assert nees is not None
    means, count = scale.run_means(nees)
    means[count == 0] = np.inf
    means[np.isin(c.runs, [failure.run for failure in c.failures])] = np.inf
    return np.asarray(means)


def nis_ratio(c: Curves, runs: int) -> Array:
    """NIS of the first ``runs`` runs over their degrees of freedom in each step, (T,)."""
    return by_steps(_ratio, c.nis[:runs], c.nis_dof[:runs])


def _ratio(nis: Array, nis_dof: Array) -> Array:
    known = np.isfinite(nis) & (nis_dof > 0)
    dof = np.where(known, nis_dof, 0).sum(axis=0)
    total = np.where(known, nis, 0.0).sum(axis=0)
    return np.asarray(np.where(dof > 0, total / np.maximum(dof, 1), np.nan))


def wins(a: Curves, b: Curves) -> tuple[int, float]:
    """Runs in which ``a`` has the lower mean NEES than ``b``, and the two-sided p value of a sign test without ties."""
    better, worse = (int((run_means(x) < run_means(y)).sum()) for x, y in ((a, b), (b, a)))
    return better, float(stats.binomtest(better, better + worse).pvalue) if better + worse else 1.0


def steps_of(results: Tables) -> int:
    """Steps of the longest run, failed steps counted."""
    last = int(results.failures["step"].max()) if len(results.failures) else 0
    for table in ("estimates", "truth"):
        for batch in results.batches(table, ["step"]):
            last = max(last, int(batch["step"].max(initial=0)))
    return last
