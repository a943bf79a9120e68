"""Have the errors of Stone Soup's Kalman filters, the linear and the extended one, the stated covariance?"""

import warnings
from datetime import datetime, timedelta

import numpy as np
import tracking_scene as tracking
from linear import AXES, STEADY, textbook
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import ConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import KalmanUpdater
from study import Case

TIMES = [datetime(2026, 1, 1) + timedelta(seconds=k) for k in range(STEADY.steps + 1)]
MODEL, SENSOR = ConstantVelocity(1.0), LinearGaussian(2, [0], np.array([[STEADY.R]]))  # F and Q of STEADY


def linear(data):
    truth, z, errors, covariances = *data, [], []
    predict, update = KalmanPredictor(MODEL).predict, KalmanUpdater(SENSOR).update
    for states, run in zip(truth, z, strict=True):
        state = GaussianState(np.zeros((2, 1)), np.eye(2), TIMES[0])
        for time, x, each in zip(TIMES[1:], states, run, strict=True):
            state = update(SingleHypothesis(predict(state, timestamp=time), Detection(np.array([[each]]), time)))
            errors.append(x - state.mean.astype(float).ravel())
            covariances.append(state.covar)
    return np.reshape(errors, truth.shape), np.reshape(covariances, (*truth.shape, 2))


def simulate(rng, runs):
    return STEADY.simulate(rng, runs), tracking.simulate(rng, runs)


def second():
    return STEADY.exact("KalmanUpdater", linear)


warnings.simplefilter("ignore")  # of noise that the library draws by a stream of its own
CASE = Case("stonesoup", AXES, 117, simulate,
            lambda data: {"KalmanUpdater": linear(data[0]), **tracking.rows(data[1], "Extended")},
            lambda data: {**textbook(data[0]), **tracking.rows(data[1], "Unscented")}, second)  # fmt: skip

if __name__ == "__main__":
    CASE.main()
