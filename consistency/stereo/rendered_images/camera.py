"""Cameras as they are: pin-hole, radial distortion, and a rectification that is a little wrong."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from consistency.bench.models import stereo
from consistency.referee.errors import InputError
from consistency.referee.geometry import rotation
from consistency.referee.types import Array

# Herath et al. (2007) sec. 4.5, as herath2007-stereo
FOCAL = 150.0  # px
BASELINE = 0.09  # m
SIZE = (320, 240)  # px
NEWTON = 12  # steps, after which an undistorted radius is exact to rounding


@dataclass(frozen=True)
class Lens:
    """Radial distortion: a point at radius r from the axis, in units of f, is seen at r (1 + k1 r^2 + k2 r^4)."""

    k1: float = 0.0
    k2: float = 0.0

    def distort(self, m: Array) -> Array:
        """Where points (..., 2) are seen, both in units of f."""
        r2 = np.square(m).sum(axis=-1, keepdims=True)
        return m * (1.0 + self.k1 * r2 + self.k2 * r2**2)

    def undistort(self, m: Array) -> Array:
        """The points (..., 2) that are seen at ``m``, by Newton's method on the radius.

        Raises
        ------
        InputError
            The lens folds the image: no point is seen at some ``m``.
        """
        seen = np.sqrt(np.square(m).sum(axis=-1, keepdims=True))
        r = seen.copy()
        for _ in range(NEWTON):
            slope = 1.0 + 3.0 * self.k1 * r**2 + 5.0 * self.k2 * r**4
            if (slope <= 0.0).any():
                raise InputError(
                    f"lens: k1 = {self.k1:g}, k2 = {self.k2:g} folds the image at {seen.max():.2f} times the focal "
                    "length from its centre; give a weaker distortion or a smaller image"
                )
            r -= (r * (1.0 + self.k1 * r**2 + self.k2 * r**4) - seen) / slope
        zoom = np.ones_like(r)
        np.divide(r, seen, out=zoom, where=seen > 0.0)
        return m * zoom


@dataclass(frozen=True)
class Camera:
    """One camera, whose image has been rectified.

    Parameters
    ----------
    f : px
    size : width, height in px
    lens : distortion of the glass
    corrected : distortion that the rectification takes out; with that of the lens nothing is left
    turned : roll, pitch, heading in rad, by which the camera is turned and the rectification does not know
    """

    f: float = FOCAL
    size: tuple[int, int] = SIZE
    lens: Lens = field(default_factory=Lens)
    corrected: Lens = field(default_factory=Lens)
    turned: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @cached_property
    def _R(self) -> Array:
        return rotation(*self.turned)

    @cached_property
    def pixels(self) -> Array:
        """u, v of all pixels (h, w, 2): px from the middle of the image, right and down."""
        width, height = self.size
        v, u = np.indices((height, width))
        return np.stack([u - (width - 1) / 2, v - (height - 1) / 2], axis=-1)

    @cached_property
    def field(self) -> Array:
        """Directions (h, w, 3) that the pixels look in, x forward, y left, z up."""
        return self.rays(self.pixels)

    def rays(self, uv: Array) -> Array:
        """Directions (..., 3) that places (..., 2) of the rectified image really look in; x is about 1."""
        m = self.lens.undistort(self.corrected.distort(np.asarray(uv, float) / self.f))
        rays = np.ones((*m.shape[:-1], 3))
        rays[..., 1:] = -m
        return rays @ self._R.T

    def project(self, points: Array) -> Array:
        """Where points (..., 3) in the camera's nominal frame, m, really are in the rectified image, (..., 2) px."""
        own = points @ self._R
        m = -own[..., 1:] / own[..., :1]
        return self.f * self.corrected.undistort(self.lens.distort(m))


@dataclass(frozen=True)
class StereoCamera:
    """Two cameras side by side; the left one is at the robot's origin, and u, v are those of its image.

    u = -f y/x, v = -f z/x, d = f B/x (Herath et al. 2007, eq. 22), in px from the middle of the image, which is
    (w/2, h/2) from its corner and ((w - 1)/2, (h - 1)/2) from the centre of its first pixel.
    """

    left: Camera = field(default_factory=Camera)
    right: Camera = field(default_factory=Camera)
    B: float = BASELINE  # m

    def __post_init__(self) -> None:
        if (self.left.f, self.left.size) != (self.right.f, self.right.size):
            raise InputError("cameras: rectified images have one focal length and one size; give both cameras the same")

    @classmethod
    def distorted(cls, k1: float, turned: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> StereoCamera:
        """The chapter's camera with a residual distortion ``k1`` in the left image and ``-k1`` in the right one."""
        return cls(Camera(lens=Lens(k1)), Camera(lens=Lens(-k1), turned=turned))

    @property
    def f(self) -> float:
        """Focal length, px."""
        return self.left.f

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of an image, px."""
        return self.left.size

    @property
    def offset(self) -> Array:
        """Place of the right camera in the frame of the left one, (3,), m."""
        return np.array([0.0, -self.B, 0.0])

    def ideal(self, points: Array) -> Array:
        """(u, v, d) in px of points (N, 3) in the robot frame, m, with ideal cameras: Herath et al. (2007) eq. 22."""
        x, y, z = points.T
        return np.stack(stereo.project(x, y, z, self.f, self.B), axis=-1)

    def real(self, points: Array) -> Array:
        """(u, v, d) in px of points (N, 3) with the cameras as they are: what a chain without noise would measure."""
        left = self.left.project(points)
        right = self.right.project(points - self.offset)
        return np.column_stack([left, left[:, 0] - right[:, 0]])

    def inside(self, uv: Array, margin: float = 0.0) -> Array:
        """Whether places (N, 2) px from the middle are in the image and ``margin`` px clear of its border."""
        half = np.array(self.size) / 2.0 - margin
        return np.asarray((np.abs(uv) <= half).all(axis=-1))
