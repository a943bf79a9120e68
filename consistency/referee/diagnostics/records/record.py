"""The record: the runs of one estimator, as every source gives them and every verdict takes them.

The first steps of each run may be left out. Values of skipped steps are NaN, so that every other step keeps its
number. Alignment and time offsets use them before.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from consistency.referee.diagnostics.records.whitening import every_entry
from consistency.referee.errors import InputError
from consistency.referee.types import Array, Failure, Indices

if TYPE_CHECKING:
    from consistency.referee.diagnostics.records.groups import Groups

INDEFINITE = "covariance is not positive definite"  # why a run failed
FORMS = "a whole number of steps (20) or seconds (2s)"
ROUNDING = 1e-6  # s: a double holds the seconds since 1970 to a quarter of that


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


@dataclass(frozen=True, repr=False)
class Record:
    """The runs of one estimator: errors with covariances, or NEES, or innovations, or several of them.

    Every source of data gives records, and everything that judges, compares, draws or describes an estimator takes
    them: arrays of a gate, files of another estimator, and results of the bench take the same way. From the step of a
    failure on all values are NaN. If the start is known exactly, its covariance is singular: in those steps the NEES
    and, for files, the covariance are NaN, and the error is not.

    What is large and not always needed, as a map, is a function that reads it when it is called.
    """

    name: str
    error: Array | None = None  # (runs, steps, n), truth minus estimate; NaN where a run has no estimate
    covariance: Array | None = None  # (runs, steps, n, n)
    nees: Array | None = None  # (runs, steps), NaN where it does not count; worked out from the errors if not given
    dof: int = 0  # dimension of the error, where NEES stands alone; 0 where there is none
    nis: Array | None = None  # (runs, steps), NaN where there was no innovation
    nis_dof: Array | None = None  # (runs, steps)
    innovations: Array | None = None  # (runs, steps, m), for their whiteness; without them the NIS has to do
    innovation_covariances: Array | None = None  # (runs, steps, m, m)
    optimal_gain: bool = False  # declared: innovations are white if the filter is right, and none was gated away
    failures: tuple[Failure, ...] = ()  # Failure.step counts the columns from 1, as the verdict does
    axes: Sequence[str] = ()  # names of the n components, if they have any
    own_names: Mapping[str, str] = field(default_factory=dict)  # of axes, what the user calls them, as a verdict does
    # indices of components whose covariance is stated, without cross terms to the other parts, which are 0 and not
    # used: each part is judged by itself. Of standard deviations alone each component is one. () where all is stated
    parts: tuple[tuple[int, ...], ...] = ()
    runs: Indices | None = None  # (runs,), what to call the runs; 0, 1, ... otherwise
    landmarks: Indices | None = None  # (steps,), of a map: the landmarks that stand in the place of steps
    joint: JointNees | None = None  # of a map
    unit: str = "run"  # what a run is called: a "row" or "window" where those are independent, a "piece" of a log
    by: Array | None = None  # (runs, steps), values of a column; of words their numbers. NaN where there is none
    groups: Groups | None = None  # (runs, steps), of that column, in which the size of the errors is asked, too
    skipped: Skipped | None = None  # first steps that are left out, and are NaN in every array but the error

    # what a fit to the truth leaves of the errors
    align: str = "none"  # how the estimates were moved into the world of the truth; "" if they are known to be in it
    caption: str = ""  # note of the verdict on that
    reduced: bool = False  # the errors may be smaller than the covariance says without a fault
    unavailable: Collection[str] = ()  # questions that cannot be answered after the fit, which are not asked
    unseen: float = 0.0  # share of the NEES that the fit may have absorbed: consistent is shown with it added

    # origin
    t: Array = field(default_factory=lambda: np.empty(0))  # (steps,), s; NaN where runs have no common clock
    times: Array | None = None  # (runs, steps), s, of the steps of each run, or of the beginnings of windows
    files: Mapping[int, str] = field(default_factory=dict)  # of each run by its number, where files hold them
    convention: str = ""  # of the error
    notes: tuple[str, ...] = ()  # notes for the reader: the convention, left-out steps
    causes: tuple[str, ...] = ()  # probable mix-ups, which the verdict names; they stand in the notes, too
    window: str | None = None  # "10 s": steps are windows of a log, and errors are those of motions over them
    independent: bool = False  # errors of different steps are independent, so that each is a run to the referee
    unshown: str = ""  # why nothing can be shown by these windows, so that no question is asked
    path: Array | None = None  # (runs, steps, 2, 2 or 3), m, true and estimated positions, to be drawn
    guesses: Mapping[str, Record] = field(default_factory=dict)  # by convention, where none is declared
    truth_covariance: Array | None = None  # (runs, steps, n, n), of the truth itself; NaN where it has none
    truth_errors: str | None = None  # declared: its errors are "independent", "per-run" or "common" to all runs
    truth_shared: bool = False  # declared: the estimator has fused the truth
    assumed: bool = False  # none is stated: the covariance is I, to be corrected
    trials: Mapping[int, str] = field(default_factory=dict)  # by run: its seed and truth, equal for the same trial

    # beside the errors
    world: Record | None = None  # errors of the same runs as differences in the world, where ``error`` is another
    map: Callable[[], MapRecord | None] | None = None  # reads the maps; None where there are none
    rejections: Rejections | None = None  # of a filter with a guard

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
        if self.runs is not None:
            return self.runs
        there = (self.error, self.nees, self.nis, self.innovations)
        return np.arange(next((len(array) for array in there if array is not None), 0))

    @property
    def names(self) -> tuple[str, ...]:
        """What a verdict calls the axes: the user's own names where he has some."""
        return tuple(self.own_names.get(axis, axis) for axis in self.axes)

    @property
    def in_world(self) -> Record:
        """The same runs with their errors as differences in the world: this record where it has no others."""
        if self.world is None:
            return self
        w = self.world
        return replace(self, error=w.error, covariance=w.covariance, nees=w.nees, convention=w.convention, world=None)

    @property
    def errors_alone(self) -> Record:
        """Without what is judged beside the errors and innovations."""
        return replace(self, world=None, map=None, rejections=None, convention="")

    def of_runs(self, rows: slice | Indices) -> Record:
        """Some of the runs, by their rows, with maps and rejections of all."""
        arrays = {name: array[rows] for name, array in arrays_of(self).items()}
        numbers = self.run_numbers[rows]
        failures = tuple(failure for failure in self.failures if failure.run in numbers)
        world = None if self.world is None else self.world.of_runs(rows)
        guesses = {kind: one.of_runs(rows) for kind, one in self.guesses.items()}
        groups = None if self.groups is None else self.groups[rows]
        return replace(self, **arrays, runs=numbers, failures=failures, world=world, guesses=guesses, groups=groups)

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

        arrays = {name: getattr(self, name) for name in ("covariance", "nees", "nis", "nis_dof", "innovations")}
        world = self.world
        t = self.times
        if world is not None:
            arrays |= {"world covariance": world.covariance, "world nees": world.nees}
        if t is None and len(self.t):
            t = self.t
        try:
            rest, skipped = without_first(skip, arrays, self.name, t)
        except ValueError as error:
            raise InputError(f"--{error}") from None
        if world is not None:
            world = replace(world, covariance=rest.pop("world covariance"), nees=rest.pop("world nees"))
        guesses = {kind: one.without_first(skip) for kind, one in self.guesses.items()}
        return replace(self, **rest, world=world, skipped=skipped, guesses=guesses)

    @property
    def as_runs(self) -> Record:
        """Independent rows or windows as runs of a single step, numbered from 1; those without an error are none."""
        if not self.independent:
            return self
        judged = [values for values in (self.nees, self.nis) if values is not None]
        there = np.any([np.isfinite(values) for values in judged], axis=0)
        number = np.arange(1, there.size + 1).reshape(there.shape)
        rows = [int(np.flatnonzero(self.run_numbers == f.run)[0]) for f in self.failures]
        at = [(row, f.step - 1) for row, f in zip(rows, self.failures, strict=True)]
        for place in at:
            there[place] = True
        failed = (replace(f, run=int(number[place]), step=1) for place, f in zip(at, self.failures, strict=True))
        return replace(
            self,
            **{name: array[there][:, None] for name, array in arrays_of(self).items()},
            failures=tuple(failed),
            runs=number[there],
            unit="row" if self.window is None else "window",
            independent=False,
            groups=None if self.groups is None else self.groups[there, None],
            t=np.full(1, np.nan),
            files={},
            trials={},
        )

    @property
    def left_out_steps(self) -> list[int]:
        """Steps, counted from 1, in which the covariance of some run is not of full rank yet."""
        if self.error is None or self.nees is None:
            return []
        deficient = np.isfinite(self.error).all(axis=-1) & np.isnan(self.nees)
        if self.skipped is not None:
            deficient[:, : self.skipped.steps] = False
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


Evidence = Record  # name of the record in scripts of before


def numbered_axes(n: int) -> tuple[str, ...]:
    """Names of components that have none: axis 0, axis 1, ..."""
    return tuple(f"axis {i}" for i in range(n))


def shown_by(function: str, *arguments: Any) -> Any:
    """Result of a function that draws or describes; its module is loaded here, as nothing else needs it."""
    return getattr(import_module("consistency.referee.notebook.read_and_judge"), function)(*arguments)


def arrays_of(record: Record) -> dict[str, Any]:
    """Arrays over runs and steps that a record has, by name."""
    names = ("error", "covariance", "nees", "nis", "nis_dof", "innovations", "innovation_covariances", "times",
             "truth_covariance", "path", "by")  # fmt: skip
    return {name: array for name in names if (array := getattr(record, name)) is not None}


def each_alone(record: Record) -> Record:
    """The record with each of its components as a part, so that no cross term of its covariances is used.

    Raises
    ------
    ValueError
        The record has no errors.
    """
    if record.error is None:
        raise ValueError(f"{record.name}: has no errors")
    n = record.error.shape[-1]
    reasons = [f.reason.replace(INDEFINITE, "a standard deviation is not above 0") for f in record.failures]
    failures = tuple(replace(f, reason=reason) for f, reason in zip(record.failures, reasons, strict=True))
    return replace(record, failures=failures, parts=tuple((i,) for i in range(n)) if n > 1 else ())


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
