"""Simulated drives. The noises here are the true ones: the filter has its own, in cart/ekf.py."""

import numpy as np

from cart.ekf import Ekf

DT, STEPS = 0.2, 40
SIGMA_V, SIGMA_OMEGA, SIGMA_FIX = 0.1, 0.05, 0.3
SIGMA_0 = np.array([0.2, 0.2, 0.05])  # m, m, rad: of the pose at the start


def trials(runs, seed=0):
    """Truth and estimates (runs, STEPS, 3) and covariances (runs, STEPS, 3, 3); each run has noise of its own."""
    truth, estimates = np.empty((runs, STEPS, 3)), np.empty((runs, STEPS, 3))
    covariances = np.empty((runs, STEPS, 3, 3))
    for run, rng in enumerate(np.random.default_rng(seed).spawn(runs)):
        pose = rng.normal(0, SIGMA_0)
        ekf = Ekf(np.zeros(3), np.diag(SIGMA_0**2))
        for step in range(STEPS):
            v, omega = 1.0, 0.3 * np.sin(0.1 * step)
            pose = pose + DT * np.array([v * np.cos(pose[2]), v * np.sin(pose[2]), omega])
            ekf.predict(v + rng.normal(0, SIGMA_V), omega + rng.normal(0, SIGMA_OMEGA), DT)
            ekf.update(pose[:2] + rng.normal(0, SIGMA_FIX, 2))
            truth[run, step], estimates[run, step], covariances[run, step] = pose, ekf.x, ekf.P
    return truth, estimates, covariances


def errors(truth, estimates):
    """Truth minus estimate, the heading wrapped."""
    difference = truth - estimates
    difference[..., 2] = np.arctan2(np.sin(difference[..., 2]), np.cos(difference[..., 2]))
    return difference
