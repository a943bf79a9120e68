"""Stone Soup's EKF and UKF on the trials of ``bench.py``; needs the extra ``bench``."""

from __future__ import annotations

from typing import Any

import numpy as np
from bench_models import Models, Peer, Said
from stonesoup.models.measurement.base import MeasurementModel
from stonesoup.models.transition.base import TransitionModel
from stonesoup.predictor.kalman import ExtendedKalmanPredictor, UnscentedKalmanPredictor
from stonesoup.types.array import CovarianceMatrix, StateVector, StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import ExtendedKalmanUpdater, UnscentedKalmanUpdater

from consistency.bench.filters.textbook import basics
from consistency.bench.types import Control
from consistency.referee.types import Array


def _flat(state: Any) -> Array:
    return np.asarray(state.state_vector, float).ravel()


def _points(state: Any) -> Array:
    """One state, or all sigma points at once, as rows."""
    return np.asarray(state.state_vector, float).T


def _vectors(rows: Array) -> StateVectors:
    return StateVector(rows[0]) if len(rows) == 1 else StateVectors(rows.T)


class _Quiet:
    """What Stone Soup's models must have and a filter never asks for."""

    def rvs(self, *args: Any, **kwargs: Any) -> Any:
        raise NotImplementedError

    def pdf(self, *args: Any, **kwargs: Any) -> Any:
        raise NotImplementedError


class Drive(_Quiet, TransitionModel):  # type: ignore[misc]
    """Eq. 18 under the control of this step."""

    models: Models
    control: Control
    F: Array
    Q: Array

    @property
    def ndim_state(self) -> int:
        return len(self.F)

    def function(self, state: Any, noise: Any = False, **kwargs: Any) -> StateVectors:
        points = _points(state).copy()
        points[:, :3] = basics.pose_after(points[:, :3].T, self.control).T
        return _vectors(points)

    def jacobian(self, state: Any, **kwargs: Any) -> Array:
        self.F[:3, :3] = basics.motion_jacobians(_flat(state)[:3], self.control)[0]
        return self.F

    def covar(self, **kwargs: Any) -> Array:
        return self.Q


class Look(_Quiet, MeasurementModel):  # type: ignore[misc]
    """Eq. 22 of the landmarks seen in this step."""

    models: Models
    at: Array
    R: Array

    @property
    def ndim_meas(self) -> int:
        return len(self.R)

    def function(self, state: Any, noise: Any = False, **kwargs: Any) -> StateVectors:
        points = _points(state)
        z = self.models.sensor.measure(points[:, None, :3], points[:, self.at])
        return _vectors(z.reshape(len(points), -1))

    def jacobian(self, state: Any, **kwargs: Any) -> Array:
        return self.models.H(_flat(state), self.at)

    def covar(self, **kwargs: Any) -> Array:
        return self.R


class StoneSoupEkf(Peer):
    def prepare(self) -> None:
        self.drive, self.look = Drive(), Look(ndim_state=self.n, mapping=None)
        self.drive.models = self.look.models = self.models
        self.drive.F, self.drive.Q = np.eye(self.n), np.zeros((self.n, self.n))
        self.look.R = CovarianceMatrix(self.R)
        self.pair()

    def pair(self) -> None:
        self.predictor = ExtendedKalmanPredictor(self.drive)
        self.updater = ExtendedKalmanUpdater(self.look)

    def step(self, x: Array, P: Array, control: Control, at: Array, z: Array) -> Said:
        self.drive.control, self.look.at = control, at
        self.models.noise(x, control, self.drive.Q)
        prediction = self.predictor.predict(GaussianState(x, P))
        detection = Detection(StateVector(z), measurement_model=self.look)
        posterior = self.updater.update(SingleHypothesis(prediction, detection))
        return _flat(posterior), np.asarray(posterior.covar)


class StoneSoupUkf(StoneSoupEkf):
    filter = "ukf-uvd"
    reorders = True

    def pair(self) -> None:
        s = self.models.belief.sigma_points
        # the spread is alpha sqrt(n + kappa), as filterpy's
        pose, both = (s.kappa + involved - self.n for involved in (3, 3 + len(self.R)))
        self.predictor = UnscentedKalmanPredictor(self.drive, alpha=s.alpha, beta=s.beta, kappa=pose)
        self.updater = UnscentedKalmanUpdater(self.look, alpha=s.alpha, beta=s.beta, kappa=both)
