"""How files of another estimator are read: values of options, for readers, commands and Python alike.

A field of a value has the name of its option. ``OPTIONS`` says how the command line shows each.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from consistency.referee.errors import InputError

COLUMNS = "columns"  # covariance of the truth: of its own file
REPEATS = "repeats"  # in place of a file of the truth
GROUPED = ("by", "by_file", "bins")  # options
ERRORS = ("so2", "vector", "left", "right", "so3", "so3-body", "rvec", "euler", "additive", "guess")
MODES = ("none", "origin", "posyaw", "posyaw-all", "se3", "se3-all")  # of --align
OF_AXES = ("world", "body_axes", "truth_world", "truth_body_axes")
MAX_DT = 0.01  # s between an estimate and its truth: half a period of a 50 Hz truth


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",")]


def _seconds(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _lengths(text: str) -> list[float]:
    """Numbers; NaN where one is none, which the readers refuse."""
    numbers = [math.nan] * (text.count(",") + 1)
    for i, part in enumerate(text.split(",")):
        with suppress(ValueError):
            numbers[i] = float(part)
    return numbers


def _columns(text: str) -> dict[str, str]:
    """Names of columns here and in a file, of a text such as ``x=pos_n,y=pos_e``."""
    columns: dict[str, str] = {}
    for pair in text.split(","):
        new, _, old = map(str.strip, pair.partition("="))
        if not new or not old or "=" in old:
            raise InputError(f"'{text}': columns are named as x=pos_n,y=pos_e: the name here, then that in the file")
        if new in columns:
            raise InputError(f"'{text}': column '{new}' is named twice")
        if ("*" in new) != ("*" in old):
            raise InputError(f"'{pair}': a * stands in both names or in none")
        columns[new] = old
    return columns


def _columns_of_members(text: str) -> dict[str, str]:
    """Names of components and of the columns of their members, of a text such as ``x=ex*,y=ey*``."""
    return {name: column + "*" for name, column in _columns(text.replace("*", "")).items()}


def _bins(text: str) -> int | list[float]:
    """A number of bins, or edges, of which a single one ends with a comma; NaN where one is none."""
    if text.strip().isdecimal():
        return int(text)
    return _lengths(text.strip().removesuffix(","))


@dataclass(frozen=True, kw_only=True)
class SourceOptions:
    """What is read beside the estimates, and which topics of a bag."""

    truth: Path | None = None
    covariance: Path | None = None
    topic: str | None = None
    truth_topic: str | None = None
    body: str | None = None

    @property
    def repeats(self) -> bool:
        """Whether runs are repeats of the same true values, and no file is called so."""
        return self.truth == Path(REPEATS) and not Path(REPEATS).exists()


@dataclass(frozen=True, kw_only=True)
class ConventionOptions:
    """What numbers of the files mean: the error, the order of a covariance, axes of world and body."""

    error: str | None = None
    covariance_order: str | None = None
    world: str | None = None
    body_axes: str | None = None
    truth_world: str | None = None
    truth_body_axes: str | None = None


@dataclass(frozen=True, kw_only=True)
class ComponentOptions:
    """Components of the error, and names of their columns."""

    state: Sequence[str] | None = None
    axes: Sequence[str] | None = None
    columns: Mapping[str, str] | None = None
    truth_columns: Mapping[str, str] | None = None
    members: Mapping[str, str] | None = None


@dataclass(frozen=True, kw_only=True)
class MatchingOptions:
    """How estimates are compared with the truth: clocks, frames, the point that is measured."""

    max_dt: float | None = None
    time_offset: float | str | None = None
    align: str | None = None
    lever_arm: Sequence[float] | None = None

    @property
    def tolerance(self) -> float:
        """Seconds between an estimate and its truth at most."""
        if self.max_dt is None:
            return MAX_DT
        return self.max_dt

    @property
    def shift(self) -> float:
        """Seconds to add to the timestamps of the estimates, as far as that is said."""
        return self.time_offset if isinstance(self.time_offset, float) else 0.0


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """What is judged as a run: a log, its pieces or windows, a row."""

    relative: str | float | None = None
    motions: bool | None = None
    windows: str | None = None
    independent: bool | None = None
    split: str | int | None = None


@dataclass(frozen=True, kw_only=True)
class TruthOptions:
    """What is declared of errors of the truth itself."""

    truth_covariance: str | None = None
    truth_errors: str | None = None
    truth_shared: bool | None = None


@dataclass(frozen=True, kw_only=True)
class StatementOptions:
    """What estimates state in place of covariances, or in addition to them."""

    level: str | float | Mapping[str, Any] | None = None
    gaussian: bool | None = None
    ends: str | None = None
    alert_limit: str | float | Mapping[str, Any] | None = None
    dof: int | None = None
    ensemble: int | None = None
    unstated: bool | None = None  # of no command line: the covariance is I where the files state none

    @property
    def is_of_bounds(self) -> bool:
        """Whether bounds are judged as such, and not as the covariance of a Gaussian."""
        return self.level is not None and not self.gaussian


@dataclass(frozen=True, kw_only=True)
class GroupOptions:
    """The column that makes groups."""

    by: str | None = None
    by_file: Path | None = None
    bins: int | Sequence[float] | None = None

    @property
    def own_column(self) -> str | None:
        """The column if it stands beside the estimates; None if it is of another file, or none is asked for."""
        return self.by if self.by_file is None else None


@dataclass(frozen=True, kw_only=True)
class Reading:
    """Options of files; None leaves one to the kind of file. :func:`consistency.read` describes them.

    :func:`make_reading` makes one of the options by name.
    """

    sources: SourceOptions = SourceOptions()
    conventions: ConventionOptions = ConventionOptions()
    components: ComponentOptions = ComponentOptions()
    matching: MatchingOptions = MatchingOptions()
    runs: RunOptions = RunOptions()
    truth: TruthOptions = TruthOptions()
    statement: StatementOptions = StatementOptions()
    groups: GroupOptions = GroupOptions()

    def option(self, name: str) -> Any:
        """The value of an option, by its name."""
        return getattr(getattr(self, VALUES[name]), name)

    def given(self, names: Iterable[str] | None = None) -> list[str]:
        """Options among ``names``, or among all, that are given, in order."""
        return [name for name in (NAMES if names is None else names) if self.option(name) is not None]

    def as_options(self) -> dict[str, Any]:
        """Values of the options that are given, by name."""
        return {name: self.option(name) for name in self.given()}

    def refuse(self, flag: str, others: Mapping[str, str]) -> None:
        """Refuse options that do not go with ``flag``, each with its reason."""
        for name, why in others.items():
            if self.option(name):
                raise InputError(f"{flag}: does not go with {flag_of(name)}{why}")

    def with_options(self, **options: Any) -> Reading:
        """Other values of some options, by name.

        Raises
        ------
        TypeError
            An option is unknown.
        """
        changed: dict[str, dict[str, Any]] = {}
        for name, value in options.items():
            if name not in VALUES:
                raise TypeError(f"no option of files: {name}")
            changed.setdefault(VALUES[name], {})[name] = value
        return replace(self, **{part: replace(getattr(self, part), **own) for part, own in changed.items()})

    def with_truth(self, truth: Path | None) -> Reading:
        """The options with another file of the truth."""
        return replace(self, sources=replace(self.sources, truth=truth))

    def with_error(self, error: str | None) -> Reading:
        """The options with another convention of the error."""
        return replace(self, conventions=replace(self.conventions, error=error))


def make_reading(**options: Any) -> Reading:
    """Options of files by name; raises TypeError if one is unknown."""
    return Reading().with_options(**options)


@dataclass(frozen=True)
class Option:
    """How the command line shows an option, and what it makes of a text."""

    name: str
    help: str
    metavar: str | None = None
    parse: Callable[[str], Any] | None = None
    flag: str | None = None
    values: Sequence[str] = ()


OPTIONS = (  # those that users give, in the order in which the command line shows them
    Option("truth", "Truth like the estimates, KITTI drive, or 'repeats'."),
    Option("covariance", "Covariances of a TUM trajectory: t, 36 or 21 numbers."),
    Option(
        "error",
        "Error definition the covariance refers to: so2, vector, left, right, so3, so3-body, rvec, euler, additive, or "
        "guess.",
        "ERROR",
        values=ERRORS,
    ),
    Option("state", "Columns of the state [x,y,heading].", "A,B,C", _names),
    Option(
        "covariance_order",
        "Order of the covariance: translation-rotation [default], rotation-translation, or blocks of p, R, v, bg, ba "
        "such as p,v,R.",
    ),
    Option("max_dt", f"Maximum time between an estimate and its truth, s [{MAX_DT:g}]."),
    Option("time_offset", "Seconds to add to the timestamps of the estimates.", "S|estimate", _seconds),
    Option("axes", "Components of a trajectory to judge: x,y,yaw.", "A,B,C", _names),
    Option("topic", "Topic of the estimates in a ROS bag."),
    Option("truth_topic", "Topic of the truth in a ROS bag, or PARENT:CHILD, two frames of /tf."),
    Option("body", "Body that a KITTI drive as truth refers to: imu [default], velodyne or camera."),
    Option("relative", "Judge motions over windows: steps, seconds, metres.", "N|Ns|Nm", str),
    Option("motions", "Read each row as a motion with its own covariance (with --relative).", flag="--motions/"),
    Option("windows", "'independent': treat each window as an independent run."),
    Option("independent", "Each row, or window, is an independent run.", flag="--independent/"),
    Option(
        "align",
        "Move estimates into the world of the truth: none; origin, by the first pose of each run; posyaw or se3, by "
        "a frame fitted to each run (posyaw-all, se3-all: to all).",
        "MODE",
        values=MODES,
    ),
    Option("lever_arm", "Point that a truth of positions measures, in the axes of the body, m.", "X,Y,Z", _lengths),
    Option("split", "Split one log into N runs, taken as independent.", "auto|N", str),
    Option(
        "truth_covariance",
        "Covariance of the truth: 'columns' of its file, or a file of t and 36 or 21 numbers.",
        "columns|FILE",
    ),
    Option("truth_errors", "Dependence of the truth's errors: independent, per-run, or common to all runs."),
    Option("truth_shared", "Declare that the estimator has fused the truth.", flag="--truth-shared/"),
    Option("level", "Level of bounds and radii: 95%, 2sigma, CEP.", "LEVEL", str),
    Option(
        "gaussian",
        "Read them (or deviations) at that --level as the covariance of a Gaussian, circular for radii.",
        flag="--gaussian/",
    ),
    Option("ends", "'independent': declare that ends of runs and lost runs do not depend on the errors (bounds)."),
    Option("alert_limit", "Alert limit of protection levels, for shares of the Stanford diagram.", "LIMIT", str),
    Option("by", "Judge groups by this column, too, or since:TOPIC.", "COLUMN"),
    Option("by_file", "Table with that column and t, run or both."),
    Option("bins", "Quantile bins of --by [5], or edges between them (40, is one edge).", "N|A,B,C", _bins),
    Option(
        "columns",
        "What columns of the estimates are called: x=pos_n,y=pos_e; P*=cov_* for all that begin alike.",
        "NAME=COLUMN,…",
        _columns,
    ),
    Option("truth_columns", "What columns of the truth are called, as --columns.", "NAME=COLUMN,…", _columns),
    Option("world", "World axes of the estimates: enu [default], ned ...", "AXES"),
    Option("body_axes", "Axes of the body of the estimates: flu [default], frd ...", "AXES"),
    Option("truth_world", "Axes of the world of the truth [enu].", "AXES"),
    Option("truth_body_axes", "Axes of the body of the truth [flu].", "AXES"),
    Option("dof", "Degrees of freedom of each NIS of a table that has no column of them.", "N"),
    Option(
        "members",
        "Columns of the members of an ensemble: x=e* for all that begin with e.",
        "NAME=COLUMN*,…",
        _columns_of_members,
    ),
    Option("ensemble", "Number of members whose mean and sample covariance the files state.", "N"),
)
VALUES = {each.name: part.name for part in fields(Reading) for each in fields(getattr(Reading, part.name))}  # by option
NAMES = tuple(dict.fromkeys([*(each.name for each in OPTIONS), *VALUES]))


def flag_of(name: str) -> str:
    """A name as the command line spells it: ``max_dt`` -> ``--max-dt``."""
    return f"--{name.replace('_', '-')}"
