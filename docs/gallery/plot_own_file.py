"""
Errors of an estimator's file, with the bounds that it states
=============================================================

A Kalman filter of position and speed believes half of the variance that its measurements have. ``cs.judge`` draws the
errors of one run with their stated bounds, the average NEES with its band, and how many errors lie within each bound.
"""

import tempfile
from pathlib import Path

import numpy as np

import consistency as cs

RUNS, STEPS, DT, SIGMA = 60, 100, 0.1, 0.5
F, H, R = np.array([[1, DT], [0, 1]]), np.array([[1, 0]]), 0.5 * SIGMA**2
Q = 0.05 * np.array([[DT**4 / 4, DT**3 / 2], [DT**3 / 2, DT**2]])
rng = np.random.default_rng(101)

errors, covariances = np.empty((RUNS, STEPS, 2)), np.empty((RUNS, STEPS, 2, 2))
for run in range(RUNS):
    P = np.eye(2)
    error = rng.multivariate_normal([0, 0], P)  # truth minus estimate
    for step in range(STEPS):
        error = F @ error + rng.multivariate_normal([0, 0], Q)
        P = F @ P @ F.T + Q
        K = P @ H.T / (H @ P @ H.T + R)
        error = error - K @ (H @ error + rng.normal(0, SIGMA, 1))
        P = (np.eye(2) - K @ H) @ P
        errors[run, step], covariances[run, step] = error, P

with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "mine.npz"
    times = DT * np.arange(1, STEPS + 1)
    np.savez(path, errors=errors, covariances=covariances, axes=["position", "speed"], t=times)
    verdict = cs.judge(cs.read(path))

figure = verdict.plot()
print(verdict.reasons[0])
