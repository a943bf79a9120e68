"""What can be wrong with matches, points and poses; all are :class:`consistency.errors.InputError`."""

from consistency.errors import InputError


class PointError(InputError):
    """A point at infinity, at a camera or behind it, or a match without positive disparity."""


class DegenerateError(InputError):
    """Points that do not fix a rigid motion: fewer than three, identical, or on one line."""


class ConsensusError(InputError):
    """No motion has enough inliers."""


class GimbalLockError(InputError):
    """A pitch of +-90 degrees, where roll and yaw are not defined."""


class ConvergenceError(InputError):
    """A minimisation that did not reach a minimum."""
