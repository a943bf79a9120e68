"""Has the error of GTSAM's IMU factor the covariance that the factor states?"""

from copy import deepcopy

import numpy as np
from gtsam_scene import ACCELEROMETER, DT, GYRO, factor, motion, noise, preintegrated
from study import Argument, Case

ROWS = "the factor at the truth", "a tenth of the turn, 0.2 rad", "the residual with `preintMeasCov()`"
AXES = [f"{name} {axis}" for name in ("rotation", "position", "velocity") for axis in "xyz"]


def simulate(rng, runs, turns=(1.0, 0.1)):
    draws = {}
    for turn in turns:
        same, (acceleration, rate, truth) = deepcopy(rng), motion(turn)
        exact, draws[turn] = preintegrated(acceleration, rate), []
        for _ in range(runs):
            noise_a, noise_w = noise(same)
            measured = preintegrated(acceleration + noise_a, rate + noise_w)
            vector, raw = exact.preintegrated() - measured.preintegrated(), measured.preintMeasCov()
            draws[turn].append((*factor(measured, truth), vector, raw))
    return {turn: list(map(np.array, zip(*each, strict=True))) for turn, each in draws.items()}


def judged(data):
    residual, stated, _, raw = data[1.0]
    return dict(zip(ROWS, ((residual, stated), data[0.1][:2], (residual, raw)), strict=True))


def control(data):
    return {"the preintegrated vector with `preintMeasCov()`": data[1.0][2:]}


def predicted(turn):
    """tr(P^-1 P') / 9, with P as stated or raw, and P' of derivatives of the residual by each sample of the noise."""
    acceleration, rate, truth = motion(turn)
    scale = np.repeat([ACCELEROMETER, GYRO], 3) / DT**0.5
    clean, columns = np.hstack([acceleration, rate]) / scale, []
    for d in 1e-3 * np.eye(clean.size).reshape(-1, *clean.shape):
        two = (preintegrated(*np.hsplit((clean + s * d) * scale, 2)) for s in (1, -1))
        columns.append(np.subtract(*(factor(measured, truth)[0] for measured in two)) / 2e-3)
    measured, true = preintegrated(acceleration, rate), np.transpose(columns) @ columns
    both = factor(measured, truth)[1], measured.preintMeasCov()
    return [np.trace(np.linalg.solve(P, true)) / 9 for P in both]


def second():
    (whole, raw), (tenth, _) = predicted(1.0), predicted(0.1)
    ratios = dict(zip(ROWS, (whole, tenth, raw), strict=True))
    return [Argument(row, "tr(P^-1 P') / 9, P' by derivatives", each) for row, each in ratios.items()]


CASE = Case("gtsam", AXES, 200, simulate, judged, control, second)

if __name__ == "__main__":
    CASE.main()
