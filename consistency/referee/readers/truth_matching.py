"""Matching of estimates to the truth, which is interpolated on its manifold, and to the steps of other runs.

:class:`Poses` is a run before any error is taken, and :class:`Estimator` is what every reader gives.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from consistency.referee.diagnostics.record import Bound
from consistency.referee.diagnostics.whitening import ROUNDED
from consistency.referee.geometry import planar_error, wrap
from consistency.referee.readers.places import Places
from consistency.referee.types import Array, Indices

AXES: tuple[str, ...] = ("x", "y", "z", "roll", "pitch", "yaw")  # from roll on a rotation vector
REST = ("vx", "vy", "vz", "bgx", "bgy", "bgz", "bax", "bay", "baz")  # velocity, biases of gyroscope and accelerometer
STATE = (*AXES, *REST)
Manifold = Literal["vector", "planar", "spatial"]  # plain; x, y, heading; x, y, z, a quaternion x, y, z, w and more
BRIDGED = 0.1  # s between two samples of the truth that are always interpolated: a period of 10 Hz
Files = tuple[Path | str, Path | str]  # of the estimates, of the truth
ROUNDING = 1e-6  # s: a double holds the seconds since 1970 to a quarter of that


def manifold_of(convention: str) -> Manifold:
    """What errors of a convention live on, of states and of poses in the plane."""
    return "vector" if convention == "vector" else "planar"


def common_steps(steps: Sequence[Array]) -> tuple[list[Indices], Array]:
    """Columns of every run and the step number of every column: the different steps, in order.

    (k,) step numbers for each run -> (k,) columns for each run, and (steps,) numbers.
    """
    numbers = np.unique(np.concatenate(steps))
    return [np.searchsorted(numbers, own).astype(np.int64) for own in steps], numbers


def common_times(times: Sequence[Array]) -> tuple[list[Indices], Array]:
    """Columns of every run and the time of every column, from timestamps in s.

    (k,) times for each run -> (k,) columns for each run, and (steps,) times. Where every run keeps to the timestamps of
    the longest one the columns are its timestamps. Otherwise, as with recordings of different days, estimates are
    counted from the first on, and no column has a time.
    """
    longest = max(times, key=len)
    columns = []
    for own in times:
        near = np.clip(np.searchsorted(longest, own - ROUNDING), 0, len(longest) - 1)
        if (np.abs(longest[near] - own) > ROUNDING).any():
            counted = [np.arange(len(each)) for each in times]
            return counted, np.full(len(longest), np.nan)
        columns.append(near.astype(np.int64))
    return columns, longest


def associate(times: Array, reference: Array, max_dt: float) -> tuple[Indices, Indices]:
    """Indices (k,) of ``times`` (N,) and of their nearest neighbours in ``reference`` (M,), both increasing, in s.

    Pairs further apart than ``max_dt`` are left out. Where two timestamps have the same neighbour the nearer one
    keeps it.
    """
    before = np.clip(np.searchsorted(reference, times, side="right") - 1, 0, None)
    found = nearest(times, reference, before)
    distance = np.abs(reference[found] - times)
    order = np.lexsort((distance, found))
    order = order[distance[order] <= max_dt + ROUNDING]
    _, first = np.unique(found[order], return_index=True)
    own = np.sort(order[first])
    return own, found[own]


class Known(NamedTuple):
    """Estimates whose truth is known, k of N."""

    rows: Indices  # (k,), which of the estimates
    truth: Array  # (k, m)
    before: Indices  # (k,), the sample of the truth at or before each
    apart: Array  # (k,), s to the nearest sample
    bend: Array  # (k,), what the interpolation may be off by in the first three components, or two in the plane


def truth_at(times: Array, reference: Array, values: Array, manifold: Manifold, max_dt: float) -> Known:
    """The truth at ``times`` (N,), s, from samples at ``reference`` (M,), increasing, with ``values`` (M, m).

    Between two samples at most ``BRIDGED`` apart, and between any two where the nearer one is within ``max_dt``, the
    truth moves evenly: straight, and about one axis (Shoemake 1985 for quaternions). Before the first and after the
    last one it is that sample, up to ``max_dt``.
    """
    last = len(reference) - 1
    before = np.clip(np.searchsorted(reference, times, side="right") - 1, 0, last)
    after = np.minimum(before + 1, last)
    gap = reference[after] - reference[before]
    inside = (times >= reference[before]) & (times <= reference[after]) & (gap > 0)
    apart = np.minimum(np.abs(times - reference[before]), np.abs(reference[after] - times))
    rows = np.flatnonzero((apart <= max_dt + ROUNDING) | (inside & (gap <= BRIDGED + ROUNDING)))
    before = before[rows]
    after = after[rows]
    gap = gap[rows]
    inside = inside[rows]
    apart = apart[rows]
    share = np.where(inside, (times[rows] - reference[before]) / np.where(gap > 0, gap, 1.0), 0.0)
    start = values[np.where(inside, before, nearest(times[rows], reference, before))]
    truth = _between(start, values[after], share, manifold)
    width = 2 if manifold == "planar" else 3
    bend = _bends(values[:, :width], before) * 4.0 * share * (1.0 - share)
    return Known(rows, truth, before, apart, bend)


def nearest(times: Array, reference: Array, before: Indices) -> Indices:
    """The nearest sample to each of ``times`` (k,), from the one at or before it."""
    after = np.minimum(before + 1, len(reference) - 1)
    is_later = np.abs(times - reference[after]) < np.abs(times - reference[before])
    return np.where(is_later, after, before)


def _between(start: Array, end: Array, share: Array, manifold: Manifold) -> Array:
    """Values (k, m) a ``share`` (k,) of the way from ``start`` to ``end``; the bits of ``start`` at its beginning."""
    step = end - start
    if manifold == "planar":
        step[:, 2] = wrap(step[:, 2])
    out = start + share[:, None] * step
    if manifold == "planar":
        out[:, 2] = wrap(out[:, 2])
    turned = np.flatnonzero(share > 0.0)
    if manifold == "spatial" and len(turned):
        from scipy.spatial.transform import Rotation  # half of what a planar log would load

        first = Rotation.from_quat(start[turned, 3:7])
        second = Rotation.from_quat(end[turned, 3:7])
        way = (first.inv() * second).as_rotvec()
        turn = Rotation.from_rotvec(share[turned, None] * way)
        out[turned, 3:7] = (first * turn).as_quat()
    out[share == 0.0] = start[share == 0.0]
    return np.asarray(out)


def _bends(position: Array, after: Indices) -> Array:
    """Greatest distance (k,) between a path of even acceleration and its chord, after some samples of (M, d)."""
    last = len(position) - 2  # the last sample with a second difference
    if last < 1:
        return np.zeros(len(after))

    def second(sample: Indices) -> Array:
        k = np.clip(sample, 1, last)
        difference = (position[k + 1] - position[k]) - (position[k] - position[k - 1])
        return np.asarray(np.linalg.norm(difference, axis=1))

    return np.asarray(np.maximum(second(after), second(after + 1)) / 8.0)


NAMES_OF_TRUTH = {"true_t": "t", "truth": "values", "true_clock": "clock", "true_covariance": "covariance"}


@dataclass(frozen=True)
class Estimates:
    """Estimates of one run as the rows of a file have them, N of them. Broken values are NaN."""

    place: Places  # (N,), "est.csv, line 7"
    t: Array  # (N,), s, or numbers of steps, increasing
    estimate: Array  # (N, m)
    covariance: Array  # (N, n, n)
    stated: Array  # (N,) of bool: there is a covariance
    cross: Array | None = None  # (N, n, n), E e_before e' with the row before
    clock: Array | None = None  # (N,), s, where t are numbers of steps
    nis: Array | None = None  # (N,)
    nis_dof: Array | None = None  # (N,)
    bounds: Array | None = None  # (N, bounds, 2), distance from the estimate to the lower and upper end of bounds
    by: Array | None = None  # (N,), cells of the column that makes groups, or their values
    members: Array | None = None  # (N, m, n), whose mean the estimate is; the error is then that of their ranks

    def of_rows(self, rows: Indices) -> Estimates:
        """Some of the estimates."""
        if len(rows) == len(self.t):
            return self
        return replace(self, place=self.place.at(rows), **_rows_of(self, rows))


@dataclass(frozen=True)
class TrueStates:
    """Samples of the truth of one run, M of them."""

    t: Array  # (M,), s or numbers of steps, increasing
    values: Array  # (M, m)
    clock: Array | None = None  # (M,), s, where t are numbers of steps
    covariance: Array | None = None  # (M, n, n), of the truth's own error in the convention; NaN where it has none

    def of_rows(self, rows: Indices) -> TrueStates:
        """Some of the samples."""
        return replace(self, **_rows_of(self, rows))


@dataclass(frozen=True)
class Interpolation:
    """How far the truth beside N estimates is from its samples, as in :class:`Known`."""

    apart: Array  # (N,), s
    bend: Array  # (N,)

    def of_rows(self, rows: Indices) -> Interpolation:
        """That of some of the estimates."""
        return replace(self, **_rows_of(self, rows))


@dataclass(frozen=True)
class RunSource:
    """Which run poses are of, and the files that hold it."""

    run: int = 0
    name: str = ""  # of a drive
    files: Files = ("the estimates", "the truth")
    numbered: bool = False  # t are numbers of steps
    open_end: str = ""  # the last row stands in a line without an end: what to note if it is cut short


@dataclass(frozen=True)
class Poses:
    """One run: estimates, and samples of the truth. :func:`make_poses` makes it of arrays."""

    own: Estimates
    true: TrueStates
    manifold: Manifold
    convention: str  # of the error which the covariance describes
    max_dt: float  # s
    source: RunSource = RunSource()
    interpolation: Interpolation | None = None  # of a truth that was matched

    def value(self, name: str) -> Any:
        """A value by its name in :func:`make_poses`."""
        part, field = PLACES[name]
        return getattr(getattr(self, part), field) if part else getattr(self, field)

    def with_values(self, **values: Any) -> Poses:
        """The run with other values, by their names in :func:`make_poses`.

        Raises
        ------
        KeyError
            A name is unknown.
        """
        changed: dict[str, dict[str, Any]] = {}
        for name, value in values.items():
            part, field = PLACES[name]
            changed.setdefault(part, {})[field] = value
        of_run = changed.pop("", {})
        return replace(self, **{part: replace(getattr(self, part), **own) for part, own in changed.items()}, **of_run)

    def known(self, shift: float = 0.0) -> Known:
        """The truth at the timestamps, ``shift`` s later."""
        if self.true.t is self.own.t and not shift:  # beside the estimates
            rows = np.arange(len(self.own.t))
            none = np.zeros(len(rows))
            return Known(rows, self.true.values, rows, none, none)
        return truth_at(self.own.t + shift, self.true.t, self.true.values, self.manifold, self.max_dt)

    def matched(self, shift: float = 0.0) -> Poses:
        """The estimates whose truth is known, ``shift`` s later, each with that truth beside it."""
        known = self.known(shift)
        own = self.own.of_rows(known.rows)
        P = self.true.covariance
        if P is not None:
            P = P[nearest(own.t + shift, self.true.t, known.before)]
        true = TrueStates(own.t, known.truth, at(self.true.clock, known.before), P)
        return replace(self, own=own, true=true, interpolation=Interpolation(known.apart, known.bend))

    def pairs(self, kept: Array) -> Poses:
        """Some of the estimates, by truth values or indices, with the truth beside each of them."""
        rows = np.arange(len(self.own.t))[kept]
        if len(rows) == len(self.own.t):
            return self
        found = self.of_rows(rows).beside(rows)
        return found.with_values(true_t=found.own.t)

    def errors(self, shift: float = 0.0) -> Array:
        """Truth less estimate, (N, n), with the truth ``shift`` s later; NaN where one of both is not known."""
        known = self.known(shift)
        if len(known.rows) == len(self.own.t):
            return self.error_of(known.rows, known.truth)
        out = np.full(self.own.covariance.shape[:2], np.nan)
        out[known.rows] = self.error_of(known.rows, known.truth)
        return out

    def error_of(self, rows: Indices, truth: Array) -> Array:
        """Error (k, n) of some rows; NaN where the estimate is not finite."""
        estimate = self.own.estimate[rows]
        finite = finite_rows(estimate)
        out = np.full((len(rows), self.own.covariance.shape[-1]), np.nan)
        if self.own.members is not None:
            from consistency.referee.diagnostics.normal_numbers import SEED, rank_numbers

            rng = np.random.default_rng((SEED, self.source.run))
            out[finite] = rank_numbers(self.own.members[rows][finite], truth[finite], rng)
            return out
        error = planar_error
        if self.manifold == "spatial":
            from consistency.referee.geometry import state_error as error
        out[finite] = error(truth[finite], estimate[finite], self.convention)
        return out

    @property
    def d(self) -> int:
        """2 in the plane, 3 in space."""
        return 2 if self.own.covariance.shape[-1] == 3 else 3

    @property
    def variances(self) -> Array:
        """Diagonals of the covariances, (N, n)."""
        return np.diagonal(self.own.covariance, axis1=1, axis2=2)

    @property
    def seconds(self) -> Array:
        """Time of each estimate, (N,), s; NaN where steps have none."""
        if not self.source.numbered:
            return self.own.t
        if self.own.clock is None:
            return np.full(len(self.own.t), np.nan)
        return self.own.clock

    def later(self, shift: float) -> Poses:
        if not shift:
            return self
        return self.with_values(t=self.own.t + shift)

    def sound(self) -> Poses:
        """Estimates that are finite, with a finite covariance, in which a variance that counts as none is 0."""
        finite = finite_rows(self.own.estimate) & finite_rows(self.own.covariance)
        found = self.of_rows(np.flatnonzero(finite))
        none = np.abs(found.variances) <= ROUNDED.zero
        if not found.variances[none].any():
            return found
        P = found.own.covariance.copy()
        row, component = np.nonzero(none)
        P[row, component, component] = 0.0
        return found.with_values(covariance=P)

    def some(self, most: int) -> Poses:
        """At most ``most`` estimates, evenly chosen."""
        return self.of_rows(evenly(len(self.own.t), most))

    def alone(self) -> Poses:
        """Without velocities and biases behind the poses in space."""
        if self.manifold != "spatial" or self.own.covariance.shape[-1] == 6:
            return self
        return self.with_values(
            estimate=self.own.estimate[:, :7],
            covariance=self.own.covariance[:, :6, :6],
            truth=self.true.values[:, :7],
        )

    def of_rows(self, rows: Indices) -> Poses:
        """Some of the estimates beside all of the truth."""
        if len(rows) == len(self.own.t):
            return self
        interpolation = None if self.interpolation is None else self.interpolation.of_rows(rows)
        return replace(self, own=self.own.of_rows(rows), interpolation=interpolation)

    def beside(self, samples: Indices) -> Poses:
        """The estimates beside some samples of the truth."""
        return replace(self, true=self.true.of_rows(samples))


def make_poses(
    place: Places,
    t: Array,
    estimate: Array,
    covariance: Array,
    stated: Array,
    true_t: Array,
    truth: Array,
    manifold: Manifold,
    convention: str,
    max_dt: float,
    **others: Any,
) -> Poses:
    """One run of arrays by name.

    Parameters
    ----------
    others : further values of :class:`Estimates` and :class:`RunSource` by their names; ``true_clock`` and
        ``true_covariance`` of :class:`TrueStates`

    Raises
    ------
    KeyError
        A name is unknown.
    """
    own = Estimates(place, t, estimate, covariance, stated)
    return Poses(own, TrueStates(true_t, truth), manifold, convention, max_dt).with_values(**others)


# of each name in make_poses, the value of Poses that has it, and what it is called there
PLACES = {
    **{each.name: ("own", each.name) for each in fields(Estimates)},
    **{each.name: ("source", each.name) for each in fields(RunSource)},
    **{name: ("true", field) for name, field in NAMES_OF_TRUTH.items()},
    **{name: ("", name) for name in ("manifold", "convention", "max_dt")},
}
Change = Callable[[Poses], Poses]  # what is read otherwise


def _rows_of(value: Estimates | TrueStates | Interpolation, rows: Indices) -> dict[str, Any]:
    """Some rows of all arrays of a value, by name."""
    return {each.name: at(getattr(value, each.name), rows) for each in fields(value) if each.name != "place"}


def at(values: Array | None, rows: Any) -> Array | None:
    """Some rows of values, if there are any."""
    if values is None:
        return None
    return np.asarray(values[rows])


def evenly(count: int, most: int) -> Indices:
    """At most ``most`` of so many places, evenly chosen, the first and the last among them."""
    if count <= most:
        return np.arange(count)
    return np.linspace(0, count - 1, most).astype(np.int64)


def finite_rows(values: Array) -> Array:
    """Which rows of values (N, ...) hold finite numbers alone, (N,) of bool."""
    return np.asarray(np.isfinite(values).all(axis=tuple(range(1, values.ndim))))


def submatrices(P: Array, index: Sequence[int]) -> Array:
    """Rows and columns ``index`` of matrices (N, n, n)."""
    part = np.array(index)
    return P if np.array_equal(part, range(P.shape[-1])) else np.asarray(P[:, part[:, None], part])


def unstated(rows: int, n: int) -> tuple[Array, Array]:
    """Covariances (rows, n, n) that are NaN, and that none is stated, (rows,): where a file states none."""
    return np.broadcast_to(np.nan, (rows, n, n)), np.zeros(rows, bool)


@dataclass(frozen=True)
class Stated:
    """Which covariances a file states: components have cross terms with those of their own group only."""

    groups: Mapping[str, slice] = field(default_factory=lambda: {"": slice(None)})  # by the end of a record's name
    alone: bool = False  # standard deviations: each component of a group is judged by itself


WHOLE = Stated()
ALONE = Stated(alone=True)
POINTS = Stated({"": slice(3)})  # positions without orientations
BLOCKS = Stated({" position": slice(3), " rotation": slice(3, 6)})
_EACH = {f" {axis}": slice(i, i + 1) for i, axis in enumerate(AXES)}
SINGLE = Stated({**_EACH, " velocity and biases": slice(6, None)}, alone=True)


class Bounds(NamedTuple):
    """Bounds on components of the error, which an estimator states in place of a covariance."""

    bounds: tuple[Bound, ...]
    places: tuple[tuple[int, ...], ...]  # of each its components, by their places in the error
    deviations: tuple[float, ...]  # of each how many standard deviations of a Gaussian it has at its level
    gaussian: bool  # declared: they stand for the covariance of one


@dataclass(frozen=True)
class StatedError:
    """Components of an estimator's error, and what of its covariance is stated."""

    axes: Sequence[str]  # names of the components
    convention: str = ""  # "" where the file holds errors
    definition: str = ""  # of the convention, in words
    stated: Stated = WHOLE
    judged: Sequence[int] | None = None  # components that are estimated; None if the errors tell
    in_space: bool = False  # poses in space, or positions beside such a truth
    position: int = 0  # leading components of an estimate that are a position in m, to be drawn
    assumed: bool = False  # its covariance is I, as the files state none
    bounds: Bounds | None = None  # that are stated in place of covariances


@dataclass(frozen=True)
class Estimator:
    """The runs of one estimator, with what its record is called and what a reader must know of it."""

    name: str
    path: Path  # of the estimates, for messages
    runs: Sequence[Poses]
    error: StatedError
    label: str = ""  # of the estimator in notes; its name if there is none
    covariances: Path | None = None  # file of the covariances; that of the estimates if there is none
    notes: Sequence[str] = ()  # what the files were read as
    causes: Sequence[str] = ()  # mix-ups that are found while reading
    t: Array | None = None  # (steps,), s, of an archive, whose poses are numbered by its steps from 0 on
    innovations_alone: bool = False  # there is no truth
    failed: Mapping[int, str] = field(default_factory=dict)  # runs without estimates, and why they have none
    trials: Mapping[int, str] = field(default_factory=dict)  # by run: its seed and truth, equal for the same trial

    @property
    def said(self) -> str:
        """Its name in notes."""
        return self.label or self.name

    def with_notes(self, *notes: str) -> Estimator:
        """The estimator with more notes behind its own."""
        return replace(self, notes=(*self.notes, *notes))

    def with_error(self, **changes: Any) -> Estimator:
        """The estimator with other values of its error."""
        return replace(self, error=replace(self.error, **changes))
