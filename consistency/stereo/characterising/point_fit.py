"""Noise where poses are known and landmarks are not: each track's point is fitted, and its three values are paid for.

In a step of least squares for points and poses together the points are eliminated, and the poses solved for at once.

A component of the noise (u, v, or d at some disparities) has the variance at which its squared residuals are what the
degrees of freedom left to it say (Helmert 1907; Foerstner 1979): ``sum r^2 = sigma^2 sum (1 - h)``, with ``h`` the
leverage of each observation in the fit of its point.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.bench.models import stereo
from consistency.referee.types import Array, Indices
from consistency.stereo.characterising.truth_residuals import GROSS, MAD, Residuals
from consistency.stereo.visual_odometry.relative_pose import cross_matrix

SHORTEST = 3  # observations of a track: with two, most of what is seen is used up by the point
ROUNDS = 30
SETTLED = 1e-6  # relative change of a sigma at which the rounds end
POSE = 6  # values of a pose: shift (m) and rotation vector (rad) in sensor axes
NEAREST = 1e-4  # m, in front of the sensor that a point has at least


@dataclass(frozen=True)
class Sightings:
    """N observations of unknown points from known poses, sorted by track and step."""

    z: Array  # (N, 3), u, v, d in px
    R: Array  # (N, 3, 3), world from sensor axes (forward, left, up)
    t: Array  # (N, 3), m, the sensor in the world
    track: Indices  # (N,)
    step: Indices  # (N,)
    moving: Array  # (N,) of bool

    def keep(self, chosen: Array) -> Sightings:
        """The rows for which ``chosen`` (N,) is true."""
        return Sightings(*(value[chosen] for value in vars(self).values()))

    def long_enough(self) -> Sightings:
        """The rows of tracks with enough observations."""
        _, where, count = np.unique(self.track, return_inverse=True, return_counts=True)
        return self.keep(count[where] >= SHORTEST)


class PointFit(NamedTuple):
    """Residuals about fitted points, N rows as in ``seen``."""

    seen: Sightings
    ideal: Array  # (N, 3), px, projections of the fitted points
    r: Array  # (N, 3), px
    free: Array  # (N, 3), 1 - h: share of each observation that the fit leaves
    parts: Indices  # (N, 3), component of the noise of each value
    sigma: Array  # (components,), px
    neighbours: Array  # (N, 3), covariance that the fit alone gives a residual and that of the row before, px^2

    @property
    def scaled(self) -> Array:
        """Residuals over their standard deviations, (N, 3)."""
        return self.r / (self.sigma[self.parts] * np.sqrt(np.maximum(self.free, 1e-9)))

    def sums_of_tracks(self, values: Array) -> Array:
        """Sums (K,) of values (N,) over the rows of each track."""
        _, where = np.unique(self.seen.track, return_inverse=True)
        return np.bincount(where, values)

    @property
    def residuals(self) -> Residuals:
        """Residuals of the fit, in the form of residuals about a truth."""
        return Residuals(self.r, self.ideal, self.seen.track, self.seen.step, self.seen.moving)


def fit_points(
    seen: Sightings,
    f: float,
    B: float,
    parts: Indices,
    start: Array,
    free_poses: bool = False,
) -> PointFit:
    """Fit the point of each track and the noise of each component, in turns until both stay.

    Parameters
    ----------
    parts : (N, 3), component of each value
    start : (components,), px, first guess of the noise
    free_poses : whether the pose of each step is fitted too, six values each, from the one that is given
    """
    sigma = np.asarray(start, float)
    points = _first_points(seen, f, B)
    groups = list(_groups(seen))
    steps, step_of_row = np.unique(seen.step, return_inverse=True)
    steps_of_groups = [step_of_row[rows] for _, rows in groups]
    r = np.zeros(seen.z.shape)
    free = np.zeros(seen.z.shape)
    neighbours = np.zeros(seen.z.shape)
    for _ in range(ROUNDS):
        s = sigma[parts]
        slopes = []
        for tracks, rows in groups:
            own = slopes_of(seen.z[rows], seen.R[rows], seen.t[rows], points[tracks], f, B, s[rows])
            slopes.append(own)
        if free_poses:
            done, moves = steps_of_both(slopes, steps_of_groups, len(steps))
            seen = _moved(seen, moves[step_of_row])
        else:
            done = list(map(step_of_points, slopes))
        for (tracks, rows), step in zip(groups, done, strict=True):
            points[tracks] += step.points
            r[rows] = step.r * s[rows]
            free[rows] = step.free
            neighbours[rows] = step.neighbours
        neighbours[1:] *= s[1:] * s[:-1]
        squares = np.bincount(parts.ravel(), (r**2).ravel())
        dof = np.bincount(parts.ravel(), free.ravel())
        new = np.sqrt(squares / dof)
        change = np.abs(new / sigma - 1.0).max()
        sigma = np.maximum(new, 1e-9)
        if change < SETTLED:
            break
    return PointFit(seen, seen.z - r, r, free, parts, sigma, neighbours)


def _moved(seen: Sightings, moves: Array) -> Sightings:
    """A copy with poses moved by shifts and rotation vectors (N, 6) in sensor axes."""
    t = seen.t + np.einsum("nij,nj->ni", seen.R, moves[:, :3])
    turn = Rotation.from_rotvec(moves[:, 3:]).as_matrix()
    return replace(seen, R=seen.R @ turn, t=t)


def without_gross(fitted: PointFit) -> Array:
    """Rows (N,) of tracks whose residuals are all within ``GROSS`` robust standard deviations of their component."""
    scaled = np.abs(fitted.r / np.sqrt(np.maximum(fitted.free, 0.05)))
    limit = np.empty(len(fitted.sigma))
    for k in range(len(limit)):
        limit[k] = MAD * np.median(scaled[fitted.parts == k]) * GROSS
    wrong = (scaled > limit[fitted.parts]).any(axis=1)
    return ~np.isin(fitted.seen.track, fitted.seen.track[wrong])


def _first_points(seen: Sightings, f: float, B: float) -> Array:
    """Points (tracks, 3) from the nearest observation of each, m in the world."""
    _, first = np.unique(seen.track, return_index=True)
    best = np.lexsort((-seen.z[:, 2], seen.track))[first]
    u, v, d = seen.z[best].T
    local = np.stack(stereo.triangulate(u, v, d, f, B), axis=-1)
    return np.einsum("nij,nj->ni", seen.R[best], local) + seen.t[best]


def _groups(seen: Sightings) -> Iterator[tuple[Indices, Indices]]:
    """Tracks (T,) of one length n and their rows (T, n), so that all are worked on at once."""
    _, first, count = np.unique(seen.track, return_index=True, return_counts=True)
    for n in np.unique(count):
        tracks = np.flatnonzero(count == n)
        yield tracks, first[tracks][:, None] + np.arange(n)


class Slopes(NamedTuple):
    """Residuals and derivatives of T tracks of n observations, by the standard deviations of the values."""

    r: Array  # (T, n, 3)
    by_point: Array  # (T, n, 3, 3), of a prediction by the point in the world
    by_pose: Array  # (T, n, 3, 6)
    cov: Array  # (T, 3, 3), of the point if the poses are right

    @property
    def pose_by_point(self) -> Array:
        """Mixed second derivatives of the cost, (T, n, 6, 3)."""
        return np.einsum("tnci,tncj->tnij", self.by_pose, self.by_point)


def slopes_of(
    z: Array,
    R: Array,
    t: Array,
    points: Array,
    f: float,
    B: float,
    sigma: Array,
) -> Slopes:
    """Slopes at points (T, 3) seen as ``z`` (T, n, 3) from poses (T, n, 3, 3), (T, n, 3), with noise (T, n, 3)."""
    in_sensor = np.einsum("tnji,tnj->tni", R, points[:, None] - t)
    in_sensor[..., 0] = np.maximum(in_sensor[..., 0], NEAREST)
    x, y, w = np.moveaxis(in_sensor, -1, 0)
    predicted = np.stack(stereo.project(x, y, w, f, B), axis=-1)
    entries = np.stack(stereo.project_jacobian(x, y, w, f, B), axis=-1)
    J = entries.reshape(*x.shape, 3, 3) / sigma[..., None]
    by_point = J @ np.swapaxes(R, -1, -2)
    by_pose = np.concatenate([-J, J @ cross_matrix(in_sensor)], axis=-1)
    cov = np.linalg.pinv(np.einsum("tnci,tncj->tij", by_point, by_point), hermitian=True)
    return Slopes((z - predicted) / sigma, by_point, by_pose, cov)


class Step(NamedTuple):
    """What one step of least squares does to T tracks of n observations, in standard deviations."""

    points: Array  # (T, 3), m
    r: Array  # (T, n, 3), residuals after the step, to first order
    free: Array  # (T, n, 3), 1 - leverage
    neighbours: Array  # (T, n, 3), covariance that the fit gives a residual and that of the observation before


def step_of_points(s: Slopes) -> Step:
    """The step with the poses held."""
    move = np.einsum("tij,tncj,tnc->ti", s.cov, s.by_point, s.r)
    r = s.r - np.einsum("tnci,ti->tnc", s.by_point, move)
    free = 1.0 - np.einsum("tnci,tij,tncj->tnc", s.by_point, s.cov, s.by_point)
    neighbours = np.zeros_like(r)
    own = s.by_point[:, 1:]
    before = s.by_point[:, :-1]
    neighbours[:, 1:] = -np.einsum("tnci,tij,tncj->tnc", own, s.cov, before)
    return Step(move, r, free, neighbours)


def steps_of_both(slopes: list[Slopes], at: list[Indices], steps: int) -> tuple[list[Step], Array]:
    """The step of all points and of all poses.

    Parameters
    ----------
    slopes : of tracks of one length each
    at : for each of these the number 0, 1, ... of the step of each observation, (T, n)
    steps : number of poses

    Returns
    -------
    steps of the points, and the moves (steps, 6) of the poses
    """
    N = np.zeros((steps, steps, POSE, POSE))
    g = np.zeros((steps, POSE))
    for s, own in zip(slopes, at, strict=True):
        W = s.pose_by_point
        pull = np.einsum("tij,tncj,tnc->ti", s.cov, s.by_point, s.r)
        with_points_held = np.einsum("tnci,tnc->tni", s.by_pose, s.r)
        np.add.at(g, own, with_points_held - np.einsum("tnij,tj->tni", W, pull))
        np.add.at(N, (own, own), np.einsum("tnci,tncj->tnij", s.by_pose, s.by_pose))
        by_points = np.einsum("tnij,tjk,tmlk->tnmil", W, s.cov, W)
        np.subtract.at(N, (own[:, :, None], own[:, None, :]), by_points)
    flat = N.swapaxes(1, 2).reshape(steps * POSE, -1)
    Q = _inverse(flat).reshape(steps, POSE, steps, POSE)
    moves = np.einsum("siuj,uj->si", Q, g)
    return [_step(s, own, Q, moves) for s, own in zip(slopes, at, strict=True)], moves


def _inverse(N: Array) -> Array:
    """Inverse on all but the six directions in which poses and points move together, which no observation tells."""
    values, axes = np.linalg.eigh(N)
    return (axes[:, POSE:] / values[POSE:]) @ axes[:, POSE:].T


def _step(
    s: Slopes,
    at: Indices,
    Q: Array,
    moves: Array,
) -> Step:
    held = step_of_points(s)
    W = s.pose_by_point
    own_moves = moves[at]  # (T, n, 6)
    points = held.points - np.einsum("tij,tnkj,tnk->ti", s.cov, W, own_moves)
    r = s.r - np.einsum("tnci,ti->tnc", s.by_point, points)
    r -= np.einsum("tnci,tni->tnc", s.by_pose, own_moves)
    # a prediction by the poses of all steps of its track, the point following them
    n = at.shape[1]
    each = np.arange(n)
    slope = -np.einsum("tnci,tij,tmkj->tncmk", s.by_point, s.cov, W)
    slope[:, each, :, each] += np.moveaxis(s.by_pose, 1, 0)
    flat = slope.reshape(*slope.shape[:3], -1)  # (T, n, 3, 6 n)
    own = Q[at[:, :, None], :, at[:, None, :], :]
    own = own.swapaxes(2, 3).reshape(len(at), POSE * n, -1)
    along = flat @ own[:, None]
    free = held.free - np.einsum("tnck,tnck->tnc", along, flat)
    neighbours = held.neighbours.copy()
    neighbours[:, 1:] -= np.einsum("tnck,tnck->tnc", along[:, 1:], flat[:, :-1])
    return Step(points, r, free, neighbours)
