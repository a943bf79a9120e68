"""Images without distortion whose rows correspond: what matching and a ``uvd`` sensor need."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.types import Array
from consistency.stereo.visual_odometry.cameras.camera_pair import Calibration
from consistency.stereo.visual_odometry.cameras.rig import StereoRig
from consistency.stereo.visual_odometry.features import opencv
from consistency.stereo.visual_odometry.matching import is_rectified


@dataclass(frozen=True)
class Rectification:
    """The rig of the rectified images, and how raw images become rectified."""

    rig: StereoRig
    turn: Array  # (3, 3), axes of the rectified left camera from those of the calibrated one
    maps: tuple[tuple[Array, Array], tuple[Array, Array]] | None  # left and right for cv2.remap; None: nothing to do

    def apply(self, left: Array, right: Array) -> tuple[Array, Array]:
        """Raw images (h, w) of the left and right camera -> rectified ones of the same size, bilinear."""
        if self.maps is None:
            return left, right
        cv2 = opencv()
        one, two = (
            cv2.remap(image, *maps, cv2.INTER_LINEAR) for image, maps in zip((left, right), self.maps, strict=True)
        )
        return one, two


def rectify(calibration: Calibration, image_size: tuple[int, int]) -> Rectification:
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
        stated, found = (f"{width} x {height} px" for width, height in (c.image_size, image_size))
        raise InputError(f"{c.source}: is for images of {stated}, but the images have {found}")
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
    )  # fmt: skip
    maps = [
        cv2.initUndistortRectifyMap(K, D, turn, P, image_size, cv2.CV_16SC2)
        for K, D, turn, P in (
            (c.K_left, c.D_left, turn_left, P_left),
            (c.K_right, c.D_right, turn_right, P_right),
        )
    ]
    baseline = np.array([-P_right[0, 3] / P_right[0, 0], 0.0, 0.0])
    rig = StereoRig(P_left[:, :3], P_right[:, :3], np.eye(3), baseline, image_size)
    return Rectification(rig, np.asarray(turn_left), (tuple(maps[0]), tuple(maps[1])))
