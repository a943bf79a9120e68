"""What every reader gives: the runs of an estimator as its files have them, before any error is taken."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from consistency.referee.readers.truth_matching import Poses
from consistency.referee.types import Array

AXES: tuple[str, ...] = ("x", "y", "z", "roll", "pitch", "yaw")  # from roll on a rotation vector
REST = ("vx", "vy", "vz", "bgx", "bgy", "bgz", "bax", "bay", "baz")  # velocity, biases of gyroscope and accelerometer
STATE = (*AXES, *REST)


@dataclass(frozen=True)
class Stated:
    """Which covariances a file states: components have cross terms with those of their own group only."""

    groups: Mapping[str, slice] = field(default_factory=lambda: {"": slice(None)})  # by the end of a record's name
    alone: bool = False  # standard deviations: each component of a group is judged by itself


WHOLE = Stated()
ALONE = Stated(alone=True)
POINTS = Stated({"": slice(3)})  # positions without orientations
BLOCKS = Stated({" position": slice(3), " rotation": slice(3, 6)})
SINGLE = Stated(
    {f" {axis}": slice(i, i + 1) for i, axis in enumerate(AXES)} | {" velocity and biases": slice(6, None)}, alone=True
)


@dataclass(frozen=True)
class Estimator:
    """The runs of one estimator, with what its record is called and what a reader must know of it."""

    name: str
    path: Path  # of the estimates, for messages
    runs: Sequence[Poses]
    axes: Sequence[str]  # names of the components of the error
    convention: str = ""  # of the error; "" where the file holds errors
    definition: str = ""  # of the convention, in words
    stated: Stated = WHOLE
    label: str = ""  # of the estimator in notes; its name if there is none
    covariances: Path | None = None  # file of the covariances; that of the estimates if there is none
    notes: Sequence[str] = ()  # what the files were read as
    causes: Sequence[str] = ()  # mix-ups that are found while reading
    judged: Sequence[int] | None = None  # components that are estimated; None if the errors tell
    in_space: bool = False  # poses in space, or positions beside such a truth
    position: int = 0  # leading components of an estimate that are a position in m, to be drawn
    t: Array | None = None  # (steps,), s, of an archive, whose poses are numbered by its steps from 0 on
    innovations_alone: bool = False  # there is no truth

    @property
    def said(self) -> str:
        """Its name in notes."""
        return self.label or self.name
