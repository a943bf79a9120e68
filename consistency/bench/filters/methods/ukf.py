"""UKF-SLAM and cubature SLAM, compiled. Equations and source: :mod:`consistency.bench.filters.textbook.ukf`.

Sigma points, Julier & Uhlmann (2004), exact at the size of what is observed.

With the variables ordered robot, seen landmarks (as observed), the rest, the Cholesky factor of P is
[[C, 0], [G, D]]. A sigma point through a column of D moves only variables that neither f nor h reads, so
it projects onto the mean: such points add nothing to S or to the cross-covariance, and their weight counts
as weight of the centre. What is left is 2 L + 1 points over the L = 3 + w m variables involved; the rest of
the state follows through G = P_rest,involved C'^-1, so that Cov(z, x) = Cov(z, C-coordinates) C^-1 P_involved,x
and M = Cov(z, C-coordinates) C^-1, of size s m x L, is all that sees the whole state.

C is lower triangular. The points of column j of the i-th seen landmark leave the robot and the landmarks
before i where they are, bit by bit; only what comes from i on is projected again.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiled import variants
from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.linalg import (
    add_gram,
    copy,
    fill,
    matrix,
    product_of_transposed,
    semidefinite_cholesky,
    solve_upper,
    vector,
)
from consistency.bench.filters.kernel.part_functions import (
    Data,
    Factors,
    Slam,
    State,
    add_motion_noise,
    correct,
    landmark_width,
    make_update_arrays,
    move,
    observed_width,
    predict,
    predict_innovation,
    propagate_covariance_root,
    robot_frame,
    wrap_residual,
)
from consistency.bench.filters.kernel.update_steps import (
    POSE,
    Scratch,
    add_noise,
    correct_at_once,
    definite_root,
    gather,
    innovate,
    observe,
    state_index,
)
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.textbook.ukf import CUBATURE, UnscentedKalman
from consistency.bench.protocols import Problem
from consistency.referee.types import Array


@part(error="Additive", point="AtEstimate")
class Unscented(NamedTuple):
    """Scaled sigma points, Merwe (2004): spread alpha sqrt(L + kappa)."""

    alpha: float
    beta: float
    kappa: float


class SigmaArrays(NamedTuple):
    """Arrays of sigma points; L = 3 + w m."""

    F: Array  # (3, 3) Cov(f, C-coordinates)
    moved: Array  # (7, 3) sigma points of the robot
    U: Array  # (L, L) upper root of the prior of the variables involved
    block: Array  # (L, L) that prior, where it is singular
    Z: Array  # (2 L + 1, s m) projected sigma points
    Mt: Array  # (L, s m) transposed statistical linearisation
    pose: Array  # (3,)
    landmark: Array  # (w,)


@implement(make_update_arrays, Unscented)
def sigma_arrays(update: Unscented, w: int, s: int, m: int, n: int) -> SigmaArrays:
    L = 3 + w * m
    return SigmaArrays(
        matrix(3, 3),
        matrix(7, 3),
        matrix(L, L),
        matrix(L, L),
        matrix(2 * L + 1, s * m),
        matrix(L, s * m),
        vector(3),
        vector(w),
    )


@inner
def _weights(L: int, points: Unscented) -> tuple[float, float, float, float]:
    """Of scaled sigma points over L variables: spread, w0m, w0c, w."""
    alpha, beta, kappa = points.alpha, points.beta, points.kappa
    spread2 = alpha * alpha * (L + kappa)
    w0 = 1.0 - L / spread2
    return np.sqrt(spread2), w0, w0 + 1.0 - alpha * alpha + beta, 0.5 / spread2


@implement(predict, Unscented)
def predict_unscented(
    update: Unscented, slam: Slam, state: State, k: int, u: Array, factors: Factors, scratch: Scratch[SigmaArrays]
) -> None:
    """x, P <- mean and covariance (3, 3) of f over 7 sigma points of the robot; its rows of P <- F C^-1 P."""
    x, P = state.x, state.P
    spread, w0m, w0c, w = _weights(3, update)
    C, F, Y = scratch.small, scratch.of_update.F, scratch.of_update.moved
    if not semidefinite_cholesky(P[:3, :3], C):
        P[0, 0] = np.nan  # an indefinite prior is reported by the loop
        return
    copy(x[:3], scratch.pose)
    move(scratch.pose, u, Y[6])
    for j in range(3):
        for side in range(2):
            step = spread if side == 0 else -spread
            point = Y[2 * j + side]
            for a in range(3):
                point[a] = x[a] + step * C[a, j]
            move(point, u, point)
    for a in range(3):
        x[a] = w0m * Y[6, a]
        for i in range(6):
            x[a] += w * Y[i, a]
        for j in range(3):
            F[a, j] = w * spread * (Y[2 * j, a] - Y[2 * j + 1, a])
    propagate_covariance_root(P, 3, state.n, C, F)
    propagate_covariance_root(factors.Phi, 0, state.base, C, F)
    for a in range(3):
        for b in range(3):
            P[a, b] = w0c * (Y[6, a] - x[a]) * (Y[6, b] - x[b])
            for i in range(6):
                P[a, b] += w * (Y[i, a] - x[a]) * (Y[i, b] - x[b])
    add_motion_noise(slam.motion, scratch.pose, u, P)


implement(correct, Unscented)(correct_at_once)


@implement(predict_innovation, Unscented)
def predict_innovation_by_points(
    update: Unscented,
    slam: Slam,
    state: State,
    data: Data,
    k: int,
    m: int,
    factors: Factors,
    scratch: Scratch[SigmaArrays],
) -> tuple[int, float]:
    gather(slam, state, m, factors, scratch)
    if not innovate_by_points(update, slam, state, m, scratch):
        return POSE, np.nan
    innovate(slam, state, data, m, scratch)
    return 0, add_noise(slam, state, data, m, scratch)


@inner
def innovate_by_points(update: Unscented, slam: Slam, state: State, m: int, scratch: Scratch[SigmaArrays]) -> bool:
    """zhat, S (without R) and A = P_zx from the rows of P in ``scratch``; False if P is indefinite.

    The points lie about ``state.x`` (n,), which need not be the mean of P; ``of_update.Mt`` is the linearisation.
    """
    w, width = landmark_width(slam.landmark), state.n + state.base
    L, rows = 3 + w * m, observed_width(slam.sensor) * m
    spread, w0m, w0c, weight = _weights(L, update)
    if not _root(w, L, scratch):
        return False
    _project(slam, state.x, m, spread, scratch)
    Z, S, Mt, zhat = (
        scratch.of_update.Z[: 2 * L + 1, :rows],
        scratch.S[:rows, :rows],
        scratch.of_update.Mt[:L, :rows],
        scratch.zhat,
    )
    centre, U = Z[2 * L], scratch.of_update.U
    for c in range(rows):
        zhat[c] = w0m * centre[c]
    for i in range(2 * L):
        for c in range(rows):
            zhat[c] += weight * Z[i, c]
    for i in range(2 * L + 1):
        for c in range(rows):
            Z[i, c] -= zhat[c]
    for a in range(rows):
        for b in range(a, rows):
            S[a, b] = w0c * centre[a] * centre[b]
    add_gram(weight, Z[: 2 * L], S)
    for j in range(L):
        for c in range(rows):
            Mt[j, c] = weight * spread * (Z[2 * j, c] - Z[2 * j + 1, c])
        if U[j, j] == 0.0:  # row j of Mt and the rest of row j of U are zero, and stay so
            U[j, j] = 1.0
    solve_upper(U[:L, :L], Mt)
    product_of_transposed(Mt, scratch.rows[:L, :width], scratch.A[:rows, :width])
    return True


@inner
def _root(w: int, L: int, scratch: Scratch[SigmaArrays]) -> bool:
    """Upper root U = C' of the prior over the variables involved; False if it is indefinite."""
    rows, at, U = scratch.rows, scratch.at, scratch.of_update.U[:L, :L]
    for b in range(L):
        j = state_index(w, b, at)
        for a in range(b + 1):
            U[a, b] = rows[a, j]
    return definite_root(U, scratch.scale) or _singular_root(w, L, scratch)


@inner
def _singular_root(w: int, L: int, scratch: Scratch[SigmaArrays]) -> bool:
    """The root of a semidefinite prior: a zero pivot has a zero row."""
    rows, at, U, block = scratch.rows, scratch.at, scratch.of_update.U[:L, :L], scratch.of_update.block[:L, :L]
    for b in range(L):
        j = state_index(w, b, at)
        for a in range(L):
            block[a, b] = rows[a, j]
    if not semidefinite_cholesky(block, U):
        return False
    for a in range(L):
        for b in range(a):
            U[b, a] = U[a, b]
    return True


@inner
def _project(slam: Slam, x: Array, m: int, spread: float, scratch: Scratch[SigmaArrays]) -> None:
    """Z <- h of the sigma points, in pairs along the rows of U; the last row is h of the mean."""
    w, s = landmark_width(slam.landmark), observed_width(slam.sensor)
    L = 3 + w * m
    at, U, Z, pose, landmark = (
        scratch.at,
        scratch.of_update.U,
        scratch.of_update.Z,
        scratch.of_update.pose,
        scratch.of_update.landmark,
    )
    for j in range(L):
        first = 0 if j < 3 else 3 + w * ((j - 3) // w)
        fill(U[j, first:j], 0.0)  # the lower half holds anything, and the variables of a part are moved together
    mean = robot_frame(x[:3])
    for i in range(m):
        observe(slam, mean, x[at[i] : at[i] + w], Z[2 * L, s * i : s * i + s])
    for k in range(2 * L):
        j, step = k // 2, spread if k % 2 == 0 else -spread
        first = 0 if j < 3 else (j - 3) // w
        copy(Z[2 * L, : s * first], Z[k, : s * first])
        frame = mean
        if j < 3:
            for a in range(3):
                pose[a] = x[a] + step * U[j, a]
            frame = robot_frame(pose)
        for i in range(first, m):
            for a in range(w):
                landmark[a] = x[at[i] + a] + step * U[j, 3 + w * i + a]
            projected = Z[k, s * i : s * i + s]
            observe(slam, frame, landmark, projected)
            wrap_residual(slam.sensor, projected, Z[2 * L, s * i : s * i + s])


def parts(problem: Problem, controls: Array, uvd: bool) -> Slam:
    points = problem.belief.sigma_points
    return ekf.parts(problem, controls, uvd)._replace(update=Unscented(points.alpha, points.beta, points.kappa))


FILTERS = variants(UnscentedKalman, "ukf", parts) | variants(
    partial(UnscentedKalman, points=CUBATURE), "ckf", ekf.parts, "xyz uvd",
    update=Unscented(CUBATURE.alpha, CUBATURE.beta, CUBATURE.kappa),
)  # fmt: skip
