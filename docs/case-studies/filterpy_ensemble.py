"""How large are the errors of filterpy's ensemble filter beside its P, with 8 members and with 100?"""

import numpy as np
from filterpy.kalman import EnsembleKalmanFilter
from linear import AXES, STEADY, H, textbook
from study import Case

F = STEADY.F[0]


def rows(data, members):
    truth, z, seeds = data
    errors, covariances = [], []
    for states, run, seed in zip(truth, z, seeds, strict=True):
        np.random.seed(seed)  # noqa: NPY002 - the library draws from the global generator
        kf = EnsembleKalmanFilter(np.zeros(2), np.eye(2), 1, 1.0, members, lambda x: H @ x, lambda x, dt: F @ x)
        kf.Q, kf.R = STEADY.Q[0], np.array([[STEADY.R]])
        for x, each in zip(states, run, strict=True):
            kf.predict()
            kf.update(np.array([each]))
            errors.append(x - kf.x)
            covariances.append(kf.P.copy())
    shape = truth.shape
    return {f"{members} members": (np.reshape(errors, shape), np.reshape(covariances, (*shape, 2)))}


def simulate(rng, runs):
    return (*STEADY.simulate(rng, runs), rng.integers(2**32, size=runs))


CASE = Case(
    "filterpy", AXES, 117, simulate, lambda data: rows(data, 8) | rows(data, 100), lambda data: textbook(data[:2])
)

if __name__ == "__main__":
    CASE.main()
