"""EKF-SLAM on points triangulated from pixels, with the moments of their noise at the prediction.

The noise of a triangulated point p, eq. 21, depends on how far it is. With rho = sigma_d / d and d = f B / x, its
covariance is R(p) = J diag(sigma_u^2, sigma_v^2, sigma_d^2) J', with J the Jacobian of eq. 21, and its mean is
p (1 + rho^2): u and v enter linearly, and the second derivative of p by d is 2 p / d^2. Both are the first terms of
series in rho.

- ``ekf-xyz`` takes R at the measured point. A point that came out too near claims to be certain, one too far to be
  uncertain, and the estimate is drawn towards the robot: see docs/consistent.md.
- ``predicted-ekf-xyz`` takes R at the point that is expected, in which the noise of this observation has no part.
- ``debiased-ekf-xyz`` also subtracts the bias, p rho^2 at the point that is expected, after Sibley, Matthies & Sukhatme
  (2005), "Bias reduction and filter convergence for long range stereo". Nothing is expected of a new landmark: its R is
  that at the measured z, and p (1 + rho^2) = z is solved by z / (1 + rho^2) with rho at z. This is right to second
  order and, unlike z (1 - rho^2), always before the camera. The bias is taken as known: p has the covariance of z.

The noise of an ``xyz`` sensor does not depend on the point, so these two filters work on (u, v, d) alone.
"""

from __future__ import annotations

import numpy as np

from consistency.bench.filters.filter_inputs import disparity_sigma, point_noise, variance_at
from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.basics import SlamState
from consistency.bench.filters.textbook.ekf import ExtendedKalman
from consistency.bench.scenario import models
from consistency.bench.types import Info
from consistency.referee.types import Array


class TriangulatedKalman(ExtendedKalman):
    """EKF-SLAM on triangulated points, with R at the prediction and, where asked, without the bias."""

    def __init__(self, name: str, debiasing: bool) -> None:
        super().__init__(name, uvd=False)
        self.debiasing = debiasing

    def _correct(self, state: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
        sensor = state.problem.belief.sensor
        zhat, H = basics.expect(state, seen, uvd=False)
        expected, R = zhat.reshape(-1, 3), R.copy()
        front = expected[:, 0] > 0.0
        x, y, up = expected[front].T
        pixels = np.column_stack(models.project(x, y, up, sensor.f or 0.0, sensor.B or 0.0))
        R[front] = point_noise(pixels, variance_at(pixels, sensor), sensor)
        bias = np.where(front, self._bias_ratio(state, expected[:, 0]), 0.0)[:, None] * expected
        return basics.corrected(state, H, z.ravel() - zhat - bias.ravel(), R)

    def _locate(self, state: SlamState, label: int, z: Array) -> tuple[Array, Array, Array]:
        return basics.locate_point(state, z / (1.0 + self._bias_ratio(state, z[0])), uvd=False)

    def _bias_ratio(self, state: SlamState, x: Array) -> Array:
        """Square of the disparity's noise over the disparity of points at depths ``x``, m, or 0."""
        sensor = state.problem.belief.sensor
        fB = (sensor.f or 0.0) * (sensor.B or 0.0)
        with np.errstate(divide="ignore"):
            rho = disparity_sigma(fB / x, sensor) * x / fB
        return np.square(rho) if self.debiasing else np.zeros_like(rho)
