"""Stereo pairs of a chessboard: corners, calibrations with three distortion models, and the sensor that is left."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import optimize
from scipy.spatial.transform import Rotation

from consistency.bench.scenario import PicturedSensor, models
from consistency.referee.errors import InputError
from consistency.referee.types import Array
from consistency.stereo.characterising.characterise import Characterisation, Residuals, characterise, robust_sd
from consistency.stereo.visual_odometry.arrays import opencv
from consistency.stereo.visual_odometry.sequence import SUFFIXES, read_image

COEFFICIENTS = {"full": 5, "poor": 1, "none": 0}  # of distortion models: all, k1 alone, no distortion
MODELS = tuple(COEFFICIENTS)
FEWEST = 5  # pairs that a calibration of two cameras takes here
Size = tuple[int, int]
POSE = 6  # parameters of the pose of a board
ROUNDS = 3  # of weights and poses in turns
NO_TIME = (
    "Each corner is seen once in each pose of the board: correlation in time and offsets of tracks cannot be told.",
    "The poses of the board are fitted, so that a bias that a turned or shifted board would show is not in the map.",
)


class Corners(NamedTuple):
    """Inner corners of a board in both images of n pairs."""

    left: Array  # (n, c, 2), px
    right: Array  # (n, c, 2)
    board: Array  # (c, 3), m, in the plane z = 0 of the board
    names: list[str]  # of the left images
    missed: list[str]  # left images of pairs in which the board was not found
    image: Size  # width, height, px

    @property
    def points_of_pairs(self) -> list[Array]:
        """The corners of the board, once for each pair, as OpenCV's calibrations take them."""
        return [self.board.astype(np.float32)] * len(self.left)


class BoardCalibration(NamedTuple):
    """Corners of one calibration in rectified pixels."""

    model: str
    z: Array  # (n, c, 3), u, v, d in px from the principal point
    rows: Array  # (n, c), v_left - v_right, px
    f: float  # px
    B: float  # m
    centre: tuple[float, float]  # principal point, px
    rms: tuple[float, float, float]  # px, of OpenCV's calibrations: left, right, both
    fitted: int  # parameters of the calibration, for both cameras


def find_corners(folder: Path, board: Size, square: float) -> Corners:
    """Corners of all pairs ``leftN``, ``rightN`` of a folder.

    Parameters
    ----------
    board : inner corners along and across
    square : m, side of a square

    Raises
    ------
    InputError
        No pairs, an image without partner, images of several sizes, the board in too few of them.
    """
    cv2 = opencv()
    pairs = pairs_of(folder)
    size = read_image(pairs[0][0]).shape[::-1]
    lefts = []
    rights = []
    names = []
    missed = []
    for left_file, right_file in pairs:
        left = _corners(cv2, read_image(left_file, size), board)
        right = _corners(cv2, read_image(right_file, size), board)
        if left is None or right is None:
            missed.append(left_file.name)
            continue
        if (left[-1] - left[0]) @ (right[-1] - right[0]) < 0:  # a board looks the same when turned by 180 degrees
            right = right[::-1]
        lefts.append(left)
        rights.append(right)
        names.append(left_file.name)
    if len(names) < FEWEST:
        raise InputError(
            f"{folder}: a board of {board[0]}x{board[1]} inner corners is in {len(names)} of {len(pairs)} pairs; at "
            f"least {FEWEST} are needed: is --board right, and the whole board in both images?"
        )
    down, across = np.indices(board[::-1])
    points = square * np.column_stack([across.ravel(), down.ravel(), np.zeros(across.size)])
    width, height = size
    return Corners(np.array(lefts), np.array(rights), points, names, missed, (width, height))


def pairs_of(folder: Path) -> list[tuple[Path, Path]]:
    """Images ``leftN`` and ``rightN`` of a folder, in order of N."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of images")
    left = _numbered(folder, "left")
    right = _numbered(folder, "right")
    if not left and not right:
        raise InputError(f"{folder}: holds no images leftN and rightN, such as left1.png and right1.png")
    if lonely := sorted(set(left) ^ set(right)):
        path = left.get(lonely[0]) or right[lonely[0]]
        raise InputError(f"{path}: has no partner of the other camera; add it, or leave this one out")
    if len(left) < FEWEST:
        raise InputError(f"{folder}: holds {len(left)} stereo pairs; a board in at least {FEWEST} poses is needed")
    return [(left[number], right[number]) for number in sorted(left)]


def _numbered(folder: Path, side: str) -> dict[int, Path]:
    """Images of a folder whose name is ``side`` and a number, by the number."""
    found = {}
    for path in folder.iterdir():
        match = re.fullmatch(rf"{side}[-_]?(\d+)", path.stem.lower())
        if match and path.suffix.lower() in SUFFIXES:
            found[int(match[1])] = path
    return found


def _corners(cv2: Any, image: Array, board: Size) -> Array | None:
    """Corners (c, 2) of a board, or None."""
    flags = cv2.CALIB_CB_ACCURACY  # normalising the image doubles the errors of corners in JPEG files
    good, corners = cv2.findChessboardCornersSB(image, board, flags=flags)
    if not good:
        return None
    return np.asarray(corners, float).reshape(-1, 2)


def calibrate(corners: Corners, model: str) -> BoardCalibration:
    """Calibrate with a distortion model and bring the corners to rectified pixels.

    Each camera is calibrated by itself, then both together with these held (OpenCV's ``stereoCalibrate``).
    """
    cv2 = opencv()
    K1, D1, rms_left = _calibrate_camera(cv2, corners, corners.left, model)
    K2, D2, rms_right = _calibrate_camera(cv2, corners, corners.right, model)
    rms_both, *_, R, T, _, _ = cv2.stereoCalibrate(
        corners.points_of_pairs,
        list(corners.left.astype(np.float32)),
        list(corners.right.astype(np.float32)),
        K1, D1, K2, D2,
        corners.image,
        flags=cv2.CALIB_FIX_INTRINSIC,
    )  # fmt: skip
    R1, R2, P1, P2, *_ = cv2.stereoRectify(
        K1, D1, K2, D2, corners.image, R, T, flags=cv2.CALIB_ZERO_DISPARITY, alpha=0.0
    )
    left = _rectified(cv2, corners.left, K1, D1, R1, P1)
    right = _rectified(cv2, corners.right, K2, D2, R2, P2)
    centre = P1[:2, 2]
    return BoardCalibration(
        model,
        z=np.concatenate([left - centre, (left - right)[..., :1]], axis=-1),
        rows=left[..., 1] - right[..., 1],
        f=float(P1[0, 0]),
        B=float(-P2[0, 3] / P2[0, 0]),
        centre=(float(centre[0]), float(centre[1])),
        rms=(float(rms_left), float(rms_right), float(rms_both)),
        fitted=2 * (4 + COEFFICIENTS[model]) + 6,
    )


def _calibrate_camera(cv2: Any, corners: Corners, side: Array, model: str) -> tuple[Array, Array, float]:
    """Matrix and distortion of one camera, and the rms of the fit in px."""
    flags = 0
    if model != "full":
        flags |= cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    if model == "none":
        flags |= cv2.CALIB_FIX_K1
    rms, K, D, *_ = cv2.calibrateCamera(
        corners.points_of_pairs, list(side.astype(np.float32)), corners.image, None, None, flags=flags
    )
    return K, D, rms


def _rectified(cv2: Any, side: Array, K: Array, D: Array, turn: Array, P: Array) -> Array:
    """Pixels (n, c, 2) of one camera after its rectification."""
    flat = cv2.undistortPoints(side.reshape(-1, 1, 2), K, D, R=turn, P=P)
    return flat.reshape(side.shape)


def characterise_board(
    folder: Path,
    board: Size,
    square: float,
    model: str,
    grid: Size,
) -> Characterisation:
    """The noise of corners with one distortion model, the others beside it in the notes.

    Raises
    ------
    InputError
        As :func:`find_corners`, or an unknown model.
    """
    if model not in MODELS:
        raise InputError(f"--distortion {model}: must be one of {', '.join(MODELS)}")
    corners = find_corners(folder, board, square)
    notes = []
    if corners.missed:
        pairs = len(corners.names) + len(corners.missed)
        names = ", ".join(corners.missed)
        notes.append(
            f"The board was not found in {len(corners.missed)} of {pairs} pairs ({names}); the others are used."
        )
    results = {name: of_model(corners, name, str(folder), grid) for name in MODELS}
    for name, of in results.items():
        notes.append(_line(name, of))
    return replace(results[model], notes=(*notes, *NO_TIME))


def of_model(
    corners: Corners,
    model: str,
    source: str,
    grid: Size,
) -> Characterisation:
    """What is known of the corners with one distortion model."""
    calibrated = calibrate(corners, model)
    data = residuals_about_boards(calibrated, corners.board)
    sensor = PicturedSensor(
        model="uvd",
        sigma=(1.0, 1.0, 1.0),
        f=calibrated.f,
        B=calibrated.B,
        image=corners.image,
        principal_point=calibrated.centre,
    )
    # the nodes of the map lie where corners are: boards do not reach the edges of the image
    where = sensor.model_copy(update={"image": None, "principal_point": None})
    of = characterise(data, where, f"{source}, distortion model '{model}'", grid=grid, alone=True)
    spread = robust_sd(calibrated.rows)
    left, right, both = calibrated.rms
    text = f"calibration rms {left:.2f}, {right:.2f}, {both:.2f} px; v_left - v_right robust sd {spread:.2f} px"
    return replace(of, sensor=sensor, notes=(text,))


def _line(model: str, of: Characterisation) -> str:
    assert of.bias is not None
    known = of.bias.believed[:, of.bias.grid.known]
    sigma = []
    widest = []
    pooled = []
    for c, bias in zip(of.coordinates, known, strict=True):
        sigma.append(f"{c.name} {c.sigma.value:.3f}")
        widest.append(f"{c.name} {np.abs(bias).max():.2f}")
        pooled.append(f"{c.name} {c.pooled:.3f}")
    return (
        f"Distortion model '{model}': noise {' '.join(sigma)} px, largest bias shown {' '.join(widest)} px, both "
        f"together {' '.join(pooled)} px; {of.notes[0]}."
    )


def residuals_about_boards(calibrated: BoardCalibration, board: Array) -> Residuals:
    """Residuals of corners about a board whose pose is fitted in each pair.

    The six parameters of each pose, and those of the calibration, are paid for: residuals are as large as they would
    be about the truth, on average.
    """
    z = calibrated.z
    sigma = np.ones(3)
    n, count = z.shape[:2]
    poses = [_first_pose(pair, board, calibrated) for pair in z]
    ideal = np.empty_like(z)
    for _ in range(ROUNDS):
        for k, pair in enumerate(z):
            poses[k], ideal[k] = _fitted(pair, board, calibrated, poses[k], sigma)
        rms = np.sqrt(np.mean((z - ideal) ** 2, axis=(0, 1)))
        sigma = np.maximum(rms, 1e-6)
    paid = 1.0 - (POSE * n + calibrated.fitted) / (3.0 * n * count)
    r = (z - ideal) / np.sqrt(paid)
    track = np.repeat(np.arange(n), count)
    step = np.tile(np.arange(count), n)
    moving = np.zeros(n * count, bool)
    return Residuals(r.reshape(-1, 3), ideal.reshape(-1, 3), track, step, moving)


def _project(pose: Array, board: Array, calibrated: BoardCalibration) -> Array:
    """Ideal (u, v, d) (c, 3) of a board; the pose is a rotation vector and a place in m, sensor axes."""
    points = Rotation.from_rotvec(pose[:3]).apply(board) + pose[3:]
    x, y, w = points.T
    return np.stack(models.project(x, y, w, calibrated.f, calibrated.B), axis=-1)


def _first_pose(z: Array, board: Array, calibrated: BoardCalibration) -> Array:
    """The pose that lays the board best on the triangulated corners, Arun et al. (1987)."""
    u, v, d = z.T
    seen = np.stack(models.triangulate(u, v, d, calibrated.f, calibrated.B), axis=-1)
    middle = seen.mean(axis=0)
    middle_of_board = board.mean(axis=0)
    turn, _ = Rotation.align_vectors(seen - middle, board - middle_of_board)
    return np.concatenate([turn.as_rotvec(), middle - turn.apply(middle_of_board)])


def _fitted(
    z: Array,
    board: Array,
    calibrated: BoardCalibration,
    start: Array,
    sigma: Array,
) -> tuple[Array, Array]:
    """Pose (6,) of the board by weighted least squares, and the ideal corners (c, 3)."""

    def misfit(pose: Array) -> Array:
        return ((z - _project(pose, board, calibrated)) / sigma).ravel()

    best = optimize.least_squares(misfit, start, x_scale="jac")
    return best.x, _project(best.x, board, calibrated)
