"""Has the attitude of AHRS's extended Kalman filter the error that its P states? Gyroscope, accelerometer, compass."""

from functools import partial
from importlib.metadata import version

import marg_scene as scene
import numpy as np
from ahrs.filters import EKF
from marg_scene import DT, JUDGED, START, VARIANCES
from scipy.spatial.transform import Rotation
from study import Argument, Case

REFERENCES = scene.REFERENCES * [[EKF().a_ref[2]], [1]]  # the sign of the first is a version's own


def xi(q):
    """(4, 3): a small rotation phi about the axes of the body changes q = w, x, y, z by xi phi / 2."""
    return np.vstack([-q[1:], q[0] * np.eye(3) + np.cross(q[1:], np.eye(3)).T])


def judged(data):
    truth, starts, gyro, seen = data
    errors, covariances = [], []
    for q, rates, fields in zip(np.roll(starts.as_quat(), 1, axis=1), gyro, seen, strict=True):
        ekf = EKF(mag=fields[:, 1], frequency=1 / DT, noises=VARIANCES, magnetic_ref=REFERENCES[1])
        ekf.P, steps = START**2 * xi(q) @ xi(q).T / 4, []
        for w, (a, m) in zip(rates, fields, strict=True):
            q = ekf.update(q, w, a, m)
            steps.append((np.roll(q, -1), 4 * xi(q).T @ ekf.P @ xi(q)))
        found, P = zip(*steps[JUDGED], strict=True)
        errors.append((Rotation.from_quat(found).inv() * Rotation.concatenate(truth)).as_rotvec())
        covariances.append(P)
    return {"attitude": (np.array(errors), np.array(covariances))}


def control(data):
    return {"multiplicative filter": scene.textbook(data, REFERENCES)}


def second():
    """The covariance of a prediction from P = 0: that of an update with measurements that weigh nothing."""
    q = np.roll(scene.FIRST.as_quat(), 1)
    ekf = EKF(mag=np.ones((1, 3)), frequency=1 / DT, noises=[VARIANCES[0], 1e12, 1e12], magnetic_ref=REFERENCES[1])
    ekf.P = np.zeros((4, 4))
    ekf.update(q, scene.RATE[0], np.ones(3), np.ones(3))
    factor, name = (DT / 2, "dt / 2 times ") if version("ahrs") < "0.4" else (1, "")
    expected = factor * VARIANCES[0] * DT**2 * xi(q) @ xi(q).T / 4
    text = f"Q of one step, against {name}the gyroscope's variance by the derivatives"
    return [Argument("attitude", text, ekf.P, expected)]


AXES = ("roll axis", "pitch axis", "yaw axis")
CASE = Case("ahrs", AXES, 78, partial(scene.simulate, references=REFERENCES), judged, control, second)

if __name__ == "__main__":
    CASE.main()
