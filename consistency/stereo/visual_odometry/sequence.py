"""Sequences of stereo pairs on disk: KITTI odometry and raw, EuRoC / ASL, or plain folders with a calibration."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.parsing import HUGE, is_file, read_text, reading
from consistency.referee.readers.formats.kitti_files import NANO, place_of, read_times
from consistency.referee.types import Array
from consistency.stereo.visual_odometry.arrays import opencv
from consistency.stereo.visual_odometry.calibration_files import read_calibration
from consistency.stereo.visual_odometry.rig import (
    PairCalibration,
    Rectification,
    StereoRig,
    in_px,
    is_rectified,
    rectify,
)

BothSides: TypeAlias = tuple[list[Path], list[Path]]  # images of the left and of the right camera
FORMATS = ("kitti", "kitti-raw", "euroc", "opencv")
KITTI_PAIRS = (("image_0", "image_1"), ("image_2", "image_3"), ("image_l", "image_r"))
RAW_PAIRS = (("image_00", "image_01"), ("image_02", "image_03"))
RAW_CALIBRATION = "calib_cam_to_cam.txt"  # in the folder of the day, one above a drive's
SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm")
RATE = 10.0  # Hz, of images without timestamps: KITTI's, and a choice elsewhere
FEWEST = 2  # stereo pairs


@dataclass(frozen=True)
class StereoSequence:
    """Stereo pairs in the order of time; images are read when they are asked for."""

    folder: Path
    format: str  # one of FORMATS
    left: list[Path]
    right: list[Path]
    t: Array  # (n,), s, increasing
    timed: bool  # whether ``t`` was read, else it is a matter of the rate
    calibration: PairCalibration
    rectification: Rectification

    def __len__(self) -> int:
        return len(self.left)

    @property
    def uvd_rig(self) -> StereoRig:
        """The rig of the rectified images, side by side as the cameras of a sensor ``uvd``; else InputError."""
        rig = self.rectification.rig
        if not is_rectified(rig):
            raise InputError(f"{self.calibration.source}: the cameras do not stand side by side; no uvd sensor does")
        return rig

    def pair(self, frame: int) -> tuple[Array, Array]:
        """Rectified grey images (h, w) of a frame.

        Raises
        ------
        InputError
            An image cannot be read or has another size than the first one.
        """
        size = self.rectification.rig.image_size
        left = read_image(self.left[frame], size)
        right = read_image(self.right[frame], size)
        return self.rectification.apply(left, right)

    def __iter__(self) -> Iterator[tuple[Array, Array]]:
        return (self.pair(frame) for frame in range(len(self)))


def read_sequence(
    folder: Path,
    calibration: Path | None = None,
    format: str | None = None,
    left: str | None = None,
    right: str | None = None,
    rate: float | None = None,
) -> StereoSequence:
    """The stereo pairs of a folder and their calibration.

    Parameters
    ----------
    folder : KITTI: image_0 and image_1 (or image_2 and image_3, image_l and image_r), times.txt, calib.txt;
        KITTI raw: a drive with image_00/data and image_01/data (or 02 and 03) and their timestamps.txt, in the folder
        of a day with calib_cam_to_cam.txt;
        EuRoC: mav0/cam0 and mav0/cam1 with data.csv and data, or cam0 and cam1 with images named by nanoseconds
    calibration : file, or a folder for EuRoC; None where the layout holds it
    format : one of FORMATS; None to find out by the folders that are there
    left, right : for ``opencv``: patterns below ``folder``, such as ``left/*.png``; None for left and right as
        folders, or as the beginning of the names
    rate : Hz, for images without timestamps

    Raises
    ------
    InputError
        No such layout, fewer than two pairs, an image without its partner, a gap in the numbers of images without
        timestamps, an unreadable image or calibration.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of images")
    if format not in (None, *FORMATS):
        raise InputError(f"--format {format}: must be one of {', '.join(FORMATS)}")
    if rate is not None and not (np.isfinite(rate) and rate > 0):
        raise InputError(f"--rate {rate}: must be a positive number of Hz")
    if (left is None) != (right is None):
        raise InputError("--left and --right go together: patterns of the left and of the right images")
    kind = format
    if kind is None:
        kind = "opencv"
        if left is None:
            kind = _recognised(folder)
    home = None
    t = None
    if kind == "kitti":
        files = _kitti(folder)
        t = _kitti_times(folder)
        home = folder / "calib.txt"
    elif kind == "kitti-raw":
        files, t = _kitti_raw(folder)
        home = place_of(folder, RAW_CALIBRATION) or folder.absolute().parent / RAW_CALIBRATION
    elif kind == "euroc":
        files, t = _euroc(folder)
        home = folder
    else:
        files = _plain(folder, left, right)
    home = calibration or home
    if home is None:
        raise InputError(f"{folder}: plain images need --calibration FILE, an OpenCV YAML or a KITTI calib.txt")
    _require_pairs(folder, files, t)
    timed = t is not None
    if t is None:
        _require_no_gap(files[0])
        t = np.arange(len(files[0])) / (rate or RATE)
    size = read_image(files[0][0]).shape[::-1]
    folders = [side[0].parent for side in files]
    if kind == "kitti-raw":  # whose images are one deeper, in ``data``
        folders = [folder.parent for folder in folders]
    cameras = read_calibration(home, folders[0].name, folders[1].name, size)
    with reading(cameras.source, "its cameras cannot be rectified"):
        rectification = rectify(cameras, size)
    return StereoSequence(folder, kind, *files, t, timed, cameras, rectification)


def read_image(path: str | Path, size: tuple[int, int] | None = None) -> Array:
    """An image as 8-bit grey (h, w); with ``size`` (width, height) it must have it.

    Raises
    ------
    InputError
        There is no such file, it is not an image, or it has another size.
    """
    cv2 = opencv()
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such image")
    try:
        image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE)
    except (OSError, cv2.error):
        image = None
    if image is None:
        raise InputError(f"{path}: cannot be read as an image; damaged or of an unknown format")
    if size is not None and image.shape[::-1] != tuple(size):
        there = in_px(image.shape[::-1])
        raise InputError(f"{path}: has {there}, other images {in_px(size)}; all must have one size")
    return image


def _recognised(folder: Path) -> str:
    if _pair_of(folder, KITTI_PAIRS):
        return "kitti"
    if _pair_of(folder, RAW_PAIRS):
        return "kitti-raw"
    if (folder / "mav0").is_dir() or (folder / "cam0").is_dir():
        return "euroc"
    return "opencv"


def _pair_of(folder: Path, pairs: tuple[tuple[str, str], ...]) -> tuple[str, str] | None:
    """The first two cameras that have folders of their own."""
    for one, two in pairs:
        if (folder / one).is_dir() and (folder / two).is_dir():
            return one, two
    return None


def _required_pair(folder: Path, pairs: tuple[tuple[str, str], ...]) -> tuple[str, str]:
    if pair := _pair_of(folder, pairs):
        return pair
    raise InputError(f"{folder}: holds no folders {' or '.join(' and '.join(pair) for pair in pairs)}")


def _images(folder: Path, pattern: str = "*") -> list[Path]:
    found = []
    for path in folder.glob(pattern):
        if path.suffix.lower() in SUFFIXES and not path.name.startswith("."):
            found.append(path)
    return sorted(found)


def _require_pairs(folder: Path, files: BothSides, t: Array | None) -> None:
    pairs = min(map(len, files))
    if pairs < FEWEST:
        raise InputError(f"{folder}: holds {pairs} stereo pairs; a motion takes at least {FEWEST}")
    if t is None:
        return
    if len(t) != pairs:
        raise InputError(f"{folder}: {len(t)} timestamps for {pairs} stereo pairs; leave the timestamps of these pairs")
    stuck = np.flatnonzero(np.diff(t) <= 0)
    if len(stuck):
        raise InputError(f"{folder}: timestamps are not increasing at stereo pair {stuck[0] + 2}")


def _number(path: Path) -> int | None:
    """The last number in a file's name, or None."""
    digits = re.findall(r"\d+", path.stem)
    if not digits:
        return None
    return int(digits[-1])


def _require_no_gap(files: list[Path]) -> None:
    """Without timestamps the frames are taken as equally far apart: their numbers must not skip one."""
    numbers = list(map(_number, files))
    if None in numbers:
        return  # names do not count frames
    steps = np.diff(np.array(numbers))
    least = steps.min()
    if least <= 0 or (steps % least).any():
        return
    far = np.flatnonzero(steps > least)
    if len(far):
        k = far[0]
        raise InputError(
            f"{files[k + 1]}: frames are missing between {files[k].name} and it, and no times are there; add the "
            "frames, or times.txt"
        )


def _by_name(folder: Path, left: list[Path], right: list[Path]) -> BothSides:
    """Both lists, if every image has a partner of the same name."""
    names = {path.stem for path in left} & {path.stem for path in right}
    for path in left + right:
        if path.stem not in names:
            raise InputError(f"{path}: has no partner of the other camera in {folder}; add it, or leave this one out")
    return left, right


def _kitti(folder: Path) -> BothSides:
    one, two = _required_pair(folder, KITTI_PAIRS)
    return _by_name(folder, _images(folder / one), _images(folder / two))


def _kitti_times(folder: Path) -> Array | None:
    path = folder / "times.txt"
    if not path.is_file():
        return None
    t = read_number_table(path, None, "must hold one time in seconds a line")
    if t.shape[1] != 1:
        raise InputError(f"{path}: must hold one time in seconds a line")
    return t[:, 0]


def _kitti_raw(folder: Path) -> tuple[BothSides, Array]:
    """Images of the first pair of cameras that is there, and the times of the left one in seconds from the first."""
    one, two = _required_pair(folder, RAW_PAIRS)
    files = _by_name(folder, _images(folder / one / "data"), _images(folder / two / "data"))
    stamps = read_times(folder / one / "timestamps.txt")
    return files, (stamps - stamps[0]) * NANO


def read_number_table(path: Path, delimiter: str | None, refusal: str) -> Array:
    """A text file of finite numbers, (lines, columns); raises :class:`InputError` with the ``refusal``."""
    text = read_text(path, refusal)
    with reading(path, refusal):
        lines = [line for line in text.splitlines() if line.split("#", 1)[0].strip()]
        values = np.empty((0, 0))
        if lines:
            values = np.loadtxt(lines, delimiter=delimiter, ndmin=2)
        if not (np.abs(values) < HUGE).all():
            raise ValueError("a number that is not finite")
    return values


def _euroc(folder: Path) -> tuple[BothSides, Array]:
    """Images of both cameras and times in seconds; the names, or data.csv, are nanoseconds."""
    root = folder
    if (folder / "mav0").is_dir():
        root = folder / "mav0"
    left = _camera(root / "cam0")
    right = _camera(root / "cam1")
    files = _by_name(root, list(left.values()), list(right.values()))
    return files, np.array(list(left)) / 1e9


def _camera(folder: Path) -> dict[int, Path]:
    """Images of one camera by their time in nanoseconds, sorted."""
    images = folder
    if (folder / "data").is_dir():
        images = folder / "data"
    if not images.is_dir():
        raise InputError(f"{folder}: no such folder of images")
    table = folder / "data.csv"
    with reading(folder, "times must be whole nanoseconds, each once, in data.csv or as the images' names"):
        if table.is_file():
            pairs = _listed_images(table, images)
        else:
            pairs = [(int(path.stem), path) for path in _images(images)]
        by_time = dict(sorted(pairs))
        impossible = [time for time in by_time if not 0 <= time < 2**63]
        if len(by_time) < len(pairs) or impossible:
            raise ValueError("a time is duplicated, or is none")
    for path in by_time.values():
        if not is_file(path):
            raise InputError(f"{table}: names {path.name}, which is not in {images}")
    return by_time


def _listed_images(table: Path, images: Path) -> list[tuple[int, Path]]:
    """Times and images that a ``data.csv`` names."""
    pairs = []
    for row in csv.reader(read_text(table, "cannot be read").splitlines()):
        if not row or row[0].startswith("#"):
            continue
        if len(row) < 2:
            raise ValueError("a line without the name of an image")
        pairs.append((int(row[0]), images / row[1].strip()))
    return pairs


def _plain(folder: Path, left: str | None, right: str | None) -> BothSides:
    """Images by pattern, paired in sorted order; names may differ between the cameras."""
    given = left is not None and right is not None
    if left is None or right is None:
        left = "[lL]eft*"
        right = "[rR]ight*"
        if (folder / "left").is_dir() and (folder / "right").is_dir():
            left = "left/*"
            right = "right/*"
    try:
        lefts = _images(folder, left)
        rights = _images(folder, right)
    except (NotImplementedError, ValueError) as error:  # of pathlib
        raise InputError(f"--left {left}, --right {right}: must be patterns below {folder} ({error})") from None
    none = not lefts and not rights
    if none and given:
        raise InputError(f"{folder}: no image is like '{left}' (--left) or '{right}' (--right)")
    if none:
        raise InputError(
            f"{folder}: holds no stereo images of a known layout: {' or '.join(map(' and '.join, KITTI_PAIRS))} "
            "(KITTI), mav0 or cam0 and cam1 (EuRoC), left and right (plain); give the folder that holds these, or "
            "--left and --right"
        )
    if len(lefts) != len(rights):
        raise InputError(
            f"{folder}: {len(lefts)} images are like '{left}' but {len(rights)} like '{right}' (--left, --right)"
        )
    if not given:
        _require_same_numbers(lefts, rights)
    return lefts, rights


def _require_same_numbers(lefts: list[Path], rights: list[Path]) -> None:
    """Where both cameras count in the same numbers, the two images of a pair have the same one."""
    left_numbers = list(map(_number, lefts))
    right_numbers = list(map(_number, rights))
    if not set(left_numbers) & set(right_numbers):
        return
    for k, (left, right) in enumerate(zip(left_numbers, right_numbers, strict=True)):
        if left != right:
            raise InputError(f"{lefts[k]} and {rights[k].name} would be a pair, but their numbers differ")
