"""The unscented update linearised again where it led to: iterated sigma points, Sibley, Sukhatme & Matthies (2006).

"The iterated sigma point Kalman filter with applications to long range stereo", Robotics: Science and Systems II, as
Barfoot (2017), sec. 4.2.10, writes it. From the prior (x, P) a pass about x_i draws sigma points with mean x_i and the
covariance P of the prior, gets from them the mean z_i, Cov(z, z) and Cov(x, z) of the observation, and gives

    x_i+1 = x + Cov(x, z) S^-1 (z - z_i - A (x - x_i)),    S = Cov(z, z) + R,    A = Cov(z, x) P^-1.

The first pass is that of the unscented filter. With points that lie close together it is the iterated EKF. The
covariance is that of the last pass, P - Cov(x, z) S^-1 Cov(z, x): it is the prior that the points spread by in every
pass, so that nothing is counted twice.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from consistency.bench.filters.textbook import ukf
from consistency.bench.filters.textbook.basics import SlamState, view
from consistency.bench.types import Info
from consistency.referee.types import Array

PASSES = 5  # linearisations of an update; the first is the unscented filter's


class IteratedPointsKalman(ukf.UnscentedKalman):
    """UKF-SLAM whose update is iterated; it predicts as the unscented filter does."""

    def _correct(self, state: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
        at = np.array([state.at(label) for label in seen])[:, None] + np.arange(3)
        involved = np.concatenate([np.arange(3), at.ravel()])
        sensor = view(state.problem.belief.sensor, self.uvd)
        set_ = state.problem.belief.sigma_points
        x, infos = state.x, []
        for _ in range(PASSES):
            points, wm, wc = ukf.sigma_points(x, state.P, involved, set_)
            Z = sensor.measure(points[:, None, :3], points[:, at]).reshape(len(points), -1)
            zhat = wm @ Z
            S = (Z - zhat).T @ (wc[:, None] * (Z - zhat)) + block_diag(*R)
            C = (points - x).T @ (wc[:, None] * (Z - zhat))
            W = np.linalg.solve(S, C.T).T
            # only the involved variables have moved; P of these may be singular in the first steps
            slope = C[involved].T @ np.linalg.pinv(state.P[np.ix_(involved, involved)], hermitian=True)
            innovation = z.ravel() - zhat - slope @ (state.x - x)[involved]
            x = state.x.copy()
            x[involved] += W[involved] @ innovation
            infos.append(Info(innovation, S, W))
        return replace(state, x=state.x + W @ innovation, P=state.P - W @ S @ W.T), infos[0]
