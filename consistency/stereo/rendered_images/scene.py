"""Scenes of flat layers at several depths, cameras with lenses, and image pairs that they take of them.

What is painted on a layer are grey values over two coordinates in metres, blurred as a lens would.

The point spread is round on the surface that is seen, as wide as at the depth of the pixel: exact for a surface that
faces the camera, and on a slanted one too narrow along the slant.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from scipy.special import ndtr

from consistency.bench.scenario import models
from consistency.referee.errors import InputError
from consistency.referee.geometry import rotation
from consistency.referee.types import Array, Indices

SAMPLES = 4  # of a tile in the shortest wavelength of its octave
TILE = 256  # samples along the side of a tile: 64 of its shortest wavelengths, after which an octave repeats
FAINT = 1e-3  # an octave that the lens leaves less of than this is not sampled
MIDDLE = 128.0  # grey value about which a texture varies
NOWHERE = -1  # layer of a ray that hits none
# Herath et al. (2007) sec. 4.5, as herath2007-stereo
FOCAL = 150.0  # px
BASELINE = 0.09  # m
SIZE = (320, 240)  # px
NEWTON = 12  # steps, after which an undistorted radius is exact to rounding
BLUR = 0.7  # px, sd of the point spread: it leaves 9 % at half the sampling rate, and nothing that could alias
REACH = 4.0  # sd of the point spread beyond which the border of a layer is not seen
COARSE = 8  # px between the rays by which a layer is found in the image


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
        return np.stack(models.project(x, y, z, self.f, self.B), axis=-1)

    def real(self, points: Array) -> Array:
        """(u, v, d) in px of points (N, 3) with the cameras as they are: what a chain without noise would measure."""
        left = self.left.project(points)
        right = self.right.project(points - self.offset)
        return np.column_stack([left, left[:, 0] - right[:, 0]])

    def inside(self, uv: Array, margin: float = 0.0) -> Array:
        """Whether places (N, 2) px from the middle are in the image and ``margin`` px clear of its border."""
        half = np.array(self.size) / 2.0 - margin
        return np.asarray((np.abs(uv) <= half).all(axis=-1))


class StereoFrame(NamedTuple):
    """One image pair and where it was taken."""

    left: Array  # (h, w), 8-bit
    right: Array
    pose: Array  # (6,), where the camera was: x, y, z (m), roll, pitch, heading (rad)
    nominal: Array  # (6,), where it is said to have been


def render(
    scene: Scene,
    camera: Camera,
    pose: Array,
    offset: Array | None = None,
) -> Array:
    """Image (h, w) of a scene without noise, grey values as float.

    Parameters
    ----------
    pose : (6,), of the robot in the world: x, y, z in m, roll, pitch, heading in rad
    offset : (3,), of the camera in the robot frame, m; None for none
    """
    R = rotation(*pose[3:])
    origin = pose[:3]
    if offset is not None:
        origin = origin + R @ offset
    rays = camera.field @ R.T
    image = np.full(rays.shape[:2], MIDDLE, np.float32)
    for layer in scene.layers:
        where = _box(layer, origin, rays, camera.f)
        if where is not None:
            part = image[where]
            painted = _painted(part.ravel(), layer, origin, rays[where].reshape(-1, 3), camera.f)
            image[where] = painted.reshape(part.shape)
    return image


def _near(
    layer: Layer,
    reach: Array,
    a: Array,
    b: Array,
    margin: Array,
) -> Array:
    """Which of the places on a plane are on the layer or within ``margin`` m of it, and before the camera."""
    with np.errstate(invalid="ignore"):
        inside = np.abs(a) < layer.half[0] + margin
        inside &= np.abs(b) < layer.half[1] + margin
        return inside & (reach > 0.0) & np.isfinite(reach)


def _box(
    layer: Layer,
    origin: Array,
    rays: Array,
    f: float,
) -> tuple[slice, slice] | None:
    """Rows and columns of an image whose rays (h, w, 3) may meet the layer, from every COARSE-th of them."""
    coarse = rays[::COARSE, ::COARSE]
    reach, a, b = layer.meet(origin, coarse.reshape(-1, 3))
    margin = (2.0 * COARSE + REACH * BLUR) / f * reach
    near = _near(layer, reach, a, b, margin).reshape(coarse.shape[:2])
    if not near.any():
        return None
    return _extent(near.sum(axis=1)), _extent(near.sum(axis=0))


def _extent(near: Array) -> slice:
    """The part of an image, along one axis, around every ``COARSE``-th place that is near."""
    places = np.flatnonzero(near) * COARSE
    return slice(max(places[0] - COARSE, 0), places[-1] + 2 * COARSE)


def _painted(
    image: Array,
    layer: Layer,
    origin: Array,
    rays: Array,
    f: float,
) -> Array:
    """A layer before what ``image`` (N,) shows along ``rays`` (N, 3)."""
    reach, a, b = layer.meet(origin, rays)
    blur = BLUR / f * reach  # rays have length 1 along the axis: their reach is the depth
    hit = _near(layer, reach, a, b, REACH * blur)
    if not hit.any():
        return image
    if not hit.all():
        a = a[hit]
        b = b[hit]
        blur = blur[hit]
    one_blur = blur
    if np.ptp(blur) < 1e-9 * blur[0]:
        one_blur = blur[0]
    own = layer.texture.grey(a, b, one_blur)
    if np.isfinite(layer.half).any():
        cover = _covered(a, layer.half[0], blur) * _covered(b, layer.half[1], blur)
        own = cover * own + (1.0 - cover) * image[hit]
    result = image.copy()
    result[hit] = own
    return result


def _covered(place: Array, half: float, blur: Array) -> Array:
    """Share of the point spread that is within ``half`` of the middle, along one axis."""
    return ndtr((half - place) / blur) - ndtr((-half - place) / blur)


def render_pair(scene: Scene, camera: StereoCamera, pose: Array) -> tuple[Array, Array]:
    """Left and right image (h, w) without noise, grey values as float."""
    return render(scene, camera.left, pose), render(scene, camera.right, pose, camera.offset)


def digitised(image: Array, noise: float, rng: np.random.Generator) -> Array:
    """Image (h, w) with Gaussian grey noise of sd ``noise``, as 8-bit."""
    drawn = rng.standard_normal(image.shape, np.float32)
    noisy = np.rint(image + np.float32(noise) * drawn)
    return np.clip(noisy, 0, 255).astype(np.uint8)


def film(
    scene: Scene,
    camera: StereoCamera,
    poses: Sequence[Array] | Array,
    rng: np.random.Generator,
    noise: float = 3.0,
    nominal: Sequence[Array] | Array | None = None,
) -> Iterator[StereoFrame]:
    """Frames of a scene, with new noise in each; a pose that repeats is rendered once.

    Parameters
    ----------
    poses : (F, 6), where the camera is: x, y, z in m, roll, pitch, heading in rad
    noise : sd of the grey noise of a pixel
    nominal : (F, 6), where it is said to be; None for ``poses``
    """
    if nominal is None:
        nominal = poses
    last = np.empty(0)
    for pose, stated in zip(poses, nominal, strict=True):
        if not np.array_equal(pose, last):
            last = pose
            left, right = render_pair(scene, camera, pose)
        seen_left = digitised(left, noise, rng)
        seen_right = digitised(right, noise, rng)
        yield StereoFrame(seen_left, seen_right, np.asarray(pose), np.asarray(stated))
