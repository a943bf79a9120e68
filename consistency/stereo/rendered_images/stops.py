"""Experiment 2 of Herath et al. (2007) sec. 3.3: a robot that stands before rendered walls, farther and nearer."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from consistency.referee.types import Array
from consistency.stereo.rendered_images.camera import StereoCamera
from consistency.stereo.rendered_images.chain import Chain, Tracks, join_tracks
from consistency.stereo.rendered_images.render import film
from consistency.stereo.rendered_images.scene import Blobs, Layer, Painted, RandomTexture, Scene, Texture

FINEST, OCTAVES, CONTRAST = 0.1, 4, 12.0  # m, number, grey values: a wall without fine detail


@dataclass(frozen=True)
class Stops:
    """Experiment 2: the robot stands before a wall, at one distance after the other.

    At each stop features are selected in one image and tracked through ``images`` more.
    """

    farthest: float = 6.0  # m
    nearest: float = 1.0
    step: float = 0.05
    images: int = 29
    noise: float = 3.0  # sd of a grey value

    @property
    def distances(self) -> Array:
        """Of all stops, (S,), m, the farthest first."""
        count = round((self.farthest - self.nearest) / self.step) + 1
        return np.linspace(self.farthest, self.nearest, count)


def wall_texture(rng: np.random.Generator) -> Texture:
    """Artificial features on a wall that has no fine detail of its own."""
    return Painted(RandomTexture.draw(rng, FINEST, OCTAVES, CONTRAST), Blobs.draw(rng))


def pose_at(x: float) -> Array:
    """Pose (6,) on the world's x axis, looking along it."""
    return np.array([x, 0.0, 0.0, 0.0, 0.0, 0.0])


def stand(
    chain: Chain,
    camera: StereoCamera,
    stops: Stops,
    rng: np.random.Generator,
    workers: int = 1,
    slant: float = 0.0,
) -> Tracks:
    """Experiment 2 with a new wall at each stop; the sequence of an observation is the number of its stop.

    The result does not depend on ``workers``, the number of threads.
    """

    def one(distance: float, own: np.random.Generator) -> Tracks:
        scene = Scene((Layer.facing(distance, wall_texture(own), slant=slant),))
        poses = np.tile(pose_at(0.0), (stops.images + 1, 1))
        return chain.run(film(scene, camera, poses, own, stops.noise), scene, camera)

    with ThreadPoolExecutor(workers) as threads:
        parts = list(threads.map(one, stops.distances, rng.spawn(len(stops.distances))))
    return join_tracks(parts)
