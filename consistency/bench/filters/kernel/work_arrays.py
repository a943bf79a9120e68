"""Work arrays of a trial, made once: no step allocates."""

from __future__ import annotations

from typing import Any, Generic, NamedTuple, TypeVar

from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.arrays import blocks, integers, matrix, vector
from consistency.bench.filters.kernel.part_functions import Slam, landmark_width, make_notes, make_room, observed_width
from consistency.referee.types import Array, Indices

Room = TypeVar("Room", covariant=True)


class Work(NamedTuple, Generic[Room]):
    """``m``: the most landmarks seen in a step, ``n``: final size of the state, ``L`` = 3 + w m, s: of ``measure``."""

    known: Indices  # (m,) rows of the observations whose landmark is in the state
    at: Indices  # (m,) and its offset there
    label: Indices  # (m,) and its label
    zhat: Array  # (s m,) expected observations
    scale: Array  # (max(L, s m),) diagonal of what is factored
    S: Array  # (s m, s m) innovation covariance, upper half
    A: Array  # (s m, n + 1) Cov(z, x); in the column after the state the innovation
    rows: Array  # (L, n) rows of P of the robot and the seen landmarks
    delta: Array  # (n,) an error of the whole state
    Hp: Array  # (m, s, 3) Jacobians
    Hl: Array  # (m, s, w)
    Jp: Array  # (w, 3) of a new landmark
    Jz: Array  # (w, s)
    Jb: Array  # (3, s) of its position in the robot frame
    pose: Array  # (3,)
    prior: Array  # (L,) of the variables involved, for an update that iterates
    small: Array  # (3, 3)
    room: Room  # what the update alone needs
    notes: Any  # what the linearisation point alone needs, of a type of its own


@inner
def make_work(slam: Slam, n: int, m: int, steps: int, labels: int) -> Work[NamedTuple]:
    """Arrays for a state of up to ``n`` variables, ``m`` landmarks in a step, and a trial with so many labels."""
    w, s = landmark_width(slam.landmark), observed_width(slam.sensor)
    rows = s * m
    return Work(
        integers(m, 0),
        integers(m, 0),
        integers(m, 0),
        vector(rows),
        vector(max(3 + w * m, rows)),
        matrix(rows, rows),
        matrix(rows, n + 1),
        matrix(3 + w * m, n),
        vector(n),
        blocks(m, s, 3),
        blocks(m, s, w),
        matrix(w, 3),
        matrix(w, s),
        matrix(3, s),
        vector(3),
        vector(3 + w * m),
        matrix(3, 3),
        make_room(slam.update, w, s, m, n),
        make_notes(slam.point, w, steps, labels),
    )
