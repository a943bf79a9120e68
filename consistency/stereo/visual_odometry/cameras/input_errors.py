"""Errors of input that cannot be used, and OpenCV, or the error that says what to install."""

from __future__ import annotations

import importlib
from typing import Any

from consistency.referee.errors import InputError
from consistency.referee.extras import MissingPackageError, remedy


class MatchError(InputError):
    """Something that may be one match's fault: ``match`` is its number, from 0, or None."""

    def __init__(self, message: str, match: int | None = None) -> None:
        super().__init__(message)
        self.match = match


class PointError(MatchError):
    """A point at infinity, at a camera or behind it, or a match without positive disparity."""


class DegenerateError(MatchError):
    """Points that do not fix a rigid motion: fewer than three, identical, or on one line; or one that is not fixed."""


class ConsensusError(InputError):
    """No motion has enough inliers."""


class GimbalLockError(InputError):
    """A pitch of +-90 degrees, where roll and yaw are not defined."""


class ConvergenceError(InputError):
    """A minimisation that did not reach a minimum."""


def opencv() -> Any:
    """The module ``cv2``.

    Raises
    ------
    InputError
        OpenCV is not installed.
    """
    try:
        return importlib.import_module("cv2")
    except ImportError:
        raise MissingPackageError(f"an image needs {remedy('vision')}") from None
