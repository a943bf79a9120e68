"""The part of a kernel that is a guard: one for all kinds, so that a filter behind any of them has one kernel."""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.guard.joint_compatibility import keep_compatible
from consistency.bench.filters.guard.ransac import keep_supported
from consistency.bench.filters.guard.screening import (
    Tracks,
    Watch,
    enters_unless_rejected,
    pass_gate,
    rejected_of,
    screen_known,
    watch_tracks,
)
from consistency.bench.filters.guard.settings import KINDS, limits_of
from consistency.bench.filters.kernel.part_functions import keep_some, make_watch, may_enter, rejected_rows, screen
from consistency.bench.scenario import GuardSettings
from consistency.referee.types import Array

JOINT, RANSAC = list(KINDS).index("joint"), list(KINDS).index("ransac")


@part()
class Guard(NamedTuple):
    """Squared distances up to which 0, 1, ... observations are accepted together, and one supports a hypothesis."""

    kind: int  # JOINT, RANSAC, or a gate of each observation alone (Cox 1993)
    tracks: Tracks
    joint: Array  # (m + 1,)
    support: float


implement(make_watch, Guard)(watch_tracks)
implement(screen, Guard)(screen_known)
implement(may_enter, Guard)(enters_unless_rejected)
implement(rejected_rows, Guard)(rejected_of)


@implement(keep_some, Guard)
def keep_agreeing(guard: Guard, s: int, m: int, y: Array, S: Array, watch: Watch) -> bool:
    count = pass_gate(guard.joint[1], s, m, y, S, watch)
    if count >= 0 and guard.kind == JOINT:
        return keep_compatible(guard.joint, count, s, m, y, S, watch)
    if count >= 0 and guard.kind == RANSAC:
        return keep_supported(guard.joint[1], guard.support, count, s, m, y, S, watch)
    return count >= 0


def guard_part(kind: str, settings: GuardSettings, s: int, m: int) -> Guard:
    """A guard of up to ``m`` landmarks in a step, each with ``s`` values."""
    limits, tracks = limits_of(settings, s, m), Tracks(settings.min_age, settings.forget_after or 0)
    return Guard(list(KINDS).index(kind), tracks, limits.joint, limits.support)
