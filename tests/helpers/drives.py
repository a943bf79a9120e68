"""Files of drives and of simulations that other tools write, in the forms of their public documentation."""

import datetime

import numpy as np
from scipy.spatial.transform import Rotation

STEPS = 60
R_IV, T_IV = Rotation.from_euler("ZYX", [0.015, -0.002, 0.008]).as_matrix(), np.array([-0.81, 0.32, -0.8])
R_VC, T_VC = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.array([-0.004, -0.076, -0.27])


def write_drive(folder, calibrated=True):
    """A drive of 6 s through Karlsruhe, all angles changing."""
    (folder / "oxts/data").mkdir(parents=True)
    rng = np.random.default_rng(2013)
    s = np.arange(STEPS) / 10.0
    place = [49.015 + 1e-4 * s, 8.434 + 8e-5 * np.sin(0.4 * s), 116.0 + 0.1 * s]
    angles = [0.03 * np.sin(s), -0.02 + 0.02 * np.cos(s), 3.0 + 0.1 * s]  # the yaw goes beyond pi
    angles[2] = np.arctan2(np.sin(angles[2]), np.cos(angles[2]))
    begin = datetime.datetime(2011, 9, 26, 23, 59, 58, 594360)
    stamps = []
    for k in range(STEPS):
        numbers = [f"{each[k]:.14g}" for each in (*place, *angles)] + ["0.1"] * 19 + ["4", "10", "4", "4", "0"]
        (folder / f"oxts/data/{k:010d}.txt").write_text(" ".join(numbers) + "\n")
        at = begin + datetime.timedelta(seconds=float(s[k]), microseconds=int(rng.integers(0, 900)) if k else 0)
        stamps.append(at.strftime("%Y-%m-%d %H:%M:%S.%f") + "375")
    (folder / "oxts/timestamps.txt").write_text("\n".join(stamps) + "\n")
    if calibrated:
        for name, R, T in (("imu_to_velo", R_IV, T_IV), ("velo_to_cam", R_VC, T_VC)):
            lines = {
                "calib_time": "25-May-2012 16:47:16",
                "R": " ".join(map(str, R.ravel())),
                "T": " ".join(map(str, T)),
            }
            text = "".join(f"{key}: {value}\n" for key, value in lines.items())
            (folder.parent / f"calib_{name}.txt").write_text(text)
    return folder


def write_states(at, cameras=1, more=0, moving=False):
    """state_estimate.txt, state_deviation.txt and state_groundtruth.txt; errors and deviations, position first.

    Velocity and biases are 0 and exact, or with ``moving`` have errors and deviations like the others.
    """
    rng = np.random.default_rng()
    t = 0.05 * np.arange(STEPS)
    sigma = np.exp(rng.normal(-3.0, 0.3, (STEPS, 15 if moving else 6)))
    e = sigma * rng.normal(size=sigma.shape)
    true_turn = Rotation.from_rotvec(np.outer(t, [0.1, 0.2, 0.5]))
    true = np.column_stack([np.sin(t), np.cos(t), t])
    turn = true_turn * Rotation.from_rotvec(-e[:, 3:6])  # R_true = R_est Exp(e): about the axes of the body
    rest, calibration = np.zeros((STEPS, 10)), np.ones((STEPS, 15 * cameras + more))
    if moving:
        rest[:, :9] = np.sin(t[:, None] + np.arange(9))
    count = np.full((STEPS, 1), float(cameras))
    own = rest.copy()
    own[:, : e.shape[1] - 6] -= e[:, 6:]
    for name, p, q, more_of in (("estimate", true - e[:, :3], turn, own), ("groundtruth", true, true_turn, rest)):
        rows = np.column_stack([t, q.as_quat(), p, more_of, count, calibration])
        np.savetxt(at / f"state_{name}.txt", rows, fmt="%.12g", header="timestamp(s) q p v bg ba ...")
    stated = np.zeros((STEPS, 10))
    stated[:, : e.shape[1] - 6] = sigma[:, 6:]
    rows = np.column_stack([t, sigma[:, 3:6], sigma[:, :3], stated, count, np.ones((STEPS, 14 * cameras + more))])
    np.savetxt(at / "state_deviation.txt", rows, fmt="%.12g")
    return e, sigma
