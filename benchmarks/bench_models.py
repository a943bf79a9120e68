"""What every peer of the bench shares: the models in NumPy, and a trial's steps by somebody else's filter."""

from __future__ import annotations

import numpy as np
from bench_trials import Case, twin_state

from consistency.bench.filters.textbook.basics import PointSensor, motion_jacobians, pose_after, process_noise
from consistency.bench.scenario import Belief, models
from consistency.bench.types import Control
from consistency.referee.types import Array

WARM = 5  # steps before the peers take over: the start is known exactly, and their roots need full rank
Said = tuple[Array, Array]  # poses (K, 3), covariances (K, 3, 3)


class Models:
    """f, h and their Jacobians over the whole state."""

    def __init__(self, belief: Belief) -> None:
        self.belief, self.sensor = belief, PointSensor(belief.sensor, uvd=True)

    def f(self, x: Array, control: Control) -> Array:
        moved = x.copy()
        moved[:3] = pose_after(x[:3], control)
        return moved

    def noise(self, x: Array, control: Control, Q: Array) -> Array:
        """Q (n, n) <- G Q G' of the pose, zero elsewhere."""
        Q[:3, :3] = process_noise(motion_jacobians(x[:3], control)[1], self.belief)
        return Q

    def h(self, x: Array, at: Array) -> Array:
        """Landmarks whose components lie at ``at`` (m, 3), as (3 m,)."""
        return self.sensor.measure(x[:3], x[at]).ravel()

    def H(self, x: Array, at: Array) -> Array:
        """Jacobian (3 m, n) of h."""
        s, m = self.sensor, len(at)
        bx, by, bz = models.to_robot(*x[:3], *x[at].T)
        J = models.project_jacobian(*models.to_sensor(bx, by, bz, s.mount), s.f, s.B)
        turned = np.stack(np.broadcast_arrays(*J), axis=-1).reshape(m, 3, 3) @ s.turn.T
        c, sn = np.cos(x[2]), np.sin(x[2])
        to_robot = np.array([[c, sn, 0.0], [-sn, c, 0.0], [0.0, 0.0, 1.0]])
        d_pose = np.zeros((m, 3, 3))
        d_pose[:, :, :2] = -to_robot[:, :2]
        d_pose[:, 0, 2], d_pose[:, 1, 2] = by, -bx
        H = np.zeros((m, 3, len(x)))
        H[:, :, :3] = turned @ d_pose
        np.put_along_axis(H, np.repeat(at[:, None, :], 3, axis=1), turned @ to_robot, axis=2)
        return H.reshape(3 * m, len(x))


class Peer:
    """Steps ``WARM`` + 1 .. ``WARM`` + ``steps`` of a case by somebody else's filter; a call does them all."""

    filter = "ekf-uvd"  # ours, which it must equal
    reorders = False

    def __init__(self, case: Case, steps: int) -> None:
        self.trial, self.models, self.steps = case.trial, Models(case.belief), steps
        self.R = np.diag(np.tile(np.square(case.belief.sensor.sigma), len(case.trial.observation(WARM + 1).z)))
        self.start = twin_state(case, self.filter, WARM)
        self.n = len(self.start[0])
        self.prepare()

    def prepare(self) -> None:
        """Make the filter object."""

    def step(self, x: Array, P: Array, control: Control, at: Array, z: Array) -> Said:
        raise NotImplementedError

    def __call__(self) -> Said:
        x, P = self.start
        place = np.arange(self.n)  # where a variable of the state is now
        pose, covariance = np.empty((self.steps, 3)), np.empty((self.steps, 3, 3))
        for k in range(self.steps):
            seen = self.trial.observation(WARM + k + 1)
            at = place[3 + 3 * seen.landmarks[:, None] + np.arange(3)]  # step 1 saw all: their order is the state's
            if self.reorders:
                rest = np.ones(self.n, bool)
                rest[:3] = rest[at] = False
                order = np.concatenate([np.arange(3), at.ravel(), np.flatnonzero(rest)])
                x, P = x[order], P[np.ix_(order, order)]
                now = np.empty(self.n, np.int64)
                now[order] = np.arange(self.n)
                place, at = now[place], now[at]
            x, P = self.step(x, P, self.trial.control(WARM + k + 1), at, seen.z.ravel())
            pose[k], covariance[k] = x[:3], P[:3, :3]
        return pose, covariance
