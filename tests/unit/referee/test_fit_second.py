"""fit-covariance --second on a real drive: the wheels of five robots beside their sightings of landmarks."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from command import consistency
from numpy.testing import assert_allclose

from consistency.bench.runs.reproduce_findings import sibling

ROOT = Path(__file__).parents[3]
DATA = Path(os.environ.get("CONSISTENCY_DATA", ROOT.parent / "shared" / "data"))
POSE = "t,x,y,heading"
LAG = 0.2  # s, of the robots behind their odometry
PUSH, SWING = 0.3, 1.0  # m/s and rad/s, by which speed and turn rate wander in a second
SIGMA = (0.17, 0.02)  # m, rad: of range and bearing
GATE = 25.0  # NIS of a wrong barcode


def by_sight(t, place, z, start):
    """Rows t, x, y, heading of an EKF that knows the places (M, 2) of what it sees, and nothing of the wheels."""
    x, P, out = np.concatenate([start, [0.0, 0.0]]), np.diag([0.01, 0.01, 0.01, 0.1, 0.1]), {}
    for now, dt, landmark, seen in zip(t, np.diff(t, prepend=t[0]), place, z, strict=True):
        F, along = np.eye(5), x[2] + 0.5 * x[4] * dt
        c, s = np.cos(along), np.sin(along)
        F[:2, 2], F[:2, 3], F[2, 4] = x[3] * dt * np.array([-s, c]), [dt * c, dt * s], dt
        x = x + dt * np.array([x[3] * c, x[3] * s, x[4], 0.0, 0.0])
        P = F @ P @ F.T + np.diag([1e-6, 1e-6, 1e-6, PUSH**2 * dt, SWING**2 * dt])
        d = landmark - x[:2]
        r = np.hypot(*d)
        e = seen - [r, np.arctan2(d[1], d[0]) - x[2]]
        e[1] = np.arctan2(np.sin(e[1]), np.cos(e[1]))
        H = np.zeros((2, 5))
        H[0, :2], H[1, :3] = -d / r, [d[1] / r**2, -d[0] / r**2, -1.0]
        S = H @ P @ H.T + np.diag(np.square(SIGMA))
        if e @ np.linalg.solve(S, e) < GATE:
            K = P @ H.T @ np.linalg.inv(S)
            x, P = x + K @ e, P - K @ H @ P
            out[now] = x[:3]
    return np.column_stack([list(out), list(out.values())])


def test_wheels_and_sightings_of_five_robots_share_no_error(tmp_path, capsys):
    """Both share the truth alone: in yaw it is not behind the errors of the wheels, in x and y nothing tells."""
    folder = DATA / "mrclam" / "MRCLAM_Dataset6"
    if not folder.is_dir():
        pytest.skip(f"no {folder}; set CONSISTENCY_DATA to the folder that holds mrclam")
    read = sibling(str(ROOT / "experiments" / "e15_mrclam.py"), "mrclam_log")
    for kind in ("wheels", "truth", "sights"):
        (tmp_path / kind).mkdir()
    for robot in range(1, 6):
        data = read.read_robot(folder, robot)
        t, landmark, z = read.sights_of(data)
        rows = by_sight(t, data.landmarks[landmark], z, data.pose(t[:1])[0])
        rows[:, 0] -= LAG  # as the stamps of the wheels are
        for kind, head, numbers in (
            ("wheels", "t,v,omega", data.odometry), ("truth", POSE, data.truth), ("sights", POSE, rows),
        ):  # fmt: skip
            once = np.append(True, np.diff(numbers[:, 0]) > 0)
            path = tmp_path / kind / f"robot{robot}.csv"
            np.savetxt(path, numbers[once], delimiter=",", header=head, comments="", fmt="%.14g")
    wheels, truth, sights = (str(tmp_path / kind) for kind in ("wheels", "truth", "sights"))
    words = ("fit-covariance", wheels, "--truth", truth, "--span", "1m", "--time-offset", str(LAG), "--json")
    out, err = consistency(capsys, *words, "--second", sights)
    assert err == ""
    said = json.loads(out)
    assert said["status"] == "inconsistent"
    assert_allclose(said["second_correlation"], [-0.03, -0.47, 0.28], atol=0.05)
    assert_allclose(said["second_size"], [3.1, 5.2, 0.83], rtol=0.1)
