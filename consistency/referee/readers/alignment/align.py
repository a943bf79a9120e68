"""The alignment that is asked for, and runs in the world of the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from consistency.referee.diagnostics import Evidence
from consistency.referee.errors import InputError
from consistency.referee.readers.poses import Poses

ALIGNMENTS = ("none", "origin", "posyaw", "posyaw-all", "se3", "se3-all")


@dataclass(frozen=True)
class Aligned:
    """Runs in the world of the truth, with notes on the alignment."""

    runs: Sequence[Poses]  # moved estimates, with covariances of the residual errors
    align: str = "none"  # the mode
    notes: tuple[str, ...] = ()
    caption: str = ""  # what the verdict has to say of it
    reduced: bool = False  # the errors may be smaller than the covariance says without a fault
    unavailable: tuple[str, ...] = ()  # questions that have no answer
    unseen: float = 0.0  # share of the NEES that a frame may have absorbed without a correction

    def on(self, recording: Evidence) -> Evidence:
        """Recording of these runs, with the notes on their alignment."""
        return replace(recording, **{key: value for key, value in vars(self).items() if key not in ("runs", "notes")})


def require_alignment(mode: str | None, truth: object) -> str | None:
    """The alignment that was asked for, or None if there is none.

    Raises
    ------
    InputError
        It is unknown, or there is no truth to align with.
    """
    if mode not in (None, *ALIGNMENTS):
        raise InputError(f"--align {mode}: must be one of {', '.join(ALIGNMENTS)}")
    if mode in (None, "none"):
        return None
    if truth is None:
        raise InputError(f"--align {mode} needs --truth, with which the estimates are aligned")
    return mode
