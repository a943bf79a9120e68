"""Have the errors of filterpy's IMMEstimator the covariance that it states? A linear model whose Q jumps."""

import numpy as np
from filterpy.kalman import IMMEstimator, KalmanFilter
from jumping_scene import MODES, START, F, M, R, interacting, simulate, told
from linear import AXES, H
from study import Argument, Case


def library(_, run):
    filters = [KalmanFilter(dim_x=2, dim_z=1) for _ in MODES]
    for f, Q in zip(filters, MODES, strict=True):
        f.F, f.H, f.Q, f.R, f.P = F, H, Q, np.array([[R]]), np.eye(2)
    imm = IMMEstimator(filters, START, M)
    for z in run:
        imm.predict()
        imm.update(np.array([z]))
        yield imm.x.ravel().copy(), imm.P.copy()


def rows(data, estimate):
    """Errors and covariances of all runs."""
    modes, truth, z = data
    found = [list(zip(*estimate(*run), strict=True)) for run in zip(modes, z, strict=True)]
    return truth - np.array([x for x, _ in found]), np.array([P for _, P in found])


def second():
    data = simulate(np.random.default_rng(1), 10)
    (_, stated), (_, right) = rows(data, library), rows(data, interacting)
    return [Argument("IMMEstimator", "the covariances of Blom and Bar-Shalom's recursion", stated, right)]


CASE = Case("filterpy", AXES, 117, simulate, lambda data: {"IMMEstimator": rows(data, library)},
            lambda data: {"filter that is told the modes": rows(data, told)}, second)  # fmt: skip

if __name__ == "__main__":
    CASE.main()
