"""Have the errors of Stone Soup's cubature filter the stated covariance, with bearings near pi and near 0?"""

import warnings

import numpy as np
from stonesoup.functions import cubature_transform, gauss2cubature
from stonesoup.types.state import GaussianState
from study import Argument, Case
from tracking_scene import SENSORS, START, rows, simulate


def second():
    """The variance of a bearing by one transform, against second moments about 0 less the square of the mean."""
    out = []
    for side, sensor in SENSORS.items():
        _, covariance, _, _ = cubature_transform(START, sensor.function)
        points = [GaussianState(x, START.covar) for x in gauss2cubature(START)]
        bearings = np.array([float(sensor.function(each)[0, 0]) for each in points])
        mean = np.angle(np.exp(1j * bearings).mean())
        right, raw = np.angle(np.exp(1j * (bearings - mean))).var(), (bearings**2).mean() - mean**2
        text = f"the variance of one bearing by moments about 0; about the mean it is {right:.2g}"
        out.append(Argument(f"CubatureKalmanUpdater, bearings {side}", text, covariance[0, 0], raw))
    return out


warnings.simplefilter("ignore")  # of matrices that are not positive definite: the verdict has them
CASE = Case("stonesoup", ("x", "speed along x", "y", "speed along y"), 60, simulate,
            lambda data: rows(data, "Cubature"), lambda data: rows(data, "Unscented"), second)  # fmt: skip

if __name__ == "__main__":
    CASE.main()
