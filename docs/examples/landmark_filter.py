"""Estimates with covariances of a public data set: an extended Kalman filter of filterpy on the robots of UTIAS MRCLAM.

    python docs/examples/landmark_filter.py DIR     # the folder MRCLAM_Dataset6; writes est.csv and truth.csv

Each minute of a robot is a run. It begins at the true pose, known to 5 cm and 0.03 rad. The noises are those that a
user might write down: sensors by their data sheet, wheels by a guess. Needs the project with [bench] and filterpy.
"""

import sys
from pathlib import Path

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from consistency.bench.runs.reproduce_findings import sibling

LAG = 0.2  # s, of the robots behind their odometry
WHEELS = 0.05, 0.1  # m/s, rad/s, in each message of the odometry
SIGHT = np.diag([0.15, 0.02]) ** 2  # range, bearing
START = np.array([0.05, 0.05, 0.03])
LENGTH, EVERY, GATE = 60.0, 1.0, 25.0  # s, s, NIS of a wrong barcode
HEAD = "run,t,x,y,heading,P_xx,P_xy,P_xh,P_yy,P_yh,P_hh,landmarks"


def predict(f, v, w, dt):
    """One message of the odometry."""
    c, s = np.cos(f.x[2] + 0.5 * w * dt), np.sin(f.x[2] + 0.5 * w * dt)
    F, G = np.array([[1, 0, -v * dt * s], [0, 1, v * dt * c], [0, 0, 1]]), dt * np.array([[c, 0], [s, 0], [0, 1]])
    f.x = f.x + G @ [v, w]
    f.P = F @ f.P @ F.T + G @ np.diag(WHEELS) ** 2 @ G.T


def sight(x, place):
    d = place - x[:2]
    return np.array([np.hypot(*d), np.arctan2(d[1], d[0]) - x[2]])


def jacobian(x, place):
    d, r = place - x[:2], np.hypot(*(place - x[:2]))
    return np.array([[-d[0] / r, -d[1] / r, 0.0], [d[1] / r**2, -d[0] / r**2, -1.0]])


def residual(a, b):
    e = a - b
    return np.array([e[0], np.arctan2(np.sin(e[1]), np.cos(e[1]))])


def run_of(data, odometry, sights, start, rng):
    """Rows t, x, y, heading, six numbers of P, landmarks of the last second; and true poses."""
    f = ExtendedKalmanFilter(dim_x=3, dim_z=2)
    f.x, f.P, f.R = data.pose(start[None])[0] + START * rng.normal(size=3), np.diag(START) ** 2, SIGHT
    out, seen, times = [], 0, odometry[:, 0]
    for (t, v, w), after in zip(odometry[:-1], times[1:], strict=True):
        predict(f, v, w, after - t)
        while sights and sights[0][0] <= after:
            _, place, z = sights.pop(0)
            H, e = jacobian(f.x, place), residual(z, sight(f.x, place))
            if e @ np.linalg.solve(H @ f.P @ H.T + SIGHT, e) < GATE:
                f.update(z, jacobian, sight, args=place, hx_args=place, residual=residual)
                seen += 1
        if after >= start + EVERY * (len(out) + 1):
            out.append([after, *f.x, *f.P[np.triu_indices(3)], seen])
            seen = 0
    return np.array(out), data.pose(np.array([row[0] for row in out]))


def main(folder):
    read = sibling(str(Path(__file__).parents[2] / "experiments" / "e15_mrclam.py"), "mrclam_log")
    rng, estimates, truth = np.random.default_rng(0), [], []
    for robot in range(1, 6):
        data = read.read_robot(folder, robot)
        odometry = data.odometry[np.append(True, np.diff(data.odometry[:, 0]) > 0)] + [LAG, 0.0, 0.0]
        t, landmark, z = read.sights_of(data)
        for minute, start in enumerate(np.arange(odometry[0, 0], odometry[-1, 0] - LENGTH - 0.1, LENGTH)):
            rows = odometry[(odometry[:, 0] >= start) & (odometry[:, 0] <= start + LENGTH + 0.1)]
            sights = [
                (when, data.landmarks[k], each)
                for when, k, each in zip(t, landmark, z, strict=True)
                if start < when <= start + LENGTH
            ]
            out, true = run_of(data, rows, sights, start, rng)
            for row, pose in zip(out, true, strict=True):
                estimates.append([100 * robot + minute, row[0] - start, *row[1:]])
                truth.append([100 * robot + minute, row[0] - start, *pose])
    numbers = "%d,%.6f" + ",%.9g" * 9 + ",%d"
    np.savetxt("est.csv", estimates, numbers, header=HEAD, comments="")
    np.savetxt("truth.csv", truth, "%d,%.6f,%.9g,%.9g,%.9g", header="run,t,x,y,heading", comments="")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
