"""A target that moves at nearly constant velocity, and a sensor of bearing and range on either side of it."""

from datetime import datetime, timedelta

import numpy as np
from stonesoup.models.measurement.nonlinear import CartesianToBearingRange
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor import kalman as predictors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState
from stonesoup.updater import kalman as updaters

TIMES = [datetime(2026, 1, 1) + timedelta(seconds=k) for k in range(21)]
MODEL = CombinedLinearGaussianTransitionModel([ConstantVelocity(0.05), ConstantVelocity(0.05)])
START = GaussianState([0, 1, 0, 1], np.diag([1.5, 0.5, 1.5, 0.5]), TIMES[0])
SENSORS = {
    side: CartesianToBearingRange(4, (0, 2), np.diag([np.radians(0.2), 1]), translation_offset=np.array([[x], [0]]))
    for side, x in (("near pi", 50), ("near 0", -50))  # m
}


def simulate(rng, runs):
    F, Q = MODEL.matrix(time_interval=TIMES[1] - TIMES[0]), MODEL.covar(time_interval=TIMES[1] - TIMES[0])
    x, truth = rng.multivariate_normal(START.mean.ravel(), START.covar, runs), []
    for _ in TIMES[1:]:
        x = x @ F.T + rng.multivariate_normal(np.zeros(4), Q, runs)
        truth.append(x)
    return np.swapaxes(truth, 0, 1), rng.normal(size=(runs, len(truth), 2)) * [np.radians(0.2) ** 0.5, 1]


def rows(data, kind):
    """Errors and covariances of one kind of filter, of both sensors."""
    out = {}
    for side, sensor in SENSORS.items():
        predict = getattr(predictors, f"{kind}KalmanPredictor")(MODEL).predict
        update = getattr(updaters, f"{kind}KalmanUpdater")(sensor).update
        errors, covariances = np.full((2, *data[0].shape, 4), np.nan)  # a run that breaks down is NaN from there on
        for run, (states, noises) in enumerate(zip(*data, strict=True)):
            state = START
            for k, (x, v) in enumerate(zip(states, noises, strict=True)):
                z = sensor.function(GaussianState(x, START.covar), noise=v[:, None])
                detection = Detection(z, timestamp=TIMES[k + 1], measurement_model=sensor)
                try:
                    state = update(SingleHypothesis(predict(state, timestamp=TIMES[k + 1]), detection))
                except np.linalg.LinAlgError:
                    break
                errors[run, k, :, 0], covariances[run, k] = x - state.mean.astype(float).ravel(), state.covar
        out[f"{kind}KalmanUpdater, bearings {side}"] = errors[..., 0], covariances
    return out
