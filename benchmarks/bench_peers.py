"""Other people's filters on the trials of ``bench.py``: filterpy and, where it is installed, Stone Soup.

Each is written to be fast: one filter object for the whole trial, models in NumPy over all landmarks at once,
the library's own Cholesky root. For the sigma points to be ours the state is put in our order (robot, seen, rest)
before a step, which costs a copy of P. The adapters in ``consistency/bench/filters`` are written to be read instead.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from typing import Any

import numpy as np
from bench_models import Peer, Said
from bench_trials import Case
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter

from consistency.bench.filters.textbook.basics import motion_jacobians
from consistency.bench.types import Control
from consistency.referee.types import Array


class _Ekf(ExtendedKalmanFilter):  # type: ignore[misc]
    f: Callable[[Array], Array]
    x: Array

    def predict_x(self, u: Any = 0) -> None:
        self.x = self.f(self.x)


class FilterpyEkf(Peer):
    def prepare(self) -> None:
        self.ekf = _Ekf(dim_x=self.n, dim_z=len(self.R))
        self.ekf.F, self.ekf.Q, self.ekf.R = np.eye(self.n), np.zeros((self.n, self.n)), self.R

    def step(self, x: Array, P: Array, control: Control, at: Array, z: Array) -> Said:
        ekf, m = self.ekf, self.models
        ekf.x, ekf.P, ekf.f = x, P, lambda x: m.f(x, control)
        ekf.F[:3, :3] = motion_jacobians(x[:3], control)[0]
        m.noise(x, control, ekf.Q)
        ekf.predict()
        ekf.update(z, HJacobian=lambda x: m.H(x, at), Hx=lambda x: m.h(x, at))
        return ekf.x, ekf.P


class FilterpyUkf(Peer):
    """filterpy's UnscentedKalmanFilter; one object a transform, for each has its own spread."""

    filter = "ukf-uvd"
    reorders = True

    def prepare(self) -> None:
        self.first = self._ukf(3)
        self.second = self._ukf(3 + len(self.R))
        self.Q = np.zeros((self.n, self.n))

    def _ukf(self, involved: int) -> UnscentedKalmanFilter:
        s = self.models.belief.sigma_points
        # filterpy's spread is alpha sqrt(n + kappa): this kappa makes it alpha sqrt(L + the belief's kappa)
        points = MerweScaledSigmaPoints(self.n, s.alpha, s.beta, involved + s.kappa - self.n)
        return UnscentedKalmanFilter(self.n, len(self.R), dt=1.0, hx=None, fx=None, points=points)

    def step(self, x: Array, P: Array, control: Control, at: Array, z: Array) -> Said:
        first, second, m = self.first, self.second, self.models
        first.x, first.P, first.Q = x, P, m.noise(x, control, self.Q)
        first.predict(fx=lambda x, dt: m.f(x, control))
        second.x, second.P = first.x, first.P
        second.sigmas_f = second.points_fn.sigma_points(second.x, second.P)
        second.update(z, R=self.R, hx=lambda x: m.h(x, at))
        return second.x, second.P


def stone_soup(kind: str, case: Case, steps: int) -> Peer | str:
    """Stone Soup's filter, ``ekf`` or ``ukf``, or why there is none."""
    if importlib.util.find_spec("stonesoup") is None:
        return "not installed; pip install -e '.[peers]'"
    peers = importlib.import_module("bench_stonesoup")
    peer: Peer = getattr(peers, {"ekf": "StoneSoupEkf", "ukf": "StoneSoupUkf"}[kind])(case, steps)
    return peer
