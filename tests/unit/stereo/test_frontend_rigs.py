"""Drives of KITTI raw and calibrations of BoofCV, as they come."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml
from drives import write_drive
from numpy.testing import assert_allclose
from scene import BASELINE, SIZE, K, drive, texture, write_kitti

import consistency as cs
from consistency.bench.scenario import Belief, BelievedMotion, BelievedSensor
from consistency.bench.store.recorded_log import read_log
from consistency.bench.types import Trial
from consistency.referee.geometry import rotation
from consistency.referee.readers.formats.kitti_files import drive_poses
from consistency.stereo.frontend import FrontendOptions, write_frontend_log
from consistency.stereo.frontend.camera_truth import find_truth, missing_of_drive, read_truth
from consistency.stereo.frontend.images_to_log import plane_of
from consistency.stereo.visual_odometry.calibration_files import read_calibration
from consistency.stereo.visual_odometry.relative_motion import RelativeMotion
from consistency.stereo.visual_odometry.rig import rectify
from consistency.stereo.visual_odometry.sequence import read_sequence
from consistency.vision import RelativePose

cv2 = pytest.importorskip("cv2", reason="OpenCV (the extra vision) is not installed")
FULL = (SIZE[0] + 40, SIZE[1] + 20)  # px of unrectified images
R_0, R_1 = rotation(0.01, 0.02, -0.01), rotation(-0.02, 0.01, 0.015)  # of the cameras in KITTI's own axes
T_1 = np.array([-0.5, 0.01, 0.02])


def cam_to_cam(**changes):
    """calib_cam_to_cam.txt; a change to None leaves a key out."""
    P_1 = K @ np.column_stack([np.eye(3), [-BASELINE, 0.0, 0.0]])
    rows = {"corner_dist": [0.1]}
    for name, K_own, R, T, P in (("00", 1.1 * K, R_0, np.zeros(3), np.column_stack([K, np.zeros(3)])),
                                 ("01", 1.2 * K, R_1, T_1, P_1)):  # fmt: skip
        K_own[2, 2] = 1.0
        rows |= {f"S_{name}": FULL, f"K_{name}": K_own, f"D_{name}": [-0.3, 0.1, 0.001, 0.002, -0.05], f"R_{name}": R,
                 f"T_{name}": T, f"S_rect_{name}": SIZE, f"R_rect_{name}": np.eye(3), f"P_rect_{name}": P}  # fmt: skip
    text = {key: " ".join(f"{x:.12e}" for x in np.ravel(value)) for key, value in rows.items()}
    lines = {"calib_time": "09-Jan-2012 13:57:47"} | text | changes
    return "".join(f"{key}: {value}\n" for key, value in lines.items() if value is not None)


@pytest.fixture(scope="module")
def day(tmp_path_factory):
    """The folder of a day with one drive of eight frames."""
    day = tmp_path_factory.mktemp("raw") / "2011_09_26"
    seq = day.parent / "seq"
    write_kitti(seq, drive(8), texture(np.random.default_rng(0)))
    for camera in ("0", "1"):
        place = day / "2011_09_26_drive_0001_sync" / f"image_0{camera}"
        place.mkdir(parents=True)
        (seq / f"image_{camera}").rename(place / "data")
        stamps = (f"2011-09-26 23:59:59.{950_000_000 + 100_000_000 * k:09d}" for k in range(1))
        later = (f"2011-09-27 00:00:00.{50_000_000 + 100_000_000 * k:09d}" for k in range(7))
        (place / "timestamps.txt").write_text("\n".join([*stamps, *later]) + "\n")
    (day / "calib_cam_to_cam.txt").write_text(cam_to_cam())
    return day


def test_a_drive_of_kitti_raw_becomes_a_log(day, tmp_path):
    """Over midnight; the calibration lies in the folder of the day."""
    folder = day / "2011_09_26_drive_0001_sync"
    sequence = read_sequence(folder)
    assert sequence.format == "kitti-raw"
    assert_allclose(sequence.t, 0.1 * np.arange(8), atol=1e-9)
    assert sequence.rectification.rig.baseline == pytest.approx(BASELINE)
    other = raw_drive(tmp_path / "2011_09_26", "00")  # its packets and calibrations beside these images
    for name in ("image_00", "image_01"):
        shutil.rmtree(other / name)
        shutil.copytree(folder / name, other / name)
    lost = other.parent / "calib_imu_to_velo.txt"
    lost.rename(tmp_path / lost.name)
    summary = write_frontend_log(other, tmp_path / "log", FrontendOptions(max_landmarks=30))
    assert summary.sequence.timed
    moved = sum(np.linalg.norm(m.pose.t) for m in summary.motions)
    assert moved == pytest.approx(np.linalg.norm(drive(8)[-1].t), rel=0.02)
    said = "no truth found: that of oxts takes calib_imu_to_velo.txt too; --truth FILE takes one"
    assert said in summary.lines(tmp_path / "log")
    (tmp_path / lost.name).rename(lost)
    summary = write_frontend_log(other, tmp_path / "true", FrontendOptions(max_landmarks=30))
    assert summary.truth == other
    assert f"truth from {other}; next: consistency analyse" in "\n".join(summary.lines(tmp_path / "true"))
    R, t = read_truth(other, read_sequence(other))
    written = np.loadtxt(tmp_path / "true/truth.tum")
    assert_allclose(written[:, 1:4], (t - t[0]) @ R[0], atol=1e-9)
    assert read_log(tmp_path / "true").trials[0].truth is not None


def raw_drive(day, camera, **changes):
    """A drive with packets, calibrations and five dark images of a camera and the one to its right."""
    folder = write_drive(day / f"{day.name}_drive_0002_sync")
    stamps = (folder / "oxts/timestamps.txt").read_text().splitlines()
    for name in (camera, f"0{int(camera) + 1}"):
        (folder / f"image_{name}/data").mkdir(parents=True)
        for k in range(5):
            cv2.imwrite(str(folder / f"image_{name}/data/{k:010d}.png"), np.zeros(SIZE[::-1], np.uint8))
        (folder / f"image_{name}/timestamps.txt").write_text("\n".join(stamps[10:15]) + "\n")
    rows = dict(line.split(": ") for line in cam_to_cam().splitlines())
    R_rect = rotation(0.02, -0.01, 0.03)
    for own, other, x in (("02", "00", 0.06), ("03", "01", 0.06 - BASELINE)):
        P = K @ np.column_stack([np.eye(3), [x, 0.0, 0.0]])
        rows |= {key.replace(other, own): value for key, value in rows.items() if key.endswith(other)}
        rows[f"P_rect_{own}"] = " ".join(f"{value:.12e}" for value in P.ravel())
    rows |= {f"R_rect_0{i}": " ".join(f"{value:.12e}" for value in R_rect.ravel()) for i in range(4)}
    lines = {key: value for key, value in (rows | changes).items() if value is not None}
    (day / "calib_cam_to_cam.txt").write_text("".join(f"{key}: {value}\n" for key, value in lines.items()))
    return folder


@pytest.mark.parametrize("camera", ["00", "02"])
def test_oxts_of_a_drive_is_the_truth_of_the_rectified_camera(tmp_path, camera):
    """As pykitti has it; frames 10 to 14 of the packets."""
    pykitti = pytest.importorskip("pykitti", reason="pykitti is not installed")
    folder = raw_drive(tmp_path / "2011_09_26", camera)
    sequence = read_sequence(folder)
    assert find_truth(sequence) == folder
    R, t = read_truth(folder, sequence)
    other = pykitti.raw(str(tmp_path), "2011_09_26", "0002")
    mount = np.linalg.inv(getattr(other.calib, f"T_cam{int(camera)}_imu"))
    true = np.array([packet.T_w_imu @ mount for packet in other.oxts[10:15]])
    assert_allclose(R[0].T @ R, true[0, :3, :3].T @ true[:, :3, :3], atol=1e-6)
    assert_allclose((t - t[0]) @ R[0], (true[:, :3, 3] - true[0, :3, 3]) @ true[0, :3, :3], atol=1e-5)


def test_images_between_packets_and_beyond_them(tmp_path):
    """Half way between two packets, and half a period before the first and after the last."""
    folder = raw_drive(tmp_path / "2011_09_26", "00")
    stamps, poses = drive_poses(folder, "camera")
    half = (stamps[1] - stamps[0]) // 2
    at = [stamps[0] - half, stamps[0], stamps[0] + half, stamps[-1], stamps[-1] + (stamps[-1] - stamps[-2]) // 2]
    times = folder / "image_00/timestamps.txt"
    times.write_text("\n".join(str(np.datetime64(int(each), "ns")).replace("T", " ") for each in at) + "\n")
    sequence = read_sequence(folder)
    R, t = read_truth(folder, sequence)
    body = sequence.calibration.body_from_left
    t = t - R @ body[:3, :3].T @ body[:3, 3]  # of camera 0
    assert_allclose(t[[1, 3]], poses[[0, -1], :3, 3], atol=1e-9)
    assert_allclose(t[2], poses[:2, :3, 3].mean(axis=0), atol=1e-6)
    for outer, inner, next_one in ((0, 1, poses[1]), (4, 3, poses[-2])):  # drives on as in the step beside it
        assert_allclose(t[outer] - t[inner], (t[inner] - next_one[:3, 3]) / 2, atol=0.01)
    late = np.datetime64(int(stamps[-1] + 3 * half), "ns")
    times.write_text(times.read_text().rsplit("\n", 2)[0] + "\n" + str(late).replace("T", " ") + "\n")
    with pytest.raises(cs.InputError, match=r"1 of 5 frames have no packet within 0\.11 s"):
        read_truth(folder, read_sequence(folder))


def test_a_drive_whose_calibrations_are_missing_has_no_truth(tmp_path):
    """What is missing is said; a truth that is asked for is refused."""
    folder = raw_drive(tmp_path / "2011_09_26", "00")
    (tmp_path / "2011_09_26/calib_velo_to_cam.txt").unlink()
    sequence = read_sequence(folder)
    assert find_truth(sequence) is None
    assert missing_of_drive(sequence) == ["calib_velo_to_cam.txt"]
    (tmp_path / "data.csv").write_text("".join(f"{k},0,0,0,1,0,0,0\n" for k in range(5)))
    with pytest.raises(cs.InputError, match=r"data\.csv: is the truth of a body, but .*calib_cam_to_cam.* has no T_BS"):
        read_truth(tmp_path / "data.csv", sequence)
    unknown = replace(sequence, calibration=replace(sequence.calibration, body=""))
    assert missing_of_drive(unknown) == ["calib_velo_to_cam.txt", "calib_cam_to_cam.txt"]
    with pytest.raises(
        cs.InputError, match=r"is of a drive of KITTI raw with calib_cam_to_cam\.txt; the images are not"
    ):
        read_truth(folder, unknown)
    with pytest.raises(cs.InputError, match=r"--body needs calib_velo_to_cam\.txt"):
        read_truth(folder, sequence)


def test_the_camera_before_rectification_is_where_its_calibration_puts_it(tmp_path):
    """x_left = R_0 x_0 + T_0, with camera 0 the body."""
    path = tmp_path / "calib_cam_to_cam.txt"
    path.write_text(cam_to_cam(T_00="0.1 0.2 0.3"))
    body = read_calibration(path, "image_00", "image_01", FULL).body_from_left
    point = np.array([1.0, -2.0, 5.0])
    assert_allclose(body[:3, :3] @ (R_0 @ point + [0.1, 0.2, 0.3]) + body[:3, 3], point, atol=1e-9)
    P_0 = K @ np.column_stack([np.eye(3), [0.06, 0.004, -0.003]])
    path.write_text(cam_to_cam(P_rect_00=" ".join(f"{x:.12e}" for x in P_0.ravel())))
    body = read_calibration(path, "image_00", "image_01", SIZE).body_from_left
    assert body is not None
    assert_allclose(body, [[1, 0, 0, -0.06], [0, 1, 0, -0.004], [0, 0, 1, 0.003], [0, 0, 0, 1]], atol=1e-9)


def test_images_of_kitti_raw_before_rectification(tmp_path):
    """x_i = R_i x_0 + T_i, so that x_1 = R x_0' + T of the left camera's axes; the size of the images decides."""
    path = tmp_path / "calib_cam_to_cam.txt"
    path.write_text(cam_to_cam(D_01="-0.2 0.05 0.003 0.004 -0.01"))
    c = read_calibration(path, "image_00", "image_01", FULL)
    assert_allclose(c.R, R_1 @ R_0.T, atol=1e-9)
    assert_allclose(c.T, T_1, atol=1e-9)
    assert c.K_left[0, 0] == pytest.approx(1.1 * K[0, 0])
    assert c.D_left.tolist() == pytest.approx([-0.3, 0.1, 0.001, 0.002, -0.05])
    assert c.D_right.tolist() == pytest.approx([-0.2, 0.05, 0.003, 0.004, -0.01])
    assert rectify(c, FULL).rig.baseline == pytest.approx(np.linalg.norm(T_1))
    assert not read_calibration(path, "image_00", "image_01", SIZE).D_left.any()
    with pytest.raises(
        cs.InputError, match="the images have 10 x 20 px, but it is for 520 x 340 px, and for 480 x 320"
    ):
        read_calibration(path, "image_00", "image_01", (10, 20))


@pytest.mark.parametrize(
    "changes, said",
    [
        ({"P_rect_01": None}, "key 'P_rect_01' is missing"),
        ({"P_rect_01": "1 2 3"}, "key 'P_rect_01': must be 12 finite numbers"),
        ({"S_rect_00": "a b"}, "key 'S_rect_00': must be numbers"),
        ({"P_rect_00": " ".join(["0"] * 12)}, "matrix of its camera is singular"),
    ],
)
def test_an_unusable_calibration_of_kitti_raw(tmp_path, changes, said):
    path = tmp_path / "calib_cam_to_cam.txt"
    path.write_text(cam_to_cam(**changes))
    with pytest.raises(cs.InputError, match=said) as error:
        read_calibration(path, "image_00", "image_01", SIZE)
    assert str(error.value).startswith(str(path))


def test_an_unusable_drive_of_kitti_raw(day, tmp_path):
    folder = tmp_path / "drive"
    for camera in ("image_00", "image_01"):
        (folder / camera).mkdir(parents=True)
        (folder / camera / "data").symlink_to(day / "2011_09_26_drive_0001_sync" / camera / "data")
    with pytest.raises(cs.InputError, match=r"timestamps\.txt: cannot be read \(No such file"):
        read_sequence(folder)
    (folder / "image_00/timestamps.txt").write_text("yesterday\n" * 8)
    with pytest.raises(cs.InputError, match=r"timestamps\.txt, line 1: not a timestamp; should be like 2011"):
        read_sequence(folder)
    (folder / "image_00/timestamps.txt").write_text("2011-09-26 13:00:00.1\n" * 8)
    with pytest.raises(cs.InputError, match=r"line 2: timestamps must increase"):
        read_sequence(folder)
    (folder / "image_00/timestamps.txt").write_text("".join(f"2011-09-26 13:00:0{k}.1\n" for k in range(8)))
    with pytest.raises(cs.InputError, match=r"calib_cam_to_cam\.txt: no such file"):
        read_sequence(folder)
    assert len(read_sequence(folder, day / "calib_cam_to_cam.txt")) == 8


# --- motions that leave the plane --------------------------------------------------------------------


@pytest.mark.parametrize(
    "sigma, holds",
    [((30.0, 30.0, 1.9), True), ((33.0, 1.0, 0.1), False), ((1.0, 33.0, 0.1), False), ((1.0, 1.0, 2.1), False)],
)
def test_a_plane_holds_where_landmarks_are_off_by_less_than_a_tenth(sigma, holds):
    """Of f = 320 px, and of the disparity of 20 px in the median; a turn about up is no tilt, 2 degrees ahead are."""
    turns = [RelativePose.from_vector(np.deg2rad([0, 0, 0, *angles])) for angles in ((0, 5, 0), (2, 0, 0), (1, 0, 1))]
    ahead = [RelativePose(turn.R, np.array([0.0, 0.0, 1.0])) for turn in turns]
    motions = [RelativeMotion(pose, *[None] * 9) for pose in ahead]  # type: ignore[arg-type]
    z = np.array([[9.0, 9.0, d] for d in (10.0, 20.0, 90.0)])
    trial = Trial(0, np.zeros(3), np.ones((3, 3)), np.arange(4), np.arange(3), z, 3)
    sensor = BelievedSensor(model="uvd", sigma=sigma, f=320.0, B=0.2)
    plane = plane_of(motions, trial, Belief(motion=BelievedMotion(sigma_v=1.0, sigma_omega=1.0), sensor=sensor))
    assert plane.limit == (32.0, 32.0, 2.0)
    assert plane.holds is holds
    assert_allclose(np.rad2deg(plane.tilts), [0.0, 2.0, np.sqrt(2.0)], atol=1e-3)
    assert plane.leaving == 1
    assert "1 of 3 motions tilt the camera by more than 1.7 deg (1.4 in the median, 2 at most)" in plane.line


# --- BoofCV ----------------------------------------------------------------------------------------


def boofcv():
    """What BoofCV writes of a stereo calibration."""
    lens = {"width": 640, "height": 480, "fx": 500.0, "fy": 501.0, "skew": 0.0, "cx": 320.0, "cy": 240.0}
    bend = {"radial": [-0.25, 0.1], "t1": 0.001, "t2": -0.002}
    camera = {"model": "pinhole_radial_tangential", "version": 0, "pinhole": lens, "radial_tangential": bend}
    R = rotation(0.01, -0.02, 0.015)
    pose = {"rotation": R.ravel().tolist(), "x": 0.12, "y": 0.001, "z": -0.002}
    parts = {"model": "stereo_camera", "version": 0, "left": camera, "right": camera, "rightToLeft": pose}
    apart = json.loads(json.dumps(parts))  # YAML would write what both cameras share as an alias
    return apart


def write(path, data):
    path.write_text("# Intrinsic and extrinsic parameters for a stereo camera pair\n" + yaml.safe_dump(data))
    return path


def test_a_calibration_of_boofcv(tmp_path):
    c = read_calibration(write(tmp_path / "stereo.yaml", boofcv()))
    R, t = rotation(0.01, -0.02, 0.015), np.array([0.12, 0.001, -0.002])
    p = np.array([0.3, -0.2, 4.0])  # in the left camera
    assert_allclose(c.R @ p + c.T, R.T @ (p - t), atol=1e-12)
    assert_allclose(c.D_left, [-0.25, 0.1, 0.001, -0.002, 0.0])
    assert_allclose(c.K_right, [[500, 0, 320], [0, 501, 240], [0, 0, 1]])
    assert c.image_size == (640, 480)


@pytest.mark.parametrize(
    "place, value, said",
    [
        (("left", "model"), "omnidirectional_universal", "key 'left.model': omnidirectional_universal is not pinhole"),
        (("left", "pinhole"), None, "key 'left.pinhole' is missing"),
        (("right", "pinhole", "fx"), "wide", "key 'right.pinhole.fx'"),
        (("right", "pinhole", "skew"), 0.3, "key 'right.pinhole.skew': 0.3, only 0 is taken"),
        (("right", "pinhole", "width"), 320, "left has 640 x 480 px, right 320 x 480"),
        (("left", "radial_tangential", "radial"), [1, 2, 3, 4], "has 4 numbers, 3 at most"),
        (("rightToLeft", "rotation"), [1.0, 0.0], "key 'rightToLeft.rotation': has 2 numbers, not 9"),
        (("rightToLeft", "x"), -0.12, "not to its right"),
        (("rightToLeft",), 3, "key 'rightToLeft' is missing"),
    ],
)
def test_an_unusable_calibration_of_boofcv(tmp_path, place, value, said):
    data = boofcv()
    part = data
    for key in place[:-1]:
        part = part[key]
    part[place[-1]] = value
    path = write(tmp_path / "stereo.yaml", data)
    with pytest.raises(cs.InputError, match=said) as error:
        read_calibration(path)
    assert str(error.value).startswith(str(path))
