"""One step of least squares for points and poses together: the points are eliminated, the poses solved for at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from consistency.bench.models import stereo
from consistency.referee.types import Array, Indices

POSE = 6  # values of a pose: shift (m) and rotation vector (rad) in sensor axes
NEAREST = 1e-4  # m, in front of the sensor that a point has at least


@dataclass(frozen=True)
class Slopes:
    """Residuals and derivatives of T tracks of n observations, by the standard deviations of the values."""

    r: Array  # (T, n, 3)
    by_point: Array  # (T, n, 3, 3), of a prediction by the point in the world
    by_pose: Array  # (T, n, 3, 6)
    cov: Array  # (T, 3, 3), of the point if the poses are right


def slopes_of(z: Array, R: Array, t: Array, points: Array, f: float, B: float, sigma: Array) -> Slopes:
    """Slopes at points (T, 3) seen as ``z`` (T, n, 3) from poses (T, n, 3, 3), (T, n, 3), with noise (T, n, 3)."""
    x, y, w = np.moveaxis(np.einsum("tnji,tnj->tni", R, points[:, None] - t), -1, 0)
    x = np.maximum(x, NEAREST)
    predicted = np.stack(stereo.project(x, y, w, f, B), axis=-1)
    zero = np.zeros_like(x)
    entries = [entry + zero for entry in stereo.project_jacobian(x, y, w, f, B)]
    J = np.stack(entries, axis=-1).reshape(*x.shape, 3, 3) / sigma[..., None]
    by_point = J @ np.swapaxes(R, -1, -2)
    turned = np.stack([zero, -w, y, w, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)
    by_pose = np.concatenate([-J, J @ turned], axis=-1)
    cov = np.linalg.pinv(np.einsum("tnci,tncj->tij", by_point, by_point), hermitian=True)
    return Slopes((z - predicted) / sigma, by_point, by_pose, cov)


@dataclass(frozen=True)
class Step:
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
    neighbours[:, 1:] = -np.einsum("tnci,tij,tncj->tnc", s.by_point[:, 1:], s.cov, s.by_point[:, :-1])
    return Step(move, r, free, neighbours)


def steps_of_both(groups: Sequence[tuple[Slopes, Indices]], steps: int) -> tuple[list[Step], Array]:
    """The step of all points and of all poses.

    Parameters
    ----------
    groups : slopes of tracks of one length, and the number 0, 1, ... of the step of each observation, (T, n)
    steps : number of poses

    Returns
    -------
    steps of the points, and the moves (steps, 6) of the poses
    """
    N, g = np.zeros((steps, steps, POSE, POSE)), np.zeros((steps, POSE))
    for s, at in groups:
        W = np.einsum("tnci,tncj->tnij", s.by_pose, s.by_point)  # (T, n, 6, 3)
        pull = np.einsum("tij,tncj,tnc->ti", s.cov, s.by_point, s.r)
        np.add.at(g, at, np.einsum("tnci,tnc->tni", s.by_pose, s.r) - np.einsum("tnij,tj->tni", W, pull))
        np.add.at(N, (at, at), np.einsum("tnci,tncj->tnij", s.by_pose, s.by_pose))
        np.add.at(N, (at[:, :, None], at[:, None, :]), -np.einsum("tnij,tjk,tmlk->tnmil", W, s.cov, W))
    Q = _inverse(N.swapaxes(1, 2).reshape(steps * POSE, -1)).reshape(steps, POSE, steps, POSE)
    moves = np.einsum("siuj,uj->si", Q, g)
    return [_step(s, at, Q, moves) for s, at in groups], moves


def _inverse(N: Array) -> Array:
    """Inverse on all but the six directions in which poses and points move together, which no observation tells."""
    values, axes = np.linalg.eigh(N)
    return np.asarray((axes[:, POSE:] / values[POSE:]) @ axes[:, POSE:].T)


def _step(s: Slopes, at: Indices, Q: Array, moves: Array) -> Step:
    held = step_of_points(s)
    W = np.einsum("tnci,tncj->tnij", s.by_pose, s.by_point)
    mine = moves[at]  # (T, n, 6)
    points = held.points - np.einsum("tij,tnkj,tnk->ti", s.cov, W, mine)
    r = s.r - np.einsum("tnci,ti->tnc", s.by_point, points) - np.einsum("tnci,tni->tnc", s.by_pose, mine)
    # a prediction by the poses of all steps of its track, the point following them
    n = at.shape[1]
    slope = -np.einsum("tnci,tij,tmkj->tncmk", s.by_point, s.cov, W)
    slope[:, np.arange(n), :, np.arange(n)] += np.moveaxis(s.by_pose, 1, 0)
    flat = slope.reshape(*slope.shape[:3], -1)  # (T, n, 3, 6 n)
    own = Q[at[:, :, None], :, at[:, None, :], :].swapaxes(2, 3).reshape(len(at), POSE * n, -1)
    along = flat @ own[:, None]
    free = held.free - np.einsum("tnck,tnck->tnc", along, flat)
    neighbours = held.neighbours.copy()
    neighbours[:, 1:] -= np.einsum("tnck,tnck->tnc", along[:, 1:], flat[:, :-1])
    return Step(points, r, free, neighbours)
