"""A chi-square gate of each observation by its own innovation, Cox (1993): the kernel."""

from __future__ import annotations

from typing import NamedTuple

from consistency.filters.guard.screening import (
    Tracks,
    Watch,
    enters_unless_rejected,
    pass_gate,
    rejected_of,
    screen_known,
    watch_tracks,
)
from consistency.filters.kernel.dispatch import implement, part
from consistency.filters.kernel.slam import keep_some, make_watch, may_enter, rejected_rows, screen
from consistency.types import Array


@part()
class Gate(NamedTuple):
    """Squared distances (m + 1,) up to which 0, 1, ... observations are accepted together."""

    tracks: Tracks
    joint: Array


implement(make_watch, Gate)(watch_tracks)
implement(screen, Gate)(screen_known)
implement(may_enter, Gate)(enters_unless_rejected)
implement(rejected_rows, Gate)(rejected_of)


@implement(keep_some, Gate)
def keep_near(guard: Gate, s: int, m: int, y: Array, S: Array, watch: Watch) -> bool:
    return pass_gate(guard.joint[1], s, m, y, S, watch) >= 0
