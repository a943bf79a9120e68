"""Poses as the systems write them: by the names of columns, by their number, as matrices; NEES worked out afresh."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_allclose
from recorded import notes_of, read_recordings

import consistency as cs
from consistency.referee.readers.clocks import unit_apart
from consistency.referee.readers.formats.columns import require_units
from consistency.referee.readers.formats.file_kinds import fields_of
from consistency.referee.readers.formats.sheet import TableRows
from consistency.referee.types import Array

DATA = Path(os.environ.get("CONSISTENCY_DATA", Path(__file__).parents[4] / "shared" / "data"))
STEPS = 12
EPOCH = 1403715273.25  # s since 1970
UPPER = np.triu_indices(6)
SPACE = ["x", "y", "z"]
W_FIRST, W_LAST = ["w", "x", "y", "z"], ["x", "y", "z", "w"]


# --- the reference: nothing here is of the package or of SciPy --------------------------------------


def matrix(q):
    """Rotation matrix of a unit quaternion x, y, z, w (Shuster 1993)."""
    v, w = q[:3], q[3]
    return (w * w - v @ v) * np.eye(3) + 2.0 * np.outer(v, v) + 2.0 * w * skew(v)


def skew(v):
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def product(p, q):
    """Hamilton product, x, y, z, w."""
    return np.append(p[3] * q[:3] + q[3] * p[:3] + np.cross(p[:3], q[:3]), p[3] * q[3] - p[:3] @ q[:3])


def rotation_vector(q):
    q = q if q[3] >= 0 else -q
    sine = np.sqrt(q[:3] @ q[:3])
    return q[:3] * (2.0 * np.arctan2(sine, q[3]) / sine if sine > 0 else 2.0)


def nees_of(e, P):
    """e' P^-1 e of errors (N, n) with P (N, n, n)."""
    return np.array([each @ np.linalg.solve(C, each) for each, C in zip(e, P, strict=True)])


def errors(own, true):
    """Errors (N, 6) of poses (N, 7): position and rotation about the axes of the world."""
    turns = [rotation_vector(product(b, a * [-1, -1, -1, 1])) for a, b in zip(own[:, 3:], true[:, 3:], strict=True)]
    return np.column_stack([true[:, :3] - own[:, :3], turns])


def reference(own, true, P):
    """NEES (N,) of poses (N, 7) with P (N, 6, 6)."""
    return nees_of(errors(own, true), P)


class Drive(NamedTuple):
    t: Array  # (N,), s
    own: Array  # (N, 7), position and quaternion x, y, z, w
    true: Array  # (N, 7)
    P: Array  # (N, 6, 6)


def drive(start=EPOCH):
    """Poses with errors of their covariance, which has cross terms and differs from row to row."""
    rng = np.random.default_rng()
    turns = rng.normal(size=(STEPS, 4)) + np.array([0, 0, 0, 3])
    true = np.column_stack([rng.normal(size=(STEPS, 3)), turns / np.linalg.norm(turns, axis=1)[:, None]])
    roots = 0.1 * rng.normal(size=(STEPS, 6, 6))
    P = roots @ np.swapaxes(roots, 1, 2) + 0.001 * np.eye(6)
    e = np.einsum("nij,nj->ni", np.linalg.cholesky(P), rng.normal(size=(STEPS, 6)))
    angle = np.linalg.norm(e[:, 3:], axis=1)
    small = np.column_stack([-e[:, 3:] * (np.sin(angle / 2) / angle)[:, None], np.cos(angle / 2)])
    own = np.array([product(a, b[3:]) for a, b in zip(small, true, strict=True)])
    return Drive(start + 0.25 * np.arange(STEPS), np.column_stack([true[:, :3] - e[:, :3], own]), true, P)


def lines(path, header, columns, separator=",", end="\n"):
    """A file of columns, whole numbers as such, written as text so that no digit is lost."""
    cells = [[each if isinstance(each, str) else _text(each) for each in column] for column in columns]
    rows = [separator.join(row) for row in zip(*cells, strict=True)]
    Path(path).write_text("\n".join([header, *rows] if header else rows) + end, encoding="utf-8")
    return path


def _text(value):
    return str(int(value)) if isinstance(value, (int, np.integer)) else repr(float(value))


def nanoseconds(t):
    return np.array([round(each * 4) * 250_000_000 for each in t], np.int64)


def whole(t):
    """Seconds and nanoseconds."""
    ns = nanoseconds(t)
    return [ns // 10**9, ns % 10**9]


def with_w_first(pose):
    return list(pose[:, [0, 1, 2, 6, 3, 4, 5]].T)


def matrices(pose, rows=3):
    """Matrices of 3 or 4 x 4 row by row, as columns."""
    M = np.zeros((len(pose), 4, 4))
    M[:, 3, 3] = 1.0
    M[:, :3, :3] = [matrix(q) for q in pose[:, 3:]]
    M[:, :3, 3] = pose[:, :3]
    return list(M[:, :rows].reshape(len(pose), -1).T)


def tum(d, path="est.tum", end="\n"):
    return lines(path, "", [d.t, *d.own.T, *d.P.reshape(STEPS, 36).T], " ", end)


# --- truth -------------------------------------------------------------------------------------------

POSE = [f"p_RS_R_{a} [m]" for a in SPACE] + [f"q_RS_{a} []" for a in W_FIRST]
ASL = "#timestamp," + ",".join(
    [*(f" {name}" for name in POSE), *(f" v_RS_R_{a} [m s^-1]" for a in SPACE),
     *(f" b_w_RS_S_{a} [rad s^-1]" for a in SPACE), *(f" b_a_RS_S_{a} [m s^-2]" for a in SPACE)]
)  # fmt: skip
REST = [np.full(STEPS, value) for value in (0.1, 0.2, 0.3, -0.002, 0.02, 0.07, -0.02, 0.1, 0.06)]


def kitti(d):
    lines("times.txt", "", [d.t])
    return lines("07.txt", "", matrices(d.true), " ")


EUROC = "read as EuRoC truth, 17 columns, nanoseconds, quaternion w first"
SHORT = "#time(ns),px,py,pz,qw,qx,qy,qz,vx,vy,vz,bwx,bwy,bwz,bax,bay,baz"  # as OpenVINS heads the columns of EuRoC
TRUTHS = {
    "EuRoC": (lambda d: lines("data.csv", ASL, [nanoseconds(d.t), *with_w_first(d.true), *REST]), EUROC),
    "EuRoC, short": (lambda d: lines("truth.csv", SHORT, [nanoseconds(d.t), *with_w_first(d.true), *REST]), EUROC),
    "EuRoC, no names": (lambda d: lines("truth.csv", "", [nanoseconds(d.t), *with_w_first(d.true), *REST]), EUROC),
    "TUM-VI": (
        lambda d: lines("data.csv", f"#timestamp [ns],{','.join(POSE)}", [nanoseconds(d.t), *with_w_first(d.true)]),
        "read as EuRoC truth, 8 columns, nanoseconds, quaternion w first",
    ),
    "Newer College": (
        lambda d: lines("registered_poses.csv", "#sec,nsec,x,y,z,qx,qy,qz,qw", [*whole(d.t), *d.true.T]),
        "names of their columns, 9 columns, seconds and nanoseconds, quaternion w last",
    ),
    "MCD": (
        lambda d: lines("pose_inW.csv", "num,t,x,y,z,qx,qy,qz,qw", [np.arange(STEPS), d.t, *d.true.T]),
        "by the names of their columns, 9 columns, seconds, quaternion w last",
    ),
    "MCD, spaces": (
        lambda d: lines("pose.csv", "num t x  y  z  qx  qy  qz  qw", [np.arange(STEPS), d.t, *d.true.T], " "),
        "by the names of their columns, 9 columns, seconds, quaternion w last",
    ),
    "Hilti": (lambda d: lines("exp14.txt", "# timestamp_s tx ty tz qx qy qz qw", [d.t, *d.true.T], " "), ""),
    "trajectory_to_df of evo": (
        lambda d: lines("truth.csv", ",x,y,z,qw,qx,qy,qz", [d.t, *with_w_first(d.true)]),
        "by the names of their columns, 8 columns, seconds, quaternion w first",
    ),
    "KITTI": (kitti, "read as matrices of 3 x 4, 12 columns, times from times.txt beside them"),
    "t + 12": (
        lambda d: lines("07_gt.txt", "", [d.t, *matrices(d.true)], " "),
        "read as matrices of 3 x 4, 13 columns, the first one the time in seconds",
    ),
    "t + 16": (
        lambda d: lines("poses.txt", "", [d.t, *matrices(d.true, 4)], " "),
        "read as matrices of 4 x 4, 17 columns, the first one the time in seconds",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", TRUTHS)
def test_truth_as_it_is_written(name, inside):
    d = drive()
    write, said = TRUTHS[name]
    truth = write(d)
    record = cs.read(tum(d), truth=truth)
    assert_allclose(record.errors.nees[0], reference(d.own, d.true, d.P), rtol=1e-9, atol=1e-9)
    assert said in notes_of(record)


def test_the_first_rows_of_euroc_judge_themselves(tmp_path):
    """Its own rows, moved by a known error, against the file as it is."""
    path = DATA / "euroc_static" / "groundtruth_first97.csv"
    if not path.is_file():
        pytest.skip(f"no {path}; set CONSISTENCY_DATA to the folder that holds euroc_static")
    rows = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()[1:]]
    t = np.array([int(row[0]) for row in rows]) * 1e-9
    pose = np.array([[float(cell) for cell in row[1:8]] for row in rows])[:, [0, 1, 2, 4, 5, 6, 3]]
    pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1)[:, None]
    own = pose.copy()
    own[:, 0] -= 0.02
    P = np.tile((0.01**2 * np.eye(6)).ravel(), (len(t), 1))
    np.savetxt(tmp_path / "est.txt", np.column_stack([t, own, P]), fmt="%.17g")
    record = cs.read(tmp_path / "est.txt", truth=path)
    assert record.errors.nees.shape == (1, 96)
    assert_allclose(record.errors.nees, 4.0, atol=2e-4)  # six digits of the quaternions: 1e-6 rad, 1e-4 of a sigma


# --- estimates ---------------------------------------------------------------------------------------


def rostopic(d):
    """rostopic echo -p of nav_msgs/Odometry: stamps in ns, frames as text, and a twist with its covariance."""
    pose = [f"field.pose.pose.position.{a}" for a in SPACE] + [f"field.pose.pose.orientation.{a}" for a in W_LAST]
    names = [
        "%time", "field.header.seq", "field.header.stamp", "field.header.frame_id", "field.child_frame_id", *pose,
        *(f"field.pose.covariance{i}" for i in range(36)),
        *(f"field.twist.twist.{kind}.{a}" for kind in ("linear", "angular") for a in SPACE),
        *(f"field.twist.covariance{i}" for i in range(36)),
    ]  # fmt: skip
    ns, zero = nanoseconds(d.t), np.zeros(STEPS)
    columns = [
        ns + 7,
        np.arange(STEPS),
        ns,
        ["odom"] * STEPS,
        ["base_link"] * STEPS,
        *d.own.T,
        *d.P.reshape(STEPS, 36).T,
    ]
    return lines("odom.csv", ",".join(names), [*columns, *[zero] * 6, *[zero + 9.0] * 36])


def bagpy(d):
    pose = [f"pose.pose.position.{a}" for a in SPACE] + [f"pose.pose.orientation.{a}" for a in W_LAST]
    names = ["Time", "header.seq", "header.stamp.secs", "header.stamp.nsecs", "header.frame_id", *pose]
    names += [f"pose.covariance_{i}" for i in range(36)]
    columns = [d.t + 0.003, np.arange(STEPS), *whole(d.t), ["odom"] * STEPS, *d.own.T, *d.P.reshape(STEPS, 36).T]
    return lines("odom.csv", ",".join(names), columns)


def twist_first(d):
    names = ["t", *(f"twist.covariance{i}" for i in range(36)), *(f"pose.covariance{i}" for i in range(36))]
    names += [f"pose.position.{a}" for a in SPACE] + [f"pose.orientation.{a}" for a in W_LAST]
    return lines("odom.csv", ",".join(names), [d.t, *np.full((36, STEPS), 9.0), *d.P.reshape(STEPS, 36).T, *d.own.T])


def plotjuggler(d):
    """Of a topic of ROS 2: its fields with slashes, the stamp in two."""
    pose = [f"/odom/pose/pose/position/{a}" for a in SPACE] + [f"/odom/pose/pose/orientation/{a}" for a in W_LAST]
    names = ["__time", "/odom/header/stamp/sec", "/odom/header/stamp/nanosec", *pose]
    names += [f"/odom/pose/covariance[{i}]" for i in range(36)]
    return lines("odom.csv", ",".join(names), [d.t + 0.1, *whole(d.t), *d.own.T, *d.P.reshape(STEPS, 36).T])


def w_first_indexed(d):
    names = ["t", *SPACE, "qw", "qx", "qy", "qz", *(f"cov[{i};{j}]" for i in range(6) for j in range(6))]
    return lines("est.csv", ",".join(names), [d.t, *with_w_first(d.own), *d.P.reshape(STEPS, 36).T])


def cnspy(d):
    """PoseWithCovTyped of cnspy_spatial_csv_formats."""
    names = ["t", *(f"t{a}" for a in SPACE), *(f"q{a}" for a in W_LAST)]
    names += [f"T{'xyzabc'[i]}{'xyzabc'[j]}" for i, j in zip(*UPPER, strict=True)] + ["est_err_type"]
    return lines("est.csv", ",".join(names), [d.t, *d.own.T, *d.P[:, UPPER[0], UPPER[1]].T, ["type1"] * STEPS])


def named_words(d):
    words = [*SPACE, "roll", "pitch", "yaw"]
    names = ["timestamp_us", *SPACE, *(f"q_{a}" for a in W_LAST)]
    names += [f"P_{words[j]}_{words[i]}" for i, j in zip(*UPPER, strict=True)]
    columns = [nanoseconds(d.t) // 1000, *d.own.T, *d.P[:, UPPER[0], UPPER[1]].T]
    return lines("est.csv", ";".join(names), columns, ";")


def kitti_with_covariance(d):
    lines("times.txt", "", [d.t])
    return lines("est.txt", "", [*matrices(d.own), *d.P.reshape(STEPS, 36).T], " ")


ESTIMATES = {
    "rostopic echo -p": (rostopic, "90 columns, nanoseconds, quaternion w last, covariance in 36 columns"),
    "bagpy": (bagpy, "48 columns, seconds and nanoseconds, quaternion w last, covariance in 36 columns"),
    "twist first": (twist_first, "80 columns, seconds, quaternion w last, covariance in 36 columns"),
    "PlotJuggler": (plotjuggler, "46 columns, seconds and nanoseconds, quaternion w last, covariance in 36 columns"),
    "w first, two indices": (w_first_indexed, "44 columns, seconds, quaternion w first, covariance in 36 columns"),
    "cnspy PoseWithCovTyped": (cnspy, "30 columns, seconds, quaternion w last, covariance in 21 columns"),
    "words": (named_words, "29 columns, microseconds, quaternion w last, covariance in 21 columns"),
    "no names": (
        lambda d: lines("est.csv", "", [d.t, *d.own.T, *d.P.reshape(STEPS, 36).T]),
        "est.csv: read as t x y z qx qy qz qw, as its columns have no names",
    ),
    "KITTI + 36": (kitti_with_covariance, "read as matrices of 3 x 4, 48 columns, times from times.txt beside them"),
    "t + 16 + 21": (
        lambda d: lines("est.txt", "", [d.t, *matrices(d.own, 4), *d.P[:, UPPER[0], UPPER[1]].T], " "),
        "read as matrices of 4 x 4, 38 columns, the first one the time in seconds",
    ),
}


@pytest.mark.parametrize("name", ESTIMATES)
def test_estimates_as_they_are_written(name, inside):
    d = drive()
    write, said = ESTIMATES[name]
    path = write(d)
    truth = lines("truth.tum", "", [d.t, *d.true.T], " ")
    record = cs.read(path, truth=truth)
    assert_allclose(record.errors.nees[0], reference(d.own, d.true, d.P), rtol=1e-9, atol=1e-9)
    assert said in notes_of(record)


def test_steps_stand_for_times_where_both_have_none(inside):
    d = drive(start=0.0)
    Path("a").mkdir()
    truth = lines("a/truth.txt", "", matrices(d.true), " ")
    own = lines("a/est.txt", "", [*matrices(d.own), *d.P.reshape(STEPS, 36).T], " ")
    assert_allclose(cs.read(own, truth=truth).errors.nees[0], reference(d.own, d.true, d.P), rtol=1e-9)
    numbered = lines("a/large.txt", "", [np.arange(STEPS), *matrices(d.true, 4)], " ")
    record = cs.read(own, truth=numbered)
    assert_allclose(record.errors.nees[0], reference(d.own, d.true, d.P), rtol=1e-9)
    assert "the first one the number of the step" in notes_of(record)


def test_two_blocks_of_cnspy_are_judged_apart(inside):
    """PosOrientWithCov: triangles of position and rotation; which error they are of, the format does not say."""
    d = drive()
    names = ["t", *(f"t{a}" for a in SPACE), *(f"q{a}" for a in W_LAST)]
    upper = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    names += [f"p{SPACE[i]}{SPACE[j]}" for i, j in upper] + [f"q{'rpy'[i]}{'rpy'[j]}" for i, j in upper]
    columns = [d.t, *d.own.T, *(d.P[:, i, j] for i, j in upper), *(d.P[:, 3 + i, 3 + j] for i, j in upper)]
    path, truth = lines("est.csv", ",".join(names), columns), lines("truth.tum", "", [d.t, *d.true.T], " ")
    apart = d.P.copy()
    apart[:, :3, 3:] = apart[:, 3:, :3] = 0.0

    position, rotation = read_recordings(Path(path), Path(truth), error="so3")
    assert_allclose(position.errors.nees[0] + rotation.errors.nees[0], reference(d.own, d.true, apart), rtol=1e-9)


NAMES = "t,x,y,z,qx,qy,qz,qw"
TWO = "t,a.position.x,a.position.y,a.position.z,b.position.x,b.position.y,b.position.z,qx,qy,qz,qw"


def short(d):
    lines("times.txt", "", [d.t[1:]])
    return lines("t.txt", "", matrices(d.true), " ")


@pytest.mark.parametrize("suffix", ["txt", "csv"])
def test_deviations_are_judged_axis_by_axis(suffix, inside):
    d = drive()
    variances = np.diagonal(d.P, axis1=1, axis2=2)
    sigma = np.sqrt(variances)
    names = ["t", *SPACE, *(f"q{a}" for a in W_LAST), *(f"std_{a}" for a in (*SPACE, "roll", "pitch", "yaw"))]
    form = ("", " ") if suffix == "txt" else (",".join(names), ",")
    path = lines(f"est.{suffix}", form[0], [d.t, *d.own.T, *sigma.T], form[1])
    truth = lines("truth.tum", "", [d.t, *d.true.T], " ")
    record = cs.read(path, truth=truth)
    assert record.errors.parts == ((0,), (1,), (2,), (3,), (4,), (5,))
    assert_allclose(np.diagonal(record.errors.covariance[0], axis1=1, axis2=2), variances, rtol=1e-9)
    assert_allclose(record.errors.error[0], errors(d.own, d.true), rtol=1e-9, atol=1e-12)
    assert "standard deviations" in notes_of(record)
    if suffix == "txt":
        own = lines("turned.txt", "", [d.t, *d.own.T, *np.roll(sigma, 3, axis=1).T], " ")
        turned = cs.read(own, truth=truth, covariance_order="rotation-translation")
        assert_allclose(turned.errors.nees, record.errors.nees, rtol=1e-9)
    assert list(cs.judge(record).parts) == [*SPACE, "roll", "pitch", "yaw"]
    with pytest.raises(cs.InputError, match="relative needs covariances of whole poses"):
        cs.read(path, truth=truth, relative=2, motions=True)


@pytest.mark.parametrize("names", ["sigma_a,sigma_b", "std_a,std_b", "sa,sb", "P_a_a,P_b_b"])
def test_deviations_of_a_state(names, inside):
    rng = np.random.default_rng()
    step, e, sigma = np.arange(1, STEPS + 1), rng.normal(size=(STEPS, 2)), 1.0 + rng.random((STEPS, 2))
    stated = sigma**2 if names.startswith("P") else sigma
    lines("est.csv", f"step,a,b,{names}", [step, *-e.T, *stated.T])
    lines("truth.csv", "step,a,b", [step, *np.zeros((2, STEPS))])
    record = cs.read("est.csv", truth="truth.csv", state=["a", "b"])
    assert record.errors.parts == ((0,), (1,))
    assert_allclose(record.errors.nees[0], (e**2 / sigma**2).sum(axis=1), rtol=1e-9)
    assert (
        "est: standard deviations without cross terms are stated, so each component is judged by itself"
        in record.origin.notes
    )
    lines("est.csv", "step,a,b,sigma_a", [step, *-e.T, sigma[:, 0]])
    with pytest.raises(cs.InputError, match="column 'P_a_a' is missing"):
        cs.read("est.csv", truth="truth.csv", state=["a", "b"])


def semicolons(path):
    text = Path(path).read_text()
    Path(path).write_text(text.replace(",", ";").replace(".", ","))
    return path


def recoded(path):
    Path(path).write_bytes(Path(path).read_text().encode("utf-16"))
    return path


REFUSED = {
    "a quaternion that is no unit": (
        lambda d: lines("t.csv", "t,x,y,z,qw,qx,qy,qz", [d.t, *with_w_first(1.01 * d.true)]),
        r"t\.csv, line 2: the quaternion has length 1\.01, not 1; read as .* quaternion w first",
    ),
    "a time that is duplicated": (
        lambda d: lines("t.csv", NAMES, [np.full(STEPS, 1.0), *d.true.T]),
        r"t\.csv, line 3: timestamp 1 is duplicated",
    ),
    "two poses in a row": (
        lambda d: lines("t.csv", TWO, [d.t, *d.true.T[:3], *d.true.T]),
        r"t\.csv: 2 columns are 'position_x'; leave one pose in the file",
    ),
    "a text for a number": (
        lambda d: lines("t.csv", NAMES, [d.t, ["east"] * STEPS, *d.true.T[1:]]),
        r"t\.csv, line 2: column 'x': not a number",
    ),
    "matrices that stretch": (
        lambda d: lines("t.txt", "", [d.t, *matrices(d.true * [1, 1, 1, 1.1, 1.1, 1.1, 1.1])], " "),
        r"t\.txt, line 1: the 12 numbers are not a rotation",
    ),
    "matrices with another last row": (
        lambda d: lines("t.txt", "", [*matrices(d.true, 4)[:15], np.full(STEPS, 2.0)], " "),
        r"t\.txt, line 1: the 16 numbers are not a rotation",
    ),
    "another time base": (
        lambda d: lines("t.csv", "#sec,nsec,x,y,z,qx,qy,qz,qw", [*whole(d.t - 1e9), *d.true.T]),
        r"no estimate has a truth within 0\.01 s",
    ),
    "nanoseconds without a name": (
        lambda d: lines("t.txt", "", [nanoseconds(d.t), *d.true.T], " "),
        r"no estimate has a truth within .* in t\.txt; t\.txt seems to be in nanoseconds, and has to be in seconds$",
    ),
    "another unit in a name": (
        lambda d: lines("t.csv", "t,x [mm],y [mm],z [mm],qx,qy,qz,qw", [d.t, *d.true.T]),
        r"t\.csv: column 'x \[mm\]' is in mm; units are SI and radians: convert and rename it",
    ),
    "decimal commas": (
        lambda d: semicolons(lines("t.csv", NAMES, [d.t, *d.true.T])),
        r"t\.csv, line 1: has 1 columns; .*; columns apart by semicolons need names, and numbers decimal points$",
    ),
    "UTF-16": (
        lambda d: recoded(lines("t.txt", "", [d.t, *d.true.T], " ")),
        r"t\.txt: is text in UTF-16, as PowerShell and Excel write it; save it as UTF-8",
    ),
    "runs in one table": (
        lambda d: lines("t.csv", f"run,{NAMES}", [np.zeros(STEPS), d.t, *d.true.T]),
        r"t\.csv: column 'run'.*a file for each run",
    ),
    "fewer times than poses": (short, r"times\.txt: has 11 times, but t\.txt 12 poses"),
    "a truth with a gap": (
        lambda d: lines("t.csv", NAMES, [d.t, *np.where(np.arange(STEPS) == 4, np.nan, d.true.T)]),
        r"t\.csv, line 6: the truth is not finite",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_read_is_one_line(name, inside):
    d = drive()
    write, said = REFUSED[name]
    truth = write(d)
    with pytest.raises(cs.InputError, match=said):
        cs.read(tum(d), truth=truth)


# --- a last line that is cut short -------------------------------------------------------------------


@pytest.mark.parametrize("fields", [2, 1])
@pytest.mark.parametrize("file", ["est.tum", "truth.tum", "t.csv"])
def test_a_last_line_that_is_cut_short_is_left_out(file, fields, inside):
    """A field less, or the last one cut to its first digit: a variance or a part of a quaternion that is 0."""
    d = drive()
    truth = lines("truth.tum", "", [d.t, *d.true.T], " ")
    if file == "t.csv":
        truth = lines(file, NAMES, [d.t, *d.true.T])
    tum(d)
    whole, mark = Path(file).read_text(encoding="utf-8"), "," if file == "t.csv" else " "
    at = whole.rindex(mark)
    Path(file).write_text(whole[: at + 2 if fields == 1 else at], encoding="utf-8")
    record = cs.read("est.tum", truth=truth)
    assert record.origin.notes[0].startswith(f"{file}: the last line, ")
    assert "has no end and is left out" in record.origin.notes[0]
    assert not record.failures
    assert_allclose(record.errors.nees[0, : STEPS - 1], reference(d.own, d.true, d.P)[:-1], rtol=1e-9)


CUT = {
    "a field less": ("est.csv", lambda text: text[: text.rindex(",")]),
    "a number that ends in e": ("est.csv", lambda text: text[: text.rindex(",") + 2] + "e"),
    "a variance of 0": ("est.csv", lambda text: text[: text.rindex(",") + 2]),
    "an object without an end": ("est.jsonl", lambda text: text.rstrip()[:-1]),
    "a truth with a field less": ("truth.csv", lambda text: text[: text.rindex(",")]),
}


@pytest.mark.parametrize("case", CUT)
def test_a_last_row_of_a_table_that_is_cut_short_is_left_out(case, inside):
    rows, (file, cut) = [float(k) for k in range(STEPS)], CUT[case]
    names = ("t", "a", "P_a_a")
    table = [dict(zip(names, (t, 0.1 * t, 0.01), strict=True)) for t in rows]
    texts = {
        "est.csv": "\n".join([",".join(names), *(",".join(map(repr, row.values())) for row in table)]),
        "est.jsonl": "\n".join(map(json.dumps, table)),
        "truth.csv": "\n".join(["t,a", *(f"{t},0.0" for t in rows)]),
    }
    for name, text in texts.items():
        Path(name).write_text(cut(text) if name == file else text, encoding="utf-8")
    est = "est.jsonl" if file == "est.jsonl" else "est.csv"
    record = cs.read(est, truth="truth.csv", state=["a"], max_dt=0.5)
    assert record.origin.notes[0] == (
        f"{file}: the last line, {STEPS + (file != 'est.jsonl')}, has no end and is left out; it seems to be cut short"
    )
    assert record.errors.nees.shape == (1, STEPS - 1)
    assert not record.failures
    if file == est and "0" not in case.split():  # a line with an end is not cut short, but broken
        Path(est).write_text(cut(texts[est]) + "\n", encoding="utf-8")
        with pytest.raises(cs.InputError, match=rf"line {STEPS + (file != 'est.jsonl')}"):
            cs.read(est, truth="truth.csv", state=["a"], max_dt=0.5)


def test_whole_files_without_a_final_newline_are_read_whole(inside):
    d = drive()
    lines("truth.csv", NAMES, [d.t, *d.true.T], end="")
    tum(d, end="")
    record = cs.read("est.tum", truth="truth.csv")
    assert record.errors.nees.shape == (1, STEPS)
    assert "has no end" not in notes_of(record)


def test_a_last_line_of_nan_is_a_failure(inside):
    """It was written so; one that is not positive definite may be cut in its last number."""
    d = drive()
    truth = lines("truth.tum", "", [d.t, *d.true.T], " ")
    own, P = d.own.copy(), d.P.copy()
    own[-1] = np.nan
    tum(d._replace(own=own), end="")
    assert [failure.step for failure in cs.read("est.tum", truth=truth).failures] == [STEPS]
    P[-1, 5, 5] = 0.0
    tum(d._replace(P=P), end="")
    assert not cs.read("est.tum", truth=truth).failures
    tum(d._replace(P=P))
    assert [failure.step for failure in cs.read("est.tum", truth=truth).failures] == [STEPS]


def test_a_file_of_one_broken_line_is_refused_for_it(inside):
    d = drive()
    Path("t.tum").write_text("1.0 2.0", encoding="utf-8")
    with pytest.raises(cs.InputError, match=r"t\.tum, line 1: has 2 columns"):
        cs.read(tum(d), truth="t.tum")


# --- what odd files are told ----------------------------------------------------------------------------------


T = 100.0 + 0.1 * np.arange(60)
P = np.array([[0.04, 0.01, 0.005], [0.01, 0.09, -0.01], [0.005, -0.01, 0.01]])


@pytest.mark.parametrize(
    "unit, name", [(10**3, "milliseconds"), (10**6, "microseconds"), (10**9, "nanoseconds"), (1, "")]
)
def test_the_unit_that_makes_times_overlap_is_named(unit, name):
    for longer in (T, np.arange(600.0)):  # a truth may begin earlier and end later
        said = [unit_apart(unit * T, longer, ("a", "b")), unit_apart(longer, unit * T, ("b", "a"))]
        assert said == [f"; a seems to be in {name}, and has to be in seconds" if name else ""] * 2
    assert not unit_apart(T, T + 5000.0, ("a", "b"))
    assert "; b seems to be in nanoseconds" in unit_apart(T, 1.7e18 + T, ("a", "b"))  # of 1970


@pytest.mark.parametrize("heading", ["heading", "theta"])
def test_a_lower_triangle_is_a_covariance(heading, inside):
    e = np.random.default_rng().normal(size=(len(T), 3)) * [0.2, 0.3, 0.1]
    places = [(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)]
    names = ",".join(f"P_{'xyh'[i]}{'xyh'[j]}" for i, j in places)
    lines("est.csv", f"t,x,y,{heading},{names}", [T, *-e.T, *(np.full(len(T), P[i, j]) for i, j in places)])
    lines("truth.csv", f"t,x,y,{heading}", [T, *np.zeros((3, len(T)))])
    record = cs.read("est.csv", truth="truth.csv")
    assert_allclose(record.errors.nees[0], np.einsum("ti,ti->t", e, np.linalg.solve(P, e.T).T), rtol=1e-9)
    assert not record.errors.parts


@pytest.mark.parametrize(
    "name, header, rows, said",
    [
        (
            "o.csv",
            "t,v [m/s],omega [deg/s]",
            "0,1,2\n1,1,2\n",
            r"o\.csv: column 'omega \[deg/s\]' is in deg/s; units are",
        ),
        ("o.csv", "t x y heading P_xx", "0 1 2 3 4\n", r"there are: t x y heading P_xx; separate columns by commas"),
        (
            "o.csv",
            "t;x;y;heading",
            "0,5;1;2;3\n",
            r"o\.csv, line 2: column 't': not a number with a decimal point",
        ),
        ("o.txt.gz", "", "", r"o\.txt\.gz: unknown kind of file; .*; unpack it$"),
        ("f.ulg", "", "", r"f\.ulg: unknown kind of file; .*; flight logs are for 'consistency monitor'; .*level=$"),
        (
            "d/0.csv",
            "t,x,y,heading",
            "0,1,2,3\n",
            r"0\.csv: column 'P_xx' is missing; .*; columns=P_xx=NAME says what it is called",
        ),
    ],
)
def test_a_refusal_names_the_remedy(name, header, rows, said, inside):
    Path("d").mkdir()
    Path(name).write_text(f"{header}\n{rows}")
    lines("truth.csv", "t,x,y,heading", [T, T, T, T])
    with pytest.raises(cs.InputError, match=said):
        cs.read(name.split("/")[0], truth="truth.csv")


def test_units_of_the_si_and_other_words_are_let_pass():
    require_units(["t [ns]", "v (m/s)", "omega[rad/s]", "P_xx [m^2]", "x [cmd]", "x (degraded)"], Path("o.csv"))
    for name in ("v (km/h)", "P_hh [deg^2]", "yaw [ ° ]", "pitch (degrees)", "z [CM]"):
        with pytest.raises(cs.InputError, match=r"o\.csv: column .* units are SI and radians"):
            require_units([name], Path("o.csv"))


def test_a_list_in_a_cell():
    cells = np.empty(1, object)
    cells[0] = [0.01, 0.0]
    with pytest.raises(
        cs.InputError, match=r"row 0: column 'P': a list, of which each number needs a column of its own"
    ):
        TableRows(Path("e.parquet"), {"P": cells}, np.arange(1), "row").numbers("P")
    assert fields_of('t, "[0.01, 0.0]","x"') == ["t", "[0.01, 0.0]", "x"]
    assert fields_of('"t" "x"') == ["t", "x"]


def test_a_solution_of_positions_is_called_so(inside):
    head = "%  UTC latitude(deg) longitude(deg) height(m) Q sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m)\n"
    rows = (f"2023/11/14 22:13:2{k}.000 47.4 8.5 488.0 1 0.1 0.1 0.2 0 0 0\n" for k in range(3))
    Path("a.pos").write_text(head + "".join(rows))
    record = cs.read("a.pos", truth="a.pos")
    assert "OpenVINS" not in notes_of(record)
    assert any(note.endswith("the default of this layout, positions alone") for note in record.origin.notes)
