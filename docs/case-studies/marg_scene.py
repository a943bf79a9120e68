"""Gyroscope, accelerometer and compass of a body that turns, and a textbook's filter of its attitude."""

import numpy as np
from scipy.spatial.transform import Rotation

STEPS, JUDGED, DT, START = 200, slice(9, None, 10), 0.01, 0.1  # samples, every tenth is judged; s; rad
REFERENCES = np.array([[0, 0, 1.0], [np.cos(1.1), 0, np.sin(1.1)]])  # down, magnetic north
VARIANCES = np.array([0.3, 0.3 / 9.81, 2000 / 48_000]) ** 2  # (rad/s)^2, and of unit vectors
T = DT * np.arange(1, STEPS + 1)
RATE = np.column_stack([np.cos(3 * T), 0.5 * np.sin(5 * T), np.full(STEPS, 0.8)])  # rad/s
FIRST = Rotation.from_euler("xyz", [0.1, -0.2, 0.5])


def simulate(rng, runs, references):
    """Truth, starts about it, rates, and the unit vectors of the two references in the axes of the body."""
    truth = [FIRST]
    for w in RATE:
        truth.append(truth[-1] * Rotation.from_rotvec(w * DT))
    fields = np.array([R.inv().apply(references) for R in truth[1:]])
    seen = fields + rng.normal(size=(runs, STEPS, 2, 3)) * VARIANCES[1:, None] ** 0.5
    seen /= np.linalg.norm(seen, axis=-1, keepdims=True)
    starts = FIRST * Rotation.from_rotvec(rng.normal(0, START, (runs, 3)))
    return truth[1:][JUDGED], starts, RATE + rng.normal(0, VARIANCES[0] ** 0.5, (runs, STEPS, 3)), seen


def textbook(data, references):
    """Errors and covariances of all runs, of rotation vectors about the axes of the body."""
    truth, R, gyro, seen = data
    P, steps, noise = START**2 * np.eye(3), [], np.diag(np.repeat(VARIANCES[1:], 3))
    for k in range(STEPS):
        turn = Rotation.from_rotvec(gyro[:, k] * DT)
        A = np.swapaxes(turn.as_matrix(), 1, 2)
        R, P = R * turn, A @ P @ np.swapaxes(A, 1, 2) + VARIANCES[0] * DT**2 * np.eye(3)
        expected = np.einsum("rji,fj->rfi", R.as_matrix(), references)
        H = np.cross(np.eye(3), expected[:, :, None]).reshape(-1, 6, 3)
        K = np.swapaxes(np.linalg.solve(H @ P @ np.swapaxes(H, 1, 2) + noise, H @ P), 1, 2)
        moved = np.einsum("rij,rj->ri", K, (seen[:, k] - expected).reshape(-1, 6))
        R, P = R * Rotation.from_rotvec(moved), P - K @ H @ P
        steps.append((R, P))
    found = steps[JUDGED]
    errors = [(R.inv() * true).as_rotvec() for true, (R, _) in zip(truth, found, strict=True)]
    return np.swapaxes(errors, 0, 1), np.swapaxes([P for _, P in found], 0, 1)
