"""Calibrations of BoofCV."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.parsing import one_line
from consistency.referee.types import Array
from consistency.stereo.visual_odometry.cameras.camera_pair import Calibration, checked, sized
from consistency.stereo.visual_odometry.cameras.yaml_file import matrix, read_yaml


def read_boofcv(path: Path) -> Calibration:
    """``stereo.yaml`` of BoofCV: left and right pin-hole cameras, rightToLeft with x_left = R x_right + (x, y, z)."""
    data = read_yaml(path)
    cameras = [_boofcv_camera(path, data, side) for side in ("left", "right")]
    pose = _part(path, data, "rightToLeft")
    R = sized(path, "rightToLeft.rotation", pose.get("rotation"), 9).reshape(3, 3)
    t = np.array([float(sized(path, f"rightToLeft.{key}", pose.get(key), 1)[0]) for key in "xyz"])
    (K_left, D_left, size), (K_right, D_right, other) = cameras
    if size != other:
        raise InputError(f"{path}: left has {size[0]} x {size[1]} px, right {other[0]} x {other[1]}; must be equal")
    return checked(Calibration(str(path), K_left, K_right, D_left, D_right, R.T, -R.T @ t, size))


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
        radial = matrix(path, f"{side}.radial_tangential.radial", bend.get("radial") or [0.0]).ravel()
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
