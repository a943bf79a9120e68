"""Runs moved so that their first poses are the true ones, with bounds for the covariances of the other errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.errors import InputError
from consistency.referee.readers.alignment.frame_fit import Sound, sound_of, tangent
from consistency.referee.readers.alignment.world_frames import WorldTransform
from consistency.referee.readers.poses import Poses
from consistency.referee.types import Array


def frame_of_first_pose(name: str, p: Poses) -> WorldTransform:
    """The frame in which the first pose is the true one.

    Raises
    ------
    InputError
        No estimate is finite and has a truth and a covariance.
    """
    row, truth = _first(name, p)
    estimate = p.estimate[row]
    if p.manifold == "planar":
        return _onto(
            Rotation.from_euler("z", truth[2] - estimate[2]), np.append(estimate[:2], 0), np.append(truth[:2], 0)
        )
    turn = Rotation.from_quat(truth[3:]) * Rotation.from_quat(estimate[3:]).inv()
    return _onto(turn, estimate[:3], truth[:3])


def _onto(turn: Rotation, own: Array, true: Array) -> WorldTransform:
    return WorldTransform(turn, true - turn.apply(own))


def _first(name: str, p: Poses) -> tuple[int, Array]:
    """Row of the first estimate that is finite and has a truth and a covariance, and its truth (m,)."""
    known = p.known()
    fine = p.stated[known.rows] & np.isfinite(p.estimate[known.rows]).all(axis=1)
    fine &= np.isfinite(p.covariance[known.rows]).all(axis=(1, 2))
    if not fine.any():
        raise InputError(f"--align origin: a run of {name} has no estimate with a truth and a covariance to begin at")
    k = int(np.argmax(fine))
    return int(known.rows[k]), known.truth[k]


def from_first_pose(name: str, p: Poses, judged: Sequence[int]) -> tuple[Poses, Array]:
    """A run whose first pose is the true one, with bounds of the covariances of the residual errors.

    The error of step k less that of the first pose, seen in step k with covariance R_k, has a covariance of at most
    (1 + t) P_k + (1 + 1/t) R_k for any t > 0, whatever their correlation (Young's inequality); t^2 = tr(P_k^-1 R_k) / n
    makes the sum of its variances, in units of those of P_k, least. If the first pose is exact it is P_k. The
    covariance of the first pose itself, which has no error now, is 0.

    Returns
    -------
    the run, and (k,) how many times as large its covariances are in the mean over components
    """
    row, _ = _first(name, p)
    sound, P, index = sound_of(p, judged), p.covariance.copy(), list(judged)
    block: Any = np.ix_(sound.rows, np.array(index), np.array(index))
    seen = _seen(name, p, row, sound)[:, index][:, :, index]
    size = np.trace(np.linalg.solve(P[block], seen), axis1=1, axis2=2) / len(index)
    t = np.sqrt(np.maximum(size, 0.0))
    wide = t[:, None, None]
    bound = (1.0 + wide) * P[block] + seen + seen / np.where(wide > 0, wide, 1.0)
    P[block] = 0.5 * (bound + np.swapaxes(bound, 1, 2))
    P[row] = 0.0
    return replace(p, covariance=P), np.square(1.0 + t[sound.rows != row])


def _seen(name: str, p: Poses, row: int, sound: Sound) -> Array:
    """Covariance (k, n, n) of the error that the pose in ``row`` causes in each sound row."""
    n = p.covariance.shape[-1]
    free = np.eye(6) if n == 6 else np.eye(6)[[0, 1, 5]]
    plain = replace(p, covariance=np.tile(np.eye(n), (len(p.t), 1, 1)))
    first = Sound(np.array([row]), _first(name, p)[1][None], np.zeros((1, n)))
    J = tangent(plain, sound, free, range(n)) @ np.linalg.inv(tangent(plain, first, free, range(n))[0])
    return np.asarray(J @ p.covariance[row] @ np.swapaxes(J, 1, 2))
