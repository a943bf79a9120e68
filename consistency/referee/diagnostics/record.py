"""The record: the runs of one estimator, as every source gives them and every verdict takes them.

The first steps of each run may be left out. Values of skipped steps are NaN, so that every other step keeps its
number. Alignment and time offsets use them before.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

import numpy as np

from consistency.referee.diagnostics.whitening import every_entry
from consistency.referee.errors import InputError
from consistency.referee.types import Array, Failure, Indices

if TYPE_CHECKING:
    from consistency.referee.diagnostics.groups import Groups

INDEFINITE = "covariance is not positive definite"  # why a run failed
FORMS = "a whole number of steps (20) or seconds (2s)"
ROUNDING = 1e-6  # s: a double holds the seconds since 1970 to a quarter of that
TINIEST = 1e-300


@dataclass(frozen=True)
class JointNees:
    """NEES of pose and map together, in two independent parts of which it is the sum; N runs.

    NaN where a run has none, infinite where its joint covariance is not positive definite.
    """

    pose: Array  # (N,), chi-square with 3 degrees of freedom if the covariance is right
    map: Array  # (N,), of all landmarks given the pose, chi-square with ``dof``
    dof: Indices  # (N,), ``width`` a landmark
    landmarks: Array | None = None  # (N, L), ``map`` by landmark, each given the pose and the landmarks before it
    width: int = 3  # degrees of freedom of a landmark, 2 in the plane


class MapRecord(NamedTuple):
    """Landmarks in the maps after the last step; M of all runs."""

    run: Indices  # (M,)
    nees: Array  # (M,), NaN where the landmark is not judged
    dof: int  # of a landmark: 3, or 2 in the plane
    record: Callable[[Array | None], Record | None]  # what is judged, of the last NEES of the pose of each run, (runs,)

    def of_runs(self, runs: int) -> MapRecord:
        """Those of runs 0 to ``runs`` - 1."""
        some = self.run < runs
        return self._replace(run=self.run[some], nees=self.nees[some])


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


class Bound(NamedTuple):
    """A bound on the size of one component of the error, or on the length of several."""

    name: str  # of its column: bound_x, radius_x_y
    components: tuple[str, ...]
    level: float  # share of the steps in which the error is inside
    ends_independent: bool = False  # declared: where runs end, and which are lost, does not depend on the errors
    alert_limit: float | None = None  # above which a bound alerts its user, who then does not rely on it


class Ensemble(NamedTuple):
    """Members of all runs and steps: what errors that are normal numbers say of them, and how they are drawn."""

    members: int
    tables: tuple[RatioTable, ...]  # (n,), what mean squares of the numbers say of the covariance
    spread: Array  # (k, n), variances of the members of k steps
    square: Array  # (k, n), squares of truth less mean of the members


class RatioTable(NamedTuple):
    """What the mean square of a normal number is where the truth spreads more than stated, or less.

    A rank among a few members, say, cannot show how far outside the truth lies.
    """

    true: Array  # (k,), ratios of true to stated covariance, increasing
    shown: Array  # (k,), mean squares, which do not decrease: 1 at the ratio 1

    def mean_square(self, ratio: float) -> float:
        """Mean square of the numbers at a true ratio."""
        return float(np.exp(np.interp(np.log(max(ratio, TINIEST)), np.log(self.true), np.log(self.shown))))

    def factor(self, factor: float) -> float:
        """The largest factor whose mean squares, up and down, are true ratios within ``factor``."""
        return min(self.mean_square(factor), 1.0 / self.mean_square(1.0 / factor))

    def ratio(self, mean_square: float) -> float:
        """The true ratio behind a mean square: the smallest, or infinite, where none shows so little, or so much."""
        if mean_square >= self.shown[-1]:
            return float("inf")
        return float(np.exp(np.interp(np.log(mean_square), np.log(self.shown), np.log(self.true))))


@dataclass(frozen=True)
class BoundErrors:
    """Errors over the bounds that are stated for them, which are judged in place of covariances."""

    bounds: tuple[Bound, ...]
    ratios: Array  # (runs, steps, bounds), error over bound with its sign; NaN as the error is
    regions: Array | None = None  # (runs, steps, bounds), places in REGIONS; NaN as the ratios, or without a limit

    OF_RUNS: ClassVar = ("ratios", "regions")


@dataclass(frozen=True)
class Errors:
    """Errors of the estimates and the covariances stated for them, or their NEES alone.

    From the step of a failure on all values are NaN. If the start is known exactly, its covariance is singular: in
    those steps the NEES and, for files, the covariance are NaN, and the error is not.
    """

    error: Array | None = None  # (runs, steps, n), truth minus estimate; NaN where a run has no estimate
    covariance: Array | None = None  # (runs, steps, n, n)
    nees: Array | None = None  # (runs, steps), NaN where it does not count; worked out from the errors if not given
    dof: int = 0  # dimension of the error, where NEES stands alone; 0 where there is none
    axes: Sequence[str] = ()  # names of the n components, if they have any
    own_names: Mapping[str, str] = field(default_factory=dict)  # of axes, what the user calls them, as a verdict does
    # indices of components whose covariance is stated, without cross terms to the other parts, which are 0 and not
    # used: each part is judged by itself. Of standard deviations alone each component is one. () where all is stated
    parts: tuple[tuple[int, ...], ...] = ()
    assumed: bool = False  # no covariance is stated: it is I, to be corrected
    convention: str = ""  # of the error
    ensemble: Ensemble | None = None  # of which the errors are normal numbers, as ranks among members are
    bounded: BoundErrors | None = None  # in place of the errors and covariances

    OF_RUNS: ClassVar = ("error", "covariance", "nees", "bounded")

    @property
    def names(self) -> tuple[str, ...]:
        """What a verdict calls the axes: the user's own names where he has some."""
        return tuple(self.own_names.get(axis, axis) for axis in self.axes)


@dataclass(frozen=True)
class InnovationRecord:
    """Innovations with their covariances, or their NIS alone."""

    nis: Array | None = None  # (runs, steps), NaN where there was no innovation
    nis_dof: Array | None = None  # (runs, steps)
    values: Array | None = None  # (runs, steps, m), for their whiteness; without them the NIS has to do
    covariances: Array | None = None  # (runs, steps, m, m)
    optimal_gain: bool = False  # declared: innovations are white if the filter is right, and none was gated away

    OF_RUNS: ClassVar = ("nis", "nis_dof", "values", "covariances")


@dataclass(frozen=True)
class Runs:
    """What the rows and columns of the arrays are: runs and their steps."""

    numbers: Indices | None = None  # (runs,), what to call the runs; 0, 1, ... otherwise
    unit: str = "run"  # what a run is called: a "row" or "window" where those are independent, a "piece" of a log
    t: Array = field(default_factory=lambda: np.empty(0))  # (steps,), s; NaN where runs have no common clock
    times: Array | None = None  # (runs, steps), s, of the steps of each run, or of the beginnings of windows
    by: Array | None = None  # (runs, steps), values of a column; of words their numbers. NaN where there is none
    independent: bool = False  # errors of different steps are independent, so that each is a run to the referee
    skipped: Skipped | None = None  # first steps that are left out, and are NaN in every array but the error
    trials: Mapping[int, str] = field(default_factory=dict)  # by run: its seed and truth, equal for the same trial

    OF_RUNS: ClassVar = ("numbers", "times", "by")


@dataclass(frozen=True)
class Truth:
    """What is stated of the truth itself."""

    covariance: Array | None = None  # (runs, steps, n, n), NaN where it has none
    errors: str | None = None  # declared: they are "independent", "per-run" or "common" to all runs
    shared: bool = False  # declared: the estimator has fused the truth

    OF_RUNS: ClassVar = ("covariance",)


@dataclass(frozen=True)
class TruthFit:
    """What a fit to the truth leaves of the errors."""

    align: str = "none"  # how the estimates were moved into the world of the truth; "" if they are known to be in it
    caption: str = ""  # note of the verdict on that
    reduced: bool = False  # the errors may be smaller than the covariance says without a fault
    unavailable: Collection[str] = ()  # questions that cannot be answered after the fit, which are not asked
    unseen: float = 0.0  # share of the NEES that the fit may have absorbed: consistent is shown with it added


@dataclass(frozen=True)
class Map:
    """Landmarks, and what a guard of the filter did to observations of them."""

    read: Callable[[], MapRecord | None] | None = None  # reads the maps; None where there are none
    rejections: Rejections | None = None  # of a filter with a guard
    landmarks: Indices | None = None  # (steps,), where the record is that of a map: they stand in the place of steps
    joint: JointNees | None = None  # where the record is that of a map


@dataclass(frozen=True)
class Origin:
    """Where a record is from, and what its reader has to say."""

    files: Mapping[int, str] = field(default_factory=dict)  # of each run by its number, where files hold them
    notes: tuple[str, ...] = ()  # notes for the reader: the convention, left-out steps
    causes: tuple[str, ...] = ()  # probable mix-ups, which the verdict names; they stand in the notes, too
    window: str | None = None  # "10 s": steps are windows of a log, and errors are those of motions over them
    unshown: str = ""  # why nothing can be shown by these windows, so that no question is asked
    path: Array | None = None  # (runs, steps, 2, 2 or 3), m, true and estimated positions, to be drawn

    OF_RUNS: ClassVar = ("path",)


OfRuns = TypeVar("OfRuns", BoundErrors, Errors, InnovationRecord, Runs, Truth, Origin)


@dataclass(frozen=True, repr=False)
class Record:
    """The runs of one estimator: errors with covariances, or NEES, or innovations, or several of them.

    Every source of data gives records, and everything that judges, compares, draws or describes an estimator takes
    them: arrays of a gate, files of another estimator, and results of the bench take the same way.
    :func:`make_record` makes one of arrays.

    What is large and not always needed, as a map, is a function that reads it when it is called.
    """

    name: str
    errors: Errors = Errors()
    innovations: InnovationRecord = InnovationRecord()
    runs: Runs = field(default_factory=Runs)
    failures: tuple[Failure, ...] = ()  # Failure.step counts the columns from 1, as the verdict does
    truth: Truth = Truth()
    fit: TruthFit = TruthFit()
    groups: Groups | None = None  # (runs, steps), in which the size of the errors is asked, too
    map: Map = Map()
    origin: Origin = Origin()
    world: Errors | None = None  # of the same runs as differences in the world, where ``errors`` are others
    guesses: Mapping[str, Record] = field(default_factory=dict)  # by convention, where none is declared

    def __post_init__(self) -> None:
        for key, array in arrays_of(self).items():
            if isinstance(array, np.ma.MaskedArray):
                raise InputError(
                    f"{self.name}: {key} is a masked array, whose mask a record would lose; write NaN where nothing is "
                    f"known, as {key}.filled(numpy.nan) does, or give the arrays to consistency.judge"
                )

    @property
    def run_numbers(self) -> Indices:
        """Labels of the runs, (runs,)."""
        if self.runs.numbers is not None:
            return self.runs.numbers
        return np.arange(len(next(iter(arrays_of(self).values()), ())))

    def table(self, index: Sequence[int] | None = None) -> RatioTable | None:
        """What mean squares of some components together say of the covariance, or of all; None if they are its."""
        tables = () if self.errors.ensemble is None else self.errors.ensemble.tables
        some = [table for i, table in enumerate(tables) if index is None or i in index]
        if not some:
            return None
        ratios = some[0].true
        return RatioTable(ratios, np.mean([[one.mean_square(ratio) for ratio in ratios] for one in some], axis=0))

    @property
    def in_world(self) -> Record:
        """The same runs with their errors as differences in the world: this record where it has no others."""
        if self.world is None:
            return self
        return replace(self, errors=self.world, world=None)

    @property
    def errors_alone(self) -> Record:
        """Without what is judged beside the errors and innovations."""
        of_map = replace(self.map, read=None, rejections=None)
        return replace(self, errors=replace(self.errors, convention=""), map=of_map, world=None)

    def with_errors(self, error: Array | None, covariance: Array | None, nees: Array | None = None) -> Record:
        """The record with other errors, covariances and NEES of the same components."""
        return replace(self, errors=replace(self.errors, error=error, covariance=covariance, nees=nees))

    def with_nees(self, nees: Array) -> Record:
        """The record with another NEES, (runs, steps)."""
        return replace(self, errors=replace(self.errors, nees=nees))

    def with_notes(self, *notes: str) -> Record:
        """The record with more notes behind its own."""
        return replace(self, origin=replace(self.origin, notes=(*self.origin.notes, *notes)))

    def with_optimal_gain(self) -> Record:
        """The record of a filter whose gain is declared optimal."""
        return replace(self, innovations=replace(self.innovations, optimal_gain=True))

    def changed(self, change: Callable[[Any], Any]) -> Record:
        """The record with ``change`` applied to each of its arrays over runs and steps, and to its groups.

        Numbers of the runs stay; those of other runs are given by the caller.
        """
        unnumbered = replace(self.runs, numbers=None)
        return replace(
            self,
            errors=_changed(self.errors, change),
            innovations=_changed(self.innovations, change),
            runs=replace(_changed(unnumbered, change), numbers=self.runs.numbers),
            truth=_changed(self.truth, change),
            groups=None if self.groups is None else replace(self.groups, index=change(self.groups.index)),
            origin=_changed(self.origin, change),
            world=None if self.world is None else _changed(self.world, change),
        )

    def of_runs(self, rows: slice | Indices) -> Record:
        """Some of the runs, by their rows, with maps and rejections of all."""
        numbers = self.run_numbers[rows]
        some = self.changed(lambda array: array[rows])
        failures = tuple(failure for failure in self.failures if failure.run in numbers)
        guesses = {kind: one.of_runs(rows) for kind, one in self.guesses.items()}
        return replace(some, runs=replace(some.runs, numbers=numbers), failures=failures, guesses=guesses)

    def first_runs(self, runs: int) -> Record:
        """Runs 0 to ``runs`` - 1."""
        return self.of_runs(slice(int(np.searchsorted(self.run_numbers, runs))))

    def without_first(self, skip: Skip | None) -> Record:
        """The first steps of each run left out of the statistics: all but the errors is NaN there; maps stay.

        Raises
        ------
        InputError
            Nothing is left, or seconds are asked for and there are no times.
        """
        if skip is None:
            return self

        arrays = {
            "covariance": self.errors.covariance,
            "nees": self.errors.nees,
            "nis": self.innovations.nis,
            "nis_dof": self.innovations.nis_dof,
            "values": self.innovations.values,
        }
        bounded = self.errors.bounded
        if bounded is not None:
            arrays |= {"ratios": bounded.ratios, "regions": bounded.regions}
        if self.world is not None:
            arrays |= {"world covariance": self.world.covariance, "world nees": self.world.nees}
        t = self.runs.times
        if t is None and len(self.runs.t):
            t = self.runs.t
        try:
            rest, skipped = without_first(skip, arrays, self.name, t)
        except ValueError as error:
            raise InputError(f"--{error}") from None
        if bounded is not None:
            bounded = replace(bounded, ratios=rest["ratios"], regions=rest["regions"])
        world = self.world
        if world is not None:
            world = replace(world, covariance=rest["world covariance"], nees=rest["world nees"])
        return replace(
            self,
            errors=replace(self.errors, covariance=rest["covariance"], nees=rest["nees"], bounded=bounded),
            innovations=replace(self.innovations, nis=rest["nis"], nis_dof=rest["nis_dof"], values=rest["values"]),
            runs=replace(self.runs, skipped=skipped),
            world=world,
            guesses={kind: one.without_first(skip) for kind, one in self.guesses.items()},
        )

    @property
    def as_runs(self) -> Record:
        """Independent rows or windows as runs of a single step, numbered from 1; those without an error are none."""
        if not self.runs.independent:
            return self
        judged = [values for values in (self.errors.nees, self.innovations.nis) if values is not None]
        if self.errors.bounded is not None:
            judged += [*np.moveaxis(self.errors.bounded.ratios, -1, 0)]
        there = np.any([np.isfinite(values) for values in judged], axis=0)
        number = np.arange(1, there.size + 1).reshape(there.shape)
        rows = [int(np.flatnonzero(self.run_numbers == f.run)[0]) for f in self.failures]
        at = [(row, f.step - 1) for row, f in zip(rows, self.failures, strict=True)]
        for place in at:
            there[place] = True
        failed = (replace(f, run=int(number[place]), step=1) for place, f in zip(at, self.failures, strict=True))
        found = self.changed(lambda array: array[there][:, None])
        unit = "row" if self.origin.window is None else "window"
        runs = Runs(number[there], unit, np.full(1, np.nan), found.runs.times, found.runs.by, skipped=self.runs.skipped)
        return replace(found, runs=runs, failures=tuple(failed), origin=replace(found.origin, files={}))

    @property
    def left_out_steps(self) -> list[int]:
        """Steps, counted from 1, in which the covariance of some run is not of full rank yet."""
        if self.errors.error is None or self.errors.nees is None:
            return []
        deficient = np.isfinite(self.errors.error).all(axis=-1) & np.isnan(self.errors.nees)
        if self.runs.skipped is not None:
            deficient[:, : self.runs.skipped.steps] = False
        return [int(k) + 1 for k in np.flatnonzero(deficient.any(axis=0))]

    def plot(self, path: str | Path | None = None) -> Any:
        """Error of each component in one run with the stated 2-sigma bounds, and the coverage.

        Parameters
        ----------
        path : .png, .pdf or .svg to write as well; one that is there is replaced

        Returns
        -------
        A figure of Matplotlib, which notebooks show

        Raises
        ------
        InputError
            There is no error to draw, or the file cannot be written.
        """
        return shown_by("plot", self, None, path)

    def __repr__(self) -> str:
        return str(shown_by("record_text", self))

    def _repr_html_(self) -> str:
        return str(shown_by("record_html", self))


def make_record(
    name: str,
    error: Array | None = None,
    covariance: Array | None = None,
    nees: Array | None = None,
    dof: int = 0,
    *,
    axes: Sequence[str] = (),
    parts: tuple[tuple[int, ...], ...] = (),
    convention: str = "",
    nis: Array | None = None,
    nis_dof: Array | None = None,
    innovations: Array | None = None,
    innovation_covariances: Array | None = None,
    optimal_gain: bool = False,
    failures: Iterable[Failure] = (),
    runs: Indices | None = None,
    unit: str = "run",
    t: Array | None = None,
    files: Mapping[int, str] | None = None,
    truth_covariance: Array | None = None,
    truth_errors: str | None = None,
    truth_shared: bool = False,
    groups: Groups | None = None,
) -> Record:
    """A record of arrays: errors with covariances, or NEES with its degrees of freedom, or innovations.

    Parameters
    ----------
    error : (runs, steps, n), truth minus estimate
    covariance : (runs, steps, n, n)
    nees : (runs, steps)
    dof : dimension of the error
    axes, parts, convention : as in :class:`Errors`
    nis, nis_dof : (runs, steps)
    innovations : (runs, steps, m)
    innovation_covariances : (runs, steps, m, m)
    optimal_gain : as in :class:`InnovationRecord`
    runs : (runs,), numbers of the runs
    unit : what a run is called
    t : (steps,), s
    files : of each run by its number
    truth_covariance : (runs, steps, n, n), with what is declared of it, as in :class:`Truth`
    groups : (runs, steps), in which the size of the errors is asked, too
    """
    return Record(
        name,
        Errors(error, covariance, nees, dof, axes, parts=parts, convention=convention),
        InnovationRecord(nis, nis_dof, innovations, innovation_covariances, optimal_gain),
        Runs(runs, unit, np.empty(0) if t is None else t),
        failures=tuple(failures),
        truth=Truth(truth_covariance, truth_errors, truth_shared),
        groups=groups,
        origin=Origin(files or {}),
    )


Evidence = make_record  # its name in scripts of before


def numbered_axes(n: int) -> tuple[str, ...]:
    """Names of components that have none: axis 0, axis 1, ..."""
    return tuple(f"axis {i}" for i in range(n))


def shown_by(function: str, *arguments: Any) -> Any:
    """Result of a function that draws or describes; its module is loaded here, as nothing else needs it."""
    return getattr(import_module("consistency.referee.notebook"), function)(*arguments)


def arrays_of(record: Record) -> dict[str, Any]:
    """Arrays over runs that a record has, by the name of their value and their own: "errors.nees"."""
    arrays: dict[str, Any] = {}
    for part in ("errors", "innovations", "runs", "truth", "origin"):
        arrays |= _arrays(getattr(record, part), part)
    return arrays


def _arrays(value: OfRuns, prefix: str) -> dict[str, Any]:
    arrays: dict[str, Any] = {}
    for name in value.OF_RUNS:
        part = getattr(value, name)
        if isinstance(part, BoundErrors):
            arrays |= _arrays(part, f"{prefix}.{name}")
        elif part is not None:
            arrays[f"{prefix}.{name}"] = part
    return arrays


def _changed(value: OfRuns, change: Callable[[Any], Any]) -> OfRuns:
    """A value with ``change`` applied to each of its arrays over runs."""
    arrays: dict[str, Any] = {}
    for name in value.OF_RUNS:
        part = getattr(value, name)
        if isinstance(part, BoundErrors):
            arrays[name] = _changed(part, change)
        elif part is not None:
            arrays[name] = change(part)
    return replace(value, **arrays)


def each_alone(record: Record) -> Record:
    """The record with each of its components as a part, so that no cross term of its covariances is used.

    Raises
    ------
    ValueError
        The record has no errors.
    """
    if record.errors.error is None:
        raise ValueError(f"{record.name}: has no errors")
    n = record.errors.error.shape[-1]
    reasons = [f.reason.replace(INDEFINITE, "a standard deviation is not above 0") for f in record.failures]
    failures = tuple(replace(f, reason=reason) for f, reason in zip(record.failures, reasons, strict=True))
    errors = replace(record.errors, parts=tuple((i,) for i in range(n)) if n > 1 else ())
    return replace(record, errors=errors, failures=failures)


@dataclass(frozen=True)
class Skip:
    """Length of the beginning of each run that is left out."""

    size: float
    unit: str = "step"  # or "s"

    @property
    def option(self) -> str:
        """Value of the option: 20, 2s."""
        if self.unit == "s":
            return f"{self.size:g}s"
        return f"{self.size:g}"

    @property
    def text(self) -> str:
        """The first 20 steps, the first 2 s."""
        if self.unit == "s":
            return f"the first {self.size:g} s"
        if self.size == 1:
            return "the first step"
        return f"the first {self.size:g} steps"

    def mask(self, shape: tuple[int, int], t: Array | None = None) -> Array:
        """Which of (runs, steps) are left out, of bool.

        Steps are counted from 1 as in sentences. Seconds are counted from the first time of each run; the step at their
        end is kept.

        Parameters
        ----------
        t : (steps,) or (runs, steps), s, NaN where a run has no step

        Raises
        ------
        ValueError
            Seconds are asked for, and a run has no times.
        """
        if self.unit == "step":
            return np.broadcast_to(np.arange(1, shape[1] + 1) <= self.size, shape)
        if t is None:
            t = np.full(shape, np.nan)
        times = np.broadcast_to(t, shape)
        is_known = np.isfinite(times)
        if not is_known.any(axis=1).all():
            raise ValueError(f"skip {self.option}: there are no times; give a number of steps, as --skip 20")
        start = times[np.arange(shape[0]), np.argmax(is_known, axis=1)]
        with np.errstate(invalid="ignore"):
            return np.asarray(times - start[:, None] < self.size - ROUNDING)


@dataclass(frozen=True)
class Skipped:
    """The steps that were left out."""

    skip: Skip
    steps: int  # of the run that lost most
    empty: int = 0  # runs of which nothing is left


def skip_of(given: str | float | Skip | None) -> Skip | None:
    """Parse the value of ``--skip``, such as 20 or "2s"; None for nothing.

    Raises
    ------
    ValueError
        It is neither a number of steps nor of seconds.
    """
    if given is None or isinstance(given, Skip):
        return given
    match = re.fullmatch(r"\s*(\d+|\d*\.\d+|\d+\.\d*)\s*(s?)\s*", str(given))
    if match is None or isinstance(given, bool) or not (match[2] == "s" or match[1].isdigit()):
        raise ValueError(f"skip {given}: must be {FORMS}")
    size = float(match[1])
    if size == 0:
        return None
    return Skip(size, match[2] or "step")


def without_first(
    skip: Skip | None, arrays: Mapping[str, Any], name: str, t: Array | None = None
) -> tuple[dict[str, Any], Skipped | None]:
    """Arrays over (runs, steps, ...) of one estimator without the first steps, and the record of those steps.

    Errors need not be among them: where covariance and NEES are NaN they do not count.

    Parameters
    ----------
    arrays : covariances, NEES, NIS, innovations, by any name; those that end in "dof"
        become 0, the others NaN. None is passed over.
    t : as in :meth:`Skip.mask`

    Raises
    ------
    ValueError
        Nothing is left, or seconds are asked for and there are no times.
    """
    given = {key: np.asarray(value) for key, value in arrays.items() if value is not None}
    if skip is None or not given:
        return dict(arrays), None
    runs, steps = next(iter(given.values())).shape[:2]
    mask = skip.mask((int(runs), int(steps)), t)
    counted = np.zeros(mask.shape, bool)
    for key, value in given.items():
        if value.ndim == 4:
            counted |= every_entry(np.isfinite, value)
        elif not key.endswith("dof"):
            counted |= np.isfinite(value).all(axis=tuple(range(2, value.ndim)))
    left = (counted & ~mask).any(axis=1)
    if not left.any():
        last = int(np.flatnonzero(counted.any(axis=0)).max(initial=-1)) + 1
        raise ValueError(f"skip {skip.option}: nothing of {name} is left, whose last step is {last}; leave out less")
    rest = dict(arrays)
    for key, value in given.items():
        beside = mask.reshape(*mask.shape, *[1] * (value.ndim - 2))
        if key.endswith("dof"):
            rest[key] = np.where(beside, np.asarray(0, value.dtype), value)
        else:
            rest[key] = np.where(beside, np.asarray(np.nan, value.dtype), value)
    return rest, Skipped(skip, int(mask.sum(axis=1).max()), int((counted.any(axis=1) & ~left).sum()))
