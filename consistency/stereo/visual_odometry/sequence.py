"""Sequences of stereo pairs on disk: KITTI odometry and raw, EuRoC / ASL, or plain folders with a calibration."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.parsing import HUGE, is_file, read_text, reading
from consistency.referee.readers.formats.kitti_files import NANO, place_of, read_times
from consistency.referee.types import Array
from consistency.stereo.visual_odometry.cameras.calibration_files import read_calibration
from consistency.stereo.visual_odometry.cameras.camera_pair import PairCalibration, Rectification, rectify
from consistency.stereo.visual_odometry.cameras.input_errors import opencv

FORMATS = ("kitti", "kitti-raw", "euroc", "opencv")
KITTI_PAIRS = (("image_0", "image_1"), ("image_2", "image_3"), ("image_l", "image_r"))
RAW_PAIRS = (("image_00", "image_01"), ("image_02", "image_03"))
RAW_CALIBRATION = "calib_cam_to_cam.txt"  # in the folder of the day, one above a drive's
SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm")
RATE = 10.0  # Hz, of images without timestamps: KITTI's, and a choice elsewhere
FEWEST = 2  # stereo pairs


@dataclass(frozen=True)
class Sequence:
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

    def pair(self, frame: int) -> tuple[Array, Array]:
        """Rectified grey images (h, w) of a frame.

        Raises
        ------
        InputError
            An image cannot be read or has another size than the first one.
        """
        size = self.rectification.rig.image_size
        left, right = (read_image(path, size) for path in (self.left[frame], self.right[frame]))
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
) -> Sequence:
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
    kind = format or ("opencv" if left is not None else _recognised(folder))
    if kind == "kitti":
        files, t, home = _kitti(folder), _kitti_times(folder), folder / "calib.txt"
    elif kind == "kitti-raw":
        files, t = _kitti_raw(folder)
        home = place_of(folder, RAW_CALIBRATION) or folder.absolute().parent / RAW_CALIBRATION
    elif kind == "euroc":
        files, t = _euroc(folder)
        home = folder
    else:
        files, t, home = _plain(folder, left, right), None, None
    if calibration is None and home is None:
        raise InputError(f"{folder}: plain images need --calibration FILE, an OpenCV YAML or a KITTI calib.txt")
    _require_pairs(folder, files, t)
    if t is None:
        _require_no_gap(files[0])
    size = read_image(files[0][0]).shape[::-1]
    names = [side[0].parent.parent.name if kind == "kitti-raw" else side[0].parent.name for side in files]
    cameras = read_calibration(calibration or home or folder, names[0], names[1], size)
    with reading(cameras.source, "its cameras cannot be rectified"):
        rectification = rectify(cameras, size)
    times = np.arange(len(files[0])) / (rate or RATE) if t is None else t
    return Sequence(folder, kind, *files, times, t is not None, cameras, rectification)


def read_image(path: str | Path, size: tuple[int, int] | None = None) -> Array:
    """An image as 8-bit grey (h, w); with ``size`` (width, height) it must have it.

    Raises
    ------
    InputError
        There is no such file, it is not an image, or it has another size.
    """
    cv2, path = opencv(), Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such image")
    try:
        image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE)
    except (OSError, cv2.error):
        image = None
    if image is None:
        raise InputError(f"{path}: cannot be read as an image; damaged or of an unknown format")
    if size is not None and image.shape[::-1] != tuple(size):
        expected_size, size_there = (f"{width} x {height} px" for width, height in (size, image.shape[::-1]))
        raise InputError(f"{path}: has {size_there}, other images {expected_size}; all must have one size")
    return np.asarray(image)


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
    return next((pair for pair in pairs if all((folder / camera).is_dir() for camera in pair)), None)


def _required_pair(folder: Path, pairs: tuple[tuple[str, str], ...]) -> tuple[str, str]:
    if pair := _pair_of(folder, pairs):
        return pair
    raise InputError(f"{folder}: holds no folders {' or '.join(' and '.join(pair) for pair in pairs)}")


def _images(folder: Path, pattern: str = "*") -> list[Path]:
    return sorted(p for p in folder.glob(pattern) if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))


def _require_pairs(folder: Path, files: tuple[list[Path], list[Path]], t: Array | None) -> None:
    pairs = min(map(len, files))
    if pairs < FEWEST:
        raise InputError(f"{folder}: holds {pairs} stereo pairs; a motion takes at least {FEWEST}")
    if t is not None and len(t) != pairs:
        raise InputError(f"{folder}: {len(t)} timestamps for {pairs} stereo pairs; leave the timestamps of these pairs")
    if t is not None and (stuck := np.diff(t) <= 0).any():
        raise InputError(f"{folder}: timestamps are not increasing at stereo pair {int(np.argmax(stuck)) + 2}")


def _number(path: Path) -> int | None:
    """The last number in a file's name, or None."""
    digits = re.findall(r"\d+", path.stem)
    return int(digits[-1]) if digits else None


def _require_no_gap(files: list[Path]) -> None:
    """Without timestamps the frames are taken as equally far apart: their numbers must not skip one."""
    numbers = [_number(path) for path in files]
    steps = np.diff([n for n in numbers if n is not None])
    if None in numbers or len(steps) == 0 or (least := steps.min()) <= 0 or (steps % least).any():
        return  # names do not count frames
    if (far := steps > least).any():
        k = int(np.argmax(far))
        raise InputError(
            f"{files[k + 1]}: frames are missing between {files[k].name} and it, and no times are there; add the "
            "frames, or times.txt"
        )


def _by_name(folder: Path, left: list[Path], right: list[Path]) -> tuple[list[Path], list[Path]]:
    """Both lists, if every image has a partner of the same name."""
    names = [{path.stem for path in side} for side in (left, right)]
    for side, lonely in ((left, names[0] - names[1]), (right, names[1] - names[0])):
        if lonely:
            path = next(path for path in side if path.stem in lonely)
            raise InputError(f"{path}: has no partner of the other camera in {folder}; add it, or leave this one out")
    return left, right


def _kitti(folder: Path) -> tuple[list[Path], list[Path]]:
    one, two = _required_pair(folder, KITTI_PAIRS)
    return _by_name(folder, _images(folder / one), _images(folder / two))


def _kitti_times(folder: Path) -> Array | None:
    path = folder / "times.txt"
    if not path.is_file():
        return None
    t = read_number_table(path, None, "must hold one time in seconds a line")
    if t.shape[1] != 1:
        raise InputError(f"{path}: must hold one time in seconds a line")
    return np.asarray(t[:, 0])


def _kitti_raw(folder: Path) -> tuple[tuple[list[Path], list[Path]], Array]:
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
        values = np.loadtxt(lines, delimiter=delimiter, ndmin=2) if lines else np.empty((0, 0))
        if not (np.abs(values) < HUGE).all():
            raise ValueError("a number that is not finite")
    return np.asarray(values)


def _euroc(folder: Path) -> tuple[tuple[list[Path], list[Path]], Array]:
    """Images of both cameras and times in seconds; the names, or data.csv, are nanoseconds."""
    root = folder / "mav0" if (folder / "mav0").is_dir() else folder
    left, right = (_camera(root / camera) for camera in ("cam0", "cam1"))
    both = _by_name(root, list(left.values()), list(right.values()))
    stamps = np.array(sorted(left), dtype=np.int64)
    return both, stamps / 1e9


def _camera(folder: Path) -> dict[int, Path]:
    """Images of one camera by their time in nanoseconds, sorted."""
    images = folder / "data" if (folder / "data").is_dir() else folder
    if not images.is_dir():
        raise InputError(f"{folder}: no such folder of images")
    table = folder / "data.csv"
    with reading(folder, "times must be whole nanoseconds, each once, in data.csv or as the images' names"):
        if table.is_file():
            lines = read_text(table, "cannot be read").splitlines()
            rows = [row for row in csv.reader(lines) if row and not row[0].startswith("#")]
            if any(len(row) < 2 for row in rows):
                raise ValueError("a line without the name of an image")
            pairs = [(int(row[0]), images / row[1].strip()) for row in rows]
        else:
            pairs = [(int(path.stem), path) for path in _images(images)]
        by_time = dict(pairs)
        if len(by_time) < len(pairs) or not all(0 <= time < 2**63 for time in by_time):
            raise ValueError("a time is duplicated, or is none")
    for path in by_time.values():
        if not is_file(path):
            raise InputError(f"{table}: names {path.name}, which is not in {images}")
    return dict(sorted(by_time.items()))


def _plain(folder: Path, left: str | None, right: str | None) -> tuple[list[Path], list[Path]]:
    """Images by pattern, paired in sorted order; names may differ between the cameras."""
    given = left is not None and right is not None
    if left is None or right is None:
        folders = (folder / "left").is_dir() and (folder / "right").is_dir()
        left, right = ("left/*", "right/*") if folders else ("[lL]eft*", "[rR]ight*")
    try:
        sides = _images(folder, left), _images(folder, right)
    except (NotImplementedError, ValueError) as error:  # of pathlib
        raise InputError(f"--left {left}, --right {right}: must be patterns below {folder} ({error})") from None
    if not any(sides) and given:
        raise InputError(f"{folder}: no image is like '{left}' (--left) or '{right}' (--right)")
    if not any(sides):
        raise InputError(
            f"{folder}: holds no stereo images of a known layout: {' or '.join(' and '.join(p) for p in KITTI_PAIRS)} "
            "(KITTI), mav0 or cam0 and cam1 (EuRoC), left and right (plain); give the folder that holds these, or "
            "--left and --right"
        )
    if len(sides[0]) != len(sides[1]):
        raise InputError(
            f"{folder}: {len(sides[0])} images are like '{left}' but {len(sides[1])} like '{right}' (--left, --right)"
        )
    numbers = [[_number(path) for path in side] for side in sides]
    if not given and numbers[0] != numbers[1] and set(numbers[0]) & set(numbers[1]):
        k = next(k for k, (a, b) in enumerate(zip(*numbers, strict=True)) if a != b)
        raise InputError(f"{sides[0][k]} and {sides[1][k].name} would be a pair, but their numbers differ")
    return sides
