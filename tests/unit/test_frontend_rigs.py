"""Drives of KITTI raw and calibrations of BoofCV, as they come."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scene import BASELINE, SIZE, K, drive, texture, write_kitti

import consistency as cs
from consistency.frontend import Options, write_frontend_log
from consistency.geometry import rotation
from consistency.vision.calibration import read_calibration
from consistency.vision.rectification import rectify
from consistency.vision.sequence import read_sequence

pytest.importorskip("cv2", reason="OpenCV (the extra vision) is not installed")
FULL = (SIZE[0] + 40, SIZE[1] + 20)  # px of unrectified images
R_0, R_1 = rotation(0.01, 0.02, -0.01), rotation(-0.02, 0.01, 0.015)  # of the cameras in KITTI's own axes
T_1 = np.array([-0.5, 0.01, 0.02])


def cam_to_cam(**changes: str | None) -> str:
    """calib_cam_to_cam.txt; a change to None leaves a key out."""
    P_1 = K @ np.column_stack([np.eye(3), [-BASELINE, 0.0, 0.0]])
    rows: dict[str, Any] = {"corner_dist": [0.1]}
    for name, K_own, R, T, P in (("00", 1.1 * K, R_0, np.zeros(3), np.column_stack([K, np.zeros(3)])),
                                 ("01", 1.2 * K, R_1, T_1, P_1)):  # fmt: skip
        K_own[2, 2] = 1.0
        rows |= {f"S_{name}": FULL, f"K_{name}": K_own, f"D_{name}": [-0.3, 0.1, 0.001, 0.002, -0.05], f"R_{name}": R,
                 f"T_{name}": T, f"S_rect_{name}": SIZE, f"R_rect_{name}": np.eye(3), f"P_rect_{name}": P}  # fmt: skip
    text = {key: " ".join(f"{x:.12e}" for x in np.ravel(value)) for key, value in rows.items()}
    lines = {"calib_time": "09-Jan-2012 13:57:47"} | text | changes
    return "".join(f"{key}: {value}\n" for key, value in lines.items() if value is not None)


@pytest.fixture(scope="module")
def day(tmp_path_factory: pytest.TempPathFactory) -> Path:
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


def test_a_drive_of_kitti_raw_becomes_a_log(day: Path, tmp_path: Path) -> None:
    """Over midnight; the calibration lies in the folder of the day."""
    folder = day / "2011_09_26_drive_0001_sync"
    sequence = read_sequence(folder)
    assert sequence.format == "kitti-raw"
    np.testing.assert_allclose(sequence.t, 0.1 * np.arange(8), atol=1e-9)
    assert sequence.rectification.rig.baseline == pytest.approx(BASELINE)
    summary = write_frontend_log(folder, tmp_path / "log", Options(max_landmarks=30))
    assert summary.timed
    assert summary.distance == pytest.approx(np.linalg.norm(drive(8)[-1].t), rel=0.02)


def test_images_of_kitti_raw_before_rectification(tmp_path: Path) -> None:
    """x_i = R_i x_0 + T_i, so that x_1 = R x_0' + T of the left camera's axes; the size of the images decides."""
    path = tmp_path / "calib_cam_to_cam.txt"
    path.write_text(cam_to_cam())
    c = read_calibration(path, "image_00", "image_01", FULL)
    np.testing.assert_allclose(c.R, R_1 @ R_0.T, atol=1e-9)
    np.testing.assert_allclose(c.T, T_1, atol=1e-9)
    assert c.K_left[0, 0] == pytest.approx(1.1 * K[0, 0])
    assert c.D_right.tolist() == pytest.approx([-0.3, 0.1, 0.001, 0.002, -0.05])
    assert rectify(c, FULL).rig.baseline == pytest.approx(np.linalg.norm(T_1))
    assert not read_calibration(path, "image_00", "image_01", SIZE).D_left.any()
    with pytest.raises(
        cs.InputError, match="the images have 10 x 20 px, but it is for 520 x 340 px, and for 480 x 320"
    ):
        read_calibration(path, "image_00", "image_01", (10, 20))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"P_rect_01": None}, "key 'P_rect_01' is missing"),
        ({"P_rect_01": "1 2 3"}, "key 'P_rect_01': must be 12 finite numbers"),
        ({"S_rect_00": "a b"}, "key 'S_rect_00': must be numbers"),
        ({"P_rect_00": " ".join(["0"] * 12)}, "matrix of its camera is singular"),
    ],
)
def test_an_unusable_calibration_of_kitti_raw(tmp_path: Path, changes: dict[str, str | None], said: str) -> None:
    path = tmp_path / "calib_cam_to_cam.txt"
    path.write_text(cam_to_cam(**changes))
    with pytest.raises(cs.InputError, match=said) as error:
        read_calibration(path, "image_00", "image_01", SIZE)
    assert str(error.value).startswith(str(path))


def test_an_unusable_drive_of_kitti_raw(day: Path, tmp_path: Path) -> None:
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


# --- BoofCV ----------------------------------------------------------------------------------------


def boofcv() -> dict[str, Any]:
    """What BoofCV writes of a stereo calibration."""
    lens = {"width": 640, "height": 480, "fx": 500.0, "fy": 501.0, "skew": 0.0, "cx": 320.0, "cy": 240.0}
    bend = {"radial": [-0.25, 0.1], "t1": 0.001, "t2": -0.002}
    camera = {"model": "pinhole_radial_tangential", "version": 0, "pinhole": lens, "radial_tangential": bend}
    R = rotation(0.01, -0.02, 0.015)
    pose = {"rotation": R.ravel().tolist(), "x": 0.12, "y": 0.001, "z": -0.002}
    parts = {"model": "stereo_camera", "version": 0, "left": camera, "right": camera, "rightToLeft": pose}
    apart: dict[str, Any] = json.loads(json.dumps(parts))  # YAML would write what both cameras share as an alias
    return apart


def write(path: Path, data: dict[str, Any]) -> Path:
    path.write_text("# Intrinsic and extrinsic parameters for a stereo camera pair\n" + yaml.safe_dump(data))
    return path


def test_a_calibration_of_boofcv(tmp_path: Path) -> None:
    c = read_calibration(write(tmp_path / "stereo.yaml", boofcv()))
    R, t = rotation(0.01, -0.02, 0.015), np.array([0.12, 0.001, -0.002])
    p = np.array([0.3, -0.2, 4.0])  # in the left camera
    np.testing.assert_allclose(c.R @ p + c.T, R.T @ (p - t), atol=1e-12)
    np.testing.assert_allclose(c.D_left, [-0.25, 0.1, 0.001, -0.002, 0.0])
    np.testing.assert_allclose(c.K_right, [[500, 0, 320], [0, 501, 240], [0, 0, 1]])
    assert c.image_size == (640, 480)


@pytest.mark.parametrize(
    ("place", "value", "said"),
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
def test_an_unusable_calibration_of_boofcv(tmp_path: Path, place: tuple[str, ...], value: Any, said: str) -> None:
    data = boofcv()
    part = data
    for key in place[:-1]:
        part = part[key]
    part[place[-1]] = value
    path = write(tmp_path / "stereo.yaml", data)
    with pytest.raises(cs.InputError, match=said) as error:
        read_calibration(path)
    assert str(error.value).startswith(str(path))
