"""A filter of the user's own with a right-invariant error: ``ekf-uvd`` with its covariance pushed forward."""

from __future__ import annotations

from typing import Any

import numpy as np

import consistency as cs
from consistency.referee.types import Array


class Invariant:
    """The plain twin of ``ekf-uvd``, which says the covariance of Log(truth estimate^-1) as its own."""

    name = "right"
    error = "right"

    def __init__(self) -> None:
        self.textbook = cs.get_filter("ekf-uvd").textbook

    def init(self, problem: Any) -> Any:
        return self.textbook.init(problem)

    def predict(self, state: Any, control: cs.Control) -> Any:
        return self.textbook.predict(state, control)

    def update(self, state: Any, observation: cs.Observation) -> tuple[Any, Any]:
        updated: tuple[Any, Any] = self.textbook.update(state, observation)
        return updated

    def pose(self, state: Any) -> cs.Gaussian:
        pose: cs.Gaussian = self.textbook.pose(state)
        return pose

    def own_covariance(self, state: Any) -> Array:
        """To first order the error is M (truth - estimate): (dx + y dh, dy - x dh, dh)."""
        pose = self.pose(state)
        x, y, _ = pose.mean
        M = np.array([[1.0, 0.0, y], [0.0, 1.0, -x], [0.0, 0.0, 1.0]])
        return np.asarray(M @ pose.covariance @ M.T)

    def map(self, state: Any) -> dict[int, cs.Gaussian]:
        landmarks: dict[int, cs.Gaussian] = self.textbook.map(state)
        return landmarks
