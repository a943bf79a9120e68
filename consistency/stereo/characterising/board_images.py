"""Stereo pairs of a chessboard: corners, calibrations with a full, a poor and no distortion model, and what is left."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.types import Array
from consistency.stereo.visual_odometry.features import opencv
from consistency.stereo.visual_odometry.sequence import SUFFIXES, read_image

MODELS = ("full", "poor", "none")  # five coefficients, k1 alone, no distortion
FEWEST = 5  # pairs that a calibration of two cameras takes here
Size = tuple[int, int]


@dataclass(frozen=True)
class Corners:
    """Inner corners of a board in both images of n pairs."""

    left: Array  # (n, c, 2), px
    right: Array  # (n, c, 2)
    board: Array  # (c, 3), m, in the plane z = 0 of the board
    names: list[str]  # of the left images
    missed: list[str]  # left images of pairs in which the board was not found
    image: Size  # width, height, px


@dataclass(frozen=True)
class Calibrated:
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
    found, names, missed = [], [], []
    for pair in pairs:
        left, right = (_corners(cv2, read_image(path, size), board) for path in pair)
        if left is None or right is None:
            missed.append(pair[0].name)
            continue
        if (left[-1] - left[0]) @ (right[-1] - right[0]) < 0:  # a board looks the same when turned by 180 degrees
            right = right[::-1]
        found.append((left, right))
        names.append(pair[0].name)
    if len(found) < FEWEST:
        raise InputError(
            f"{folder}: a board of {board[0]}x{board[1]} inner corners is in {len(found)} of {len(pairs)} pairs; at "
            f"least {FEWEST} are needed: is --board right, and the whole board in both images?"
        )
    across, down = np.meshgrid(np.arange(board[0]), np.arange(board[1]))
    points = square * np.column_stack([across.ravel(), down.ravel(), np.zeros(across.size)])
    lefts, rights = (np.array(side, float) for side in zip(*found, strict=True))
    return Corners(lefts, rights, points, names, missed, (int(size[0]), int(size[1])))


def pairs_of(folder: Path) -> list[tuple[Path, Path]]:
    """Images ``leftN`` and ``rightN`` of a folder, in order of N."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of images")
    sides: list[dict[int, Path]] = []
    for side in ("left", "right"):
        files = {path: re.fullmatch(rf"{side}[-_]?(\d+)", path.stem.lower()) for path in folder.iterdir()}
        sides.append({int(m[1]): path for path, m in files.items() if m and path.suffix.lower() in SUFFIXES})
    left, right = sides
    if not left and not right:
        raise InputError(f"{folder}: holds no images leftN and rightN, such as left1.png and right1.png")
    if lonely := sorted(set(left) ^ set(right)):
        path = left.get(lonely[0]) or right[lonely[0]]
        raise InputError(f"{path}: has no partner of the other camera; add it, or leave this one out")
    if len(left) < FEWEST:
        raise InputError(f"{folder}: holds {len(left)} stereo pairs; a board in at least {FEWEST} poses is needed")
    return [(left[number], right[number]) for number in sorted(left)]


def _corners(cv2: Any, image: Array, board: Size) -> Array | None:
    """Corners (c, 2) of a board, or None."""
    flags = cv2.CALIB_CB_ACCURACY  # normalising the image doubles the errors of corners in JPEG files
    good, corners = cv2.findChessboardCornersSB(image, board, flags=flags)
    return np.asarray(corners, float).reshape(-1, 2) if good else None


def calibrate(corners: Corners, model: str) -> Calibrated:
    """Calibrate with a distortion model and bring the corners to rectified pixels.

    Each camera is calibrated by itself, then both together with these held (OpenCV's ``stereoCalibrate``).
    """
    cv2 = opencv()
    flags = {"full": 0, "poor": cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3}
    flags["none"] = flags["poor"] | cv2.CALIB_FIX_K1
    points = [corners.board.astype(np.float32)] * len(corners.left)
    sides = [[c.astype(np.float32) for c in side] for side in (corners.left, corners.right)]
    cameras = [cv2.calibrateCamera(points, side, corners.image, None, None, flags=flags[model]) for side in sides]
    (rms_left, K1, D1, *_), (rms_right, K2, D2, *_) = cameras
    both = cv2.stereoCalibrate(points, *sides, K1, D1, K2, D2, corners.image, flags=cv2.CALIB_FIX_INTRINSIC)
    R, T = both[5], both[6]
    R1, R2, P1, P2, *_ = cv2.stereoRectify(
        K1, D1, K2, D2, corners.image, R, T, flags=cv2.CALIB_ZERO_DISPARITY, alpha=0.0
    )
    left, right = (
        np.array([cv2.undistortPoints(c[:, None], K, D, R=turn, P=P)[:, 0] for c in side], float)
        for side, K, D, turn, P in ((corners.left, K1, D1, R1, P1), (corners.right, K2, D2, R2, P2))
    )
    centre = P1[:2, 2]
    z = np.concatenate([left - centre, (left - right)[..., :1]], axis=-1)
    coefficients = {"full": 5, "poor": 1, "none": 0}[model]
    return Calibrated(
        model, z, left[..., 1] - right[..., 1], float(P1[0, 0]), float(-P2[0, 3] / P2[0, 0]),
        (float(centre[0]), float(centre[1])), (float(rms_left), float(rms_right), float(both[0])),
        2 * (4 + coefficients) + 6,
    )  # fmt: skip
