"""Work arrays of a trial, made once: no step allocates."""

from __future__ import annotations

from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from consistency.filters.kernel.jit import inner
from consistency.filters.kernel.slam import OBSERVED, Slam, landmark_width, make_notes, make_room, robot_width
from consistency.types import Array, Indices

Room = TypeVar("Room", covariant=True)


class NoNotes(NamedTuple):
    """Of a linearisation point that remembers nothing."""


class Work(NamedTuple, Generic[Room]):
    """``m`` is the most landmarks seen in a step, ``n`` the final size of the state, ``L`` = r + w m."""

    known: Indices  # (m,) rows of the observations whose landmark is in the state
    at: Indices  # (m,) and its offset there
    label: Indices  # (m,) and its label
    zhat: Array  # (3 m,) expected observations
    scale: Array  # (max(L, 3 m),) diagonal of what is factored
    S: Array  # (3 m, 3 m) innovation covariance, upper half
    A: Array  # (3 m, n + 1) Cov(z, x); in the column after the state the innovation
    rows: Array  # (L, n) rows of P of the robot and the seen landmarks
    delta: Array  # (n,) an error of the whole state
    Hp: Array  # (m, 3, r) Jacobians
    Hl: Array  # (m, 3, w)
    Jp: Array  # (w, r) of a new landmark
    Jz: Array  # (w, 3)
    Jb: Array  # (3, 3) of its position in the robot frame
    pose: Array  # (r,)
    small: Array  # (r, r)
    room: Room  # what the update alone needs
    notes: Any  # what the linearisation point alone needs, of a type of its own


@inner
def make_work(slam: Slam, n: int, m: int, steps: int, labels: int) -> Work[NamedTuple]:
    """Arrays for a state of up to ``n`` variables, ``m`` landmarks in a step, and a trial with so many labels."""
    r, w = robot_width(slam.motion), landmark_width(slam.landmark)
    rows = OBSERVED * m
    return Work(
        np.empty(m, np.int64),
        np.empty(m, np.int64),
        np.empty(m, np.int64),
        np.empty(rows),
        np.empty(max(r + w * m, rows)),
        np.empty((rows, rows)),
        np.empty((rows, n + 1)),
        np.empty((r + w * m, n)),
        np.empty(n),
        np.empty((m, OBSERVED, r)),
        np.empty((m, OBSERVED, w)),
        np.empty((w, r)),
        np.empty((w, OBSERVED)),
        np.empty((3, 3)),
        np.empty(r),
        np.empty((r, r)),
        make_room(slam.update, r, w, m, n),
        make_notes(slam.point, r, w, steps, labels),
    )
