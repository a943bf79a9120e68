"""The one loop over a trial that all compiled filters share."""

from __future__ import annotations

from typing import Any

import numpy as np

from consistency.filters.jit import inner, kernel
from consistency.filters.linalg import definiteness, forward_substitute, semidefinite_cholesky
from consistency.filters.observation import place
from consistency.filters.rules import innovate, predict

REASONS = {
    1: "the estimate is not finite",
    2: "the innovation covariance is not positive definite",
    3: "the pose covariance is not positive definite",
}


@inner
def _correct(x: Any, P: Any, n: int, innovation: Any, S: Any, A: Any) -> Any:
    """Eq. 11, 12 with W = S^-1/2 A: x += W' S^-1/2 innovation, P -= W' W. Returns the NIS or NaN."""
    C = np.zeros_like(S)
    if not semidefinite_cholesky(S, C):
        return np.nan
    for i in range(len(C)):
        if C[i, i] == 0.0:
            return np.nan
    y = innovation.copy()
    forward_substitute(C, y)
    forward_substitute(C, A)
    P[:n, :n] -= np.dot(A.T, A)
    x[:n] += np.dot(A.T, y)
    return np.dot(y, y)


@inner
def _augment(x: Any, P: Any, n: int, Jp: Any, Jz: Any, R: Any) -> None:
    """Covariance of a landmark put at n: its own and the one with everything before it."""
    for a in range(3):
        for j in range(n):
            P[n + a, j] = Jp[a, 0] * P[0, j] + Jp[a, 1] * P[1, j] + Jp[a, 2] * P[2, j]
            P[j, n + a] = P[n + a, j]
    own = np.dot(np.dot(Jz, R), Jz.T)
    for a in range(3):
        for b in range(3):
            own[a, b] += P[n + a, 0] * Jp[b, 0] + P[n + a, 1] * Jp[b, 1] + P[n + a, 2] * Jp[b, 2]
    P[n : n + 3, n : n + 3] = 0.5 * (own + own.T)


@kernel
def run_trial(
    rule: int,
    model: int,
    n_landmarks: int,
    controls: Any,
    first: Any,
    landmark: Any,
    z: Any,
    R: Any,
    start: Any,
    path0: Any,
    landmarks0: Any,
    q: Any,
    rig: Any,
    points: Any,
) -> Any:
    """Filter a whole trial.

    Parameters
    ----------
    rule, model : codes of ``rules`` and ``observation``
    controls, first, landmark, z : as in :class:`consistency.types.Trial`
    R : (M, 3, 3) noise of each observation
    path0 : (T + 1, 3), landmarks0 : (N, 3)
        Reference of a linear world; zeros elsewhere.
    q : (2,) sigma_v, sigma_omega; rig : (14,); points : (3,) alpha, beta, kappa

    Returns
    -------
    pose (T, 3), covariance (T, 3, 3), nis (T,), nis_dof (T,), step of the failure or 0, its code
    """
    T = len(controls)
    pose, covariance = np.full((T, 3), np.nan), np.full((T, 3, 3), np.nan)
    nis, nis_dof = np.full(T, np.nan), np.zeros(T, np.int64)
    offset = np.full(n_landmarks, -1)
    size = 3 + 3 * len(np.unique(landmark))
    x, P, n = np.zeros(size), np.zeros((size, size)), 3
    x[:3] = start
    full_rank = False
    Jp, Jz = np.empty((3, 3)), np.empty((3, 3))
    for k in range(T):
        predict(rule, x, P, n, controls[k], path0[k], q, points)
        rows = np.arange(first[k], first[k + 1])
        known = np.array([r for r in rows if offset[landmark[r]] >= 0], np.int64)
        m = len(known)
        if m > 0:
            at = offset[landmark[known]]
            zhat, S, A = np.empty(3 * m), np.empty((3 * m, 3 * m)), np.empty((3 * m, n))
            if not innovate(
                rule, model, x, P, n, at, path0[k + 1], landmarks0[landmark[known]], rig, points, zhat, S, A
            ):
                return pose, covariance, nis, nis_dof, k + 1, 3
            for i in range(m):
                S[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += R[known[i]]
            value = _correct(x, P, n, z[known].ravel() - zhat, S, A)
            if not np.isfinite(value):
                finite = np.isfinite(S.sum() + zhat.sum() + z[known].sum())
                return pose, covariance, nis, nis_dof, k + 1, 2 if finite else 1
            nis[k], nis_dof[k] = value, 3 * m
        for r in rows:
            if offset[landmark[r]] < 0:
                offset[landmark[r]] = n
                place(model, x[:3], z[r], path0[k + 1], landmarks0[landmark[r]], rig, x[n : n + 3], Jp, Jz)
                _augment(x, P, n, Jp, Jz, R[r])
                n += 3
        rank = definiteness(P[:3, :3])
        if not np.isfinite(x[:n].sum()):
            return pose, covariance, nis, nis_dof, k + 1, 1
        if rank < 0 or (full_rank and rank == 0):
            return pose, covariance, nis, nis_dof, k + 1, 3
        full_rank = full_rank or rank == 1
        pose[k], covariance[k] = x[:3], P[:3, :3]
    return pose, covariance, nis, nis_dof, 0, 0
