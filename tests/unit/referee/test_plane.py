"""Planar poses of speeds and turn rates, under other names, and of poses in space."""

from __future__ import annotations

import gzip
import os
from pathlib import Path

import numpy as np
import pytest
from recorded import read_recordings
from test_layouts import DATA, EPOCH, STEPS, lines, nanoseconds, with_w_first

import consistency as cs
from consistency.referee.readers.formats.planar_columns import motions_of, poses_of
from consistency.referee.readers.formats.table import planar_sheet
from consistency.referee.types import Array

P = ["P_xx", "P_xy", "P_xh", "P_yy", "P_yh", "P_hh"]
UPPER = np.triu_indices(3)


def walked(t: Array, v: Array, omega: Array, parts: int = 4000) -> Array:
    """Poses by many small straight steps, (N, 3): the path that the speeds say, to the square of a step."""
    pose, out = np.zeros(3), [np.zeros(3)]
    for k in range(len(t) - 1):
        dt = (t[k + 1] - t[k]) / parts
        for _ in range(parts):
            middle = pose[2] + omega[k] * dt / 2
            pose = pose + dt * np.array([v[k] * np.cos(middle), v[k] * np.sin(middle), omega[k]])
        out.append(pose.copy())
    return np.array(out)


def test_arcs_are_the_limit_of_small_steps() -> None:
    t = np.array([0.0, 0.3, 0.5, 1.1, 1.2])
    v, omega = np.array([1.0, -0.5, 2.0, 1.0, 9.0]), np.array([0.7, 3.0, 0.0, -2.0, 9.0])
    np.testing.assert_allclose(poses_of(motions_of(t, v, omega)), walked(t, v, omega), atol=1e-7)


def speeds(path: str, name: str = "t,v,omega") -> tuple[Array, Array, Array]:
    rng = np.random.default_rng()
    t, v, omega = 0.25 * np.arange(STEPS), 1.0 + rng.random(STEPS), rng.normal(size=STEPS)
    lines(path, name, [t, v, omega])
    return t, v, omega


def test_speeds_are_motions_with_their_covariances(inside: Path) -> None:
    """Windows of one motion: the NEES is that of the motions, worked out from the speeds."""
    t, v, omega = speeds("odo.csv")
    root = 0.1 * np.random.default_rng().normal(size=(3, 3))
    C = root @ root.T + 0.001 * np.eye(3)
    lines(
        "odo.csv",
        ",".join(["t,v,omega", *P]),
        [t, v, omega, *(np.full(STEPS, C[i, j]) for i, j in zip(*UPPER, strict=True))],
    )
    true = walked(t, v * 1.02, omega + 0.03)
    lines("truth.csv", "t,x,y,heading", [t, *true.T])
    record = cs.read("odo.csv", truth="truth.csv", motions=True, relative=1, error="left")
    assert record.notes[0].startswith(
        "odo.csv: read as speed and turn rate, each held until the next, integrated to motions"
    )
    dt, a, b = 0.25, omega[:-1] * 0.25, (omega[:-1] + 0.03) * 0.25
    nees = []
    for k in range(STEPS - 1):
        D, M = (arc(speed * v[k] * dt, turn[k]) for speed, turn in ((1.0, a), (1.02, b)))
        e = log(np.linalg.solve(D, M))
        nees.append(e @ np.linalg.solve(C, e))
    np.testing.assert_allclose(record.nees.ravel(), nees, rtol=1e-5)


def arc(way: float, turn: float) -> Array:
    """Pose matrix at the end of an arc."""
    x, y = way * np.sin(turn) / turn, way * (1.0 - np.cos(turn)) / turn
    return np.array([[np.cos(turn), -np.sin(turn), x], [np.sin(turn), np.cos(turn), y], [0.0, 0.0, 1.0]])


def log(M: Array) -> Array:
    """Logarithm in SE(2): Sola, Deray & Atchuthan (2018), eq. 157."""
    turn = np.arctan2(M[1, 0], M[0, 0])
    a, b = np.sin(turn) / turn, (1.0 - np.cos(turn)) / turn
    return np.append(np.linalg.solve(np.array([[a, -b], [b, a]]), M[:2, 2]), turn)


def test_packed_speeds_and_other_names(inside: Path) -> None:
    t, v, omega = speeds("odo.dat", "# Time [s]    forward velocity [m/s]    angular velocity[rad/s]")
    Path("odo.dat").write_text(Path("odo.dat").read_text().replace(",", "\t "))
    Path("odo.dat.gz").write_bytes(gzip.compress(Path("odo.dat").read_bytes()))
    for name in ("odo.dat", "odo.dat.gz"):
        sheet, note = planar_sheet(Path(name), motions=False)
        assert "integrated to poses, 3 columns, seconds" in note
        np.testing.assert_allclose(
            np.column_stack([sheet.data[a] for a in ("x", "y", "heading")]), poses_of(motions_of(t, v, omega))
        )
    names = "%time,field.header.stamp,field.twist.twist.linear.x,field.twist.twist.angular.z"
    lines("twist.csv", names, [nanoseconds(EPOCH + t), nanoseconds(EPOCH + t), v, omega])
    sheet, note = planar_sheet(Path("twist.csv"), motions=True)
    assert note.endswith("integrated to motions, 4 columns, nanoseconds")
    np.testing.assert_allclose(sheet.data["t"], EPOCH + t, atol=1e-6)
    np.testing.assert_allclose(sheet.data["heading"], motions_of(t, v, omega)[:, 2], atol=1e-12)


def test_planar_estimates_against_a_truth_in_space(inside: Path) -> None:
    """The heading is that of the x axis, whatever roll and pitch are."""
    t, heading = EPOCH + 0.25 * np.arange(STEPS), np.linspace(-3.0, 3.0, STEPS)
    half, zero = heading / 2, np.zeros(STEPS)
    true = np.column_stack([np.cos(heading), np.sin(heading), zero + 5.0, zero, zero, np.sin(half), np.cos(half)])
    lines("data.csv", "#timestamp [ns],px,py,pz,qw,qx,qy,qz", [nanoseconds(t), *with_w_first(true)])
    own = [t, true[:, 0] - 0.1, true[:, 1], heading + 0.2]
    lines("est.csv", ",".join(["t,x,y,theta", *P]), [*own, zero + 0.04, zero, zero, zero + 0.04, zero, zero + 0.16])
    (record,) = read_recordings(Path("est.csv"), Path("data.csv"))
    np.testing.assert_allclose(record.nees, 0.1**2 / 0.04 + 0.2**2 / 0.16, rtol=1e-9)
    assert record.notes[0] == "est.csv: read as planar poses, 10 columns, seconds"
    assert record.notes[1].endswith("quaternion w first, of which the heading is that of the x axis")


def test_the_robots_of_mrclam_as_they_are() -> None:
    """Odometry and truth of a robot: a second of driving is a few percent off (README of the data)."""
    folder = DATA / "mrclam" / "MRCLAM_Dataset6"
    if not folder.is_dir():
        pytest.skip(f"no {folder}; set CONSISTENCY_DATA to the folder that holds mrclam")
    odometry, said = planar_sheet(folder / "Robot1_Odometry.dat.gz", motions=True)
    truth, _ = planar_sheet(folder / "Robot1_Groundtruth.dat.gz")
    rows = np.loadtxt(folder / "Robot1_Odometry.dat.gz")
    assert "speed and turn rate" in said
    assert len(odometry) == len(rows)
    np.testing.assert_allclose(odometry.data["heading"][1:], rows[:-1, 2] * np.diff(rows[:, 0]), atol=1e-9)
    t = odometry.data["t"]
    heading = np.unwrap(np.interp(t, truth.data["t"], np.unwrap(truth.data["heading"])))
    inside = (t > truth.data["t"][0]) & (t < truth.data["t"][-1])
    turn = np.cumsum(odometry.data["heading"])
    every = np.flatnonzero(inside)[::68]  # about a second
    error = np.diff(heading[every]) - np.diff(turn[every])
    assert 0.002 < np.std(error) < 0.05


def test_speeds_without_a_covariance_are_refused(inside: Path) -> None:
    t, *_ = speeds("odo.csv")
    lines("truth.csv", "t,x,y,heading", [t, t, t, 0 * t])
    with pytest.raises(cs.InputError, match=r"odo\.csv: column 'P_xx' is missing"):
        cs.read("odo.csv", truth="truth.csv", motions=True, relative=1)
    os.truncate("odo.csv", 0)
    Path("odo.csv.gz").write_bytes(gzip.compress(b"t,v,omega\n" + b"0,0,0\n" * 10**6)[:-40])
    with pytest.raises(cs.InputError, match=r"odo\.csv\.gz"):
        cs.read("odo.csv.gz", truth="truth.csv", motions=True, relative=1)
