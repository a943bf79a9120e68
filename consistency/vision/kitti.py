"""Calibrations of KITTI: odometry and raw."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from consistency.errors import InputError
from consistency.reading import HUGE, one_line, read_text, reading
from consistency.types import Array
from consistency.vision.cameras import Calibration, checked


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
    return _projections(path, rows, names, None)


def _projections(
    path: Path, rows: dict[str, Array], names: tuple[str, str], size: tuple[int, int] | None
) -> Calibration:
    """Rectified cameras by their matrices P = K [I | t]."""
    for name in names:
        if np.linalg.matrix_rank(_row(path, rows, name, 12).reshape(3, 4)[:, :3]) < 3:
            raise InputError(f"{path}: key '{name}': the matrix of its camera is singular; must be P = K [I | t]")
    P_left, P_right = (rows[name].reshape(3, 4) for name in names)
    T = np.linalg.solve(P_right[:, :3], P_right[:, 3]) - np.linalg.solve(P_left[:, :3], P_left[:, 3])
    none = np.zeros(4)
    return checked(Calibration(str(path), P_left[:, :3], P_right[:, :3], none, none, np.eye(3), T, size))


def _row(path: Path, rows: dict[str, Array], name: str, count: int) -> Array:
    if name not in rows:
        raise InputError(f"{path}: key '{name}' is missing; there: {one_line(', '.join(rows)) or 'nothing'}")
    if rows[name].size != count or not (np.abs(rows[name]) < HUGE).all():
        shape = ", P (3 x 4) row by row" if count == 12 else ""
        raise InputError(f"{path}: key '{name}': must be {count} finite numbers{shape}")
    return rows[name]


def read_kitti_raw(
    path: Path, left: str = "", right: str = "", image_size: tuple[int, int] | None = None
) -> Calibration:
    """``calib_cam_to_cam.txt`` of KITTI raw (Geiger et al. 2013), of image_00 and image_01 or image_02 and image_03.

    Images of ``image_size`` S_rect are rectified (``sync``) and have P_rect; those of size S (``extract``) have K, D, R
    and T, with x_i = R_i x_0 + T_i. Without a size they are taken as rectified.
    """
    rows: dict[str, Array] = {}
    for line in read_text(path, "cannot be read").splitlines():
        key, _, values = line.partition(":")
        if key.strip() != "calib_time" and values.strip():
            with reading(path, f"key '{one_line(key)}': must be numbers"):
                rows[key.strip()] = np.array(values.split(), float)
    two = ("02", "03") if left.endswith("2") and right.endswith("3") else ("00", "01")
    sizes = {name: tuple(_row(path, rows, f"{name}_{two[0]}", 2).astype(int).tolist()) for name in ("S", "S_rect")}
    if image_size in (None, sizes["S_rect"]):
        return _projections(path, rows, (f"P_rect_{two[0]}", f"P_rect_{two[1]}"), sizes["S_rect"])
    if image_size != sizes["S"]:
        found, raw, rectified = (f"{w} x {h} px" for w, h in (image_size or (0, 0), sizes["S"], sizes["S_rect"]))
        raise InputError(f"{path}: the images have {found}, but it is for {raw}, and for {rectified} rectified")
    K, D, R, T = (
        [_row(path, rows, f"{name}_{camera}", count) for camera in two]
        for name, count in (("K", 9), ("D", 5), ("R", 9), ("T", 3))
    )
    turn = R[1].reshape(3, 3) @ R[0].reshape(3, 3).T
    K_left, K_right = (each.reshape(3, 3) for each in K)
    return checked(Calibration(str(path), K_left, K_right, D[0], D[1], turn, T[1] - turn @ T[0], sizes["S"]))
