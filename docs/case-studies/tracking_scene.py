"""A target that moves at nearly constant velocity, and a sensor of bearing and range on either side of it."""

from datetime import datetime, timedelta

import numpy as np
from stonesoup.models.measurement.nonlinear import CartesianToBearingRange
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.types.state import GaussianState

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
