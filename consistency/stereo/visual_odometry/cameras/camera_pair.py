"""Two calibrated cameras, whatever file they are from, and what their numbers must be.

Rectification makes their images ones without distortion whose rows correspond: what matching and a ``uvd`` sensor need.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.types import Array
from consistency.stereo.visual_odometry.cameras.input_errors import opencv
from consistency.stereo.visual_odometry.cameras.rig import StereoRig, is_rectified

WIDEST = 30.0  # m between two cameras on one rig; calibrations are often in millimetres by mistake
EUROC_BODY = "body of EuRoC"
CAMERA_0 = "camera 0 of KITTI raw"


@dataclass(frozen=True)
class PairCalibration:
    """Two cameras as calibrated, before any rectification.

    Raises
    ------
    InputError
        The numbers cannot be those of two cameras side by side.
    """

    source: str  # file or files, for messages
    K_left: Array  # (3, 3), px
    K_right: Array  # (3, 3), px
    D_left: Array  # (k,), k1 k2 p1 p2 ... of OpenCV, all 0 for images without distortion
    D_right: Array
    R: Array  # (3, 3), x_right = R x_left + T (Bouguet's convention, OpenCV's); replaced by the nearest rotation
    T: Array  # (3,), m
    image_size: tuple[int, int] | None  # width, height, px; None where the file does not say
    body_from_left: Array | None = None  # (4, 4), pose of the left camera in the body that a truth is of
    body: str = ""  # which body that is: that of EuRoC, or camera 0 of KITTI raw

    def __post_init__(self) -> None:
        self._require_camera("left", self.K_left)
        self._require_camera("right", self.K_right)
        U, singular, Vt = np.linalg.svd(self.R)
        if not np.allclose(singular, 1.0, atol=1e-3) or np.linalg.det(self.R) < 0:  # files print six digits or more
            raise InputError(
                f"{self.source}: the rotation between the cameras is not one (singular values {singular.round(4)})"
            )
        object.__setattr__(self, "R", U @ Vt)
        centre = -self.R.T @ self.T
        if centre[0] <= 0 or abs(centre[1]) > centre[0]:
            raise InputError(
                f"{self.source}: the right camera stands at {np.round(centre, 3).tolist()} m of the left one, not to "
                "its right: T is that of x_right = R x_left + T, in metres; are the cameras swapped?"
            )
        if centre[0] > WIDEST:
            raise InputError(
                f"{self.source}: the right camera stands {centre[0]:g} m from the left one; T is in metres, is it in "
                "millimetres?"
            )

    def _require_camera(self, side: str, K: Array) -> None:
        upper = np.allclose(K[1:, 0], 0) and np.isclose(K[2, 1], 0) and np.isclose(K[2, 2], 1)
        if not upper or K[0, 0] <= 0 or K[1, 1] <= 0:
            raise InputError(
                f"{self.source}: the matrix of the {side} camera must be fx 0 cx, 0 fy cy, 0 0 1 with fx, fy > 0"
            )


class Rectification(NamedTuple):
    """The rig of the rectified images, and how raw images become rectified."""

    rig: StereoRig
    turn: Array  # (3, 3), axes of the rectified left camera from those of the calibrated one
    maps: tuple[tuple[Array, Array], tuple[Array, Array]] | None  # left and right for cv2.remap; None: nothing to do

    def apply(self, left: Array, right: Array) -> tuple[Array, Array]:
        """Raw images (h, w) of the left and right camera -> rectified ones of the same size, bilinear."""
        if self.maps is None:
            return left, right
        cv2 = opencv()
        left_maps, right_maps = self.maps
        left = cv2.remap(left, *left_maps, cv2.INTER_LINEAR)
        right = cv2.remap(right, *right_maps, cv2.INTER_LINEAR)
        return left, right


def rectify(calibration: PairCalibration, image_size: tuple[int, int]) -> Rectification:
    """Rectification by OpenCV (Bouguet's algorithm, only pixels that both images have: alpha = 0).

    Images that are rectified already (no distortion, same axes and focal lengths, baseline along x) stay as they
    are.

    Parameters
    ----------
    image_size : width and height of the raw images, px

    Raises
    ------
    InputError
        The images have another size than the calibration says, or OpenCV is not installed and needed.
    """
    c = calibration
    if c.image_size is not None and c.image_size != image_size:
        raise InputError(f"{c.source}: is for images of {in_px(c.image_size)}, but the images have {in_px(image_size)}")
    raw = StereoRig(c.K_left, c.K_right, c.R.T, -c.R.T @ c.T, image_size)
    if not c.D_left.any() and not c.D_right.any() and is_rectified(raw):
        return Rectification(raw, np.eye(3), None)
    cv2 = opencv()
    turn_left, turn_right, P_left, P_right, *_ = cv2.stereoRectify(
        c.K_left,
        c.D_left,
        c.K_right,
        c.D_right,
        image_size,
        c.R,
        c.T.reshape(3, 1),
        flags=cv2.CALIB_ZERO_DISPARITY,
        alpha=0.0,
    )
    left = cv2.initUndistortRectifyMap(c.K_left, c.D_left, turn_left, P_left, image_size, cv2.CV_16SC2)
    right = cv2.initUndistortRectifyMap(c.K_right, c.D_right, turn_right, P_right, image_size, cv2.CV_16SC2)
    baseline = np.array([-P_right[0, 3] / P_right[0, 0], 0.0, 0.0])
    rig = StereoRig(P_left[:, :3], P_right[:, :3], np.eye(3), baseline, image_size)
    return Rectification(rig, turn_left, (left, right))


def in_px(size: tuple[int, ...]) -> str:
    """The size of an image in words."""
    width, height = size
    return f"{width} x {height} px"
