"""A chi-square gate of each observation by its own innovation, Cox (1993): the kernel."""

from __future__ import annotations

from typing import NamedTuple

from consistency.filters.guard.screening import (
    Tracks,
    Watch,
    pass_gate,
    share_screening,
)
from consistency.filters.kernel.dispatch import implement, part
from consistency.filters.kernel.slam import keep_some
from consistency.types import Array


@part()
class Gate(NamedTuple):
    """Squared distances (m + 1,) up to which 0, 1, ... observations are accepted together."""

    tracks: Tracks
    joint: Array


share_screening(Gate)


@implement(keep_some, Gate)
def keep_near(guard: Gate, s: int, m: int, y: Array, S: Array, watch: Watch) -> bool:
    return pass_gate(guard.joint[1], s, m, y, S, watch) >= 0
