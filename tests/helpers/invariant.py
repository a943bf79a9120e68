"""A filter of the user's own with a right-invariant error: ``ekf-uvd`` with its covariance pushed forward."""

import numpy as np

import consistency as cs


class Invariant:
    """The plain twin of ``ekf-uvd``, which says the covariance of Log(truth estimate^-1) as its own."""

    name = "right"
    error = "right"

    def __init__(self):
        self.textbook = cs.get_filter("ekf-uvd").textbook

    def init(self, problem):
        return self.textbook.init(problem)

    def predict(self, state, control):
        return self.textbook.predict(state, control)

    def update(self, state, observation):
        updated = self.textbook.update(state, observation)
        return updated

    def pose(self, state):
        pose = self.textbook.pose(state)
        return pose

    def own_covariance(self, state):
        """To first order the error is M (truth - estimate): (dx + y dh, dy - x dh, dh)."""
        pose = self.pose(state)
        x, y, _ = pose.mean
        M = np.array([[1.0, 0.0, y], [0.0, 1.0, -x], [0.0, 0.0, 1.0]])
        return np.asarray(M @ pose.covariance @ M.T)

    def map(self, state):
        landmarks = self.textbook.map(state)
        return landmarks
