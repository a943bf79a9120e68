"""Scenes of flat layers at several depths; near ones hide far ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.geometry import rotation
from consistency.referee.types import Array, Indices
from consistency.stereo.rendered_images.texture import Texture

NOWHERE = -1  # layer of a ray that hits none


@dataclass(frozen=True, eq=False)
class Layer:
    """A rectangle in a plane.

    Parameters
    ----------
    middle : (3,), in the world, m
    right, down : (3,), unit vectors in the plane, along which its coordinates a and b are counted
    half : half its extent along a and b, m; infinite for a whole plane
    texture : what is painted on it, over a and b
    """

    middle: Array
    right: Array
    down: Array
    half: tuple[float, float]
    texture: Texture

    @classmethod
    def facing(
        cls,
        distance: float,
        texture: Texture,
        centre: tuple[float, float] = (0.0, 0.0),
        size: tuple[float, float] = (np.inf, np.inf),
        slant: float = 0.0,
    ) -> Layer:
        """A layer across the world's x axis.

        Parameters
        ----------
        distance : x of its middle, m
        centre : y and z of its middle, m
        size : width and height, m
        slant : rad by which it is turned about its vertical axis; positive: its right side is farther
        """
        right = np.array([np.sin(slant), -np.cos(slant), 0.0])
        middle = np.array([distance, *centre])
        return cls(middle, right, np.array([0.0, 0.0, -1.0]), (0.5 * size[0], 0.5 * size[1]), texture)

    def meet(self, origin: Array, rays: Array) -> tuple[Array, Array, Array]:
        """Where rays (N, 3) from ``origin`` (3,) meet the plane.

        Returns
        -------
        reach : (N,), in lengths of the ray; not above 0 or infinite where a ray does not meet it
        a, b : (N,), m
        """
        normal = np.cross(self.right, self.down)
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = normal @ (self.middle - origin) / (rays @ normal)
            start = origin - self.middle
            return (
                reach,
                start @ self.right + reach * (rays @ self.right),
                start @ self.down + reach * (rays @ self.down),
            )

    def points(self, a: Array, b: Array) -> Array:
        """Points (N, 3) in the world at coordinates (N,), m."""
        return np.asarray(self.middle + a[:, None] * self.right + b[:, None] * self.down)


@dataclass(frozen=True, eq=False)
class Scene:
    """Layers that do not cut each other, from far to near."""

    layers: tuple[Layer, ...]

    def __post_init__(self) -> None:
        if not self.layers:
            raise InputError("scene: has no layer; give at least one")

    def seen(self, pose: Array, rays: Array) -> tuple[Array, Indices]:
        """What rays hit: the last layer that they meet, for layers stand from far to near.

        Parameters
        ----------
        pose : (6,), of the camera in the world: x, y, z in m, roll, pitch, heading in rad
        rays : (N, 3), in the frame of the camera

        Returns
        -------
        points : (N, 3), in the world, m; NaN where nothing is hit
        layer : (N,), number of the layer, -1 for none
        """
        turned = rays @ rotation(*pose[3:]).T
        points, number = np.full((len(rays), 3), np.nan), np.full(len(rays), NOWHERE)
        for k, layer in enumerate(self.layers):
            reach, a, b = layer.meet(pose[:3], turned)
            hit = (reach > 0.0) & np.isfinite(reach) & (np.abs(a) <= layer.half[0]) & (np.abs(b) <= layer.half[1])
            points[hit], number[hit] = layer.points(a[hit], b[hit]), k
        return points, number


def to_camera(pose: Array, points: Array) -> Array:
    """Points (N, 3) of the world in the frame of a camera at ``pose`` (6,), m."""
    return np.asarray((points - pose[:3]) @ rotation(*pose[3:]))
