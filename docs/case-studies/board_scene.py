"""Views of a board of known points by a camera without distortion, and a textbook's least squares of them."""

import numpy as np
from scipy.spatial.transform import Rotation

VIEWS, NOISE = 8, 0.3  # px
TRUE = np.array([600.0, 610.0, 322.0, 238.0])
BOARD = np.column_stack([30e-3 * np.indices((9, 6)).reshape(2, -1).T, np.zeros(54)]).astype(np.float32)  # m


def project(x):
    """Pixels of all views, (8 * 54 * 2,), from fx, fy, cx, cy and a rotation vector and a translation of each view."""
    views = x[4:].reshape(VIEWS, 6)
    p = Rotation.from_rotvec(views[:, :3]).as_matrix() @ BOARD.T.astype(float) + views[:, 3:, None]
    return (p[:, :2] / p[:, 2:] * x[:2, None] + x[2:4, None]).transpose(0, 2, 1).ravel()


def jacobian(x, h=1e-6):
    """Central differences; the parameters of a view move its own pixels alone, so that all views are moved at once."""
    J, rows = np.zeros((VIEWS, 2 * len(BOARD), len(x))), np.arange(VIEWS)
    for k in range(10):
        d = h * (np.arange(len(x)) == k if k < 4 else np.r_[np.zeros(4), np.tile(np.arange(6) == k - 4, VIEWS)])
        change = ((project(x + d) - project(x - d)) / (2 * h)).reshape(VIEWS, -1)
        J[rows, :, k if k < 4 else 6 * rows + k] = change
    return J.reshape(-1, len(x))


def simulate(rng, runs):
    draws = []
    for _ in range(runs):
        turns = rng.uniform(-1, 1, (VIEWS, 3)) * [0.6, 0.6, 0.3]
        middle = np.column_stack([rng.uniform(-0.05, 0.05, (VIEWS, 2)), rng.uniform(0.35, 0.6, VIEWS)])
        places = middle - Rotation.from_rotvec(turns).apply(BOARD.mean(axis=0))
        x = np.r_[TRUE, np.hstack([turns, places]).ravel()]
        draws.append((x, project(x) + rng.normal(0, NOISE, VIEWS * len(BOARD) * 2)))
    return draws


def least_squares(x, pixels):
    """From the truth, with (J'J)^-1 and the variance of the residuals over 2 N - n."""
    for _ in range(3):
        J = jacobian(x)
        x = x + np.linalg.solve(J.T @ J, J.T @ (pixels - project(x)))
    return x, np.linalg.inv(J.T @ J) * np.sum((pixels - project(x)) ** 2) / (J.shape[0] - J.shape[1])
