"""Files of estimators whose errors are quantiles of a normal distribution in a fixed order: no generator of random
numbers, so that every version of NumPy makes the same."""

import numpy as np
from scipy import special
from scipy.spatial.transform import Rotation

RUNS, STEPS = 40, 6
SIGMA = np.array([0.1, 0.2, 0.03])  # m, m, rad
P = np.outer(SIGMA, SIGMA) * [[1.0, 0.3, 0.0], [0.3, 1.0, -0.2], [0.0, -0.2, 1.0]]
PRIMES = (2.0, 3.0, 5.0, 7.0, 11.0, 13.0)


def normal(count, n):
    """(count, n) like independent standard normal numbers: squares times roots of primes, modulo 1."""
    share = np.outer(np.square(np.arange(1, count + 1)), np.sqrt(PRIMES[:n])) % 1.0
    return np.asarray(special.ndtri(share))


def rows(path, header, lines, mark=","):
    text = [mark.join(f"{value:.12g}" if isinstance(value, float) else str(value) for value in line) for line in lines]
    path.write_text("\n".join([header, *text] if header else text) + "\n", encoding="utf-8")
    return path


def planar(at, name, scale=1.0, optimal=False):
    """Poses in the plane with errors ``scale`` times as large as stated, beside ``truth.csv``."""
    error = scale * normal(RUNS * STEPS, 3) @ np.linalg.cholesky(P).T
    nis = scale**2 * np.square(normal(RUNS * STEPS, 5)[:, 3:]).sum(axis=1)
    half = P[np.triu_indices(3)].tolist()
    lines, truth = [], []
    for k, e in enumerate(error):
        run, step = divmod(k, STEPS)
        pose = np.array([0.5 * step, np.sin(0.3 * step), 0.2 * step])
        lines.append(
            [run, step + 1, *map(float, pose - e), *map(float, half), *([float(nis[k]), 2] if optimal else [])]
        )
        if run == 0:
            truth.append([step + 1, *pose.tolist()])
    rows(at / "truth.csv", "step,x,y,heading", truth)
    own = ",nis,nis_dof" if optimal else ""
    return rows(at / f"{name}.csv", f"run,step,x,y,heading,P_xx,P_xy,P_xh,P_yy,P_yh,P_hh{own}", lines)


def trajectories(at, scale=1.0, runs=30, steps=5):
    """Folders est, true and cov of TUM trajectories in space, a file for each run."""
    sigma = np.array([0.1, 0.2, 0.05, 0.01, 0.02, 0.03])
    error = scale * sigma * normal(runs * steps, 6)
    for folder in ("est", "true", "cov"):
        (at / folder).mkdir()
    for run in range(runs):
        t = 100.0 + 0.1 * np.arange(steps)
        position = np.outer(np.arange(steps), [0.5, 0.1, 0.02])
        turn = Rotation.from_rotvec(np.outer(np.arange(steps), [0.02, -0.01, 0.1]))
        e = error[run * steps : (run + 1) * steps]
        true = (Rotation.from_rotvec(e[:, 3:]) * turn).as_quat()
        for folder, values in (
            ("est", np.column_stack([t, position, turn.as_quat()])),
            ("true", np.column_stack([t, position + e[:, :3], true])),
            ("cov", np.column_stack([t, np.tile(np.diag(sigma**2).ravel(), (steps, 1))])),
        ):
            rows(at / folder / f"run{run:02d}.txt", "", values.tolist(), " ")
    return at / "est", at / "true", at / "cov"


def archive(at, scale=1.0):
    """Errors and covariances of two components as a NumPy archive."""
    errors = scale * normal(RUNS * STEPS, 2).reshape(RUNS, STEPS, 2)
    np.savez(at / "errors.npz", errors=errors, covariances=np.broadcast_to(np.eye(2), (RUNS, STEPS, 2, 2)))
    return at / "errors.npz"


def drive(at, steps=1200):
    """One log in the plane: motions, each with a covariance of its own, and the true poses."""
    error = SIGMA / 10.0 * normal(steps, 3)
    motion, true = np.array([0.5, 0.0, 0.01]), np.zeros(3)
    lines, truth = [[0, *true.tolist(), *np.zeros(6).tolist()]], [[0, *true.tolist()]]
    Q = np.diag(np.square(SIGMA / 10.0))
    half = Q[np.triu_indices(3)].tolist()
    for k in range(steps):
        true = moved(true, motion + error[k])
        lines.append([k + 1, *motion.tolist(), *half])
        truth.append([k + 1, *true.tolist()])
    header = "step,x,y,heading"
    one = rows(at / "drive.csv", f"{header},P_xx,P_xy,P_xh,P_yy,P_yh,P_hh", lines)
    return one, rows(at / "driven.csv", header, truth)


def moved(pose, motion):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return pose + np.array([c * motion[0] - s * motion[1], s * motion[0] + c * motion[1], motion[2]])
