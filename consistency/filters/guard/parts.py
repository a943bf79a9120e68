"""The part of a kernel that is a guard of a kind."""

from __future__ import annotations

from typing import NamedTuple

from consistency.filters.guard.gate import Gate
from consistency.filters.guard.joint import Compatible
from consistency.filters.guard.ransac import OnePoint
from consistency.filters.guard.screening import Tracks
from consistency.filters.guard.settings import limits_of
from consistency.scenario import GuardSettings


def guard_part(kind: str, settings: GuardSettings, s: int, m: int) -> NamedTuple:
    """A guard of up to ``m`` landmarks in a step, each with ``s`` values."""
    limits, tracks = limits_of(settings, s, m), Tracks(settings.min_age, settings.forget_after or 0)
    if kind == "gate":
        return Gate(tracks, limits.joint)
    if kind == "joint":
        return Compatible(tracks, limits.joint)
    return OnePoint(tracks, limits.joint, limits.support)
