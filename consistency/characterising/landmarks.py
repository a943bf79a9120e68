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

from consistency.characterising.residuals import GROSS, MAD, Residuals
from consistency.models import stereo
from consistency.types import Array, Indices

SHORTEST = 3  # observations of a track: with two, most of what is seen is used up by the point
ROUNDS, SLOWLY = 30, 100  # at most; with free poses the points and the poses wait for each other
SETTLED = 1e-6  # relative change of a sigma at which the rounds end
NEAREST = 1e-3  # of the sigma of the disparity that a fitted one has at least


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
        """The same as residuals about a truth."""
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
    N = len(seen.z)
    r, free, neighbours = np.zeros((N, 3)), np.ones((N, 3)), np.zeros((N, 3))
    for _ in range(SLOWLY if free_poses else ROUNDS):
        for tracks, rows in groups:
            step, r[rows], free[rows], neighbours[rows] = _adjusted(seen, points[tracks], rows, f, B, sigma[parts])
            points[tracks] += step
        if free_poses:
            _, which = np.unique(seen.track, return_inverse=True)
            seen, taken = posed_anew(seen, points[which], r, f, B, sigma[parts])
            free = free - taken
        flat, count = parts.ravel(), len(sigma)
        left = np.maximum(np.bincount(flat, free.ravel(), count), 1e-9)
        new = np.sqrt(np.bincount(flat, (r**2).ravel(), count) / left)
        change = np.abs(new / sigma - 1.0).max()
        sigma = np.maximum(new, 1e-9)
        if change < SETTLED:
            break
    return Fitted(seen, seen.z - r, r, free, parts, sigma, neighbours)


def posed_anew(seen: Seen, points: Array, r: Array, f: float, B: float, sigma: Array) -> tuple[Seen, Array]:
    """Each step's pose where the residuals of its points are least, and the leverage (N, 3) that this takes.

    Parameters
    ----------
    points : (N, 3), the point of each row, m
    r : (N, 3), residuals, px
    sigma : (N, 3), px
    """
    local = np.einsum("nji,nj->ni", seen.R, points - seen.t)
    x, y, z = local.T
    jacobian = np.stack(stereo.project_jacobian(x, y, z, f, B), axis=-1) + np.zeros((len(x), 9))
    zero = np.zeros_like(x)
    turned = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    by_pose = np.concatenate([np.broadcast_to(-np.eye(3), turned.shape), turned], axis=2)
    A = jacobian.reshape(-1, 3, 3) @ by_pose / sigma[..., None]
    _, where, count = np.unique(seen.step, return_inverse=True, return_counts=True)
    order, steps = np.argsort(where, kind="stable"), len(count)
    first = np.append(0, np.cumsum(count)[:-1])
    normal = np.add.reduceat(np.einsum("nci,ncj->nij", A, A)[order], first, axis=0)
    pull = np.add.reduceat(np.einsum("nci,nc->ni", A, r / sigma)[order], first, axis=0)
    cov = np.linalg.pinv(normal, hermitian=True)
    move = np.einsum("sij,sj->si", cov, pull)[where]
    # all steps together may move as they like with their points: one of the poses is none that is fitted
    taken = np.einsum("nci,nij,ncj->nc", A, cov[where], A) * (steps - 1) / steps
    R = seen.R @ Rotation.from_rotvec(move[:, 3:]).as_matrix()
    return replace(seen, R=R, t=seen.t + np.einsum("nij,nj->ni", seen.R, move[:, :3])), taken


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


def _adjusted(
    seen: Seen, points: Array, rows: Indices, f: float, B: float, sigma: Array
) -> tuple[Array, Array, Array, Array]:
    """One step of least squares for tracks of one length: steps (T, 3), residuals, free shares, covariances (T, n, 3).

    The residuals are those after the step, to first order.
    """
    R, local = seen.R[rows], np.einsum("tnji,tnj->tni", seen.R[rows], points[:, None] - seen.t[rows])
    x = np.maximum(local[..., 0], f * B / 1e4)
    predicted = np.stack(stereo.project(x, local[..., 1], local[..., 2], f, B), axis=-1)
    zero = np.zeros_like(x)
    jacobian = np.stack(stereo.project_jacobian(x, local[..., 1], local[..., 2], f, B), axis=-1)
    H = (jacobian + zero[..., None]).reshape(*x.shape, 3, 3) @ np.swapaxes(R, -1, -2)
    r0, s = seen.z[rows] - predicted, sigma[rows]
    A = H / s[..., None]
    cov = np.linalg.pinv(np.einsum("tnci,tncj->tij", A, A), hermitian=True)
    step = np.einsum("tij,tncj,tnc->ti", cov, A, r0 / s)
    r = r0 - np.einsum("tnci,ti->tnc", H, step)
    free = 1.0 - np.einsum("tnci,tij,tncj->tnc", A, cov, A)
    shared = np.zeros_like(r)
    shared[:, 1:] = -np.einsum("tnci,tij,tncj->tnc", H[:, 1:], cov, H[:, :-1])
    return step, r, free, shared
