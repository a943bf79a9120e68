"""How files of another estimator are read: one record of options, for readers, commands and Python alike."""

# ruff: noqa: RUF009  # an option is a field

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields
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


def _option(
    help: str,
    metavar: str | None = None,
    parse: Callable[[str], Any] | None = None,
    flag: str | None = None,
    values: Sequence[str] = (),
) -> Any:
    """An option: how the command line shows it, and what it makes of a text."""
    return field(
        default=None, metadata={"help": help, "metavar": metavar, "parse": parse, "flag": flag, "values": values}
    )


@dataclass(frozen=True, kw_only=True)
class Reading:
    """Options of files; None leaves one to the kind of file. :func:`consistency.read` describes them."""

    truth: Path | None = _option("Truth like the estimates, KITTI drive, or 'repeats'.")
    covariance: Path | None = _option("Covariances of a TUM trajectory: t, 36 or 21 numbers.")
    error: str | None = _option(
        "Error definition the covariance refers to: so2, vector, left, right, so3, so3-body, rvec, euler, additive, or "
        "guess.",
        "ERROR",
        values=ERRORS,
    )
    state: Sequence[str] | None = _option("Columns of the state [x,y,heading].", "A,B,C", _names)
    covariance_order: str | None = _option(
        "Order of the covariance: translation-rotation [default], rotation-translation, or blocks of p, R, v, bg, ba "
        "such as p,v,R."
    )
    max_dt: float | None = _option(f"Maximum time between an estimate and its truth, s [{MAX_DT:g}].")
    time_offset: float | str | None = _option(
        "Seconds to add to the timestamps of the estimates.", "S|estimate", _seconds
    )
    axes: Sequence[str] | None = _option("Components of a trajectory to judge: x,y,yaw.", "A,B,C", _names)
    topic: str | None = _option("Topic of the estimates in a ROS bag.")
    truth_topic: str | None = _option("Topic of the truth in a ROS bag, or PARENT:CHILD, two frames of /tf.")
    body: str | None = _option("Body that a KITTI drive as truth refers to: imu [default], velodyne or camera.")
    relative: str | float | None = _option("Judge motions over windows: steps, seconds, metres.", "N|Ns|Nm", str)
    motions: bool | None = _option(
        "Read each row as a motion with its own covariance (with --relative).", flag="--motions/"
    )
    windows: str | None = _option("'independent': treat each window as an independent run.")
    independent: bool | None = _option("Each row, or window, is an independent run.", flag="--independent/")
    align: str | None = _option(
        "Move estimates into the world of the truth: none; origin, by the first pose of each run; posyaw or se3, by "
        "a frame fitted to each run (posyaw-all, se3-all: to all).",
        "MODE",
        values=MODES,
    )
    lever_arm: Sequence[float] | None = _option(
        "Point that a truth of positions measures, in the axes of the body, m.", "X,Y,Z", _lengths
    )
    split: str | int | None = _option("Split one log into N runs, taken as independent.", "auto|N", str)
    truth_covariance: str | None = _option(
        "Covariance of the truth: 'columns' of its file, or a file of t and 36 or 21 numbers.", "columns|FILE"
    )
    truth_errors: str | None = _option("Dependence of the truth's errors: independent, per-run, or common to all runs.")
    truth_shared: bool | None = _option("Declare that the estimator has fused the truth.", flag="--truth-shared/")
    level: str | float | Mapping[str, Any] | None = _option(
        "Level of bounds and radii: 95%, 2sigma, CEP.", "LEVEL", str
    )
    gaussian: bool | None = _option(
        "Read them (or deviations) at that --level as the covariance of a Gaussian, circular for radii.",
        flag="--gaussian/",
    )
    ends: str | None = _option(
        "'independent': declare that ends of runs and lost runs do not depend on the errors (bounds)."
    )
    by: str | None = _option("Judge groups by this column, too: bins, or words.", "COLUMN")
    by_file: Path | None = _option("Table with that column and t, run or both.")
    bins: int | Sequence[float] | None = _option(
        "Quantile bins of --by [5], or edges between them (40, is one edge).", "N|A,B,C", _bins
    )
    columns: Mapping[str, str] | None = _option(
        "What columns of the estimates are called: x=pos_n,y=pos_e; P*=cov_* for all that begin alike.",
        "NAME=COLUMN,…",
        _columns,
    )
    truth_columns: Mapping[str, str] | None = _option(
        "What columns of the truth are called, as --columns.", "NAME=COLUMN,…", _columns
    )
    world: str | None = _option("World axes of the estimates: enu [default], ned ...", "AXES")
    body_axes: str | None = _option("Axes of the body of the estimates: flu [default], frd ...", "AXES")
    truth_world: str | None = _option("Axes of the world of the truth [enu].", "AXES")
    truth_body_axes: str | None = _option("Axes of the body of the truth [flu].", "AXES")
    dof: int | None = _option("Degrees of freedom of each NIS of a table that has no column of them.", "N")
    unstated: bool | None = None  # of no command line: the covariance is I where the files state none

    members: Mapping[str, str] | None = _option(
        "Columns of the members of an ensemble: x=e* for all that begin with e.", "NAME=COLUMN*,…", _columns_of_members
    )
    ensemble: int | None = _option("Number of members whose mean and sample covariance the files state.", "N")

    @property
    def repeats(self) -> bool:
        """Whether runs are repeats of the same true values, and no file is called so."""
        return self.truth == Path(REPEATS) and not Path(REPEATS).exists()

    def given(self, names: Sequence[str] | None = None) -> list[str]:
        """Options among ``names``, or among all, that are given, in order."""
        if names is None:
            names = [each.name for each in fields(self)]
        return [name for name in names if getattr(self, name) is not None]

    def refuse(self, flag: str, others: Mapping[str, str]) -> None:
        """Refuse options that do not go with ``flag``, each with its reason."""
        for name, why in others.items():
            if getattr(self, name):
                raise InputError(f"{flag}: does not go with {flag_of(name)}{why}")

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


OPTIONS = [each for each in fields(Reading) if each.metadata]  # those that users give


def flag_of(name: str) -> str:
    """A name as the command line spells it: ``max_dt`` -> ``--max-dt``."""
    return f"--{name.replace('_', '-')}"
