"""KITTI drives as truth, against pykitti, and the files of a simulation with OpenVINS."""

import shutil

import numpy as np
import pytest
from drives import R_IV, R_VC, STEPS, T_IV, T_VC, write_drive, write_states
from numpy.testing import assert_allclose
from recorded import read_recordings
from scipy.spatial.transform import Rotation

import consistency as cs
from consistency.referee.errors import InputError
from consistency.referee.geometry import planar_error, spatial_error
from consistency.referee.readers.formats.kitti_files import mercator, read_drive


@pytest.fixture
def drive(tmp_path):
    return write_drive(tmp_path / "2011_09_26_drive_0001_sync")


def matrices(lines):
    out = np.tile(np.eye(4), (len(lines), 1, 1))
    out[:, :3, :3], out[:, :3, 3] = Rotation.from_quat(lines[:, 4:]).as_matrix(), lines[:, 1:4]
    return out


def test_poses_are_those_of_pykitti(drive):
    utils = pytest.importorskip("pykitti.utils", reason="pykitti is not installed")
    files = sorted((drive / "oxts/data").iterdir())
    true = np.array([each.T_w_imu for each in utils.load_oxts_packets_and_poses(list(map(str, files)))])
    own = matrices(read_drive(drive).values)
    assert_allclose(own, np.linalg.inv(true[0]) @ true, atol=1e-6)
    velo = utils.transform_from_rot_trans(R_IV, T_IV)  # points of the imu, as the velodyne has them
    camera = utils.transform_from_rot_trans(R_VC, T_VC) @ velo
    for body, mount in (("velodyne", velo), ("camera", camera)):
        each = true @ np.linalg.inv(mount)
        assert_allclose(matrices(read_drive(drive, body).values), np.linalg.inv(each[0]) @ each, atol=1e-6)


def test_seconds_are_counted_from_the_first_packet_across_midnight(drive):
    t = read_drive(drive).t
    assert t[0] == 0.0
    assert ((t - np.arange(STEPS) / 10.0 >= -1e-9) & (t - np.arange(STEPS) / 10.0 < 1e-3)).all()


def test_the_projection_is_right_to_the_millimetre():
    """Against the ellipsoid's tangent, which differs by the sphere of Mercator: 0.4 % at most; shape exact."""
    place = np.array([[49.0, 8.4, 100.0], [49.0, 8.401, 100.0], [49.001, 8.4, 103.0]])
    x, y, z = (mercator(place) - mercator(place)[0]).T
    assert_allclose(x[1], np.deg2rad(0.001) * 6378137.0 * np.cos(np.deg2rad(49.0)), rtol=1e-9)
    assert_allclose(y[2], np.deg2rad(0.001) * 6378137.0, rtol=2e-5)
    assert_allclose((x[0], y[1], x[2], z[2]), (0.0, 0.0, 0.0, 3.0), atol=1e-9)


def estimates(folder, body=None):
    """est.tum (44 columns) and est.csv beside a drive, and the errors that they have, spatial and planar."""
    lines, rng = read_drive(folder, body).values, np.random.default_rng()
    sigma = np.array([0.2, 0.1, 0.05, 0.01, 0.02, 0.01])
    e = sigma * rng.normal(size=(STEPS, 6))
    turn = (Rotation.from_rotvec(-e[:, 3:]) * Rotation.from_quat(lines[:, 4:])).as_quat()
    pose, P = np.column_stack([lines[:, 1:4] - e[:, :3], turn]), np.diag(sigma**2).ravel()
    at = folder.parent
    np.savetxt(at / "est.tum", np.column_stack([lines[:, 0], pose, np.tile(P, (STEPS, 1))]), fmt="%.12g")
    ahead = Rotation.from_quat(lines[:, 4:]).apply([1.0, 0.0, 0.0])
    flat = np.column_stack([lines[:, 1:3], np.arctan2(ahead[:, 1], ahead[:, 0])])
    own = flat - e[:, [0, 1, 5]]
    names = "t,x,y,heading,P_xx,P_xy,P_xh,P_yy,P_yh,P_hh"
    rows = np.column_stack([lines[:, 0], own, np.tile([0.04, 0.0, 0.0, 0.01, 0.0, 1e-4], (STEPS, 1))])
    np.savetxt(at / "est.csv", rows, fmt="%.12g", delimiter=",", header=names, comments="")
    return spatial_error(lines[:, 1:], pose, "so3"), planar_error(flat, own, "so2")


def test_a_trajectory_and_a_table_are_judged_by_a_drive(drive):
    spatial, planar = estimates(drive)
    [r] = read_recordings(drive.parent / "est.tum", drive)
    assert_allclose(r.errors.error[0], spatial, atol=1e-8)
    assert "the path of the imu as its first pose sees it" in r.origin.notes[0]
    [r] = read_recordings(drive.parent / "est.csv", drive)
    assert_allclose(r.errors.error[0], planar, atol=1e-8)
    record = cs.read(drive.parent / "est.csv", truth=drive, body="velodyne")
    assert np.abs(np.asarray(record.errors.error)[0] - planar).max() > 0.01


def test_the_body_is_chosen(drive):
    spatial, _ = estimates(drive, "camera")
    [r] = read_recordings(drive.parent / "est.tum", drive, body="camera")
    assert_allclose(r.errors.error[0], spatial, atol=1e-8)
    assert "the path of the camera" in r.origin.notes[0]
    [other] = read_recordings(drive.parent / "est.tum", drive)
    assert np.abs(other.errors.error[0] - spatial).max() > 1.0


def test_a_folder_of_runs_has_a_drive_for_each_or_one_for_all(drive):
    spatial, _ = estimates(drive)
    (drive.parent / "est").mkdir()
    shutil.copy(drive.parent / "est.tum", drive.parent / "est" / f"{drive.name}.tum")
    for truth in (drive, drive.parent):
        [r] = read_recordings(drive.parent / "est", truth)
        assert_allclose(r.errors.error[0], spatial, atol=1e-8)


def test_what_is_wrong_with_a_drive_is_said(drive):
    estimates(drive)
    est, data = drive.parent / "est.tum", drive / "oxts/data"

    def refused(match, path=est, body=None):
        with pytest.raises(InputError, match=match):
            read_recordings(path, drive, body=body)

    refused("--body lidar: must be one of imu, velodyne, camera", body="lidar")
    refused("--body camera: with x, y, heading it is imu or velodyne", est.with_suffix(".csv"), "camera")
    with pytest.raises(InputError, match="--body imu: goes with --truth DIR, the folder of a KITTI drive"):
        read_recordings(est, est, body="imu")
    packet = data / "0000000007.txt"
    text = packet.read_text()
    for bad, match in (
        ("1 2 3", r"0000000007\.txt: has 3 numbers; a packet of KITTI has 30"),
        (text.replace("0.1", "ten", 1), r"0000000007\.txt: is not a packet of numbers"),
        ("nan" + text[text.index(" ") :], r"begins with nan .*; should be latitude and longitude in degrees"),
        ("91" + text[text.index(" ") :], r"begins with 91 "),
    ):
        packet.write_text(bad)
        refused(match)
    packet.unlink()
    refused(r"oxts: timestamps\.txt has 60 lines, but data 59 packets")
    packet.write_text(text)
    stamps = drive / "oxts/timestamps.txt"
    lines = stamps.read_text().splitlines()
    for at, bad, match in (
        (3, "12:00", r"timestamps\.txt, line 4: not a timestamp; should be like 2011-09-26"),
        (3, "2011-13-26 13:02:25.0", r"timestamps\.txt, line 4: not a timestamp"),
        (5, lines[4], r"timestamps\.txt, line 6: timestamps must increase; take the synced drive"),
    ):
        stamps.write_text("\n".join([*lines[:at], bad, *lines[at + 1 :]]))
        refused(match)
    stamps.write_text("")
    refused(r"timestamps\.txt: is empty")
    stamps.unlink()
    refused(r"timestamps\.txt: cannot be read")
    stamps.write_text("\n".join(lines))
    calibration = drive.parent / "calib_imu_to_velo.txt"
    calibration.write_text("R: 1 0 0 0 2 0 0 0 1\nT: 0 0 0\n")
    refused(r"calib_imu_to_velo\.txt: key 'R': is not a rotation", body="velodyne")
    calibration.write_text("R: 1 0 0\nT: 0 0 0\n")
    refused(r"calib_imu_to_velo\.txt: key '", body="velodyne")
    calibration.unlink()
    refused(r"--body needs calib_imu_to_velo\.txt, here or in the folder above", body="velodyne")


# --- OpenVINS -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("cameras, more", [(1, 0), (2, 0), (1, 25)])
def test_states_are_judged_component_by_component(cameras, more, tmp_path):
    e, sigma = write_states(tmp_path, cameras, more)
    files = [tmp_path / f"state_{name}.txt" for name in ("estimate", "groundtruth", "deviation")]
    found = read_recordings(*files)
    assert [r.name for r in found] == [f"state_estimate {axis}" for axis in ("x", "y", "z", "roll", "pitch", "yaw")]
    for i, r in enumerate(found):
        assert_allclose(r.errors.error[0, :, 0], e[:, i], atol=1e-9)
        assert_allclose(r.errors.covariance[0, :, 0, 0], sigma[:, i] ** 2, rtol=1e-9)
        assert r.errors.convention == "so3-body"
    [yaw] = read_recordings(*files, axes=["yaw"])
    assert yaw.errors.axes == ("yaw",)


def test_velocity_and_biases_of_states(tmp_path):
    """One recording more, each of whose components is judged by itself; EuRoC's truth has them, too."""
    e, sigma = write_states(tmp_path, moving=True)
    est, truth, deviation = (tmp_path / f"state_{name}.txt" for name in ("estimate", "groundtruth", "deviation"))
    rows = np.loadtxt(truth)
    euroc = tmp_path / "data.csv"
    np.savetxt(euroc, rows[:, [0, 5, 6, 7, 4, 1, 2, 3, *range(8, 17)]], delimiter=",", fmt="%.17g")
    for path in (truth, euroc):
        *poses, rest = read_recordings(est, path, deviation)
        assert len(poses) == 6
        assert rest.name == "state_estimate velocity and biases"
        assert rest.errors.axes == ("vx", "vy", "vz", "bgx", "bgy", "bgz", "bax", "bay", "baz")
        assert rest.errors.parts == tuple((i,) for i in range(9))
        assert_allclose(rest.errors.error[0], e[:, 6:], atol=1e-9)
        assert_allclose(np.diagonal(rest.errors.covariance[0], axis1=1, axis2=2), sigma[:, 6:] ** 2, rtol=1e-9)
    [bias] = read_recordings(est, truth, deviation, axes=["bgy"])
    assert_allclose(bias.errors.error[0, :, 0], e[:, 10], atol=1e-9)
    np.savetxt(tmp_path / "tum.txt", rows[:, [0, 5, 6, 7, 1, 2, 3, 4]])
    assert len(read_recordings(est, tmp_path / "tum.txt", deviation)) == 6
    found = read_recordings(est, truth, deviation, align="posyaw-all")
    assert len(found) == 6
    assert f"{est}: with --align the poses alone are judged, not their velocities and biases" in found[0].origin.notes


def test_what_is_wrong_with_states_is_said(tmp_path):
    write_states(tmp_path)
    est, truth, deviation = (tmp_path / f"state_{name}.txt" for name in ("estimate", "groundtruth", "deviation"))
    with pytest.raises(InputError, match="give --covariance FILE, the standard deviations of t, three"):
        read_recordings(est, truth)
    with pytest.raises(InputError, match="written by OpenVINS, rotation before translation"):
        read_recordings(est, truth, deviation, covariance_order="translation-rotation")
    rows = np.loadtxt(est)
    for column, value, match in (
        (18, 0.5, "has 34 columns; should be t tx ty tz"),
        (18, 7.0, "has 34 columns; should be t tx ty tz"),
        (1, 3.0, "the quaternion has length .*; columns 2 to 5 must be qx qy qz qw"),
    ):
        bad = rows.copy()
        bad[:, column] = value
        np.savetxt(est, bad)
        with pytest.raises(InputError, match=match):
            read_recordings(est, truth, deviation)
    np.savetxt(est, rows)
    bad = np.loadtxt(deviation)
    bad[4, 2] = -1.0
    np.savetxt(deviation, bad)
    with pytest.raises(InputError, match=r"state_deviation\.txt, line 5: a standard deviation is below 0"):
        read_recordings(est, truth, deviation)
