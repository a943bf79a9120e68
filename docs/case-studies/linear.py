"""A linear model with Gaussian noise, position and velocity, for the cases of Kalman filters and smoothers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from study import Argument

AXES = ("position", "velocity")
H = np.array([[1.0, 0.0]])  # the position is measured
TEXT = "exact, as the estimates are linear in the measurements"


@dataclass(frozen=True)
class Model:
    """x[k + 1] = F[k] x[k] + w[k], z[k] = H x[k] + v[k]; T steps."""

    F: Any  # (T - 1, 2, 2)
    Q: Any  # (T - 1, 2, 2)
    R: float
    P0: Any  # (2, 2), of the first state, whose mean is 0

    @property
    def steps(self) -> int:
        return len(self.F) + 1

    def simulate(self, rng: np.random.Generator, runs: int) -> tuple[Any, Any]:
        """States (runs, T, 2) and measurements (runs, T)."""
        x = np.empty((runs, self.steps, 2))
        x[:, 0] = rng.multivariate_normal(np.zeros(2), self.P0, runs)
        for k, (F, Q) in enumerate(zip(self.F, self.Q, strict=True)):
            x[:, k + 1] = x[:, k] @ F.T + rng.multivariate_normal(np.zeros(2), Q, runs)
        return x, x[..., 0] + rng.normal(0, self.R**0.5, x.shape[:2])

    def prior(self) -> Any:
        """Covariance of the states of all steps, (T, 2, T, 2)."""
        C = np.zeros((self.steps, 2, self.steps, 2))
        C[0, :, 0] = self.P0
        for k, (F, Q) in enumerate(zip(self.F, self.Q, strict=True)):
            C[k + 1, :, : k + 1] = np.einsum("ij,jlm->ilm", F, C[k, :, : k + 1])
            C[: k + 1, :, k + 1] = np.moveaxis(C[k + 1, :, : k + 1], 0, -1)
            C[k + 1, :, k + 1] = F @ C[k, :, k] @ F.T + Q
        return C

    def exact(self, row: str, estimate: Callable[[tuple[Any, Any]], tuple[Any, Any]]) -> list[Argument]:
        """Ratios of true to stated covariance, mean over steps, without a random number.

        ``estimate`` gives errors and covariances of states and measurements. A linear estimator is known by what it
        makes of unit measurements, one step 1 and the others 0; the covariance of its errors is a product of matrices.
        """
        size = 2 * self.steps
        minus, stated = estimate((np.zeros((self.steps, self.steps, 2)), np.eye(self.steps)))
        G = -np.reshape(minus, (self.steps, size)).T
        A = np.eye(size) - G @ np.kron(np.eye(self.steps), H)
        E = (A @ self.prior().reshape(size, size) @ A.T + self.R * G @ G.T).reshape(self.steps, 2, self.steps, 2)
        true, stated = np.array([E[k, :, k] for k in range(self.steps)]), np.asarray(stated)[0]
        whole = np.trace(np.linalg.solve(stated, true), axis1=1, axis2=2).mean() / 2
        parts = [(true[:, i, i] / stated[:, i, i]).mean() for i in range(2)]
        by_axis = (Argument(row, TEXT, part, axis=axis) for part, axis in zip(parts, AXES, strict=True))
        return [Argument(row, TEXT, whole), *by_axis]


STEPS = 40
_F, _Q = np.array([[1.0, 1], [0, 1]]), np.array([[1 / 3, 1 / 2], [1 / 2, 1]])
STEADY = Model([_F] * (STEPS - 1), [_Q] * (STEPS - 1), 0.1, _F @ _F.T + _Q)  # one step after a state N(0, I)


def textbook(data: tuple[Any, Any]) -> dict[str, tuple[Any, Any]]:
    """The control: a Kalman filter of ``STEADY``, for all runs at once."""
    (truth, z), P, means, covariances = data, STEADY.P0, [], []
    m = np.zeros((len(z), 2))
    for k in range(STEPS):
        K = P @ H.T / (H @ P @ H.T + STEADY.R)
        m, P = m + (z[:, k, None] - m @ H.T) @ K.T, P - K @ H @ P
        means.append(m)
        covariances.append(np.broadcast_to(P, (len(z), 2, 2)))
        m, P = m @ _F.T, _F @ P @ _F.T + _Q
    return {"textbook filter": (truth - np.swapaxes(means, 0, 1), np.swapaxes(covariances, 0, 1))}
