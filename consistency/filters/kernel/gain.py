"""The correction that all updates share, eq. 11 and 12 with W = S^-1/2 Cov(z, x)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.filters.kernel.arrays import copy_matrix
from consistency.filters.kernel.blas import add_gram, add_product_of_transposed, add_transposed_times, solve_transposed
from consistency.filters.kernel.covariance import definite_root, gather_rows, subtract_gram
from consistency.filters.kernel.jit import inner
from consistency.filters.kernel.local_state import Factors
from consistency.filters.kernel.measuring import linearise
from consistency.filters.kernel.slam import (
    OBSERVED,
    Data,
    Slam,
    State,
    combine,
    landmark_width,
    retract,
    robot_width,
    to_error,
)
from consistency.filters.kernel.work import Work
from consistency.types import Array

NOT_FINITE, INNOVATION, POSE = 1, 2, 3
REASONS = {
    NOT_FINITE: "the estimate is not finite",
    INNOVATION: "the innovation covariance is not positive definite",
    POSE: "the pose covariance is not positive definite",
}


@inner
def gather(slam: Slam, state: State, m: int, local: Factors, work: Work[NamedTuple]) -> None:
    """``work.rows`` (r + w m, n) <- rows of P of the robot and of the ``m`` seen landmarks.

    The rows of Phi, which are treated alike, follow them in columns n..n + base - 1.
    """
    r, w, n, base = robot_width(slam.motion), landmark_width(slam.landmark), state.n, state.base
    gather_rows(state.P, n, r, w, work.at, m, work.rows)
    if base > 0:
        copy_matrix(local.Phi[:r, :base], work.rows[:r, n : n + base])
        for i in range(m):
            first, o = r + w * i, work.at[i]
            copy_matrix(local.Phi[o : o + w, :base], work.rows[first : first + w, n : n + base])


@inner
def linearise_seen(slam: Slam, state: State, k: int, m: int, work: Work[NamedTuple]) -> None:
    """``work``: zhat (3 m,), Hp (m, 3, r), Hl (m, 3, w) <- h of the seen landmarks; Jacobians by the filter's error."""
    pose, w = state.x[: robot_width(slam.motion)], landmark_width(slam.landmark)
    for i in range(m):
        o, expected = work.at[i], work.zhat[OBSERVED * i : OBSERVED * i + OBSERVED]
        values = state.x[o : o + w]
        linearise(slam, pose, values, k, work.label[i], expected, work.Hp[i], work.Hl[i], work)
        to_error(slam.error, pose, values, work.Hp[i], work.Hl[i])


@inner
def combine_seen(slam: Slam, state: State, m: int, work: Work[NamedTuple]) -> None:
    """``work.A`` (3 m, n + base) <- H P from the gathered rows; upper half of ``work.S`` (3 m, 3 m) <- H P H'."""
    r, w, width = robot_width(slam.motion), landmark_width(slam.landmark), state.n + state.base
    A, S, Hp, Hl = work.A, work.S, work.Hp, work.Hl
    for i in range(m):
        combine(slam.landmark, Hp[i], Hl[i], work.rows[:, :width], i, A[OBSERVED * i : OBSERVED * i + OBSERVED, :width])
    for i in range(m):
        o = work.at[i]
        for row in range(OBSERVED * i + OBSERVED):
            for a in range(OBSERVED):
                total = 0.0
                for c in range(max(r, w)):
                    term = 0.0
                    if c < r:
                        term += A[row, c] * Hp[i, a, c]
                    if c < w:
                        term += A[row, o + c] * Hl[i, a, c]
                    total += term
                S[row, OBSERVED * i + a] = total


@inner
def innovate(state: State, data: Data, m: int, work: Work[NamedTuple]) -> Array:
    """Innovation (3 m,) of the ``m`` landmarks, which is the last column of ``work.A``."""
    y = work.A[: OBSERVED * m, state.n + state.base]
    for i in range(m):
        for a in range(OBSERVED):
            y[OBSERVED * i + a] = data.z[work.known[i], a] - work.zhat[OBSERVED * i + a]
    return y


@inner
def whiten(state: State, data: Data, m: int, work: Work[NamedTuple]) -> tuple[int, float]:
    """S (3 m, 3 m) <- root of S + R; A and the innovation <- divided by it. Gives a code of REASONS or 0, and NIS."""
    rows, width = OBSERVED * m, state.n + state.base
    S, joined = work.S[:rows, :rows], work.A[:rows, : width + 1]
    y, total = joined[:, width], 0.0
    for i in range(m):
        for a in range(OBSERVED):
            r = OBSERVED * i + a
            for c in range(OBSERVED):
                S[r, OBSERVED * i + c] += data.R[work.known[i], a, c]
            total += y[r] + S[r, r:].sum()
    return divide_by_root(state, m, work, total)


@inner
def divide_by_root(state: State, m: int, work: Work[NamedTuple], total: float) -> tuple[int, float]:
    """S <- its root, and A and the innovation <- divided by it; ``total`` is finite if all that is given is."""
    rows, width = OBSERVED * m, state.n + state.base
    S, joined = work.S[:rows, :rows], work.A[:rows, : width + 1]
    y = joined[:, width]
    if not definite_root(S, work.scale):
        return INNOVATION if np.isfinite(total) else NOT_FINITE, np.nan
    solve_transposed(S, joined)
    nis = 0.0
    for r in range(rows):
        nis += y[r] * y[r]
    if np.isfinite(nis):
        return 0, nis
    return INNOVATION if np.isfinite(total) else NOT_FINITE, np.nan


@inner
def shift(state: State, m: int, j: int, work: Work[NamedTuple]) -> float:
    """By how much the whitened gain moves variable j of an additive error."""
    total, y = 0.0, state.n + state.base
    for row in range(OBSERVED * m):
        total += work.A[row, j] * work.A[row, y]
    return total


@inner
def apply(slam: Slam, state: State, m: int, local: Factors, work: Work[NamedTuple]) -> None:
    """x (n,) <- moved by W' S^-1/2 innovation, P (n, n) <- P - W' W; with the columns of Phi as ``local`` says."""
    rows, n, base = OBSERVED * m, state.n, state.base
    A, y = work.A[:rows, :n], work.A[:rows, n + base]
    retract(slam.error, slam, state, A, y, work)
    subtract_gram(state.P, n, robot_width(slam.motion), A)
    apply_beyond(state, m, local, work)


@inner
def apply_beyond(state: State, m: int, local: Factors, work: Work[NamedTuple]) -> None:
    """Phi, Psi and theta <- what a correction of the active part says of the rest."""
    rows, n, base = OBSERVED * m, state.n, state.base
    A, y = work.A[:rows, :n], work.A[:rows, n + base]
    if base > 0:
        beyond = work.A[:rows, n : n + base]
        add_product_of_transposed(-1.0, A, beyond, local.Phi[:n, :base])
        add_gram(1.0, beyond, local.Psi[:base, :base])
        add_transposed_times(beyond, y, local.theta[:base])
