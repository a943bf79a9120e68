"""Two poses with errors T = exp(xi) mean, their composition, and the textbook's covariance of it."""

import numpy as np
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

AXES = ("rx", "ry", "rz", "x", "y", "z")
SIGMA = np.array([0.1, 0.05, 0.08, 0.1, 0.2, 0.1])  # rad, m
P = [np.outer(s, s) * (0.5 + 0.5 * np.eye(6)) for s in (SIGMA, SIGMA[[1, 2, 0, 5, 3, 4]], SIGMA[[2, 0, 1, 4, 5, 3]])]


def hat(w):
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def exp(xi):
    return expm(np.vstack([np.column_stack([hat(xi[:3]), xi[3:]]), np.zeros(4)]))


def log(T):
    w, t = Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3]
    W, half = hat(w), max(np.linalg.norm(w), 1e-9) / 2
    return np.r_[w, t - W @ t / 2 + (1 - half / np.tan(half)) / (2 * half) ** 2 * W @ W @ t]


def adjoint(T):
    R = T[:3, :3]
    return np.block([[R, np.zeros((3, 3))], [hat(T[:3, 3]) @ R, R]])


A, B = exp(np.array([0.3, -0.5, 1.0, 1.0, 2.0, -0.5])), exp(np.array([-0.8, 0.2, 0.4, -1.0, 0.5, 1.5]))


def simulate(rng, runs):
    """Errors of three poses of each run, (runs, 3, 6)."""
    return np.stack([rng.multivariate_normal(np.zeros(6), each, runs) for each in P], axis=1)


def textbook(draws):
    """Barfoot & Furgale (2014), to second order."""
    errors, covariances = [], []
    for xi in draws:
        a, b = exp(-xi[0]) @ A, exp(-xi[1]) @ B
        errors.append(log(B @ A @ np.linalg.inv(b @ a)))
        covariances.append(P[1] + adjoint(b) @ P[0] @ adjoint(b).T)
    return {"textbook composition": (np.array(errors), np.array(covariances))}
