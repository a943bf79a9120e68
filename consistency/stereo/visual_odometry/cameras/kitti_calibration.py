"""Calibrations of KITTI: odometry and raw."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.readers.formats.kitti_files import numbers, read_keys, turn
from consistency.referee.types import Array
from consistency.stereo.visual_odometry.cameras.camera_pair import CAMERA_0, Calibration, checked


def read_kitti(path: Path, left: str = "", right: str = "") -> Calibration:
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
) -> Calibration:
    """Rectified cameras by their matrices P = K [I | t]; ``rectified`` (3, 3) turns camera 0 into their axes."""
    P_left, P_right = (numbers(path, rows, name, (3, 4)) for name in names)
    for name, P in zip(names, (P_left, P_right), strict=True):
        if np.linalg.matrix_rank(P[:, :3]) < 3:
            raise InputError(f"{path}: key '{name}': the matrix of its camera is singular; must be P = K [I | t]")
    t_left, t_right = (np.linalg.solve(P[:, :3], P[:, 3]) for P in (P_left, P_right))
    none = np.zeros(4)
    body = (None, "") if rectified is None else (_pose(rectified, t_left), CAMERA_0)
    return checked(
        Calibration(str(path), P_left[:, :3], P_right[:, :3], none, none, np.eye(3), t_right - t_left, size, *body)
    )


def _pose(R: Array, t: Array) -> Array:
    """Pose (4, 4) in camera 0 of a camera with x = R x_0 + t."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R.T, -R.T @ t
    return pose


def read_kitti_raw(
    path: Path, left: str = "", right: str = "", image_size: tuple[int, int] | None = None
) -> Calibration:
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
    return checked(
        Calibration(
            str(path), K[0], K[1], D[0], D[1], between, T[1] - between @ T[0], sizes["S"], _pose(R[0], T[0]), CAMERA_0
        )
    )  # fmt: skip
