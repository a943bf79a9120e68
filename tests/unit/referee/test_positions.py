"""A truth of positions alone, of a point of the body in every convention; planar poses, of speeds and in space."""

import gzip
import os
from pathlib import Path

import numpy as np
import pytest
from command import refused
from numpy.testing import assert_allclose
from recorded import notes_of, read_recordings
from test_layouts import (
    DATA,
    EPOCH,
    POSE,
    STEPS,
    Drive,
    drive,
    lines,
    matrix,
    nanoseconds,
    nees_of,
    product,
    skew,
    tum,
    with_w_first,
)

import consistency as cs
from consistency.referee.readers.formats.pose_rows import motions_of, poses_of
from consistency.referee.readers.formats.positions import _jacobian
from consistency.referee.readers.formats.table import planar_sheet

ARM = np.array([0.3, -0.2, 0.5])
SMALL = 1e-6


def exponential(v):
    """Quaternion x, y, z, w of a rotation vector."""
    angle = np.sqrt(v @ v)
    return np.append(v * (np.sin(angle / 2) / angle if angle > 0 else 0.5), np.cos(angle / 2))


def group(xi):
    """Rotation and translation of the exponential of SE(3): Sola et al. (2018), eq. 172."""
    v, angle = xi[3:], np.sqrt(xi[3:] @ xi[3:])
    W = skew(v)
    if angle < 1e-12:
        return np.eye(3) + W, xi[:3]
    V = np.eye(3) + (1 - np.cos(angle)) / angle**2 * W + (angle - np.sin(angle)) / angle**3 * W @ W
    return matrix(exponential(v)), V @ xi[:3]


def moved(convention, pose, e):
    """Position of the point of the true pose, whose error is ``e`` in a convention."""
    R, p = matrix(pose[3:]), pose[:3]
    if convention == "so3":
        return p + e[:3] + matrix(exponential(e[3:])) @ R @ ARM
    if convention == "so3-body":
        return p + e[:3] + R @ matrix(exponential(e[3:])) @ ARM
    turn, shift = group(e)
    if convention == "left":
        return R @ (turn @ ARM + shift) + p
    return turn @ (R @ ARM + p) + shift


@pytest.mark.parametrize("convention", ["so3", "so3-body", "left", "right"])
def test_derivatives_are_those_of_differences(convention):
    d = drive()
    R = np.array([matrix(q) for q in d.own[:, 3:]])
    T = np.tile(np.eye(4), (len(R), 1, 1))
    T[:, :3, :3] = R
    T[:, :3, 3] = d.own[:, :3]
    J = _jacobian(convention, T, ARM)
    for pose, rows in zip(d.own, J, strict=True):
        for i, side in enumerate(SMALL * np.eye(6)):
            slope = (moved(convention, pose, side) - moved(convention, pose, -side)) / (2 * SMALL)
            assert_allclose(rows[:, i], slope, atol=1e-8)


def bare(d, point):
    return lines("prism.txt", "", [d.t, *point.T], " ")


@pytest.mark.parametrize(
    "write",
    [
        lambda d, point: lines("data.csv", "#timestamp [ns]," + ",".join(POSE[:3]), [nanoseconds(d.t), *point.T]),
        bare,
        lambda d, point: lines("fixes.csv", "t,x,y,z,fix", [d.t, *point.T, ["RTK"] * STEPS]),
    ],
    ids=["Leica", "bare", "GNSS"],
)
def test_the_point_of_a_prism(write, inside):
    d = drive()
    R, true = (np.array([matrix(q) for q in pose[:, 3:]]) for pose in (d.own, d.true))
    truth = write(d, d.true[:, :3] + true @ ARM)
    record = cs.read(tum(d), truth=truth, lever_arm=ARM.tolist())
    e = d.true[:, :3] + true @ ARM - d.own[:, :3] - R @ ARM
    J = np.concatenate([np.tile(np.eye(3), (STEPS, 1, 1)), [-skew(each @ ARM) for each in R]], axis=2)
    assert_allclose(record.errors.nees[0], nees_of(e, J @ d.P @ np.swapaxes(J, 1, 2)), rtol=1e-9)
    assert record.errors.axes == ("x", "y", "z")
    said = "the truth has no orientation, so that the position alone is judged, of the point (0.3, -0.2, 0.5) m"
    assert said in notes_of(record)


def test_the_origin_needs_no_rotation(inside):
    """Deviations alone do for it, and so do two blocks; a lever arm would need their cross terms."""
    d = drive()
    truth = bare(d, d.true[:, :3])
    sigma = np.sqrt(np.diagonal(d.P, axis1=1, axis2=2))
    own = lines("est.txt", "", [d.t, *d.own.T, *sigma.T], " ")
    record = cs.read(own, truth=truth)
    assert record.errors.parts == ((0,), (1,), (2,))
    assert_allclose(record.errors.nees[0], ((d.true - d.own)[:, :3] ** 2 / sigma[:, :3] ** 2).sum(axis=1), rtol=1e-9)
    with pytest.raises(cs.InputError, match=r"est\.txt, line 1: lever_arm= moves errors of the rotation.*not stated"):
        cs.read(own, truth=truth, lever_arm=[0.0, 0.0, 0.1])
    upper = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    split = [d.P[:, 3 + i, 3 + j] for i, j in upper] + [d.P[:, i, j] for i, j in upper]
    blocks = lines("blocks.txt", "", [d.t, *d.own.T, *split], " ")
    expected = nees_of((d.true - d.own)[:, :3], d.P[:, :3, :3])
    assert_allclose(cs.read(blocks, truth=truth).errors.nees[0], expected, rtol=1e-9)
    with pytest.raises(cs.InputError, match="error=right moves errors"):
        cs.read(blocks, truth=truth, error="right")


def test_a_broken_estimate_fails_there(inside):
    d = drive()
    truth = bare(d, d.true[:, :3])
    d.own[5] = np.nan
    record = cs.read(tum(d), truth=truth, lever_arm=ARM.tolist())
    assert [failure.step for failure in record.failures] == [6]


def test_a_frame_is_fitted_to_positions(inside):
    """Estimates in a world that is turned about z and shifted: the same errors, to what the fit takes of them."""
    d = drive()
    P = 1e-10 * d.P  # as good as no errors, so that the frame is the one put in
    own = np.column_stack([d.true[:, :3] - 1e-5 * (d.true - d.own)[:, :3], d.true[:, 3:]])
    turn, shift = exponential(np.array([0.0, 0.0, 0.8])), np.array([3.0, -4.0, 5.0])
    away = np.array([[*(matrix(turn) @ pose[:3] + shift), *product(turn, pose[3:])] for pose in own])
    C = np.kron(np.eye(2), matrix(turn))
    truth = bare(d, d.true[:, :3])
    record = cs.read(tum(Drive(d.t, away, d.true, C @ P @ C.T)), truth=truth, align="posyaw-all")
    straight = cs.read(tum(Drive(d.t, own, d.true, P)), truth=truth)
    assert record.fit.align == "posyaw-all"
    assert record.errors.nees.sum() < straight.errors.nees.sum() * (1 + 1e-6)
    assert_allclose(record.errors.error[0], straight.errors.error[0], atol=5e-5)


@pytest.mark.parametrize(
    "options, said",
    [
        ({"align": "se3-all"}, r"align=se3-all: needs a truth with orientations; prism\.txt"),
        ({"align": "origin"}, r"align=origin: needs a truth with orientations; prism\.txt holds positions alone"),
        ({"relative": 2, "motions": True}, r"relative: needs a truth with orientations; prism\.txt"),
        ({"axes": ["x", "yaw"]}, "axes=x,yaw: 'yaw' has no truth"),
        ({"lever_arm": [1.0, 2.0]}, "lever_arm: must be three numbers x,y,z, in m"),
        ({"lever_arm": [1.0, 2.0, float("nan")]}, "lever_arm: must be three numbers x,y,z, in m"),
    ],
)
def test_what_needs_an_orientation_is_refused(options, said, inside):
    d = drive()
    bare(d, d.true[:, :3])
    with pytest.raises(cs.InputError, match=said):
        cs.read(tum(d), truth="prism.txt", **options)  # type: ignore[arg-type]


def test_positions_are_no_estimates_and_poses_need_no_arm(inside, capsys):
    d = drive()
    lines("truth.txt", "", [d.t, *d.true.T], " ")
    with pytest.raises(cs.InputError, match=r"prism\.txt, line 1: has 4 columns"):
        cs.read(bare(d, d.true[:, :3]), truth="truth.txt")
    with pytest.raises(cs.InputError, match=r"fixes\.txt: holds no quaternion; a table of a state is read with state="):
        cs.read(lines("fixes.txt", "# t x y z", [d.t, *d.true[:, :3].T], " "), truth="truth.txt")
    with pytest.raises(cs.InputError, match="lever_arm: goes with a truth of positions alone"):
        cs.read(tum(d), truth="truth.txt", lever_arm=[0.0, 0.0, 1.0])
    numbers = "must be three numbers x,y,z, in m"
    for text, said in (("1,2", numbers), ("a,0,0", numbers), ("0,0,1", "goes with a truth of positions alone")):
        err = refused(capsys, "analyse", "est.tum", "--truth", "truth.txt", "--lever-arm", text)
        assert f"--lever-arm: {said}" in err


# --- planar poses ---------------------------------------------------------------------------------------------


P = ["P_xx", "P_xy", "P_xh", "P_yy", "P_yh", "P_hh"]
UPPER = np.triu_indices(3)


def walked(t, v, omega, parts=4000):
    """Poses by many small straight steps, (N, 3): the path that the speeds say, to the square of a step."""
    pose, out = np.zeros(3), [np.zeros(3)]
    for k in range(len(t) - 1):
        dt = (t[k + 1] - t[k]) / parts
        for _ in range(parts):
            middle = pose[2] + omega[k] * dt / 2
            pose = pose + dt * np.array([v[k] * np.cos(middle), v[k] * np.sin(middle), omega[k]])
        out.append(pose.copy())
    return np.array(out)


def test_arcs_are_the_limit_of_small_steps():
    t = np.array([0.0, 0.3, 0.5, 1.1, 1.2])
    v, omega = np.array([1.0, -0.5, 2.0, 1.0, 9.0]), np.array([0.7, 3.0, 0.0, -2.0, 9.0])
    assert_allclose(poses_of(motions_of(t, v, omega)), walked(t, v, omega), atol=1e-7)


def speeds(path, name="t,v,omega"):
    rng = np.random.default_rng()
    t, v, omega = 0.25 * np.arange(STEPS), 1.0 + rng.random(STEPS), rng.normal(size=STEPS)
    lines(path, name, [t, v, omega])
    return t, v, omega


def test_speeds_are_motions_with_their_covariances(inside):
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
    assert record.origin.notes[0].startswith(
        "odo.csv: read as speed and turn rate, each held until the next, integrated to motions"
    )
    dt, a, b = 0.25, omega[:-1] * 0.25, (omega[:-1] + 0.03) * 0.25
    e = []
    for k in range(STEPS - 1):
        D, M = (arc(speed * v[k] * dt, turn[k]) for speed, turn in ((1.0, a), (1.02, b)))
        e.append(log(np.linalg.solve(D, M)))
    assert_allclose(record.errors.nees.ravel(), nees_of(e, [C] * len(e)), rtol=1e-5)


def arc(way, turn):
    """Pose matrix at the end of an arc."""
    x, y = way * np.sin(turn) / turn, way * (1.0 - np.cos(turn)) / turn
    return np.array([[np.cos(turn), -np.sin(turn), x], [np.sin(turn), np.cos(turn), y], [0.0, 0.0, 1.0]])


def log(M):
    """Logarithm in SE(2): Sola, Deray & Atchuthan (2018), eq. 157."""
    turn = np.arctan2(M[1, 0], M[0, 0])
    a, b = np.sin(turn) / turn, (1.0 - np.cos(turn)) / turn
    return np.append(np.linalg.solve(np.array([[a, -b], [b, a]]), M[:2, 2]), turn)


def test_packed_speeds_and_other_names(inside):
    t, v, omega = speeds("odo.dat", "# Time [s]    forward velocity [m/s]    angular velocity[rad/s]")
    Path("odo.dat").write_text(Path("odo.dat").read_text().replace(",", "\t "))
    Path("odo.dat.gz").write_bytes(gzip.compress(Path("odo.dat").read_bytes()))
    for name in ("odo.dat", "odo.dat.gz"):
        sheet, note = planar_sheet(Path(name), motions=False)
        assert "integrated to poses, 3 columns, seconds" in note
        assert_allclose(
            np.column_stack([sheet.data[a] for a in ("x", "y", "heading")]), poses_of(motions_of(t, v, omega))
        )
    names = "%time,field.header.stamp,field.twist.twist.linear.x,field.twist.twist.angular.z"
    lines("twist.csv", names, [nanoseconds(EPOCH + t), nanoseconds(EPOCH + t), v, omega])
    sheet, note = planar_sheet(Path("twist.csv"), motions=True)
    assert note.endswith("integrated to motions, 4 columns, nanoseconds")
    assert_allclose(sheet.data["t"], EPOCH + t, atol=1e-6)
    assert_allclose(sheet.data["heading"], motions_of(t, v, omega)[:, 2], atol=1e-12)


def test_planar_estimates_against_a_truth_in_space(inside):
    """The heading is that of the x axis, whatever roll and pitch are."""
    t, heading = EPOCH + 0.25 * np.arange(STEPS), np.linspace(-3.0, 3.0, STEPS)
    half, zero = heading / 2, np.zeros(STEPS)
    true = np.column_stack([np.cos(heading), np.sin(heading), zero + 5.0, zero, zero, np.sin(half), np.cos(half)])
    lines("data.csv", "#timestamp [ns],px,py,pz,qw,qx,qy,qz", [nanoseconds(t), *with_w_first(true)])
    own = [t, true[:, 0] - 0.1, true[:, 1], heading + 0.2]
    lines("est.csv", ",".join(["t,x,y,theta", *P]), [*own, zero + 0.04, zero, zero, zero + 0.04, zero, zero + 0.16])
    (record,) = read_recordings(Path("est.csv"), Path("data.csv"))
    assert_allclose(record.errors.nees, 0.1**2 / 0.04 + 0.2**2 / 0.16, rtol=1e-9)
    assert record.origin.notes[0] == "est.csv: read as planar poses, 10 columns, seconds"
    assert record.origin.notes[1].endswith("quaternion w first, of which the heading is that of the x axis")


def test_the_robots_of_mrclam_as_they_are():
    """Odometry and truth of a robot: a second of driving is a few percent off (README of the data)."""
    folder = DATA / "mrclam" / "MRCLAM_Dataset6"
    if not folder.is_dir():
        pytest.skip(f"no {folder}; set CONSISTENCY_DATA to the folder that holds mrclam")
    odometry, said = planar_sheet(folder / "Robot1_Odometry.dat.gz", motions=True)
    truth, _ = planar_sheet(folder / "Robot1_Groundtruth.dat.gz")
    rows = np.loadtxt(folder / "Robot1_Odometry.dat.gz")
    assert "speed and turn rate" in said
    assert len(odometry) == len(rows)
    assert_allclose(odometry.data["heading"][1:], rows[:-1, 2] * np.diff(rows[:, 0]), atol=1e-9)
    t = odometry.data["t"]
    heading = np.unwrap(np.interp(t, truth.data["t"], np.unwrap(truth.data["heading"])))
    inside = (t > truth.data["t"][0]) & (t < truth.data["t"][-1])
    turn = np.cumsum(odometry.data["heading"])
    every = np.flatnonzero(inside)[::68]  # about a second
    error = np.diff(heading[every]) - np.diff(turn[every])
    assert 0.002 < np.std(error) < 0.05


def test_speeds_without_a_covariance_are_refused(inside):
    t, *_ = speeds("odo.csv")
    lines("truth.csv", "t,x,y,heading", [t, t, t, 0 * t])
    with pytest.raises(cs.InputError, match=r"odo\.csv: column 'P_xx' is missing"):
        cs.read("odo.csv", truth="truth.csv", motions=True, relative=1)
    os.truncate("odo.csv", 0)
    Path("odo.csv.gz").write_bytes(gzip.compress(b"t,v,omega\n" + b"0,0,0\n" * 10**6)[:-40])
    with pytest.raises(cs.InputError, match=r"odo\.csv\.gz"):
        cs.read("odo.csv.gz", truth="truth.csv", motions=True, relative=1)
