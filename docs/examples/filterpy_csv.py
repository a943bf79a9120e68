"""Write truth.csv and estimates.csv of 60 runs of a Kalman filter of filterpy; needs filterpy and pandas."""

import numpy as np
import pandas as pd
from filterpy.common import Q_discrete_white_noise
from filterpy.kalman import KalmanFilter

STATE = ["px", "py", "vx", "vy"]
dt, sigma_z, var_a = 0.1, 0.5, 0.2
believed = 1.0  # ratio of believed to true measurement variance: 1 is honest

F = np.eye(4) + dt * np.eye(4, k=2)
H = np.eye(2, 4)
Q = Q_discrete_white_noise(2, dt, var_a, block_size=2, order_by_dim=False)
start, P0 = np.array([0.0, 0.0, 1.0, 0.0]), np.diag([1.0, 1.0, 0.5, 0.5])
rng = np.random.default_rng(1)
truth, estimates = [], []
for run in range(60):
    x = rng.multivariate_normal(start, P0)
    kf = KalmanFilter(dim_x=4, dim_z=2)
    kf.x, kf.P, kf.F, kf.H, kf.Q = start.copy(), P0.copy(), F, H, Q
    kf.R = believed * sigma_z**2 * np.eye(2)
    for step in range(1, 101):
        x = F @ x + rng.multivariate_normal(np.zeros(4), Q)
        kf.predict()
        kf.update(H @ x + rng.normal(0, sigma_z, 2))
        key = {"run": run, "step": step, "t": step * dt}
        upper = {f"P_{STATE[i]}_{STATE[j]}": kf.P[i, j] for i in range(4) for j in range(i, 4)}
        nis = {"nis": kf.y @ kf.SI @ kf.y, "nis_dof": 2}
        truth.append(key | dict(zip(STATE, x, strict=True)))
        estimates.append(key | dict(zip(STATE, kf.x, strict=True)) | upper | nis)
pd.DataFrame(truth).to_csv("truth.csv", index=False)
pd.DataFrame(estimates).to_csv("estimates.csv", index=False)
