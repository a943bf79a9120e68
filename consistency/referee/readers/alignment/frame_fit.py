"""Frames of least NEES, and how whitened errors change with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.diagnostics.records.large_arrays import by_runs
from consistency.referee.diagnostics.records.whitening import whiten
from consistency.referee.errors import InputError
from consistency.referee.readers.alignment.world_frames import (
    IDENTITY,
    WorldTransform,
    fitted_frame,
    moved,
    turned_frame,
)
from consistency.referee.readers.truth_matching import Known, Poses, finite_rows, submatrices
from consistency.referee.types import Array, Indices

DIFFERENCE = 1e-6  # m or rad, over which the change of an error is taken
FRAME_ROUNDS = 20  # steps of a fit at most
DONE = 1e-3  # size of the last one, in stated standard deviations: the next is its square
RANK = 1e-10  # of the largest singular value: directions that no error shows


@dataclass(frozen=True)
class Sound:
    """Estimates of one run that have truth and a covariance of full rank, k of them."""

    rows: Indices  # (k,)
    truth: Array  # (k, m)
    whitened: Array  # (k, n), errors, of the components that are judged


def sound_of(p: Poses, judged: Sequence[int], known: Known | None = None) -> Sound:
    """Estimates usable for an alignment; ``known`` is the truth at all timestamps, if already computed."""
    if known is None:
        known = p.known()
    w = _whitened(p, known.rows, p.error_of(known.rows, known.truth), judged)
    fine = finite_rows(w) & p.stated[known.rows]
    return Sound(known.rows[fine], known.truth[fine], w[fine])


def _whitened(p: Poses, rows: Indices, error: Array, judged: Sequence[int]) -> Array:
    index = list(judged)

    def of_block(e: Array, at: Indices) -> Array:
        return whiten(e[:, index], submatrices(p.covariance[at], index))

    return by_runs(of_block, error, rows)


def tangent(p: Poses, sound: Sound, free: Array, judged: Sequence[int]) -> Array:
    """Change of the whitened errors with a small motion of the world of the estimates, (k, n, d).

    The truth is moved the other way instead: errors and covariances are carried alike, so that the whitened errors
    are the same but for a turn of their axes.

    Parameters
    ----------
    free : (d, 6), directions in which the world moves: shift, then rotation vector
    """

    def of_block(truth: Array, rows: Indices) -> Array:
        out = np.empty((len(rows), len(judged), len(free)))
        for k, motion in enumerate(DIFFERENCE * free):
            after = p.error_of(rows, _small(-motion).placed(truth, p.manifold))
            before = p.error_of(rows, _small(motion).placed(truth, p.manifold))
            change = (after - before) / (2.0 * DIFFERENCE)
            out[:, :, k] = _whitened(p, rows, change, judged)
        return out

    return by_runs(of_block, sound.truth, sound.rows)


def _small(motion: Array) -> WorldTransform:
    return WorldTransform(Rotation.from_rotvec(motion[3:]), motion[:3])


def frame_of_least_nees(name: str, runs: Sequence[Poses], free: Array, judged: Sequence[int]) -> WorldTransform:
    """The frame in which the sum of the NEES of all ``runs`` is least, by Gauss-Newton iteration.

    Raises
    ------
    InputError
        No estimate has a truth and a covariance of full rank.
    """
    known = [p.known() for p in runs]

    def at(frame: WorldTransform) -> tuple[float, list[tuple[Poses, Sound]]]:
        found = []
        nees = 0.0
        for p, k in zip(runs, known, strict=True):
            there = moved(p, frame)
            sound = sound_of(there, judged, k)
            found.append((there, sound))
            nees += float(np.square(sound.whitened).sum())
        return nees, found

    frame = turned_frame(runs) if free[:, 3:5].any() else fitted_frame(runs) or IDENTITY
    nees, found = at(frame)
    if not any(len(sound.rows) for _, sound in found):
        raise InputError(f"--align: no estimate of {name} has a truth and a covariance of full rank to be aligned by")
    for _ in range(FRAME_ROUNDS):
        step, size = _step(found, free, judged)
        further = _small(step @ free).after(frame)
        while size > DONE and (tried := at(further))[0] > nees:
            step = 0.5 * step
            size = 0.5 * size
            further = _small(step @ free).after(frame)
        frame = further
        if size <= DONE:
            break
        nees, found = tried
    return frame


def _step(found: Sequence[tuple[Poses, Sound]], free: Array, judged: Sequence[int]) -> tuple[Array, float]:
    """Gauss-Newton step (d,), and its length in stated standard deviations."""
    tangents = []
    whitened = []
    for p, sound in found:
        tangents.append(tangent(p, sound, free, judged).reshape(-1, len(free)))
        whitened.append(sound.whitened.ravel())
    A = np.concatenate(tangents)
    w = np.concatenate(whitened)
    scale = _column_norms(A)
    step = -np.linalg.lstsq(A / scale, w, rcond=RANK)[0] / scale
    return step, float(np.linalg.norm(A @ step))


def _column_norms(A: Array) -> Array:
    size = np.sqrt(np.square(A).sum(axis=0))
    return np.where(size > 0, size, 1.0)


def orthonormal(tangents: Sequence[Array]) -> list[Array]:
    """Columns Q, (k, n, d) of each run, that span the tangents of one frame of all runs; fewer where some are 0."""
    A = np.concatenate([each.reshape(-1, each.shape[-1]) for each in tangents])
    U, s, _ = np.linalg.svd(A / _column_norms(A), full_matrices=False)
    U = U[:, s > RANK * s[0]]
    bases = []
    start = 0
    for each in tangents:
        end = start + each.shape[0] * each.shape[1]
        bases.append(U[start:end].reshape(*each.shape[:2], -1))
        start = end
    return bases
