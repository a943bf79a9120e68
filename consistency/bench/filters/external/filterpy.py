"""filterpy 2.x in the bench: its ExtendedKalmanFilter and UnscentedKalmanFilter do predict and update.

What filterpy leaves to its user comes from the reference implementations: the models, and new landmarks. The
sigma points are filterpy's MerweScaledSigmaPoints over the whole state; kappa is set so that their spread
is that of the L variables involved, and the square root is taken in their order (robot, landmarks
seen in this step as observed, the rest).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter
from scipy.linalg import block_diag

from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.basics import PointSensor, SlamState
from consistency.bench.filters.textbook.ekf import ExtendedKalman
from consistency.bench.filters.textbook.ukf import ordered_root
from consistency.bench.types import Control, Info
from consistency.referee.types import Array


class _Ekf(ExtendedKalmanFilter):  # type: ignore[misc]
    """filterpy's EKF with a nonlinear f, which its documentation asks to give by overriding predict_x."""

    def __init__(self, state: SlamState, f: Callable[[Array], Array]) -> None:
        super().__init__(dim_x=len(state.x), dim_z=3)
        self.x, self.P, self.f = state.x.copy(), state.P.copy(), f

    def predict_x(self, u: Any = 0) -> None:
        self.x = self.f(self.x)


class FilterpyEkf(ExtendedKalman):
    """EKF-SLAM with filterpy's predict and (Joseph form) update."""

    def __init__(self, name: str, uvd: bool) -> None:
        super().__init__(name, uvd)
        self.sensors = ("uvd",) if uvd else ("xyz", "uvd")

    def predict(self, state: SlamState, control: Control) -> SlamState:
        ekf = _Ekf(state, lambda x: np.concatenate([basics.pose_after(x[:3], control), x[3:]]))
        ekf.F = np.eye(len(state.x))
        ekf.F[:3, :3], G = basics.motion_jacobians(state.x[:3], control)
        ekf.Q = np.pad(basics.process_noise(G, state.problem.belief), (0, len(state.x) - 3))
        ekf.predict()
        return replace(state, x=ekf.x, P=ekf.P)

    def _correct(self, state: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
        ekf = _Ekf(state, lambda x: x)
        zhat, H = basics.expect(state, seen, self.uvd)
        ekf.update(z.ravel(), HJacobian=lambda _: H, Hx=lambda _: zhat, R=block_diag(*R))
        return replace(state, x=ekf.x, P=ekf.P), Info(ekf.y, ekf.S, ekf.K)


class FilterpyUkf(FilterpyEkf):
    """UKF-SLAM with filterpy's unscented transforms over the whole state."""

    def predict(self, state: SlamState, control: Control) -> SlamState:
        def f(x: Array, dt: float) -> Array:
            return np.concatenate([basics.pose_after(x[:3], control), x[3:]])

        ukf = _ukf(state, np.arange(3), f, lambda x: x[:3])
        _, G = basics.motion_jacobians(state.x[:3], control)
        ukf.Q = np.pad(basics.process_noise(G, state.problem.belief), (0, len(state.x) - 3))
        ukf.predict()
        return replace(state, x=ukf.x, P=ukf.P)

    def _correct(self, state: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
        at = np.array([state.at(label) for label in seen])[:, None] + np.arange(3)
        sensor = PointSensor(state.problem.belief.sensor, self.uvd)
        involved = np.concatenate([np.arange(3), at.ravel()])
        ukf = _ukf(state, involved, lambda x, dt: x, lambda x: sensor.measure(x[:3], x[at]).ravel(), dim_z=z.size)
        ukf.sigmas_f = ukf.points_fn.sigma_points(ukf.x, ukf.P)
        ukf.update(z.ravel(), R=block_diag(*R))
        return replace(state, x=ukf.x, P=ukf.P), Info(ukf.y, ukf.S, ukf.K)


def _ukf(
    state: SlamState, involved: Array, f: Callable[..., Array], h: Callable[..., Array], dim_z: int = 3
) -> UnscentedKalmanFilter:
    n, set_ = len(state.x), state.problem.belief.sigma_points
    # filterpy's spread is alpha sqrt(n + kappa): this kappa makes it alpha sqrt(L + the belief's kappa)
    kappa = len(involved) + set_.kappa - n
    points = MerweScaledSigmaPoints(
        n, set_.alpha, set_.beta, kappa, sqrt_method=lambda scaled: ordered_root(scaled, involved).T
    )
    ukf = UnscentedKalmanFilter(dim_x=n, dim_z=dim_z, dt=1.0, hx=h, fx=f, points=points)
    ukf.x, ukf.P = state.x.copy(), state.P.copy()
    return ukf


FILTERS = {
    f"filterpy-{method}-{data}": kind(f"filterpy-{method}-{data}", uvd=data == "uvd")
    for method, kind in (("ekf", FilterpyEkf), ("ukf", FilterpyUkf))
    for data in ("xyz", "uvd")
}
