"""UKF-SLAM, Herath et al. (2007) sec. 4.5; sigma points after Julier & Uhlmann (2004).

Cubature SLAM, Arasaratnam & Haykin (2009), is the unscented filter with its points fixed to the cubature rule.
The third-degree spherical-radial rule has 2 L points at +-sqrt(L) columns of a root of P, with weights 1 / (2 L) and no
centre. Sigma points with alpha = 1, beta = kappa = 0 are these, and are the default of a belief: then ``ckf`` and
``ukf`` are one filter. ``ckf`` has them whatever the belief says of sigma points. L counts the variables that f or h
reads, a rule over the whole state would have a spread that grows with the map.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.basics import SlamState, view
from consistency.bench.filters.textbook.ekf import ExtendedKalman
from consistency.bench.scenario import SigmaPoints
from consistency.bench.types import Control, Info
from consistency.referee.types import Array

CUBATURE = SigmaPoints(alpha=1.0, beta=0.0, kappa=0.0)


class UnscentedKalman(ExtendedKalman):
    """UKF-SLAM over the whole state.

    The variables are ordered robot, landmarks seen in this step (as observed), the rest before the
    Cholesky square root is taken; spread and centre weight are those of the L variables involved. New
    landmarks are initialised to first order: with a spread of sqrt(L) standard deviations a sigma point
    of a landmark below about 2 px of disparity would lie behind the camera. ``points`` are those of the belief unless
    they are given.
    """

    def __init__(self, name: str, uvd: bool, points: SigmaPoints | None = None) -> None:
        super().__init__(name, uvd)
        self.points = points

    def predict(self, state: SlamState, control: Control) -> SlamState:
        belief = state.problem.belief
        points, wm, wc = sigma_points(state.x, state.P, np.arange(3), self.points or belief.sigma_points)
        moved = points.copy()
        moved[:, :3] = [basics.pose_after(p[:3], control) for p in points]
        x = wm @ moved
        P = (moved - x).T @ (wc[:, None] * (moved - x))
        _, G = basics.motion_jacobians(state.x[:3], control)
        P[:3, :3] += basics.process_noise(G, belief)
        return replace(state, x=x, P=P)

    def _correct(self, state: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
        at = np.array([state.at(label) for label in seen])[:, None] + np.arange(state.width)
        involved = np.concatenate([np.arange(3), at.ravel()])
        set_ = self.points or state.problem.belief.sigma_points
        points, wm, wc = sigma_points(state.x, state.P, involved, set_)
        sensor = view(state.problem.belief.sensor, self.uvd)
        Z = sensor.measure(points[:, None, :3], points[:, at])
        Z = (Z[0] + sensor.less(Z, Z[0])).reshape(len(points), -1)
        zhat = wm @ Z
        S = (Z - zhat).T @ (wc[:, None] * (Z - zhat)) + block_diag(*R)
        W = np.linalg.solve(S, (Z - zhat).T @ (wc[:, None] * (points - state.x))).T
        innovation = basics.innovation_of(state, z, zhat, self.uvd)
        x, P = state.x + W @ innovation, state.P - W @ S @ W.T
        return replace(state, x=x, P=P), Info(innovation, S, W)


def sigma_points(x: Array, P: Array, involved: Array, set_: SigmaPoints) -> tuple[Array, Array, Array]:
    """2 n + 1 points (2 n + 1, n) of the whole state, and their weights for mean and covariance.

    The spread alpha sqrt(L + kappa) counts the L ``involved`` variables, which come first in the square
    root. The centre weight is what makes the weights sum to one over all n.
    """
    n, L = len(x), len(involved)
    spread2 = set_.alpha**2 * (L + set_.kappa)
    steps = np.sqrt(spread2) * ordered_root(P, involved).T
    wm = np.full(2 * n + 1, 0.5 / spread2)
    wm[0] = 1.0 - n / spread2
    wc = wm.copy()
    wc[0] += 1.0 - set_.alpha**2 + set_.beta
    return np.concatenate([[x], x + steps, x - steps]), wm, wc


def ordered_root(P: Array, first: Array) -> Array:
    """Root C (n, n) with C C' = P (n, n), lower triangular once the variables ``first`` (L,) are put first."""
    order = np.concatenate([first, np.setdiff1d(np.arange(len(P)), first)])
    root = np.empty_like(P)
    root[order] = square_root(P[np.ix_(order, order)])
    return root


def square_root(P: Array) -> Array:
    """Lower C (n, n) with C C' = P (n, n), positive semidefinite; where a pivot vanishes so does its column.

    Raises
    ------
    numpy.linalg.LinAlgError
        P is indefinite or not finite.
    """
    A, C = P.copy(), np.zeros_like(P)
    scale = np.diag(P)
    for j in range(len(P)):
        if not A[j, j] >= -1e-12 * abs(scale[j]):
            raise np.linalg.LinAlgError("the state covariance is not positive semidefinite")
        if A[j, j] > 1e-12 * scale[j]:
            C[j:, j] = A[j:, j] / np.sqrt(A[j, j])
            A[j:, j:] -= np.outer(C[j:, j], C[j:, j])
    return C
