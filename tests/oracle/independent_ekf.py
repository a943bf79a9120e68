"""Plain dense EKF-SLAM after Herath et al. 2007 (eq. 14, 18, 19, 21, 22) and CONTRACT.md."""

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

Array = NDArray[np.float64]
Pairs = list[tuple[int, Array]]  # position in the map, measurement
RANK_TOLERANCE = 1e-12  # smallest over largest eigenvalue of the 3x3 pose covariance
COLUMNS = ["step", "x", "y", "heading", "P_xx", "P_xy", "P_xh", "P_yy", "P_yh", "P_hh"]
COLUMNS += ["nees", "nis", "nis_dof"]


@dataclass(frozen=True)
class Sensor:
    """What the sensor delivers ('uvd' or 'xyz'), its variances, focal length and baseline."""

    model: str
    variances: Array
    f: float = math.nan
    B: float = math.nan


def triangulate(z: Array, s: Sensor) -> Array:
    """Eq. 21: (u, v, d) to (x, y, z) in the camera frame."""
    u, v, d = z
    return np.array([s.B * s.f / d, -s.B * u / d, -s.B * v / d])


def triangulate_jacobian(z: Array, s: Sensor) -> Array:
    """Derivative of eq. 21 with respect to (u, v, d)."""
    (u, v, d), b = z, s.B
    return np.array([[0, 0, -b * s.f / d**2], [-b / d, 0, b * u / d**2], [0, -b / d, b * v / d**2]])


def project(p: Array, s: Sensor) -> Array:
    """Eq. 22: (x, y, z) in the camera frame to (u, v, d)."""
    x, y, z = p
    return np.array([-s.f * y / x, -s.f * z / x, s.f * s.B / x])


def project_jacobian(p: Array, s: Sensor) -> Array:
    """Derivative of eq. 22 with respect to (x, y, z)."""
    (x, y, z), f = p, s.f
    return np.array([[f * y / x**2, -f / x, 0], [f * z / x**2, 0, -f / x], [-f * s.B / x**2, 0, 0]])


def to_robot(pose: Array, m: Array) -> Array:
    """Eq. 19, with the heading of the same instant: a world point in the robot frame."""
    c, s, dx, dy = np.cos(pose[2]), np.sin(pose[2]), m[0] - pose[0], m[1] - pose[1]
    return np.array([c * dx + s * dy, -s * dx + c * dy, m[2]])


def to_robot_jacobian(pose: Array, m: Array) -> Array:
    """Derivative of eq. 19 with respect to (x, y, heading | mx, my, mz): 3 by 6."""
    c, s, (a, b, _) = np.cos(pose[2]), np.sin(pose[2]), to_robot(pose, m)
    return np.array([[-c, -s, b, c, s, 0], [s, -c, -a, -s, c, 0], [0, 0, 0, 0, 0, 1]])


def predict(x: Array, P: Array, dt: float, v: float, w: float, Q: Array) -> tuple[Array, Array]:
    """Eq. 18 (Euler, heading before the move), F P F' + G Q G'."""
    c, s = math.cos(x[2]), math.sin(x[2])
    F, G = np.eye(len(x)), np.zeros((len(x), 2))
    F[0, 2], F[1, 2] = -dt * v * s, dt * v * c
    G[0, 0], G[1, 0], G[2, 1] = dt * c, dt * s, dt
    moved = x.copy()
    moved[:3] += [dt * v * c, dt * v * s, dt * w]
    return moved, F @ P @ F.T + G @ Q @ G.T


def measurement(z: Array, sensor: Sensor, model: str) -> tuple[Array, Array]:
    """The measurement and its R as the filter takes them (eq. 21 for 'xyz' on a 'uvd' sensor)."""
    R = np.diag(sensor.variances)
    if model == sensor.model:
        return z, R
    J = triangulate_jacobian(z, sensor)
    return triangulate(z, sensor), J @ R @ J.T


def update(x: Array, P: Array, seen: Pairs, s: Sensor, model: str) -> tuple[Array, Array, float]:
    """One joint update with known landmarks; also returns the NIS."""
    m, n = 3 * len(seen), len(x)
    H, R, innovation = np.zeros((m, n)), np.zeros((m, m)), np.zeros(m)
    for i, (slot, raw) in enumerate(seen):
        rows, cols = slice(3 * i, 3 * i + 3), slice(3 + 3 * slot, 6 + 3 * slot)
        z, R[rows, rows] = measurement(raw, s, model)
        p, J = to_robot(x[:3], x[cols]), to_robot_jacobian(x[:3], x[cols])
        innovation[rows] = z - (project(p, s) if model == "uvd" else p)
        J = project_jacobian(p, s) @ J if model == "uvd" else J
        H[rows, :3], H[rows, cols] = J[:, :3], J[:, 3:]
    S = H @ P @ H.T + R
    K = np.linalg.solve(S, H @ P).T
    A = np.eye(n) - K @ H
    P = A @ P @ A.T + K @ R @ K.T  # eq. 8, equal to eq. 12 for this gain
    return x + K @ innovation, (P + P.T) / 2, float(innovation @ np.linalg.solve(S, innovation))


def initialise(x: Array, P: Array, new: list[Array], sensor: Sensor) -> tuple[Array, Array]:
    """Append landmarks at pose (+) eq. 21 with all cross-covariances; P' = Y blkdiag(P, R..) Y'."""
    n, k = len(x), 3 * len(new)
    c, s = math.cos(x[2]), math.sin(x[2])
    C, points = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), [x]
    Y, big = np.eye(n + k), np.zeros((n + k, n + k))
    big[:n, :n] = P
    for i, raw in enumerate(new):
        p, R = measurement(raw, sensor, "xyz")
        rows = slice(n + 3 * i, n + 3 * i + 3)
        Y[rows, :3] = [[1, 0, -s * p[0] - c * p[1]], [0, 1, c * p[0] - s * p[1]], [0, 0, 0]]
        Y[rows, rows] = C
        big[rows, rows] = R
        points.append(np.array([x[0], x[1], 0]) + C @ p)
    return np.concatenate(points), Y @ big @ Y.T


def run(folder: Path, run: int, model: str) -> pd.DataFrame:
    """Filter one run of a folder; raises LinAlgError once a full-rank pose covariance is lost."""
    cfg = tomllib.loads((folder / "sensor.toml").read_text())
    if np.any([cfg.get("mount", {}).get(k, [0, 0, 0]) for k in ("position", "rotation")]):
        raise NotImplementedError("a mounted camera")
    if model not in ("uvd", "xyz") or (model, cfg["model"]) == ("uvd", "xyz"):
        raise ValueError(f"filter model {model!r} on a {cfg['model']!r} sensor")
    if cfg["model"] == "uvd":
        sensor = Sensor("uvd", np.square(cfg["sigma_px"], dtype=float), cfg["f"], cfg["B"])
    else:
        sensor = Sensor("xyz", np.square(cfg["sigma_m"], dtype=float))
    Q = np.diag([cfg["motion"]["sigma_v"] ** 2, cfg["motion"]["sigma_omega"] ** 2])
    names = ("controls", "observations", "truth")
    tables = (pd.read_parquet(folder / f"{name}.parquet") for name in names)
    controls, observations, truth = (t[t["run"] == run].sort_values("step") for t in tables)
    truths = truth.set_index("step")[["x", "y", "heading"]]
    x, P = np.array([cfg["start"][k] for k in ("x", "y", "heading")], float), np.zeros((3, 3))
    slots: dict[int, int] = {}
    out, full = [], False
    for step, dt, v, w in controls[["step", "dt", "v", "omega"]].itertuples(index=False):
        x, P = predict(x, P, dt, v, w, Q)
        now = observations[observations["step"] == step]
        pairs = list(zip(now["landmark"], now[["z0", "z1", "z2"]].to_numpy(float), strict=True))
        seen, nis = [(slots[i], z) for i, z in pairs if i in slots], math.nan
        if seen:
            x, P, nis = update(x, P, seen, sensor, model)
        fresh = [(i, z) for i, z in pairs if i not in slots]
        slots |= {i: len(slots) + j for j, (i, _) in enumerate(fresh)}
        x, P = initialise(x, P, [z for _, z in fresh], sensor)
        if not (np.isfinite(x).all() and np.isfinite(P).all()):
            raise np.linalg.LinAlgError(f"state not finite in step {step}")
        C, nees = P[:3, :3], math.nan
        low, _, high = np.linalg.eigvalsh(C)
        full = full or bool(low > RANK_TOLERANCE * high)
        if full:
            np.linalg.cholesky(C)
            e = truths.loc[step].to_numpy(float) - x[:3]
            e[2] = math.remainder(e[2], 2 * math.pi)
            nees = float(e @ np.linalg.solve(C, e))
        out.append([step, *x[:3], *C[np.triu_indices(3)], nees, nis, 3 * len(seen)])
    return pd.DataFrame(out, columns=COLUMNS).astype({"step": int, "nis_dof": int})
