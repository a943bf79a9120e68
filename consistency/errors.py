"""The errors that a user can correct."""

from consistency.referee.errors import InputError
from consistency.referee.extras import MissingPackageError

__all__ = ["InputError", "MissingPackageError"]
