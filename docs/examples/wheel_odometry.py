"""Independent motions of wheel odometry in an archive, judged over windows; docs/files.md, Relative poses."""

import numpy as np

import consistency as cs

rng = np.random.default_rng(3)
sigma = np.array([0.02, 0.01, 0.005])  # m, m, rad: of each motion, in its own frame
motions = np.tile([0.15, 0.0, 0.02], (3000, 1))  # forward, left, turn
true = motions + sigma * rng.normal(size=motions.shape)
heading = np.concatenate([[0.0], np.cumsum(true[:, 2])])
c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
steps = np.column_stack([c * true[:, 0] - s * true[:, 1], s * true[:, 0] + c * true[:, 1]])
truth = np.column_stack([np.concatenate([[[5.0, -3.0]], np.array([5.0, -3.0]) + np.cumsum(steps, axis=0)]), heading])
start = np.zeros((1, 3))
covariances = np.broadcast_to(np.diag(sigma**2), (3001, 3, 3))
np.savez("wheels.npz", estimates=np.concatenate([start, motions]), truth=truth, covariances=covariances)

record = cs.read("wheels.npz", relative=50, motions=True)  # 60 windows of 50 steps
cs.judge(record)
