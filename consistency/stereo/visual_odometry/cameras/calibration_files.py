"""Stereo calibrations from files: KITTI odometry and raw, EuRoC / ASL, OpenCV, BoofCV, as one record."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.parsing import one_line, read_text, reading
from consistency.referee.readers.formats.kitti_files import numbers, read_keys, turn
from consistency.referee.types import Array
from consistency.stereo.visual_odometry.cameras.camera_pair import (
    CAMERA_0,
    EUROC_BODY,
    PairCalibration,
    checked_calibration,
    distortion,
    sized,
)
from consistency.stereo.visual_odometry.cameras.yaml_file import read_matrix, read_yaml

# names that tools give to the same thing; the first one is used in messages
OPENCV_KEYS = {
    "K1": ("K1", "camera_matrix_1", "cameraMatrix1", "K_left", "left_K", "M1", "LEFT.K"),
    "D1": ("D1", "distortion_coefficients_1", "distCoeffs1", "D_left", "left_D", "LEFT.D"),
    "K2": ("K2", "camera_matrix_2", "cameraMatrix2", "K_right", "right_K", "M2", "RIGHT.K"),
    "D2": ("D2", "distortion_coefficients_2", "distCoeffs2", "D_right", "right_D", "RIGHT.D"),
    "R": ("R", "rotation_matrix", "R_stereo"),
    "T": ("T", "translation_coefficients", "translation_vector", "T_stereo"),
}
# matrices that the same tools write beside them and nobody needs here
OTHERS = {"R1", "R2", "P1", "P2", "Q", "E", "F", "essential_matrix", "fundamental_matrix", "LEFT.R", "LEFT.P"}
OTHERS |= {"RIGHT.R", "RIGHT.P", "projection_matrix_1", "projection_matrix_2", "rectification_matrix_1"}
OTHERS |= {"rectification_matrix_2", "image_size", "imageSize"}
EUROC_KEYS = ("T_BS", "intrinsics", "distortion_model", "distortion_coefficients", "resolution")
NO_DISTORTION = ("none", "")
RADIAL_TANGENTIAL = ("radial-tangential", "radtan", "plumb_bob", *NO_DISTORTION)


def read_calibration(
    path: Path, left: str = "", right: str = "", image_size: tuple[int, int] | None = None
) -> PairCalibration:
    """A calibration by the look of ``path``: a folder as EuRoC's, .yaml or .yml as OpenCV's or BoofCV's, else KITTI's.

    ``left`` and ``right`` are the folders of the images: they choose the cameras in a KITTI file. ``image_size``,
    (width, height), tells whether the images of KITTI raw are rectified.

    Raises
    ------
    InputError
        The file is missing or damaged, a key is missing or unknown, a number is not finite, a rotation is none.
    """
    with reading(path, "holds no calibration of two cameras"):
        if path.is_dir():
            return read_euroc(path)
        if not path.is_file():
            raise InputError(f"--calibration {path}: no such file")
        if path.suffix.lower() in (".yaml", ".yml"):
            return read_boofcv(path) if "rightToLeft" in read_yaml(path) else read_opencv(path)
        if "P_rect_00:" in read_text(path, "cannot be read"):
            return read_kitti_raw(path, left, right, image_size)
        return read_kitti(path, left, right)


def read_opencv(path: Path) -> PairCalibration:
    """A YAML file as OpenCV's FileStorage writes it: K1, D1, K2, D2, R, T in Bouguet's convention.

    x_right = R x_left + T. D1 and D2 may be left out for images without distortion, R for rectified ones;
    ``image_width`` and ``image_height`` are optional. Other usual names of the same keys are taken as well. Where one
    of D1, D2 and R is left out, another list or matrix of an unknown name may be that one misspelt, and is refused.
    """
    data = read_yaml(path)
    matrices: dict[str, Array] = {}
    for key, names in OPENCV_KEYS.items():
        name = next((name for name in names if name in data), None)
        if name is not None:
            matrices[key] = read_matrix(path, name, data[name])
        elif "T_BS" in data:
            raise InputError(f"{path}: is one of the two files of EuRoC; --calibration takes the folder with both")
        elif key in ("K1", "K2", "T"):
            known = "; ".join(" = ".join(names) for names in OPENCV_KEYS.values())
            raise InputError(f"{path}: key '{key}' is missing; known keys: {known}, image_width, image_height")
    _require_known(path, data, [key for key in ("D1", "D2", "R") if key not in matrices])
    for key, shape in (("K1", (3, 3)), ("K2", (3, 3)), ("R", (3, 3)), ("T", (3,))):
        if key in matrices:
            if matrices[key].size != np.prod(shape):
                raise InputError(f"{path}: key '{key}': has {matrices[key].size} numbers, not {np.prod(shape)}")
            matrices[key] = matrices[key].reshape(shape)
    size = tuple(int(_number(path, data, key)) for key in ("image_width", "image_height") if key in data)
    D_left, D_right = (distortion(path, key, matrices.get(key, np.zeros(4))) for key in ("D1", "D2"))
    R, image_size = matrices.get("R", np.eye(3)), (size[0], size[1]) if len(size) == 2 else None
    return checked_calibration(
        PairCalibration(str(path), matrices["K1"], matrices["K2"], D_left, D_right, R, matrices["T"], image_size)
    )


def read_euroc(folder: Path) -> PairCalibration:
    """``sensor.yaml`` of both cameras of a EuRoC / ASL folder: mav0/cam0, cam0, or cam0_sensor.yaml beside cam0."""
    left, right = (_euroc_camera(folder, camera) for camera in ("cam0", "cam1"))
    if left.size != right.size:
        raise InputError(f"{right.path}: key 'resolution': {right.size} is not that of {left.path}, {left.size}")
    right_from_left = np.linalg.solve(right.pose, left.pose)
    R, T = right_from_left[:3, :3], right_from_left[:3, 3]
    source = f"{left.path} and {right.path}"
    return checked_calibration(
        PairCalibration(source, left.K, right.K, left.D, right.D, R, T, left.size, left.pose, EUROC_BODY)
    )


class _Camera(NamedTuple):
    path: Path
    K: Array  # (3, 3), px
    D: Array  # distortion
    size: tuple[int, int]  # width, height, px
    pose: Array  # (4, 4), T_BS: the camera in the body


def _euroc_camera(folder: Path, camera: str) -> _Camera:
    places = [folder / "mav0" / camera / "sensor.yaml", folder / camera / "sensor.yaml"]
    places.append(folder / f"{camera}_sensor.yaml")
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        raise InputError(
            f"{folder}: holds no calibration of {camera}; expected {' or '.join(map(str, places))}; a calibration "
            "that is not EuRoC's is given as a file"
        )
    data = read_yaml(path)
    for key in EUROC_KEYS:
        if key not in data:
            raise InputError(f"{path}: key '{key}' is missing; needed: {', '.join(EUROC_KEYS)}")
    model = str(data["distortion_model"]).lower()
    if model not in RADIAL_TANGENTIAL:
        raise InputError(f"{path}: key 'distortion_model': '{model}' is not one of {', '.join(RADIAL_TANGENTIAL)}")
    fu, fv, cu, cv = sized(path, "intrinsics", data["intrinsics"], 4)
    width, height = sized(path, "resolution", data["resolution"], 2)
    K = np.array([[fu, 0.0, cu], [0.0, fv, cv], [0.0, 0.0, 1.0]])
    D = distortion(path, "distortion_coefficients", read_matrix(path, "D", data["distortion_coefficients"]))
    return _Camera(path, K, D, (int(width), int(height)), sized(path, "T_BS", data["T_BS"], 16).reshape(4, 4))


def _require_known(path: Path, data: dict[str, Any], missing: list[str]) -> None:
    known = OTHERS.union(*OPENCV_KEYS.values())
    strange = [key for key, value in data.items() if isinstance(value, dict | list | np.ndarray) and key not in known]
    if missing and strange:
        names = " = ".join(OPENCV_KEYS[missing[0]])
        raise InputError(f"{path}: key '{strange[0]}' is unknown while '{missing[0]}' is missing; known: {names}")
    lonely = [key for key in ("image_width", "image_height") if key in data]
    if len(lonely) == 1:
        raise InputError(f"{path}: key '{lonely[0]}': image_width and image_height go together")


def _number(path: Path, data: dict[str, Any], key: str) -> float:
    return float(sized(path, key, data[key], 1)[0])


def read_boofcv(path: Path) -> PairCalibration:
    """``stereo.yaml`` of BoofCV: left and right pin-hole cameras, rightToLeft with x_left = R x_right + (x, y, z)."""
    data = read_yaml(path)
    cameras = [_boofcv_camera(path, data, side) for side in ("left", "right")]
    pose = _part(path, data, "rightToLeft")
    R = sized(path, "rightToLeft.rotation", pose.get("rotation"), 9).reshape(3, 3)
    t = np.array([float(sized(path, f"rightToLeft.{key}", pose.get(key), 1)[0]) for key in "xyz"])
    (K_left, D_left, size), (K_right, D_right, other) = cameras
    if size != other:
        raise InputError(f"{path}: left has {size[0]} x {size[1]} px, right {other[0]} x {other[1]}; must be equal")
    return checked_calibration(PairCalibration(str(path), K_left, K_right, D_left, D_right, R.T, -R.T @ t, size))


def _boofcv_camera(path: Path, data: dict[str, Any], side: str) -> tuple[Array, Array, tuple[int, int]]:
    camera = _part(path, data, side)
    model = camera.get("model")
    if model not in ("pinhole", "pinhole_radial_tangential"):
        raise InputError(
            f"{path}: key '{side}.model': {one_line(str(model))} is not pinhole or pinhole_radial_tangential"
        )
    lens = _part(path, camera, "pinhole", f"{side}.")
    keys = ("fx", "fy", "cx", "cy", "skew", "width", "height")
    fx, fy, cx, cy, skew, width, height = (
        float(sized(path, f"{side}.pinhole.{key}", lens.get(key), 1)[0]) for key in keys
    )
    if skew != 0.0:
        raise InputError(f"{path}: key '{side}.pinhole.skew': {skew:g}, only 0 is taken; calibrate with zero skew")
    D = np.zeros(5)
    if model != "pinhole":
        bend = _part(path, camera, "radial_tangential", f"{side}.")
        radial = read_matrix(path, f"{side}.radial_tangential.radial", bend.get("radial") or [0.0]).ravel()
        if radial.size > 3:
            raise InputError(f"{path}: key '{side}.radial_tangential.radial': has {radial.size} numbers, 3 at most")
        D[[0, 1, 4][: radial.size]] = radial
        D[2:4] = [
            float(sized(path, f"{side}.radial_tangential.{key}", bend.get(key, 0.0), 1)[0]) for key in ("t1", "t2")
        ]
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), D, (int(width), int(height))


def _part(path: Path, data: dict[str, Any], key: str, before: str = "") -> dict[str, Any]:
    part = data.get(key)
    if not isinstance(part, dict):
        raise InputError(f"{path}: key '{before}{key}' is missing, or holds no keys of its own")
    return part


def read_kitti(path: Path, left: str = "", right: str = "") -> PairCalibration:
    """``calib.txt`` of KITTI odometry: lines ``P0:`` to ``P3:`` of 12 numbers, or two lines without names.

    P = K [I | t] of each camera in the common rectified axes; colour images (image_2, image_3) go with P2 and P3.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file")
    names = ("P2", "P3") if left.endswith("2") and right.endswith("3") else ("P0", "P1")
    return _projections(path, read_keys(path, unnamed="P"), names, None)


def _projections(
    path: Path,
    rows: dict[str, Array],
    names: tuple[str, str],
    size: tuple[int, int] | None,
    rectified: Array | None = None,
) -> PairCalibration:
    """Rectified cameras by their matrices P = K [I | t]; ``rectified`` (3, 3) turns camera 0 into their axes."""
    P_left, P_right = (numbers(path, rows, name, (3, 4)) for name in names)
    for name, P in zip(names, (P_left, P_right), strict=True):
        if np.linalg.matrix_rank(P[:, :3]) < 3:
            raise InputError(f"{path}: key '{name}': the matrix of its camera is singular; must be P = K [I | t]")
    t_left, t_right = (np.linalg.solve(P[:, :3], P[:, 3]) for P in (P_left, P_right))
    none = np.zeros(4)
    body = (None, "") if rectified is None else (_pose(rectified, t_left), CAMERA_0)
    return checked_calibration(
        PairCalibration(str(path), P_left[:, :3], P_right[:, :3], none, none, np.eye(3), t_right - t_left, size, *body)
    )


def _pose(R: Array, t: Array) -> Array:
    """Pose (4, 4) in camera 0 of a camera with x = R x_0 + t."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R.T, -R.T @ t
    return pose


def read_kitti_raw(
    path: Path, left: str = "", right: str = "", image_size: tuple[int, int] | None = None
) -> PairCalibration:
    """``calib_cam_to_cam.txt`` of KITTI raw (Geiger et al. 2013), of image_00 and image_01 or image_02 and image_03.

    Images of ``image_size`` S_rect are rectified (``sync``) and have P_rect; those of size S (``extract``) have K, D, R
    and T, with x_i = R_i x_0 + T_i. Without a size they are taken as rectified. The body of the calibration is camera
    0, before rectification.
    """
    rows = read_keys(path)
    two = ("02", "03") if left.endswith("2") and right.endswith("3") else ("00", "01")
    sizes = {
        name: tuple(numbers(path, rows, f"{name}_{two[0]}", (2,)).astype(int).tolist()) for name in ("S", "S_rect")
    }
    if image_size in (None, sizes["S_rect"]):
        axes = turn(path, rows, "R_rect_00")
        return _projections(path, rows, (f"P_rect_{two[0]}", f"P_rect_{two[1]}"), sizes["S_rect"], axes)
    if image_size != sizes["S"]:
        found, raw, rectified = (f"{w} x {h} px" for w, h in (image_size or (0, 0), sizes["S"], sizes["S_rect"]))
        raise InputError(f"{path}: the images have {found}, but it is for {raw}, and for {rectified} rectified")
    K, D, T = ([numbers(path, rows, f"{name}_{camera}", shape) for camera in two]
               for name, shape in (("K", (3, 3)), ("D", (5,)), ("T", (3,))))  # fmt: skip
    R = [turn(path, rows, f"R_{camera}") for camera in two]
    between = R[1] @ R[0].T
    return checked_calibration(
        PairCalibration(
            str(path), K[0], K[1], D[0], D[1], between, T[1] - between @ T[0], sizes["S"], _pose(R[0], T[0]), CAMERA_0
        )
    )  # fmt: skip
