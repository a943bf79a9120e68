"""Bounds, radii and intervals with the level at which they are stated: their columns, keys and options.

A bound holds for the size of one component of the error, a radius for the length of several, an interval for a
component about its estimate. ``--gaussian`` declares that they stand for the covariance of a Gaussian.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from consistency.referee.column_names import POSE
from consistency.referee.diagnostics.exceedance import deviations_of, level_of
from consistency.referee.diagnostics.record import Bound, Record
from consistency.referee.diagnostics.verdict_parts import HAZARD
from consistency.referee.errors import InputError
from consistency.referee.readers.formats.columns import require_units
from consistency.referee.readers.formats.sheet import TableRows
from consistency.referee.readers.options import Reading, StatementOptions
from consistency.referee.readers.places import refuse
from consistency.referee.readers.truth_matching import Bounds, Estimator
from consistency.referee.types import Array

ENDS = "independent"
PREFIXES = ("bound_", "radius_")
INTERVAL = ("_low", "_high")
FORMS = "must be above 0 and below 100 %, as 95%, or 2sigma, CEP, SEP, R95; of each column bound_x=95%,bound_y=68%"
COLUMNS = "bound_x, radius_x_y, or x_low and x_high (--columns radius_x_y=NAME says what one is called)"
TRACE = "is the root of a trace, which has no level: give the radius of a level, as CEP or 95%"
WORDS = {"cep": (0.5, 2), "r95": (0.95, 2), "sep": (0.5, 3)}  # level, and dimensions of the radius


class Level(NamedTuple):
    """A level as it is stated: a share of the steps, or a number of standard deviations."""

    text: str
    share: float | None
    deviations: float | None = None
    dimensions: int | None = None  # of a radius whose name says them

    def of(self, dimensions: int) -> float:
        """Share of the steps inside a bound on so many components."""
        if self.dimensions not in (None, dimensions):
            raise InputError(f"--level {self.text}: is a radius of {self.dimensions} components, not of {dimensions}")
        return level_of(self.deviations, dimensions) if self.share is None else self.share  # type: ignore[arg-type]

    def in_deviations(self, dimensions: int) -> float:
        """Standard deviations of a Gaussian in a bound on so many components."""
        if self.deviations is not None:
            return self.deviations
        return deviations_of(self.of(dimensions), dimensions)


def level_of_text(given: Any) -> Level:
    """A level of an option or argument: 95%, 0.95, 2sigma, CEP; raises InputError for what is none."""
    text = str(given).strip()
    word = text.lower().replace(" ", "")
    if word in ("2drms", "drms"):
        raise InputError(f"--level {text}: {TRACE}")
    if word in WORDS:
        return Level(text, WORDS[word][0], dimensions=WORDS[word][1])
    found = re.fullmatch(r"(\d+\.?\d*(?:e-?\d+)?|\.\d+)(%|sigma|)", word)
    value = float(found[1]) / (100.0 if found[2] == "%" else 1.0) if found else 0.0
    is_sigma = found is not None and found[2] == "sigma"
    if not 0.0 < value < (10.0 if is_sigma else 1.0):
        raise InputError(f"--level {text}: {FORMS}")
    return Level(text, None, value) if is_sigma else Level(text, value)


def limit_of_text(given: Any) -> float:
    """An alert limit of an option or argument; raises InputError for what is none."""
    try:
        limit = float(given)
    except (TypeError, ValueError):
        limit = float("nan")
    if not 0.0 < limit < float("inf"):
        raise InputError(f"--alert-limit {given}: must be above 0, in the unit of the bound; of each "
                         "radius_x_y=40,bound_z=50")  # fmt: skip
    return limit


T = TypeVar("T")


class OfBounds(Generic[T]):
    """The level or the alert limit of each bound, one for all or by name."""

    def __init__(self, flag: str, parse: Callable[[Any], T], given: Any) -> None:
        pairs = given if isinstance(given, Mapping) else {}
        if not pairs and isinstance(given, str) and "=" in given:
            pairs = dict([*map(str.strip, each.partition("=")[::2])] for each in given.split(","))
        self.flag = flag
        self.by_name = {str(name): parse(value) for name, value in pairs.items()}
        self.every = None if pairs or given is None else parse(given)

    def get(self, *names: str) -> T | None:
        """That of a bound by any of its names; None if it has none."""
        return next((self.by_name[name] for name in names if name in self.by_name), self.every)

    def of(self, *names: str) -> T:
        """That of a bound by any of its names; raises InputError if it has none."""
        found = self.get(*names)
        if found is None:
            raise InputError(f"{self.flag}: says none for {names[0]}, only for {', '.join(self.by_name)}")
        return found

    def require(self, known: Sequence[str]) -> None:
        """Refuse one of a bound that is not there."""
        for name in self.by_name:
            if name not in known:
                raise InputError(f"{self.flag} {name}: there is no such bound; there are: {', '.join(known)}")


def levels_of(given: Any) -> OfBounds[Level]:
    """Levels of bounds; raises InputError for what is none."""
    return OfBounds("--level", level_of_text, given)


def alert_limits(given: Any) -> OfBounds[float]:
    """Alert limits of bounds, where such are given; raises InputError for what is none."""
    return OfBounds("--alert-limit", limit_of_text, given)


def require_bound_options(r: Reading) -> None:
    """Refuse options of bounds that say nothing, or do not go together."""
    stated = r.statement
    if stated.ends not in (None, ENDS):
        raise InputError(f"--ends {stated.ends}: must be '{ENDS}'")
    of_bounds = {"--ends": stated.ends, "--alert-limit": stated.alert_limit}
    for flag, value in ({"--gaussian": stated.gaussian or None} | of_bounds).items():
        if value is not None and stated.level is None:
            raise InputError(f"{flag}: goes with --level, as --level 95%")
        if value is not None and stated.gaussian and flag in of_bounds:
            raise InputError(f"{flag}: is for bounds; with --gaussian covariances are judged, so leave it out")
    if stated.level is not None:
        levels_of(stated.level)
    alert_limits(stated.alert_limit)
    if stated.is_of_bounds:
        others = ("relative", "align", "split", "truth_covariance", "truth_errors", "truth_shared", "axes")
        r.refuse("--level", dict.fromkeys(others, ", which is for covariances"))


# --- tables ----------------------------------------------------------------------------------------------


class BoundColumns(NamedTuple):
    """Columns of a table that state one bound."""

    name: str
    components: tuple[str, ...]
    columns: tuple[str, ...]  # one, or those of the lower and upper end


def bound_columns(names: Sequence[str]) -> list[BoundColumns]:
    """Bounds that the columns of a table state."""
    found = []
    for name in names:
        if name.startswith(PREFIXES[0]) and len(name) > len(PREFIXES[0]):
            found.append(BoundColumns(name, (name.removeprefix(PREFIXES[0]),), (name,)))
        elif name.startswith(PREFIXES[1]) and len(name) > len(PREFIXES[1]):
            found.append(BoundColumns(name, _components(name.removeprefix(PREFIXES[1]), names), (name,)))
        elif name.endswith(INTERVAL[0]) and (high := name.removesuffix(INTERVAL[0]) + INTERVAL[1]) in names:
            found.append(BoundColumns(f"{name}..{high}", (name.removesuffix(INTERVAL[0]),), (name, high)))
    return found


def _components(text: str, names: Sequence[str]) -> tuple[str, ...]:
    """Components that a text such as ``x_y`` joins: names of columns where such are there."""
    known = {*names, *(name.removeprefix("true_") for name in names)}
    for end in range(1, len(text)):
        if text[end] == "_" and text[:end] in known:
            return text[:end], *_components(text[end + 1 :], names)
    return (text,) if text in known else tuple(text.split("_"))


def state_of_bounds(names: Sequence[str]) -> list[str]:
    """The state that columns of bounds name; a pose where a heading is among x, y, heading."""
    components = list(dict.fromkeys(c for one in bound_columns(names) for c in one.components))
    if "heading" in components and set(components) <= set(POSE):
        return list(POSE)
    return components


def with_centres(sheet: TableRows) -> TableRows:
    """The table with the middle of each interval as its estimate, where the component has no column."""
    data = dict(sheet.data)
    for one in bound_columns(list(data)):
        (component, *_), (low, *high) = one.components, one.columns
        if high and component not in data:
            data[component] = 0.5 * (sheet.numbers(low) + sheet.numbers(high[0]))
    return replace(sheet, data=data)


def stated_in(sheet: TableRows, axes: Sequence[str], options: StatementOptions) -> tuple[Bounds, Array] | None:
    """Bounds of a table, and for each row the distance to the lower and the upper end, (N, bounds, 2); or None.

    Raises
    ------
    InputError
        A bound is negative, the ends of an interval are not in order, or a component or level is not known.
    """
    found = bound_columns(list(sheet.data))
    if not found:
        return None
    names = [(one.name, *one.columns) for one in found]
    require_units([name for one in found for name in one.columns], sheet.path)
    values = np.empty((len(sheet), len(found), 2))
    for k, one in enumerate(found):
        for component in one.components:
            if component not in axes:
                raise InputError(f"{sheet.path}: {one.name} bounds '{component}', which is not in the state "
                                 f"{','.join(axes)}; --state names another")  # fmt: skip
        values[:, k] = _distances(sheet, one)
    return _stated(names, [one.components for one in found], axes, options), values


def _distances(sheet: TableRows, one: BoundColumns) -> Array:
    """Distance from the estimate to the lower and the upper end of a bound in each row, (N, 2)."""
    if len(one.columns) == 1:
        size = sheet.numbers(one.columns[0])
        refuse(size < 0.0, sheet.place, lambda row: f"{one.name} is negative, {size[row]:g}")
        return np.stack([size, size], axis=-1)
    low, high = map(sheet.numbers, one.columns)
    x = sheet.numbers(one.components[0])
    lower, upper = one.columns
    refuse(low > high, sheet.place, lambda row: f"{lower} {low[row]:g} is above {upper} {high[row]:g}")
    refuse((x < low) | (x > high), sheet.place, lambda row: (
        f"{one.components[0]} {x[row]:g} is outside {lower} {low[row]:g} and {upper} {high[row]:g}; without a column "
        f"'{one.components[0]}' intervals grow about their middle"
    ))  # fmt: skip
    return np.stack([x - low, high - x], axis=-1)


def _stated(
    names: Sequence[tuple[str, ...]],
    bounded: Sequence[tuple[str, ...]],
    axes: Sequence[str],
    options: StatementOptions,
) -> Bounds:
    """Bounds by their names, of which the first is shown, and the components that they bound."""
    levels, limits = levels_of(options.level), alert_limits(options.alert_limit)
    known = list(dict.fromkeys(name for each in names for name in each))
    levels.require(known)
    limits.require(known)
    of = [levels.of(*each) for each in names]
    bounds = []
    for each, components, level in zip(names, bounded, of, strict=True):
        share = level.of(len(components))
        bounds.append(Bound(each[0], components, share, options.ends == ENDS, limits.get(*each)))
    places = tuple(tuple(map(list(axes).index, components)) for components in bounded)
    deviations = tuple(level.in_deviations(len(one)) for level, one in zip(of, places, strict=True))
    stated = Bounds(tuple(bounds), places, deviations, bool(options.gaussian))
    twice = [axes[i] for i in set(sum(places, ())) if sum(places, ()).count(i) > 1]
    if stated.gaussian and twice:
        raise InputError(f"--gaussian: {twice[0]} has several bounds; leave all but one of them out")
    return stated


# --- arrays ----------------------------------------------------------------------------------------------


def stated_in_arrays(
    where: str, bounds: Array, axes: Sequence[str], shape: tuple[int, ...], options: StatementOptions
) -> tuple[Bounds, Array]:
    """Bounds (runs, steps, n) of each component, or (runs, steps) of the length of all; (runs, steps, bounds, 2).

    Raises
    ------
    InputError
        Another shape, or a negative bound.
    """
    if options.level is None:
        raise InputError(f"{where}bounds need their level: --level 95%, or level=0.95 in Python")
    if bounds.shape == shape[:2]:
        names = [(_name("radius" if len(axes) > 1 else "bound", axes),)]
        bounded = [tuple(axes)]
        bounds = bounds[..., None]
    elif bounds.shape == shape:
        names = [(_name("bound", [axis]),) for axis in axes]
        bounded = [(axis,) for axis in axes]
    else:
        raise InputError(f"{where}bounds has shape {bounds.shape}, needs {shape} of each component, or {shape[:2]} of "
                         "the length of all")  # fmt: skip
    if (bounds < 0.0).any():
        run, step, _ = np.argwhere(bounds < 0.0)[0]
        raise InputError(f"{where}bounds, run {run}, step {step + 1}: negative; a bound is a size")
    return _stated(names, bounded, axes, options), np.stack([bounds, bounds], axis=-1)


def _name(kind: str, axes: Sequence[str]) -> str:
    """radius_x_y; "radius" and bound_0 of components without names."""
    unnamed = [axis.removeprefix("axis ") for axis in axes if axis.startswith("axis ")]
    if len(unnamed) > 1:
        return kind
    return "_".join([kind, *(unnamed or axes)])


def require_gaussian(where: str, options: StatementOptions) -> None:
    """Refuse a level of covariances or deviations that is not declared to be that of a Gaussian."""
    if not options.gaussian:
        raise InputError(f"{where}: has no bounds at --level {options.level}: columns {COLUMNS}, or the key 'bounds' "
                         "of an archive; with --gaussian it is the level of deviations")  # fmt: skip


def covariance_factor(options: StatementOptions) -> float:
    """Factor on covariances whose deviations are stated at a level."""
    level = levels_of(options.level).of("the covariance")
    return level.in_deviations(level.dimensions or 1) ** -2


# --- what is judged ----------------------------------------------------------------------------------------


def covariance_of(stated: Bounds, values: Array, n: int) -> Array:
    """Covariances (N, n, n) of the Gaussian that bounds stand for; of radii, circular ones.

    Where they do not stand for one, the matrices say which rows state a bound: NaN where one is NaN.
    """
    variances = np.ones((len(values), n))
    for k, (index, deviations) in enumerate(zip(stated.places, stated.deviations, strict=True)):
        sigma = values[:, k].mean(axis=-1) / deviations
        if not stated.gaussian:
            sigma = np.where(np.isnan(sigma), np.nan, 1.0)
        variances[:, list(index)] *= np.square(sigma)[:, None]
    return variances[:, :, None] * np.eye(n)


def ratios_of(stated: Bounds, values: Array, errors: Array) -> Array:
    """Errors (N, n) over their bounds (N, bounds, 2), with the sign of single components, (N, bounds)."""
    e = _bounded_errors(stated, errors)
    size = np.where(e < 0.0, values[..., 0], values[..., 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where((e == 0.0) & ~np.isnan(size), 0.0, e / size)


def regions_of(stated: Bounds, values: Array, errors: Array) -> Array | None:
    """Regions of the Stanford diagram of errors (N, n) with bounds (N, bounds, 2), by their places in REGIONS.

    (N, bounds), which say nothing of a bound without an alert limit; None where no bound has one. Of an interval its
    longer side decides whether it alerts.
    """
    limits = np.array([np.nan if bound.alert_limit is None else bound.alert_limit for bound in stated.bounds])
    if np.isnan(limits).all():
        return None
    ratios = np.abs(ratios_of(stated, values, errors))
    is_misleading = ratios > 1.0
    is_hazard = np.abs(_bounded_errors(stated, errors)) > limits
    regions = np.where(values.max(axis=-1) > limits, 3.0 + is_misleading, np.where(is_hazard, HAZARD, is_misleading))
    return np.where(np.isnan(ratios), np.nan, regions)


def _bounded_errors(stated: Bounds, errors: Array) -> Array:
    """What is bounded of errors (N, n): a component with its sign, or the length of several, (N, bounds)."""
    return np.stack(
        [errors[:, i[0]] if len(i) == 1 else np.linalg.norm(errors[:, list(i)], axis=1) for i in stated.places], axis=1
    )


def judged_bounds(record: Record, e: Estimator, level_text: str) -> Record:
    """The record with bounds in place of covariances; with ``--gaussian``, components by what they are stated with."""
    stated = e.error.bounds
    assert stated is not None
    if stated.gaussian:
        places = {list(e.error.axes).index(axis): i for i, axis in enumerate(record.errors.axes)}
        parts = tuple(tuple(places[i] for i in index) for index in stated.places)
        note = f"{e.said}: bounds are read as those of a Gaussian at --level {level_text}"
        errors = replace(record.errors, parts=parts if len(parts) > 1 else (), bounded=None)
        return replace(record, errors=errors).with_notes(note)
    failures = tuple(replace(f, reason=f.reason.replace("covariance", "bound")) for f in record.failures)
    errors = replace(record.errors, error=None, covariance=None, nees=None, dof=0)
    return replace(record, errors=errors, failures=failures, origin=replace(record.origin, causes=()))
