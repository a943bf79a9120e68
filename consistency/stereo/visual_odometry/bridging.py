"""Motions that the images do not tell, from the motions around them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.types import Array, Indices
from consistency.stereo.visual_odometry.motion import RelativeMotion
from consistency.stereo.visual_odometry.pose import RelativePose

FULL, FEWEST = 12, 3  # motions beside which a bridge was tried, for a covariance (6, 6), and for variances alone
MOST = 0.5  # of the motions may be missing


def bridged(found: Sequence[RelativeMotion | InputError], t: Array) -> list[RelativeMotion]:
    """All motions of a sequence, where those that could not be measured keep to their neighbours' velocity.

    Between two measured motions the six numbers of the pose are interpolated, before the first and after the last one
    held. The covariance is what the same rule misses by, on average, where the motion was measured.

    Parameters
    ----------
    found : T motions, or why there is none
    t : (T + 1,), s

    Returns
    -------
    T motions; a bridge has no matches, and the reason as its ``fault``

    Raises
    ------
    InputError
        More than half of the motions are missing, or too few are left to tell how well a bridge holds.
    """
    good = np.array([isinstance(each, RelativeMotion) for each in found], bool)
    faults = {k: each for k, each in enumerate(found) if isinstance(each, InputError)}
    measured = [each for each in found if isinstance(each, RelativeMotion)]
    if not faults:
        return measured
    first = next(iter(faults.values()))
    if len(found) == 1:
        raise first
    if len(faults) > MOST * len(found):
        raise type(first)(f"{len(faults)} of {len(found)} motions could not be measured; the first: {first}")
    dt = np.diff(t)
    speed = np.full((len(found), 6), np.nan)  # of the numbers of the pose
    speed[good] = np.array([m.pose.vector for m in measured]) / dt[good, None]
    motions = dict(zip(np.flatnonzero(good).tolist(), measured, strict=True))
    for k, fault in faults.items():
        around, share = neighbours(good, t, k)
        missed = _missed(speed, around - k, share)
        if len(missed) < FEWEST:
            raise type(fault)(f"{fault} (too few motions around it were measured to bridge it)")
        P = missed.T @ missed / len(missed)
        P = np.diag(np.diag(P)) if len(missed) < FULL else P
        pose = RelativePose.from_vector(dt[k] * (share @ speed[around]))
        none, rows = np.empty((0, 4)), np.empty((0, 2), np.int64)
        motions[k] = RelativeMotion(
            pose, dt[k] ** 2 * P, np.empty(0, bool), 0.0, 0, none, none, none, none, rows, str(fault)
        )
    return [motions[k] for k in range(len(found))]


def neighbours(good: Array, t: Array, k: int) -> tuple[Indices, Array]:
    """The measured motions, ``good`` (T,), next to motion k at t (T + 1,), and the share of each in its velocity."""
    at = np.flatnonzero(good)
    i = int(np.searchsorted(at, k))
    around = at[max(i - 1, 0) : i + 1]
    if len(around) == 1:
        return around, np.ones(1)
    middle = 0.5 * (t[1:] + t[:-1])
    share = (middle[k] - middle[around[0]]) / (middle[around[1]] - middle[around[0]])
    return around, np.array([1.0 - share, share])


def _missed(speed: Array, offsets: Indices, share: Array) -> Array:
    """By how much a measured velocity differs from that of the motions at ``offsets`` from it, (n, 6)."""
    T = len(speed)
    at = np.arange(max(0, -offsets.min()), min(T, T - offsets.max()))
    missed = speed[at] - sum(part * speed[at + offset] for part, offset in zip(share, offsets, strict=True))
    return np.asarray(missed[np.isfinite(missed).all(axis=1)])
