"""Stereo calibrations from files: KITTI odometry, EuRoC / ASL, OpenCV. Whatever they hold becomes one record."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from consistency.errors import InputError
from consistency.reading import HUGE, one_line, read_text, reading
from consistency.types import Array
from consistency.vision.yaml_file import matrix, read_yaml

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
WIDEST = 30.0  # m between two cameras on one rig; calibrations are often in millimetres by mistake
COUNTS = (4, 5, 8, 12, 14)  # distortion coefficients that OpenCV knows
EUROC_KEYS = ("T_BS", "intrinsics", "distortion_model", "distortion_coefficients", "resolution")
NO_DISTORTION = ("none", "")
RADIAL_TANGENTIAL = ("radial-tangential", "radtan", "plumb_bob", *NO_DISTORTION)


@dataclass(frozen=True)
class Calibration:
    """Two cameras as calibrated, before any rectification."""

    source: str  # file or files, for messages
    K_left: Array  # (3, 3), px
    K_right: Array  # (3, 3), px
    D_left: Array  # (k,), k1 k2 p1 p2 ... of OpenCV, all 0 for images without distortion
    D_right: Array
    R: Array  # (3, 3), x_right = R x_left + T (Bouguet's convention, OpenCV's)
    T: Array  # (3,), m
    image_size: tuple[int, int] | None  # width, height, px; None where the file does not say
    body_from_left: Array | None = None  # (4, 4), pose of the left camera in the body that a truth is of


def read_calibration(path: Path, left: str = "", right: str = "") -> Calibration:
    """A calibration by the look of ``path``: a folder as EuRoC's, .yaml or .yml as OpenCV's, else KITTI's text.

    ``left`` and ``right`` are the folders of the images: they choose P0 and P1 or P2 and P3 in a KITTI file.

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
            return read_opencv(path)
        return read_kitti(path, left, right)


def read_kitti(path: Path, left: str = "", right: str = "") -> Calibration:
    """``calib.txt`` of KITTI odometry: lines ``P0:`` to ``P3:`` of 12 numbers, or two lines without names.

    P = K [I | t] of each camera in the common rectified axes; colour images (image_2, image_3) go with P2 and P3.
    """
    rows: dict[str, Array] = {}
    if not path.exists():
        raise InputError(f"{path}: no such file")
    lines = [line for line in read_text(path, "cannot be read").splitlines() if line.strip()]
    for number, line in enumerate(lines):
        key, _, values = line.rpartition(":")
        name = key.strip() or f"P{number}"
        if name in rows:
            raise InputError(f"{path}: key '{one_line(name)}' is there twice")
        try:
            rows[name] = np.array(values.split(), float)
        except ValueError:
            raise InputError(f"{path}: line {number + 1}: must be 'P0:' and 12 numbers, or 12 numbers") from None
    names = ("P2", "P3") if left.endswith("2") and right.endswith("3") else ("P0", "P1")
    for name in names:
        if name not in rows:
            raise InputError(f"{path}: key '{name}' is missing; there: {one_line(', '.join(rows)) or 'nothing'}")
        if rows[name].size != 12 or not (np.abs(rows[name]) < HUGE).all():
            raise InputError(f"{path}: key '{name}': must be 12 finite numbers, P (3 x 4) row by row")
        if np.linalg.matrix_rank(rows[name].reshape(3, 4)[:, :3]) < 3:
            raise InputError(f"{path}: key '{name}': the matrix of its camera is singular; must be P = K [I | t]")
    P_left, P_right = (rows[name].reshape(3, 4) for name in names)
    T = np.linalg.solve(P_right[:, :3], P_right[:, 3]) - np.linalg.solve(P_left[:, :3], P_left[:, 3])
    none = np.zeros(4)
    return _checked(Calibration(str(path), P_left[:, :3], P_right[:, :3], none, none, np.eye(3), T, None))


def read_opencv(path: Path) -> Calibration:
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
            matrices[key] = matrix(path, name, data[name])
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
    D_left, D_right = (_distortion(path, key, matrices.get(key, np.zeros(4))) for key in ("D1", "D2"))
    R, image_size = matrices.get("R", np.eye(3)), (size[0], size[1]) if len(size) == 2 else None
    return _checked(
        Calibration(str(path), matrices["K1"], matrices["K2"], D_left, D_right, R, matrices["T"], image_size)
    )


def read_euroc(folder: Path) -> Calibration:
    """``sensor.yaml`` of both cameras of a EuRoC / ASL folder: mav0/cam0, cam0, or cam0_sensor.yaml beside cam0."""
    left, right = (_euroc_camera(folder, camera) for camera in ("cam0", "cam1"))
    if left.size != right.size:
        raise InputError(f"{right.path}: key 'resolution': {right.size} is not that of {left.path}, {left.size}")
    right_from_left = np.linalg.solve(right.pose, left.pose)
    R, T = right_from_left[:3, :3], right_from_left[:3, 3]
    source = f"{left.path} and {right.path}"
    return _checked(Calibration(source, left.K, right.K, left.D, right.D, R, T, left.size, left.pose))


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
    fu, fv, cu, cv = _sized(path, "intrinsics", data["intrinsics"], 4)
    width, height = _sized(path, "resolution", data["resolution"], 2)
    K = np.array([[fu, 0.0, cu], [0.0, fv, cv], [0.0, 0.0, 1.0]])
    D = _distortion(path, "distortion_coefficients", matrix(path, "D", data["distortion_coefficients"]))
    return _Camera(path, K, D, (int(width), int(height)), _sized(path, "T_BS", data["T_BS"], 16).reshape(4, 4))


def _checked(calibration: Calibration) -> Calibration:
    """The calibration, if its numbers can be those of two cameras side by side."""
    where = calibration.source
    for name, K in (("left", calibration.K_left), ("right", calibration.K_right)):
        upper = np.allclose(K[1:, 0], 0) and np.isclose(K[2, 1], 0) and np.isclose(K[2, 2], 1)
        if not upper or K[0, 0] <= 0 or K[1, 1] <= 0:
            raise InputError(
                f"{where}: the matrix of the {name} camera must be fx 0 cx, 0 fy cy, 0 0 1 with fx, fy > 0"
            )
    calibration = replace(calibration, R=_rotation(where, calibration.R))
    centre = -calibration.R.T @ calibration.T
    if centre[0] <= 0 or abs(centre[1]) > centre[0]:
        raise InputError(
            f"{where}: the right camera stands at {np.round(centre, 3).tolist()} m of the left one, not to its right: "
            "T is that of x_right = R x_left + T, in metres; are the cameras swapped?"
        )
    if centre[0] > WIDEST:
        raise InputError(
            f"{where}: the right camera stands {centre[0]:g} m from the left one; T is in metres, is it in millimetres?"
        )
    return calibration


def _require_known(path: Path, data: dict[str, Any], missing: list[str]) -> None:
    known = OTHERS.union(*OPENCV_KEYS.values())
    strange = [key for key, value in data.items() if isinstance(value, dict | list | np.ndarray) and key not in known]
    if missing and strange:
        names = " = ".join(OPENCV_KEYS[missing[0]])
        raise InputError(f"{path}: key '{strange[0]}' is unknown while '{missing[0]}' is missing; known: {names}")
    lonely = [key for key in ("image_width", "image_height") if key in data]
    if len(lonely) == 1:
        raise InputError(f"{path}: key '{lonely[0]}': image_width and image_height go together")


def _rotation(where: str, R: Array) -> Array:
    """The rotation nearest to ``R``; calibrations print six digits or more."""
    U, singular, Vt = np.linalg.svd(R)
    if not np.allclose(singular, 1.0, atol=1e-3) or np.linalg.det(R) < 0:
        raise InputError(f"{where}: the rotation between the cameras is not one (singular values {singular.round(4)})")
    return np.asarray(U @ Vt)


def _distortion(path: Path, key: str, values: Array) -> Array:
    values = values.ravel()
    if values.size not in COUNTS:
        raise InputError(f"{path}: key '{key}': has {values.size} coefficients, not {', '.join(map(str, COUNTS))}")
    return values


def _sized(path: Path, key: str, value: Any, count: int) -> Array:
    numbers = matrix(path, key, value).ravel()
    if numbers.size != count:
        raise InputError(f"{path}: key '{key}': has {numbers.size} numbers, not {count}")
    return numbers


def _number(path: Path, data: dict[str, Any], key: str) -> float:
    return float(_sized(path, key, data[key], 1)[0])
