"""Has the error of GTSAM's CombinedImuFactor, with biases that walk at random, the covariance that it states?"""

import gtsam
import numpy as np
from gtsam_scene import BIAS, DT, STEPS, WALKS, combined, motion, noise
from study import Argument, Case

ROW = "CombinedImuFactor at the truth"
PARTS = "rotation", "position", "velocity", "bias of the accelerometer", "bias of the gyro"
AXES = [f"{part} {axis}" for part in PARTS for axis in "xyz"]


def vector(m):
    return np.concatenate([gtsam.Rot3.Logmap(m.deltaRij()), m.deltaPij(), m.deltaVij()])


def simulate(rng, runs):
    acceleration, rate, (pose, velocity, last_pose, last_velocity, _) = motion(1.0)
    exact, draws = combined(acceleration, rate), []
    for _ in range(runs):
        walk_a, walk_w = (np.cumsum(rng.normal(0, w * DT**0.5, (STEPS, 3)), axis=0) for w in WALKS)
        noise_a, noise_w = noise(rng)
        m = combined(acceleration + walk_a + noise_a, rate + walk_w + noise_w)
        bias = gtsam.imuBias.ConstantBias(walk_a[-1], walk_w[-1])
        factor = gtsam.CombinedImuFactor(*range(6), m)
        residual = factor.evaluateError(pose, velocity, last_pose, last_velocity, BIAS, bias)
        stated, raw = getattr(m, "residualCovariance", m.preintMeasCov)(), m.preintMeasCov()
        tangent = np.concatenate([vector(exact) - vector(m), -bias.vector()])
        draws.append((residual, stated, tangent, raw))
    return list(map(np.array, zip(*draws, strict=True)))


def judged(data):
    return {ROW: data[:2]}


def second():
    """J P' J', with J from the vector to the residual: right Jacobian, turned vectors, biases of the other sign."""
    m = combined(*motion(1.0)[:2])
    theta, P, J = gtsam.Rot3.Logmap(m.deltaRij()), m.preintMeasCov(), -np.eye(15)
    X, t = np.cross(np.eye(3), theta), np.linalg.norm(theta)
    J[:3, :3] = np.eye(3) - (1 - np.cos(t)) / t**2 * X + (t - np.sin(t)) / t**3 * X @ X
    J[3:6, 3:6] = J[6:9, 6:9] = m.deltaRij().matrix().T
    stated = getattr(m, "residualCovariance", m.preintMeasCov)()
    return [Argument(ROW, "tr(P^-1 J P' J') / 15", np.trace(np.linalg.solve(stated, J @ P @ J.T)) / 15)]


CASE = Case("gtsam", AXES, 200, simulate, judged, lambda data: {"its preintegrated vector": data[2:]}, second)

if __name__ == "__main__":
    CASE.main()
