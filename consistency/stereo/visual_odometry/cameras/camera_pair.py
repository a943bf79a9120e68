"""Two calibrated cameras, whatever file they are from, and what their numbers must be."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.types import Array
from consistency.stereo.visual_odometry.cameras.yaml_file import matrix

WIDEST = 30.0  # m between two cameras on one rig; calibrations are often in millimetres by mistake
EUROC_BODY, CAMERA_0 = "body of EuRoC", "camera 0 of KITTI raw"
COUNTS = (4, 5, 8, 12, 14)  # distortion coefficients that OpenCV knows


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
    body: str = ""  # which body that is: that of EuRoC, or camera 0 of KITTI raw


def checked(calibration: Calibration) -> Calibration:
    """The calibration, if its numbers can be those of two cameras side by side."""
    where = calibration.source
    for name, K in (("left", calibration.K_left), ("right", calibration.K_right)):
        upper = np.allclose(K[1:, 0], 0) and np.isclose(K[2, 1], 0) and np.isclose(K[2, 2], 1)
        if not upper or K[0, 0] <= 0 or K[1, 1] <= 0:
            raise InputError(
                f"{where}: the matrix of the {name} camera must be fx 0 cx, 0 fy cy, 0 0 1 with fx, fy > 0"
            )
    calibration = replace(calibration, R=rotation(where, calibration.R))
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


def rotation(where: str, R: Array) -> Array:
    """The rotation nearest to ``R``; calibrations print six digits or more."""
    U, singular, Vt = np.linalg.svd(R)
    if not np.allclose(singular, 1.0, atol=1e-3) or np.linalg.det(R) < 0:
        raise InputError(f"{where}: the rotation between the cameras is not one (singular values {singular.round(4)})")
    return np.asarray(U @ Vt)


def distortion(path: Path, key: str, values: Array) -> Array:
    values = values.ravel()
    if values.size not in COUNTS:
        raise InputError(f"{path}: key '{key}': has {values.size} coefficients, not {', '.join(map(str, COUNTS))}")
    return values


def sized(path: Path, key: str, value: Any, count: int) -> Array:
    numbers = matrix(path, key, value).ravel()
    if numbers.size != count:
        raise InputError(f"{path}: key '{key}': has {numbers.size} numbers, not {count}")
    return numbers
