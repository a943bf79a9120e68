"""The one loop over a trial that all compiled filters share."""

from __future__ import annotations

from typing import Any

import numpy as np

from consistency.filters.blas import add_gram, add_product_of_transposed, add_transposed_times, solve_transposed
from consistency.filters.covariance import append_landmark, definite_root, subtract_gram
from consistency.filters.jit import inner, kernel
from consistency.filters.linalg import definiteness_with
from consistency.filters.local import (
    activate,
    append,
    count,
    count_settling,
    is_due,
    join,
    make_local,
    may_split,
    split,
    start_counting,
)
from consistency.filters.observation import place
from consistency.filters.rules import UNSCENTED, innovate, predict
from consistency.filters.work import make_work

REASONS = {
    1: "the estimate is not finite",
    2: "the innovation covariance is not positive definite",
    3: "the pose covariance is not positive definite",
}


@inner
def _correct(x: Any, P: Any, n: int, local: Any, b: int, m: int, z: Any, R: Any, work: Any) -> Any:
    """Eq. 11, 12 with W = S^-1/2 A: x += W' S^-1/2 innovation, P -= W' W; with ``b`` columns of Phi as ``local`` says.

    Returns a code of REASONS or 0, and the NIS.
    """
    S, zhat = work.S[: 3 * m, : 3 * m], work.zhat
    A, joined = work.A[: 3 * m, :n], work.A[: 3 * m, : n + b + 1]
    y = joined[:, n + b]
    total = 0.0
    for i in range(m):
        for a in range(3):
            r = 3 * i + a
            y[r] = z[work.known[i], a] - zhat[r]
            for c in range(3):
                S[r, 3 * i + c] += R[work.known[i], a, c]
            total += y[r] + S[r, r:].sum()
    if not definite_root(S, work.scale):
        return 2 if np.isfinite(total) else 1, np.nan
    solve_transposed(S, joined)
    nis = 0.0
    for r in range(3 * m):
        nis += y[r] * y[r]
    add_transposed_times(A, y, x[:n])
    subtract_gram(P, n, A)
    if b > 0:
        beyond = joined[:, n : n + b]
        add_product_of_transposed(-1.0, A, beyond, local.Phi[:n, :b])
        add_gram(1.0, beyond, local.Psi[:b, :b])
        add_transposed_times(beyond, y, local.theta[:b])
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


@inner
def _step(
    rule: int,
    model: int,
    x: Any,
    P: Any,
    n: int,
    local: Any,
    b: int,
    k: int,
    controls: Any,
    first: Any,
    landmark: Any,
    z: Any,
    R: Any,
    path0: Any,
    landmarks0: Any,
    q: Any,
    rig: Any,
    points: Any,
    offset: Any,
    work: Any,
    pose: Any,
    covariance: Any,
) -> Any:
    """Step k + 1 of the active part: predict, update, place what is new; ``pose`` and its ``covariance`` <- after it.

    Returns a code of REASONS or 0, the landmarks in the update, the NIS, ``n`` with what is new, and the rank of the
    covariance as ``definiteness`` says it.
    """
    predict(rule, x, P, n, local.Phi, b, controls[k], path0[k], q, points, work)
    m, nis = _find_known(first[k], first[k + 1], landmark, offset, work), np.nan
    if m > 0:
        if not innovate(rule, model, x, P, n, local.Phi, b, m, path0[k + 1], landmarks0, rig, points, work):
            return 3, 0, nis, n, 0
        code, nis = _correct(x, P, n, local, b, m, z, R, work)
        if code > 0:
            return code, 0, nis, n, 0
    for r in range(first[k], first[k + 1]):
        label = landmark[r]
        if offset[label] < 0:
            offset[label] = n
            place(model, x[:3], z[r], path0[k + 1], landmarks0[label], rig, x[n : n + 3], work.Jp, work.Jz)
            append_landmark(P, n, work.Jp, work.Jz, R[r])
            if b > 0:
                append(label, n, b, work.Jp, local)
            n += 3
    rank = definiteness_with(P[:3, :3], work.small)
    if not np.isfinite(x[:n].sum()):
        return 1, m, nis, n, rank
    pose[:], covariance[:] = x[:3], P[:3, :3]
    return 0, m, nis, n, rank


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
    local_from: int,
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
    local_from : variables in the state from which updates are local (``local``); the numbers are the same

    Returns
    -------
    pose (T, 3), covariance (T, 3, 3), nis (T,), nis_dof (T,), step of the failure or 0, its code
    """
    T = len(controls)
    pose, covariance = np.full((T, 3), np.nan), np.full((T, 3, 3), np.nan)
    nis, nis_dof = np.full(T, np.nan), np.zeros(T, np.int64)
    offset, home = np.full(n_landmarks, -1), np.full(n_landmarks, -1)  # of a landmark in the active part, in the whole
    size = 3 + 3 * len(np.unique(landmark))
    x_all, P_all, whole = np.zeros(size), np.zeros((size, size)), 3
    work = make_work(size, np.max(first[1:] - first[:-1]), rule == UNSCENTED)
    local = make_local(size, local_from)
    x, P, n, b = x_all, P_all, 3, 0  # the active part: the whole, unless it has a base, b > 0
    x[:3] = start
    full_rank = False
    for k in range(T):
        labels = landmark[first[k] : first[k + 1]]
        if b > 0 and is_due(whole, n, b, len(labels), local):
            join(x_all, P_all, whole, home, n, b, local)
            count_settling(whole, n, b, local)
            x, P, n, b = x_all, P_all, whole, 0
            offset[:] = home
        if b == 0 and n >= local_from and may_split(whole, len(labels), local):
            n = split(x_all, P_all, home, labels, offset, local)
            start_counting(n, local)
            x, P, b = local.x, local.P, n
        if b > 0:
            more = activate(x_all, P_all, home, labels, offset, n, b, local)
            n, b = n + more, b + more
            count(whole, n, b, more, len(labels), local)
        code, m, value, n, rank = _step(
            rule, model, x, P, n, local, b, k, controls, first, landmark, z, R, path0, landmarks0, q, rig, points,
            offset, work, pose[k], covariance[k],
        )  # fmt: skip
        if m > 0:
            nis[k], nis_dof[k] = value, 3 * m
        if code == 0 and (rank < 0 or (full_rank and rank == 0)):
            code, pose[k], covariance[k] = 3, np.nan, np.nan
        if code > 0:
            return pose, covariance, nis, nis_dof, k + 1, code
        for label in labels:
            if home[label] < 0:
                home[label], whole = whole, whole + 3
        full_rank = full_rank or rank == 1
    return pose, covariance, nis, nis_dof, 0, 0
