"""Have the errors of filterpy's filters the covariance P that they state, on a linear model with Gaussian noise?"""

import numpy as np
from filterpy import kalman
from filterpy.kalman import CubatureKalmanFilter, KalmanFilter, SquareRootKalmanFilter, UnscentedKalmanFilter
from linear import AXES, STEADY, H
from study import Case

F, Q = STEADY.F[0], STEADY.Q[0]
KINDS = CubatureKalmanFilter, UnscentedKalmanFilter, SquareRootKalmanFilter
JUDGED = {kind.__name__: (kind, False) for kind in KINDS} | {"smoother of the UKF": (UnscentedKalmanFilter, True)}


def made(kind):
    if kind in (KalmanFilter, SquareRootKalmanFilter):
        f = kind(dim_x=2, dim_z=1)
        f.F, f.H = F, H
    else:
        points = () if kind is CubatureKalmanFilter else (kalman.MerweScaledSigmaPoints(2, 0.1, 2.0, 1.0),)
        f = kind(2, 1, 1.0, lambda x: H @ x, lambda x, dt: F @ x, *points)
    f.Q, f.R, f.P = Q, np.array([[STEADY.R]]), np.eye(2)
    return f


def rows(data, kind, smooth=False):
    truth, z, means, covariances = *data, [], []
    for run in z:
        f, steps = made(kind), []
        for each in run:
            f.predict()
            f.update(np.array([each]))
            steps.append((f.x.ravel().copy(), f.P.copy()))
        x, P = map(np.array, zip(*steps, strict=True))
        if smooth:
            x, P = f.rts_smoother(x if kind is UnscentedKalmanFilter else x[..., None], P)[:2]
        means.append(x.reshape(-1, 2))
        covariances.append(P)
    return truth - means, np.array(covariances)


def judged(data):
    return {name: rows(data, *how) for name, how in JUDGED.items()}


def control(data):
    return {"KalmanFilter": rows(data, KalmanFilter), "smoother of the KalmanFilter": rows(data, KalmanFilter, True)}


def second():
    return [each for name, how in JUDGED.items() for each in STEADY.exact(name, lambda data, how=how: rows(data, *how))]


CASE = Case("filterpy", AXES, 117, STEADY.simulate, judged, control, second)

if __name__ == "__main__":
    CASE.main()
