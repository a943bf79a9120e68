"""Estimates with covariances of a public data set: a robot between four radio beacons (Labyrinth, TU Chemnitz).

    python docs/examples/radio_beacons.py DIR    # the folder datasets/Indoor_UWB of libRSF; writes est.csv

An extended Kalman filter of wheels and ranges, with the variances that the data state for both. DIR holds
Indoor_UWB_Input.txt and _GT.txt, as github.com/TUC-ProAut/libRSF has them (CC BY-SA 4.0).
"""

import sys
from pathlib import Path

import numpy as np

NEAR = 0.05  # s, between an estimate and its truth
START = np.diag([0.01, 0.01, np.pi**2 / 3])  # the place is known to 10 cm, the heading is not
HEAD = "t,x,y,P_x_x,P_x_y,P_y_y,true_x,true_y"


def lines_of(path):
    """Kind and numbers of each line, in order of time."""
    if not path.is_file():
        sys.exit(f"{path}: no such file; DIR must be the folder datasets/Indoor_UWB of libRSF")
    lines = [line.split() for line in path.read_text().splitlines() if line.strip()]
    rows = [(kind, np.array(numbers, float)) for kind, *numbers in lines]
    return sorted(rows, key=lambda row: row[1][0])


def predict(x, P, wheels, dt):
    """State and covariance after dt, with speeds of the wheels, their distance, and the variances of the speeds."""
    right, left, _, width, *variances = wheels[:6]
    v, w = 0.5 * (right + left), (right - left) / width
    c, s = np.cos(x[2] + 0.5 * w * dt), np.sin(x[2] + 0.5 * w * dt)
    F = np.array([[1.0, 0.0, -v * dt * s], [0.0, 1.0, v * dt * c], [0.0, 0.0, 1.0]])
    G = dt * np.array([[0.5 * c, 0.5 * c], [0.5 * s, 0.5 * s], [1.0 / width, -1.0 / width]])
    return x + dt * np.array([v * c, v * s, w]), F @ P @ F.T + G @ np.diag(variances) @ G.T


def update(x, P, measured, variance, beacon):
    """State and covariance with the range to a beacon."""
    d = x[:2] - beacon
    distance = np.hypot(*d)
    H = np.append(d / distance, 0.0)
    gain = P @ H / (H @ P @ H + variance)
    return x + gain * (measured - distance), P - np.outer(gain, H @ P)


def main(folder):
    truth = np.array([numbers for _, numbers in lines_of(folder / "Indoor_UWB_GT.txt")])
    measurements = lines_of(folder / "Indoor_UWB_Input.txt")
    x, P = np.append(truth[0, 1:3], 0.0), START
    wheels, last = None, measurements[0][1][0]
    out = []
    for kind, (t, *numbers) in measurements:
        if wheels is not None:
            x, P = predict(x, P, wheels, t - last)
        last = t
        if kind == "odom2diff":
            wheels = numbers
            continue
        x, P = update(x, P, numbers[0], numbers[1], np.array(numbers[2:4]))
        nearest = truth[np.argmin(np.abs(truth[:, 0] - t))]
        if abs(nearest[0] - t) < NEAR:
            out.append([t, *x[:2], P[0, 0], P[0, 1], P[1, 1], *nearest[1:3]])
    np.savetxt("est.csv", out, "%.9g", ",", header=HEAD, comments="")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
