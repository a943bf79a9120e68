"""The one loop over a trial that all compiled filters share."""

from __future__ import annotations

from typing import Any

import numpy as np

from consistency.filters.blas import add_transposed_times, solve_transposed
from consistency.filters.covariance import append_landmark, definite_root, subtract_gram
from consistency.filters.jit import inner, kernel
from consistency.filters.linalg import definiteness_with
from consistency.filters.observation import place
from consistency.filters.rules import UNSCENTED, innovate, predict
from consistency.filters.work import make_work

REASONS = {
    1: "the estimate is not finite",
    2: "the innovation covariance is not positive definite",
    3: "the pose covariance is not positive definite",
}


@inner
def _correct(x: Any, P: Any, n: int, m: int, z: Any, R: Any, work: Any) -> Any:
    """Eq. 11, 12 with W = S^-1/2 A: x += W' S^-1/2 innovation, P -= W' W.

    Returns a code of REASONS or 0, and the NIS.
    """
    S, zhat = work.S[: 3 * m, : 3 * m], work.zhat
    A, joined = work.A[: 3 * m, :n], work.A[: 3 * m, : n + 1]
    y = joined[:, n]
    total = 0.0
    for i in range(m):
        for a in range(3):
            r = 3 * i + a
            y[r] = z[work.known[i], a] - zhat[r]
            for b in range(3):
                S[r, 3 * i + b] += R[work.known[i], a, b]
            total += y[r] + S[r, r:].sum()
    if not definite_root(S, work.scale):
        return 2 if np.isfinite(total) else 1, np.nan
    solve_transposed(S, joined)
    nis = 0.0
    for r in range(3 * m):
        nis += y[r] * y[r]
    add_transposed_times(A, y, x[:n])
    subtract_gram(P, n, A)
    if np.isfinite(nis):
        return 0, nis
    return 2 if np.isfinite(total) else 1, np.nan


@inner
def _find_known(first: int, last: int, landmark: Any, offset: Any, work: Any) -> int:
    """Observations first..last-1 whose landmark is in the state, their offsets, and how many they are."""
    m = 0
    for r in range(first, last):
        if offset[landmark[r]] >= 0:
            work.known[m], work.label[m], work.at[m] = r, landmark[r], offset[landmark[r]]
            m += 1
    return m


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
    work = make_work(size, np.max(first[1:] - first[:-1]), rule == UNSCENTED)
    x[:3] = start
    full_rank = False
    for k in range(T):
        predict(rule, x, P, n, controls[k], path0[k], q, points, work)
        m = _find_known(first[k], first[k + 1], landmark, offset, work)
        if m > 0:
            if not innovate(rule, model, x, P, n, m, path0[k + 1], landmarks0, rig, points, work):
                return pose, covariance, nis, nis_dof, k + 1, 3
            code, value = _correct(x, P, n, m, z, R, work)
            if code > 0:
                return pose, covariance, nis, nis_dof, k + 1, code
            nis[k], nis_dof[k] = value, 3 * m
        for r in range(first[k], first[k + 1]):
            if offset[landmark[r]] < 0:
                offset[landmark[r]] = n
                at0 = landmarks0[landmark[r]]
                place(model, x[:3], z[r], path0[k + 1], at0, rig, x[n : n + 3], work.Jp, work.Jz)
                append_landmark(P, n, work.Jp, work.Jz, R[r])
                n += 3
        rank = definiteness_with(P[:3, :3], work.small)
        if not np.isfinite(x[:n].sum()):
            return pose, covariance, nis, nis_dof, k + 1, 1
        if rank < 0 or (full_rank and rank == 0):
            return pose, covariance, nis, nis_dof, k + 1, 3
        full_rank = full_rank or rank == 1
        pose[k], covariance[k] = x[:3], P[:3, :3]
    return pose, covariance, nis, nis_dof, 0, 0
