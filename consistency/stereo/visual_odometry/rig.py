"""A calibrated pair of pin-hole cameras, Valencia & Andrade-Cetto (2018) sec. 2.1, whatever file it is from.

Rectification makes their images ones without distortion whose rows correspond: what matching and a ``uvd`` sensor need.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.types import Array
from consistency.stereo.visual_odometry import arrays
from consistency.stereo.visual_odometry.arrays import PointError, opencv

NEAREST = 1e-3  # depth in baselines up to which a point is at the camera: a disparity of a thousand focal lengths
FARTHEST = 1e6  # depth in baselines from which on a point is at infinity
# What A'A leaves of a coordinate's own entry when the others are eliminated: some 3e-13 at FARTHEST, up to 6e-16 by
# rounding alone. Parallel rays must not pass for a point that rounding made up.
FIXED = 2e-14
WIDEST = 30.0  # m between two cameras on one rig; calibrations are often in millimetres by mistake
EUROC_BODY = "body of EuRoC"
CAMERA_0 = "camera 0 of KITTI raw"


@dataclass(frozen=True, eq=False)
class StereoRig:
    """Two cameras without distortion; x right, y down, z forward, pixels from the image's corner.

    ``R, t`` are the pose of the right camera in the left camera's frame, p_left = R p_right + t, which is how the
    chapter's text and its experiments state them. Its eq. 2.2 and 2.3 apply [R t] to a point in the left frame and so
    mean the inverse, R' and -R' t: R and t put there literally are another rig.

    Parameters
    ----------
    K_left, K_right : (3, 3), upper triangular with 1 at the end, px
    R : (3, 3), rotation
    t : (3,), m
    image_size : (width, height), px

    Raises
    ------
    InputError
        A shape, a value that is not finite, a focal length that is not positive, R no rotation, no baseline.
    """

    K_left: Array  # (3, 3), px
    K_right: Array  # (3, 3), px
    R: Array  # (3, 3)
    t: Array  # (3,), m
    image_size: tuple[int, int]  # width, height, px

    def __post_init__(self) -> None:
        arrays.freeze(self, K_left=(3, 3), K_right=(3, 3), R=(3, 3), t=(3,))
        for name, K in (("K_left", self.K_left), ("K_right", self.K_right)):
            if np.tril(K, -1).any() or K[2, 2] != 1.0 or min(K[0, 0], K[1, 1]) <= 0.0:
                raise InputError(f"{name}: give [[fu, skew, u0], [0, fv, v0], [0, 0, 1]] with positive fu and fv")
        if not self.t.any():
            raise InputError("t: no baseline between the cameras; depth needs one")
        if len(self.image_size) != 2 or min(self.image_size) < 1:
            raise InputError(f"image_size: {self.image_size}, allowed is (width, height) in pixels")
        object.__setattr__(self, "image_size", (int(self.image_size[0]), int(self.image_size[1])))

    @property
    def baseline(self) -> float:
        """Distance of the two cameras, m."""
        return float(np.linalg.norm(self.t))

    @property
    def f(self) -> float:
        """Focal length of the left camera along its rows, px."""
        return float(self.K_left[0, 0])

    @property
    def principal_point(self) -> tuple[float, float]:
        """That of the left camera, px."""
        u, v = self.K_left[:2, 2].tolist()
        return u, v

    @cached_property
    def cameras(self) -> Array:
        """(2, 3, 4): K [I 0] of eq. 2.1 and K' [R' -R't], which eq. 2.2 calls [R t]."""
        left = np.column_stack([self.K_left, np.zeros(3)])
        right = np.column_stack([self.R.T, -self.R.T @ self.t])
        return np.stack([left, self.K_right @ right])

    def project(self, points: Array) -> Array:
        """Eq. 2.1 and 2.2: points in the left camera's frame to both images.

        Parameters
        ----------
        points : (N, 3), m

        Returns
        -------
        (N, 4): u, v, u', v', px; also outside ``image_size``

        Raises
        ------
        PointError
            A point at or behind a camera.
        """
        p = arrays.checked_rows("points", points, 3)
        h = p @ np.swapaxes(self.cameras[:, :, :3], 1, 2) + self.cameras[:, None, :, 3]  # (2, N, 3)
        depth = h[:, :, 2]
        bad = np.flatnonzero((depth <= NEAREST * self.baseline).any(axis=0))
        if len(bad):
            k = int(bad[0])
            raise PointError(f"points: number {k} is at or behind a camera; leave such points out", k)
        left, right = h[:, :, :2] / depth[:, :, None]
        return np.column_stack([left, right])

    def inside(self, uv: Array) -> Array:
        """(N, 4) px to (N,) bool: seen in both images."""
        largest = np.tile(self.image_size, 2) - 1.0
        return np.asarray(((uv >= 0.0) & (uv <= largest)).all(axis=1))

    def equations(self, uv: Array) -> tuple[Array, Array]:
        """A (4, 3, N) and b (4, N) of eq. 2.3, rows in the order u, v, u', v'; sums over points run along memory."""
        rows = self.cameras[:, :2].reshape(4, 4, 1)
        last = self.cameras[:, 2].repeat(2, axis=0)[:, :, None]
        A = uv.T[:, None] * last[:, :3]
        A -= rows[:, :3]
        return A, rows[:, 3] - uv.T * last[:, 3]

    def intersections(self, uv: Array) -> tuple[Array, Array]:
        """Least squares of eq. 2.3: points (N, 3), m, and which of them are in front of both cameras (N,)."""
        A, b = self.equations(uv)
        AtA = np.einsum("kin,kjn->ijn", A, A)
        inverse, definite = arrays.symmetric_inverses(np.moveaxis(AtA, -1, 0))
        inverse = np.moveaxis(inverse, 0, -1)
        alone = np.einsum("iin,iin->in", inverse, AtA)
        fixed = definite & (alone < 1.0 / FIXED).all(axis=0)
        points = np.einsum("ijn,jn->in", inverse, np.einsum("kin,kn->in", A, b))
        depth = self.cameras[:, 2, :3] @ points + self.cameras[:, 2, 3:]
        far_enough = (depth > NEAREST * self.baseline).all(axis=0)
        near_enough = (depth < FARTHEST * self.baseline).all(axis=0)
        return np.ascontiguousarray(points.T), fixed & far_enough & near_enough


def triangulate(rig: StereoRig, uv: Array) -> Array:
    """Least squares of eq. 2.3 by eq. 2.26.

    Parameters
    ----------
    uv : (N, 4), u, v, u', v', px

    Returns
    -------
    (N, 3), points in the left camera's frame, m

    Raises
    ------
    PointError
        Rays that meet at infinity, at a camera or behind one: zero or negative disparity. See :func:`triangulable`.
    """
    points, good = rig.intersections(arrays.checked_rows("uv", uv, 4))
    if not good.all():
        k = int(np.argmin(good))
        raise PointError(
            f"uv: match {k} has zero or negative disparity, its point is at infinity or behind a camera; leave such "
            "matches out (triangulable tells them)",
            k,
        )
    return points


def triangulable(rig: StereoRig, uv: Array) -> Array:
    """(N, 4) px to (N,) bool: the matches that :func:`triangulate` gives a point in front of both cameras."""
    return rig.intersections(arrays.checked_rows("uv", uv, 4))[1]


def is_rectified(rig: StereoRig) -> bool:
    """Whether rows of both images correspond: same axes and focal lengths, baseline along x within 1 %."""
    if not np.allclose(rig.R, np.eye(3), atol=1e-6):
        return False
    if not np.allclose(rig.K_left[:, :2], rig.K_right[:, :2], rtol=1e-6):
        return False
    if abs(rig.K_left[1, 2] - rig.K_right[1, 2]) >= 1e-3:
        return False
    return bool(np.linalg.norm(rig.t[1:]) <= 0.01 * rig.t[0])


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
