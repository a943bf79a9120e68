"""Image pairs of a scene: exact geometry, a Gaussian point spread, and grey noise.

The point spread is round on the surface that is seen, as wide as at the depth of the pixel: exact for a surface that
faces the camera, and on a slanted one too narrow along the slant.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from consistency.referee.geometry import rotation
from consistency.referee.types import Array
from consistency.stereo.rendered_images.camera import Camera, StereoCamera
from consistency.stereo.rendered_images.scene import MIDDLE, Layer, Scene

BLUR = 0.7  # px, sd of the point spread: it leaves 9 % at half the sampling rate, and nothing that could alias
REACH = 4.0  # sd of the point spread beyond which the border of a layer is not seen
COARSE = 8  # px between the rays by which a layer is found in the image


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
