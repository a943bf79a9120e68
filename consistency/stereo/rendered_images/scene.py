"""Scenes of flat layers at several depths; near ones hide far ones.

What is painted on a layer: grey values over two coordinates in metres, blurred as a lens would.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.geometry import rotation
from consistency.referee.types import Array, Indices

SAMPLES = 4  # of a tile in the shortest wavelength of its octave
TILE = 256  # samples along the side of a tile: 64 of its shortest wavelengths, after which an octave repeats
FAINT = 1e-3  # an octave that the lens leaves less of than this is not sampled
MIDDLE = 128.0  # grey value about which a texture varies
NOWHERE = -1  # layer of a ray that hits none


class Texture(Protocol):
    """Grey values of a surface."""

    def grey(
        self,
        a: Array,
        b: Array,
        blur: Array | float,
    ) -> Array:
        """Grey values (N,) at ``a``, ``b`` (N,), m, seen through a Gaussian point spread of sd ``blur`` in m."""


@dataclass(frozen=True)
class Plain:
    """One grey value everywhere."""

    value: float = MIDDLE

    def grey(
        self,
        a: Array,
        b: Array,
        blur: Array | float,
    ) -> Array:
        return np.full(a.shape, self.value, np.float32)


@dataclass(frozen=True, eq=False)
class RandomTexture:
    """Sum of octaves of Gaussian noise with the same contrast in each, as natural surfaces have it.

    Each octave is a periodic tile; between its samples the surface is bilinear, in whichever camera it is seen, so that
    geometry is exact. The lens weakens an octave by the transfer of its point spread at the octave's middle frequency.
    So a near surface shows detail that a far one does not, and an image holds next to nothing beyond half its sampling
    rate.
    """

    tiles: tuple[Array, ...]  # (TILE, TILE) each, float32, sd 1
    wavelengths: tuple[float, ...]  # shortest of each octave, m
    contrast: float  # sd of each octave, grey values

    @classmethod
    def draw(
        cls,
        rng: np.random.Generator,
        finest: float = 0.012,
        octaves: int = 7,
        contrast: float = 14.0,
    ) -> RandomTexture:
        """A texture with wavelengths from ``finest`` to ``finest * 2**octaves``, m."""
        frequency = np.fft.fftfreq(TILE)
        radius = np.hypot(frequency[:, None], frequency[None])
        ring = (radius > 0.5 / SAMPLES) & (radius <= 1.0 / SAMPLES)
        tiles = []
        for _ in range(octaves):
            noise = rng.standard_normal((TILE, TILE))
            tile = np.fft.ifft2(np.fft.fft2(noise) * ring).real
            tiles.append((tile / tile.std()).astype(np.float32))
        return cls(tuple(tiles), tuple(finest * 2.0**k for k in range(octaves)), contrast)

    def grey(
        self,
        a: Array,
        b: Array,
        blur: Array | float,
    ) -> Array:
        total = np.full(a.shape, MIDDLE, np.float32)
        for tile, shortest in zip(self.tiles, self.wavelengths, strict=True):
            kept = np.exp(-2.0 * (np.pi * np.asarray(blur) * 0.75 / shortest) ** 2)  # 0.75: middle of the octave
            if np.max(kept) > FAINT:
                scale = SAMPLES / shortest
                contrast = np.float32(self.contrast) * kept.astype(np.float32)
                total += contrast * sampled(tile, scale * b, scale * a)
        return total


@dataclass(frozen=True, eq=False)
class Blobs:
    """Dark Gaussian spots on a bright surface, one at a random place in each cell of a grid that repeats.

    A spot stays clear of the border of its cell by 3 times ``radius``, so that a point sees the spot of its own cell
    and no other; through a lens it is a Gaussian again, wider and fainter.
    """

    offsets: Array  # (n, n, 2), of the spots from the middle of their cells, m
    cell: float  # m
    radius: float  # sd of a spot, m
    depth: float = 90.0  # grey values in the middle of a spot
    ground: float = 170.0

    @classmethod
    def draw(
        cls,
        rng: np.random.Generator,
        cell: float = 0.35,
        radius: float = 0.035,
        count: int = 64,
    ) -> Blobs:
        """Spots in ``count`` by ``count`` cells of side ``cell``."""
        room = max(0.5 * cell - 3.0 * radius, 0.0)
        return cls(rng.uniform(-room, room, (count, count, 2)), cell, radius)

    def centres(self, i: Array, j: Array) -> Array:
        """Middle of the spots (N, 2), a and b in m, in cells ``i`` along a and ``j`` along b."""
        n = len(self.offsets)
        offset = self.offsets[np.mod(j, n), np.mod(i, n)]
        return np.stack([i + 0.5, j + 0.5], axis=-1) * self.cell + offset

    def grey(
        self,
        a: Array,
        b: Array,
        blur: Array | float,
    ) -> Array:
        i = np.floor(a / self.cell).astype(int)
        j = np.floor(b / self.cell).astype(int)
        off = np.stack([a, b], axis=-1) - self.centres(i, j)
        variance = self.radius**2 + np.square(blur)
        squared = np.square(off).sum(axis=-1)
        spot = self.radius**2 / variance * np.exp(-0.5 * squared / variance)
        return np.asarray(self.ground - self.depth * spot, np.float32)


@dataclass(frozen=True)
class Painted:
    """One texture on another, whose values are added."""

    ground: Texture
    marks: Texture

    def grey(
        self,
        a: Array,
        b: Array,
        blur: Array | float,
    ) -> Array:
        return self.ground.grey(a, b, blur) + self.marks.grey(a, b, blur) - MIDDLE


def sampled(tile: Array, row: Array, column: Array) -> Array:
    """Bilinear values (N,) of a periodic tile (n, n), n a power of 2, at rows and columns (N,)."""
    n = tile.shape[0]
    i = np.floor(row)
    j = np.floor(column)
    di = (row - i).astype(np.float32)
    dj = (column - j).astype(np.float32)
    top = i.astype(np.int64) & (n - 1)
    left = j.astype(np.int64) & (n - 1)
    below = (top + 1) & (n - 1)
    right = (left + 1) & (n - 1)
    flat = tile.ravel()
    upper = flat[top * n + left] * (1 - dj) + flat[top * n + right] * dj
    lower = flat[below * n + left] * (1 - dj) + flat[below * n + right] * dj
    return upper * (1 - di) + lower * di


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
        down = np.array([0.0, 0.0, -1.0])
        width, height = size
        return cls(middle, right, down, (0.5 * width, 0.5 * height), texture)

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
        return self.middle + a[:, None] * self.right + b[:, None] * self.down


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
        points = np.full((len(rays), 3), np.nan)
        number = np.full(len(rays), NOWHERE)
        for k, layer in enumerate(self.layers):
            reach, a, b = layer.meet(pose[:3], turned)
            hit = (reach > 0.0) & np.isfinite(reach)
            hit &= (np.abs(a) <= layer.half[0]) & (np.abs(b) <= layer.half[1])
            points[hit] = layer.points(a[hit], b[hit])
            number[hit] = k
        return points, number


def to_camera(pose: Array, points: Array) -> Array:
    """Points (N, 3) of the world in the frame of a camera at ``pose`` (6,), m."""
    return (points - pose[:3]) @ rotation(*pose[3:])
