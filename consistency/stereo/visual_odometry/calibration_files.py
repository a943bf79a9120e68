"""Stereo calibrations from files, as one record: KITTI, EuRoC / ASL, OpenCV and BoofCV.

OpenCV's files are not quite YAML, so that they have a reader of their own.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.extras import MissingPackageError, remedy
from consistency.referee.parsing import HUGE, one_line, read_text, reading
from consistency.referee.readers.formats.kitti_files import numbers, read_keys, turn
from consistency.referee.types import Array
from consistency.stereo.visual_odometry.arrays import opencv
from consistency.stereo.visual_odometry.rig import CAMERA_0, EUROC_BODY, PairCalibration, in_px

COUNTS = (4, 5, 8, 12, 14)  # distortion coefficients that OpenCV knows
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
OTHERS = {
    "R1", "R2", "P1", "P2", "Q", "E", "F", "essential_matrix", "fundamental_matrix", "LEFT.R", "LEFT.P", "RIGHT.R",
    "RIGHT.P", "projection_matrix_1", "projection_matrix_2", "rectification_matrix_1", "rectification_matrix_2",
    "image_size", "imageSize",
}  # fmt: skip
NUMBERS = {"K1": 9, "K2": 9, "R": 9, "T": 3}  # of matrices whose size is fixed
SIZE_KEYS = ("image_width", "image_height")
EUROC_KEYS = ("T_BS", "intrinsics", "distortion_model", "distortion_coefficients", "resolution")
NO_DISTORTION = ("none", "")
RADIAL_TANGENTIAL = ("radial-tangential", "radtan", "plumb_bob", *NO_DISTORTION)
UNREADABLE = "cannot be read as YAML"
LARGEST = 2**20  # bytes of a calibration
DEEPEST = 100  # brackets in brackets
_STACKED = re.compile(rf"(?:[-?:] ){{{DEEPEST}}}")  # lists in lists on one line
SIGNATURE = "%YAML"  # how a file of FileStorage begins: %YAML:1.0 up to OpenCV 4, %YAML 1.2 since
MATRIX = {"rows", "cols", "dt", "data"}  # keys of a matrix in it


def read_calibration(
    path: Path,
    left: str = "",
    right: str = "",
    image_size: tuple[int, int] | None = None,
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
            if "rightToLeft" in read_yaml(path):
                return read_boofcv(path)
            return read_opencv(path)
        if "P_rect_00:" in read_text(path, "cannot be read"):
            return read_kitti_raw(path, left, right, image_size)
        return read_kitti(path, left, right)


def read_opencv(path: Path) -> PairCalibration:
    """A YAML file as OpenCV's FileStorage writes it: K1, D1, K2, D2, R, T in Bouguet's convention.

    x_right = R x_left + T. D1 and D2 may be left out for images without distortion, R for rectified ones;
    ``image_width`` and ``image_height`` are optional. Other usual names of the same keys are taken as well. Where one
    of D1, D2 and R is left out, another list or matrix of an unknown name may be that one misspelt, and is refused.
    """
    keys = read_yaml(path)
    matrices = {"D1": np.zeros(4), "D2": np.zeros(4), "R": np.eye(3)}
    missing = []
    for key, names in OPENCV_KEYS.items():
        used = [name for name in names if name in keys]
        if used and key in NUMBERS:
            matrices[key] = keys.numbers(used[0], NUMBERS[key])
        elif used:
            matrices[key] = _distortion(keys, used[0])
        elif "T_BS" in keys:
            raise InputError(f"{path}: is one of the two files of EuRoC; --calibration takes the folder with both")
        elif key in ("K1", "K2", "T"):
            known = "; ".join(" = ".join(names) for names in OPENCV_KEYS.values())
            raise InputError(f"{path}: key '{key}' is missing; known keys: {known}, image_width, image_height")
        else:
            missing.append(key)
    _require_known(keys, missing)
    image_size = None
    if SIZE_KEYS[0] in keys:
        image_size = int(keys.number("image_width")), int(keys.number("image_height"))
    return PairCalibration(
        str(path),
        K_left=matrices["K1"].reshape(3, 3),
        K_right=matrices["K2"].reshape(3, 3),
        D_left=matrices["D1"],
        D_right=matrices["D2"],
        R=matrices["R"].reshape(3, 3),
        T=matrices["T"],
        image_size=image_size,
    )


def _distortion(keys: YamlKeys, name: str) -> Array:
    coefficients = keys.matrix(name).ravel()
    if coefficients.size not in COUNTS:
        counts = ", ".join(map(str, COUNTS))
        raise InputError(f"{keys.path}: key '{name}': has {coefficients.size} coefficients, not {counts}")
    return coefficients


def _require_known(keys: YamlKeys, missing: list[str]) -> None:
    known = OTHERS.union(*OPENCV_KEYS.values())
    for key, value in keys.values.items():
        if missing and key not in known and isinstance(value, dict | list | np.ndarray):
            names = " = ".join(OPENCV_KEYS[missing[0]])
            raise InputError(f"{keys.path}: key '{key}' is unknown while '{missing[0]}' is missing; known: {names}")
    lonely = [key for key in SIZE_KEYS if key in keys]
    if len(lonely) == 1:
        raise InputError(f"{keys.path}: key '{lonely[0]}': image_width and image_height go together")


def read_euroc(folder: Path) -> PairCalibration:
    """``sensor.yaml`` of both cameras of a EuRoC / ASL folder: mav0/cam0, cam0, or cam0_sensor.yaml beside cam0."""
    left = _euroc_camera(folder, "cam0")
    right = _euroc_camera(folder, "cam1")
    if left.size != right.size:
        raise InputError(f"{right.path}: key 'resolution': {right.size} is not that of {left.path}, {left.size}")
    right_from_left = np.linalg.solve(right.pose, left.pose)
    return PairCalibration(
        f"{left.path} and {right.path}",
        K_left=left.K,
        K_right=right.K,
        D_left=left.D,
        D_right=right.D,
        R=right_from_left[:3, :3],
        T=right_from_left[:3, 3],
        image_size=left.size,
        body_from_left=left.pose,
        body=EUROC_BODY,
    )


class _Camera(NamedTuple):
    path: Path
    K: Array  # (3, 3), px
    D: Array  # distortion
    size: tuple[int, int]  # width, height, px
    pose: Array  # (4, 4), T_BS: the camera in the body


def _euroc_camera(folder: Path, camera: str) -> _Camera:
    places = (
        folder / "mav0" / camera / "sensor.yaml",
        folder / camera / "sensor.yaml",
        folder / f"{camera}_sensor.yaml",
    )
    files = [place for place in places if place.is_file()]
    if not files:
        raise InputError(
            f"{folder}: holds no calibration of {camera}; expected {' or '.join(map(str, places))}; a calibration "
            "that is not EuRoC's is given as a file"
        )
    path = files[0]
    keys = read_yaml(path)
    for key in EUROC_KEYS:
        if key not in keys:
            raise InputError(f"{path}: key '{key}' is missing; needed: {', '.join(EUROC_KEYS)}")
    model = str(keys.values["distortion_model"]).lower()
    if model not in RADIAL_TANGENTIAL:
        raise InputError(f"{path}: key 'distortion_model': '{model}' is not one of {', '.join(RADIAL_TANGENTIAL)}")
    width, height = keys.numbers("resolution", 2).astype(int).tolist()
    return _Camera(
        path,
        K=_pinhole(*keys.numbers("intrinsics", 4)),
        D=_distortion(keys, "distortion_coefficients"),
        size=(width, height),
        pose=keys.numbers("T_BS", 16).reshape(4, 4),
    )


def _pinhole(fx: float, fy: float, cx: float, cy: float) -> Array:
    K = np.diag([fx, fy, 1.0])
    K[:2, 2] = cx, cy
    return K


def read_boofcv(path: Path) -> PairCalibration:
    """``stereo.yaml`` of BoofCV: left and right pin-hole cameras, rightToLeft with x_left = R x_right + (x, y, z)."""
    keys = read_yaml(path)
    K_left, D_left, size = _boofcv_camera(keys, "left")
    K_right, D_right, other = _boofcv_camera(keys, "right")
    pose = keys.table("rightToLeft")
    R = pose.numbers("rotation", 9).reshape(3, 3)
    t = np.array(list(map(pose.number, "xyz")))
    if size != other:
        raise InputError(f"{path}: left has {in_px(size)}, right {other[0]} x {other[1]}; must be equal")
    return PairCalibration(str(path), K_left, K_right, D_left, D_right, R.T, -R.T @ t, size)


def _boofcv_camera(keys: YamlKeys, side: str) -> tuple[Array, Array, tuple[int, int]]:
    camera = keys.table(side)
    model = camera.values.get("model")
    if model not in ("pinhole", "pinhole_radial_tangential"):
        raise InputError(
            f"{keys.path}: key '{side}.model': {one_line(str(model))} is not pinhole or pinhole_radial_tangential"
        )
    lens = camera.table("pinhole")
    fx, fy, cx, cy = map(lens.number, ("fx", "fy", "cx", "cy"))
    skew = lens.number("skew")
    size = int(lens.number("width")), int(lens.number("height"))
    if skew != 0.0:
        raise InputError(f"{keys.path}: key '{side}.pinhole.skew': {skew:g}, only 0 is taken; calibrate with zero skew")
    D = np.zeros(5)
    if model != "pinhole":
        bend = camera.table("radial_tangential")
        bend.values.setdefault("t1", 0.0)
        bend.values.setdefault("t2", 0.0)
        bend.values["radial"] = bend.values.get("radial") or 0.0
        radial = bend.matrix("radial").ravel()
        if radial.size > 3:
            raise InputError(
                f"{keys.path}: key '{side}.radial_tangential.radial': has {radial.size} numbers, 3 at most"
            )
        D[[0, 1, 4][: radial.size]] = radial
        D[2] = bend.number("t1")
        D[3] = bend.number("t2")
    return _pinhole(fx, fy, cx, cy), D, size


def read_kitti(path: Path, left: str = "", right: str = "") -> PairCalibration:
    """``calib.txt`` of KITTI odometry: lines ``P0:`` to ``P3:`` of 12 numbers, or two lines without names.

    P = K [I | t] of each camera in the common rectified axes; colour images (image_2, image_3) go with P2 and P3.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file")
    names = ("P0", "P1")
    if _are_colour(left, right):
        names = ("P2", "P3")
    return _projections(path, read_keys(path, unnamed="P"), names, None)


def _are_colour(left: str, right: str) -> bool:
    """Whether folders of images are those of KITTI's colour cameras."""
    return left.endswith("2") and right.endswith("3")


def _projections(
    path: Path,
    rows: dict[str, Array],
    names: tuple[str, str],
    size: tuple[int, int] | None,
    rectified: Array | None = None,
) -> PairCalibration:
    """Rectified cameras by their matrices P = K [I | t]; ``rectified`` (3, 3) turns camera 0 into their axes."""
    K_left, t_left = _projection(path, rows, names[0])
    K_right, t_right = _projection(path, rows, names[1])
    pose = None
    body = ""
    if rectified is not None:
        pose = _pose(rectified, t_left)
        body = CAMERA_0
    none = np.zeros(4)
    return PairCalibration(
        str(path),
        K_left,
        K_right,
        D_left=none,
        D_right=none,
        R=np.eye(3),
        T=t_right - t_left,
        image_size=size,
        body_from_left=pose,
        body=body,
    )


def _projection(path: Path, rows: dict[str, Array], name: str) -> tuple[Array, Array]:
    """K (3, 3) and t (3,) of the matrix P = K [I | t] of a rectified camera."""
    P = numbers(path, rows, name, (3, 4))
    K = P[:, :3]
    if np.linalg.matrix_rank(K) < 3:
        raise InputError(f"{path}: key '{name}': the matrix of its camera is singular; must be P = K [I | t]")
    return K, np.linalg.solve(K, P[:, 3])


def _pose(R: Array, t: Array) -> Array:
    """Pose (4, 4) in camera 0 of a camera with x = R x_0 + t."""
    pose = np.eye(4)
    pose[:3, :3] = R.T
    pose[:3, 3] = -R.T @ t
    return pose


def read_kitti_raw(
    path: Path,
    left: str = "",
    right: str = "",
    image_size: tuple[int, int] | None = None,
) -> PairCalibration:
    """``calib_cam_to_cam.txt`` of KITTI raw (Geiger et al. 2013), of image_00 and image_01 or image_02 and image_03.

    Images of ``image_size`` S_rect are rectified (``sync``) and have P_rect; those of size S (``extract``) have K, D, R
    and T, with x_i = R_i x_0 + T_i. Without a size they are taken as rectified. The body of the calibration is camera
    0, before rectification.
    """
    rows = read_keys(path)
    one, two = "00", "01"
    if _are_colour(left, right):
        one, two = "02", "03"
    raw = tuple(numbers(path, rows, f"S_{one}", (2,)).astype(int).tolist())
    rectified = tuple(numbers(path, rows, f"S_rect_{one}", (2,)).astype(int).tolist())
    if image_size in (None, rectified):
        axes = turn(path, rows, "R_rect_00")
        return _projections(path, rows, (f"P_rect_{one}", f"P_rect_{two}"), rectified, axes)
    if image_size != raw:
        raise InputError(
            f"{path}: the images have {in_px(image_size or raw)}, but it is for {in_px(raw)}, and for "
            f"{in_px(rectified)} rectified"
        )
    left_camera = _raw_camera(path, rows, one)
    right_camera = _raw_camera(path, rows, two)
    R = right_camera.R @ left_camera.R.T
    return PairCalibration(
        str(path),
        K_left=left_camera.K,
        K_right=right_camera.K,
        D_left=left_camera.D,
        D_right=right_camera.D,
        R=R,
        T=right_camera.T - R @ left_camera.T,
        image_size=raw,
        body_from_left=_pose(left_camera.R, left_camera.T),
        body=CAMERA_0,
    )


class _RawCamera(NamedTuple):
    K: Array  # (3, 3), px
    D: Array  # (5,), distortion
    R: Array  # (3, 3), x = R x_0 + T
    T: Array  # (3,), m


def _raw_camera(path: Path, rows: dict[str, Array], name: str) -> _RawCamera:
    return _RawCamera(
        K=numbers(path, rows, f"K_{name}", (3, 3)),
        D=numbers(path, rows, f"D_{name}", (5,)),
        R=turn(path, rows, f"R_{name}"),
        T=numbers(path, rows, f"T_{name}", (3,)),
    )


@dataclass(frozen=True)
class YamlKeys:
    """Keys of a YAML file, or of a table in it; errors name file and key.

    Values are numbers, text, lists, tables and, of FileStorage, arrays.
    """

    path: Path
    values: dict[str, Any]
    outer: str = ""  # names of the tables around these keys, each with a point behind it

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def table(self, key: str) -> YamlKeys:
        """The keys below a key."""
        value = self.values.get(key)
        if not isinstance(value, dict):
            raise InputError(f"{self.path}: key '{self.outer}{key}' is missing, or holds no keys of its own")
        return YamlKeys(self.path, value, f"{self.outer}{key}.")

    def matrix(self, key: str) -> Array:
        """Numbers of a key: a number, a list, an array, or a table with rows, cols and data."""
        value = self.values.get(key)
        where = f"{self.path}: key '{self.outer}{key}'"
        try:
            if isinstance(value, dict):
                shape = int(value["rows"]), int(value["cols"])
                numbers = _floats(value["data"]).reshape(shape)
            else:
                numbers = _floats(value)
        except (KeyError, TypeError, ValueError, OverflowError):
            raise InputError(f"{where}: must be numbers, or a matrix with rows, cols and data") from None
        if not (np.abs(numbers) < HUGE).all():
            raise InputError(f"{where}: holds a number that is not finite")
        return numbers

    def numbers(self, key: str, count: int) -> Array:
        """The ``count`` numbers of a key, (count,)."""
        numbers = self.matrix(key).ravel()
        if numbers.size != count:
            raise InputError(f"{self.path}: key '{self.outer}{key}': has {numbers.size} numbers, not {count}")
        return numbers

    def number(self, key: str) -> float:
        """The only number of a key."""
        return float(self.numbers(key, 1)[0])


def _floats(value: Any) -> Array:
    return np.asarray(value, dtype=object).ravel().astype(float)


def read_yaml(path: Path) -> YamlKeys:
    """The keys of a YAML file, by OpenCV where FileStorage has written it.

    Raises
    ------
    InputError
        PyYAML or OpenCV is not installed, or the file is not YAML with keys.
    """
    text = read_text(path, UNREADABLE, LARGEST)
    with reading(path, UNREADABLE):
        _require_shallow(text)
    parse = _plain
    if text.startswith(SIGNATURE):
        parse = _stored
    data = parse(path, text)
    if not isinstance(data, dict):
        raise InputError(f"{path}: holds no 'key: value' lines")
    return YamlKeys(path, {str(key): value for key, value in data.items()})


def _require_shallow(text: str) -> None:
    """Refuse what parsers would be slow at, or call themselves too often for."""
    depth = max(accumulate((char in "[{") - (char in "]}") for char in text), default=0)
    if depth > DEEPEST or _STACKED.search(text):
        raise RecursionError


def _plain(path: Path, text: str) -> Any:
    try:
        import yaml
    except ImportError:
        raise MissingPackageError(f"{path}: YAML needs {remedy('vision', package='pyyaml')}") from None
    with reading(path, UNREADABLE):
        if any(isinstance(token, yaml.AliasToken) for token in yaml.scan(text)):
            raise ValueError("aliases (*name) are not followed; write their values")  # a few lines hold 10^9 of them
        return yaml.load(text, Loader=_once(yaml))


def _once(yaml: Any) -> Any:
    """PyYAML's safe loader, which refuses a key that is duplicated."""

    class Once(yaml.SafeLoader):  # type: ignore[misc]
        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            keys = [self.construct_object(key, deep=True) for key, _ in node.value]
            if twice := [key for key in keys if keys.count(key) > 1]:
                raise ValueError(f"key '{twice[0]}' is duplicated")
            return super().construct_mapping(node, deep)

    return Once


def _stored(path: Path, text: str) -> Any:
    cv2 = opencv()
    with reading(path, UNREADABLE):
        try:
            # the text and not the path, which OpenCV cannot open on Windows where it is not ASCII
            storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
            return _value(cv2, storage.root())
        except SystemError as error:  # from the constructor, with OpenCV's as its cause
            raise error.__cause__ or error from None


def _value(cv2: Any, node: Any) -> Any:
    """Numbers, text, list, dict or array of a node; None for an empty node."""
    if node.isMap():
        if set(node.keys()) >= MATRIX:
            try:
                return node.mat()
            except cv2.error:
                return {}  # a table without numbers, which is refused when they are asked for
        return {key: _value(cv2, node.getNode(key)) for key in node.keys()}  # noqa: SIM118, no dict
    if node.isSeq():
        return [_value(cv2, node.at(i)) for i in range(node.size())]
    if node.isInt() or node.isReal():
        return node.real()
    if node.isString():
        return node.string()
    return None
