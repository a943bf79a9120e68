"""Drives before rendered scenes, for e24 and e25: experiment 1 and figures 6 and 9 of Herath et al. (2007)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from consistency.referee.types import Array
from consistency.stereo.rendered_images.chain import Chain, Stops, Tracks, pose_at, wall_texture
from consistency.stereo.rendered_images.scene import Layer, Plain, RandomTexture, Scene, StereoCamera, film


def retreat(chain: Chain, camera: StereoCamera, stops: Stops, rng: np.random.Generator, shake: float = 0.0) -> Tracks:
    """The tracks of fig. 6: features of the nearest image followed to the farthest one, an image a stop.

    ``shake`` is the sd of roll, pitch and heading at each stop, rad, of which the expected values know nothing.
    """
    scene = Scene((Layer.facing(0.0, wall_texture(rng)),))
    nominal = np.stack([pose_at(-distance) for distance in stops.distances[::-1]])
    return chain.run(film(scene, camera, shaken(nominal, shake, rng), rng, stops.noise, nominal), scene, camera)


def drive(
    chain: Chain,
    camera: StereoCamera,
    scene: Scene,
    rng: np.random.Generator,
    images: int = 100,
    step: float = 0.02,
    noise: float = 3.0,
    shake: float = 0.0,
) -> Tracks:
    """Experiment 1: forward along the x axis, an image each ``step`` m."""
    nominal = np.stack([pose_at(step * k) for k in range(images)])
    return chain.run(film(scene, camera, shaken(nominal, shake, rng), rng, noise, nominal), scene, camera)


def shaken(poses: Array, sd: float, rng: np.random.Generator) -> Array:
    """Poses (F, 6) with independent Gaussian roll, pitch and heading of standard deviation ``sd``, rad."""
    turned = poses.copy()
    if sd > 0.0:
        turned[:, 3:] += sd * rng.standard_normal((len(poses), 3))
    return turned


def office(rng: np.random.Generator, boxes: int = 8) -> Scene:
    """A back wall at 7 m and boxes between 3 and 6 m, all textured."""
    layers = [Layer.facing(7.0, RandomTexture.draw(rng, contrast=10.0))]
    for x in np.sort(rng.uniform(3.0, 6.0, boxes))[::-1]:
        texture = RandomTexture.draw(rng, contrast=rng.uniform(8.0, 24.0))
        centre = float(x * rng.uniform(-0.8, 0.8)), float(x * rng.uniform(-0.5, 0.5))
        size = float(rng.uniform(0.5, 1.5)), float(rng.uniform(0.5, 1.5))
        layers.append(Layer.facing(float(x), texture, centre, size, float(rng.uniform(-0.5, 0.5))))
    return Scene(tuple(layers))


def partition(rng: np.random.Generator, poles: int = 5, posters: int = 24) -> Scene:
    """Fig. 9: poles before the horizontal edges of a plain partition, before a wall with posters.

    Where a pole crosses an edge the image has a corner, and the world has no point. The corners of posters are points.
    """
    layers = [Layer.facing(6.0, RandomTexture.draw(rng, contrast=5.0))]
    for y, z in zip(rng.uniform(-5.0, 5.0, posters), rng.uniform(-0.3, 4.0, posters), strict=True):
        size = float(rng.uniform(0.5, 0.9)), float(rng.uniform(0.4, 0.8))
        layers.append(Layer.facing(5.999, Plain(float(rng.choice([40.0, 220.0]))), (float(y), float(z)), size))
    layers.append(Layer.facing(4.0, Plain(75.0), (0.0, -1.6), (20.0, 2.6)))
    layers.append(Layer.facing(4.5, Plain(180.0), (0.0, 1.6), (20.0, 0.4)))
    places = np.linspace(-1.5, 1.5, poles) + rng.uniform(-0.2, 0.2, poles)
    for x, k in zip(np.sort(rng.uniform(2.0, 3.0, poles))[::-1], rng.permutation(poles), strict=True):
        grey = float(rng.choice([20.0, 240.0]))
        layers.append(Layer.facing(float(x), Plain(grey), (float(places[k]), 0.0), (0.12, 8.0)))
    return Scene(tuple(layers))


def rigid_residual(tracks: Tracks, poses: Array, camera: StereoCamera, steps: int = 4) -> tuple[Array, Array]:
    """How far each track is from that of a rigid point.

    The point is the least-squares fit to u and v of all frames in which the track is, by weighted linear equations.

    Parameters
    ----------
    poses : (F, 6), nominal poses; their attitudes must be zero

    Returns
    -------
    track : (K,), numbers of the tracks
    residual : (K,), root mean square of u and v about the projections of the point, px; NaN below 3 frames
    """
    numbers = np.unique(tracks.track)
    residual = np.full(len(numbers), np.nan)
    for row, number in enumerate(numbers):
        own = tracks.track == number
        if own.sum() >= 3:
            residual[row] = _residual(tracks.z[own, :2], poses[tracks.frame[own], :3], camera.f, steps)
    return numbers, residual


def _residual(uv: Array, places: Array, f: float, steps: int) -> float:
    """Of one track: uv (n, 2) seen from places (n, 3)."""
    zero = np.zeros(len(uv))
    rows = np.concatenate(
        [np.stack([uv[:, 0], zero + f, zero], axis=-1), np.stack([uv[:, 1], zero, zero + f], axis=-1)]
    )
    twice = np.concatenate([places, places])
    weight = np.ones(len(rows))
    for _ in range(steps):  # rows are residuals times depth: weights are one over it
        point = np.linalg.lstsq(weight[:, None] * rows, weight * (rows * twice).sum(axis=1))[0]
        depth = point[0] - twice[:, 0]
        weight = 1.0 / np.where(np.abs(depth) > 0.05, depth, 0.05)
    error = weight * (rows * (point - twice)).sum(axis=1)
    return float(np.sqrt(np.mean(error**2)))


def bootstrap(
    rng: np.random.Generator, parts: list[Array], statistic: Callable[[Array], Array], draws: int, level: float
) -> tuple[float, float]:
    """Interval of the least entry of a statistic of all parts together, from drawing parts with replacement."""
    drawn = [
        np.min(statistic(np.concatenate([parts[k] for k in rng.integers(0, len(parts), len(parts))])))
        for _ in range(draws)
    ]
    low, high = np.quantile(drawn, [level / 2, 1 - level / 2])
    return float(low), float(high)
