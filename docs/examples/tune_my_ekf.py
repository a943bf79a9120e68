"""Tune the noises of an EKF-SLAM with filterpy; docs/tuning.md shows what it prints. It takes some minutes."""

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

import consistency as cs


def filter_of(x, P):
    ekf = ExtendedKalmanFilter(dim_x=len(x), dim_z=2)
    ekf.x, ekf.P = x, P
    return ekf


class MyEkf:  # EKF-SLAM on landmarks at (dx, dy) in the frame of the robot
    name, sensors = "my-ekf", ("relative-xy",)

    def init(self, problem):
        return problem.belief, problem.start, np.zeros((3, 3)), ()

    def predict(self, state, control):
        belief, x, P, labels = state
        ekf, dt, v = filter_of(x, P), control.dt, control.v
        c, s = np.cos(x[2]), np.sin(x[2])
        ekf.F = np.eye(len(x))
        ekf.F[:2, 2] = -dt * v * s, dt * v * c
        G = np.zeros((len(x), 2))
        G[:3] = [[dt * c, 0], [dt * s, 0], [0, dt]]
        # the noises come from the belief, which is what tuning changes
        ekf.Q = G @ np.diag([belief.motion.sigma_v**2, belief.motion.sigma_omega**2]) @ G.T
        ekf.predict()
        moved = x.copy()
        moved[:3] += dt * v * c, dt * v * s, dt * control.omega
        return belief, moved, ekf.P, labels

    def update(self, state, observation):
        belief, x, P, labels = state
        c, s = np.cos(x[2]), np.sin(x[2])
        turn = np.array([[c, s], [-s, c]])  # from the world to the robot
        R = np.diag(np.square(belief.sensor.sigma))
        rows, z, zhat, info = [], [], [], None
        seen = list(zip(observation.landmarks.tolist(), observation.z, strict=True))
        for label, measured in seen:
            if label in labels:
                at, H = 3 + 2 * labels.index(label), np.zeros((2, len(x)))
                offset = x[at : at + 2] - x[:2]
                H[:, :2], H[:, 2], H[:, at : at + 2] = -turn, np.array([[-s, c], [-c, -s]]) @ offset, turn
                rows, z, zhat = [*rows, H], [*z, measured], [*zhat, turn @ offset]
        if rows:
            ekf, H, expected = filter_of(x, P), np.vstack(rows), np.concatenate(zhat)
            noise = np.kron(np.eye(len(rows)), R)
            ekf.update(np.concatenate(z), HJacobian=lambda _: H, Hx=lambda _: expected, R=noise)
            x, P, info = ekf.x, ekf.P, cs.Info(ekf.y, ekf.S, ekf.K)
        for label, measured in seen:
            if label not in labels:
                c, s = np.cos(x[2]), np.sin(x[2])
                back = np.array([[c, -s], [s, c]])
                J = np.zeros((2, len(x)))
                J[:, :2], J[:, 2] = np.eye(2), np.array([[-s, -c], [c, -s]]) @ measured
                P = np.block([[P, P @ J.T], [J @ P, J @ P @ J.T + back @ R @ back.T]])
                x, labels = np.concatenate([x, x[:2] + back @ measured]), (*labels, label)
        return (belief, x, P, labels), info

    def pose(self, state):
        _, x, P, _ = state
        return cs.Gaussian(x[:3], P[:3, :3])


world = cs.load_scenario("esde-xy").variant(
    "doubtful",
    truth__steps=50,
    belief__motion__sigma_v=0.005,  # the truth is 0.014
    belief__motion__sigma_omega=0.02,  # and 0.057
)
tuning = cs.tune(world, MyEkf(), runs=20)
print(tuning)
