"""Noise where poses are known and landmarks are not: each track's point is fitted, and its three values are paid for.

A component of the noise (u, v, or d at some disparities) has the variance at which its squared residuals are what the
degrees of freedom left to it say (Helmert 1907; Foerstner 1979): ``sum r^2 = sigma^2 sum (1 - h)``, with ``h`` the
leverage of each observation in the fit of its point.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.bench.models import stereo
from consistency.referee.types import Array, Indices
from consistency.stereo.characterising.bundle_step import slopes_of, step_of_points, steps_of_both
from consistency.stereo.characterising.residuals import GROSS, MAD, Residuals

SHORTEST = 3  # observations of a track: with two, most of what is seen is used up by the point
ROUNDS = 30
SETTLED = 1e-6  # relative change of a sigma at which the rounds end


@dataclass(frozen=True)
class Seen:
    """N observations of unknown points from known poses, sorted by track and step."""

    z: Array  # (N, 3), u, v, d in px
    R: Array  # (N, 3, 3), world from sensor axes (forward, left, up)
    t: Array  # (N, 3), m, the sensor in the world
    track: Indices  # (N,)
    step: Indices  # (N,)
    moving: Array  # (N,) of bool

    def keep(self, chosen: Array) -> Seen:
        """The rows for which ``chosen`` (N,) is true."""
        return Seen(*(value[chosen] for value in vars(self).values()))

    def long_enough(self) -> Seen:
        """The rows of tracks with enough observations."""
        _, where, count = np.unique(self.track, return_inverse=True, return_counts=True)
        return self.keep(count[where] >= SHORTEST)


@dataclass(frozen=True)
class Fitted:
    """Residuals about fitted points, N rows as in ``seen``."""

    seen: Seen
    ideal: Array  # (N, 3), px, projections of the fitted points
    r: Array  # (N, 3), px
    free: Array  # (N, 3), 1 - h: share of each observation that the fit leaves
    parts: Indices  # (N, 3), component of the noise of each value
    sigma: Array  # (components,), px
    neighbours: Array  # (N, 3), covariance that the fit alone gives a residual and that of the row before, px^2

    @property
    def scaled(self) -> Array:
        """Residuals over their standard deviations, (N, 3)."""
        return np.asarray(self.r / (self.sigma[self.parts] * np.sqrt(np.maximum(self.free, 1e-9))))

    @property
    def residuals(self) -> Residuals:
        """Residuals of the fit, in the form of residuals about a truth."""
        return Residuals(self.r, self.ideal, self.seen.track, self.seen.step, self.seen.moving)


def fit_points(seen: Seen, f: float, B: float, parts: Indices, start: Array, free_poses: bool = False) -> Fitted:
    """Fit the point of each track and the noise of each component, in turns until both stay.

    Parameters
    ----------
    parts : (N, 3), component of each value
    start : (components,), px, first guess of the noise
    free_poses : whether the pose of each step is fitted too, six values each, from the one that is given
    """
    sigma, points = np.asarray(start, float), _first_points(seen, f, B)
    groups = list(_groups(seen))
    steps, at = np.unique(seen.step, return_inverse=True)
    r, free, neighbours = (np.zeros(seen.z.shape) for _ in range(3))
    for _ in range(ROUNDS):
        s = sigma[parts]
        slopes = [slopes_of(seen.z[k], seen.R[k], seen.t[k], points[t], f, B, s[k]) for t, k in groups]
        if free_poses:
            done, moves = steps_of_both(
                [(each, at[k]) for each, (_, k) in zip(slopes, groups, strict=True)], len(steps)
            )
            seen = _moved(seen, moves[at])
        else:
            done = [step_of_points(each) for each in slopes]
        for (tracks, rows), step in zip(groups, done, strict=True):
            points[tracks] += step.points
            r[rows], free[rows], neighbours[rows] = step.r * s[rows], step.free, step.neighbours
        neighbours[1:] *= s[1:] * s[:-1]
        new = np.sqrt(np.bincount(parts.ravel(), (r**2).ravel()) / np.bincount(parts.ravel(), free.ravel()))
        change = np.abs(new / sigma - 1.0).max()
        sigma = np.maximum(new, 1e-9)
        if change < SETTLED:
            break
    return Fitted(seen, seen.z - r, r, free, parts, sigma, neighbours)


def _moved(seen: Seen, moves: Array) -> Seen:
    """A copy with poses moved by shifts and rotation vectors (N, 6) in sensor axes."""
    t = seen.t + np.einsum("nij,nj->ni", seen.R, moves[:, :3])
    return replace(seen, R=seen.R @ Rotation.from_rotvec(moves[:, 3:]).as_matrix(), t=t)


def without_gross(fitted: Fitted) -> Array:
    """Rows (N,) of tracks whose residuals are all within ``GROSS`` robust standard deviations of their component."""
    scaled = np.abs(fitted.r / np.sqrt(np.maximum(fitted.free, 0.05)))
    limit = np.array([MAD * np.median(scaled[fitted.parts == k]) for k in range(len(fitted.sigma))]) * GROSS
    wrong = (scaled > limit[fitted.parts]).any(axis=1)
    return np.asarray(~np.isin(fitted.seen.track, fitted.seen.track[wrong]))


def _first_points(seen: Seen, f: float, B: float) -> Array:
    """Points (tracks, 3) from the nearest observation of each, m in the world."""
    _, where = np.unique(seen.track, return_inverse=True)
    best = np.lexsort((-seen.z[:, 2], where))[np.cumsum(np.append(0, np.bincount(where)[:-1]))]
    u, v, d = seen.z[best].T
    local = np.stack(stereo.triangulate(u, v, d, f, B), axis=-1)
    return np.asarray(np.einsum("nij,nj->ni", seen.R[best], local) + seen.t[best])


def _groups(seen: Seen) -> Iterator[tuple[Indices, Indices]]:
    """Tracks (T,) of one length n and their rows (T, n), so that all are worked on at once."""
    _, first, count = np.unique(seen.track, return_index=True, return_counts=True)
    for n in np.unique(count):
        tracks = np.flatnonzero(count == n)
        yield tracks, first[tracks][:, None] + np.arange(n)
