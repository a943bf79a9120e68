"""EKF of a cart with wheel odometry and position fixes. State: x, y (m), heading (rad)."""

import numpy as np

SIGMA_V, SIGMA_OMEGA = 0.1, 0.05  # m/s, rad/s: noise of the odometry, as the filter believes
SIGMA_FIX = 0.3  # m: noise of a fix, as the filter believes


class Ekf:
    """``x`` (3,) is the estimate and ``P`` (3, 3) its covariance."""

    def __init__(self, x, P):
        self.x, self.P = np.array(x, float), np.array(P, float)

    def predict(self, v, omega, dt):
        """Move by the measured speeds, m/s and rad/s, for dt seconds."""
        c, s = np.cos(self.x[2]), np.sin(self.x[2])
        F = np.array([[1, 0, -dt * v * s], [0, 1, dt * v * c], [0, 0, 1]])
        G = dt * np.array([[c, 0], [s, 0], [0, 1]])
        self.x = self.x + dt * np.array([v * c, v * s, omega])
        self.P = F @ self.P @ F.T + G @ np.diag([SIGMA_V**2, SIGMA_OMEGA**2]) @ G.T

    def update(self, fix):
        """Correct by a measured position (2,), m."""
        K = self.P[:, :2] @ np.linalg.inv(self.P[:2, :2] + SIGMA_FIX**2 * np.eye(2))
        self.x = self.x + K @ (fix - self.x[:2])
        P = self.P - K @ self.P[:2]
        self.P = (P + P.T) / 2
