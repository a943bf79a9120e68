"""The observations of a whole trial, as effects take and give them, and the world that they are made in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from consistency.bench.models import planar, point, stereo
from consistency.bench.scenario.tables.sensor_view import SeeingSensor
from consistency.referee.types import Array, Indices

NO_LANDMARK = -1  # source of an observation that is of no landmark


class Observations:
    """Observations of a trial, row by row, in order of step and then of landmark. Methods give new ones.

    Parameters
    ----------
    step : (M,)
        Steps 1..T.
    landmark : (M,)
        Ids as a filter is told them: 0..N-1 are the landmarks of the world, those from N on are things that are
        not landmarks.
    z : (M, s), or what gives it for (step, landmark)
        (x, y, z) in m, (u, v, d) in px, (dx, dy) in m, or range in m and bearing in rad.
    ids : int
        Ids in use so far: 0..ids-1.
    source : (M,), optional
        Landmark that a row is really of, -1 if it is of none. None: each row is of its ``landmark``.
    """

    __slots__ = ("_z", "ids", "landmark", "source", "step")

    def __init__(
        self,
        step: Indices,
        landmark: Indices,
        z: Array | Callable[[Indices, Indices], Array],
        ids: int,
        source: Indices | None = None,
    ) -> None:
        self.step, self.landmark, self._z, self.ids, self.source = step, landmark, z, ids, source

    def __len__(self) -> int:
        return len(self.step)

    @property
    def z(self) -> Array:
        """Measured values, shape (M, s); those of the ideal observation are worked out when first asked for."""
        if callable(self._z):
            self._z = self._z(self.step, self.landmark)
        return self._z

    @property
    def sources(self) -> Indices:
        """Landmark that each row is really of, shape (M,); -1 where it is of none."""
        return self.landmark if self.source is None else self.source

    def tracks(self) -> tuple[Indices, Indices]:
        """Number of the track of each row from 0 on, and how many rows of it come before; both (M,).

        A track is what is seen of one id in consecutive steps; after a gap a new one begins.
        """
        order = np.argsort(self.landmark, kind="stable")
        landmark, step = self.landmark[order], self.step[order]
        begins = np.ones(len(order), bool)
        begins[1:] = (landmark[1:] != landmark[:-1]) | (step[1:] != step[:-1] + 1)
        track, age = np.empty(len(order), np.int64), np.empty(len(order), np.int64)
        track[order] = number = np.cumsum(begins) - 1
        age[order] = np.arange(len(order)) - np.flatnonzero(begins)[number]
        return track, age

    def keep(self, chosen: Array) -> Observations:
        """The rows for which ``chosen``, of the shape of ``step``, is true."""
        z = self._z if callable(self._z) else self._z[chosen]
        source = None if self.source is None else self.source[chosen]
        return Observations(self.step[chosen], self.landmark[chosen], z, self.ids, source)

    def with_z(self, z: Array, source: Indices | None = None) -> Observations:
        """A copy of the rows with other values ``z`` (M, s), and another ``source`` (M,) where one is given."""
        return Observations(self.step, self.landmark, z, self.ids, self.source if source is None else source)

    def add(self, step: Indices, thing: Indices, z: Array) -> Observations:
        """With K rows more, of things that are not landmarks.

        Parameters
        ----------
        step : (K,)
            Steps 1..T.
        thing : (K,)
            Number of the thing, from 0: rows of one number are a track, one landmark to a filter.
        z : (K, s)
            What is measured of it.
        """
        if len(step) == 0:
            return self
        landmark = np.concatenate([self.landmark, self.ids + np.asarray(thing, np.int64)])
        steps = np.concatenate([self.step, np.asarray(step, np.int64)])
        source = np.concatenate([self.sources, np.full(len(step), NO_LANDMARK)])
        order = np.lexsort((landmark, steps))
        values = np.concatenate([self.z, z])[order]
        return Observations(steps[order], landmark[order], values, int(landmark.max()) + 1, source[order])


@dataclass(frozen=True)
class Context:
    """What an effect may know of a trial: the sensor, the landmarks and the path. Numbers of runs are not there.

    Attributes
    ----------
    sensor : SeeingSensor
    landmarks : (N, 3)
        True positions in the world, m.
    path : (T + 1, 3)
        True x, y (m) and heading (rad, not wrapped) of steps 0..T.
    planned : (T + 1, 3)
        The path without any noise.
    """

    sensor: SeeingSensor
    landmarks: Array
    path: Array
    planned: Array

    @property
    def linear(self) -> bool:
        """Whether the world is linear: to first order about the planned path."""
        return self.sensor.model == "linear"

    @property
    def steps(self) -> int:
        """T, the number of the last step."""
        return len(self.path) - 1

    def ideal(self) -> Observations:
        """Every landmark in every step, without limit and without error.

        ``step`` and ``landmark`` have the shape (T, N) and take no memory; the field of view makes rows of them.
        """
        shape = self.steps, len(self.landmarks)
        step = np.broadcast_to(np.arange(1, shape[0] + 1)[:, None], shape)
        return Observations(step, np.broadcast_to(np.arange(shape[1]), shape), self.measure, shape[1])

    def at(self, step: Indices, landmark: Indices) -> Observations:
        """Ideal observations of landmarks in steps, shapes (M,)."""
        return Observations(step, landmark, self.measure, len(self.landmarks))

    def measure(self, step: Indices, landmark: Indices) -> Array:
        """Ideal measurements (M, s) of landmarks in steps 1..T, in the units of the sensor.

        Herath et al. (2007) eq. 19 and 22, or eq. 19 to first order about the planned path.
        """
        points = self._linearised(step, landmark) if self.linear else self.points(step, landmark)
        if self.sensor.rig is not None:
            points = stereo.project(*points, *self.sensor.rig)
        if self.sensor.model == "range-bearing":
            return np.stack(planar.range_bearing(*points[:2]), axis=-1)
        return np.stack(points[: self.sensor.size], axis=-1)

    def in_image(self, u: Array, v: Array) -> Array:
        """Which pixels, in px from the principal point, are in the image; all of them where it has no bounds."""
        if self.sensor.image is None:
            return np.ones(np.shape(u), bool)
        (width, height), (column, row) = self.sensor.image, self.sensor.centre
        return np.asarray((u >= -column) & (u < width - column) & (v >= -row) & (v < height - row))

    def points(self, step: Indices, landmark: Indices) -> tuple[Array, Array, Array]:
        """True x, y, z of landmarks in the sensor frame in steps 1..T, m, each (M,)."""
        body = point.to_robot(*self.path[step].T, *self.landmarks[landmark].T)
        return point.to_sensor(*body, self.sensor.mount.packed())

    def _linearised(self, step: Indices, landmark: Indices) -> tuple[Array, Array, Array]:
        pose, reference = self.path[step], self.planned[step]
        x, y, z = point.to_robot(*reference.T, *self.landmarks[landmark].T)
        c, s = np.cos(reference[:, 2]), np.sin(reference[:, 2])
        dx, dy, dh = (pose - reference).T
        body = x - c * dx - s * dy + y * dh, y + s * dx - c * dy - x * dh, z
        return point.to_sensor(*body, self.sensor.mount.packed())
