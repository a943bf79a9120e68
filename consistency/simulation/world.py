"""Trials of a scenario, each a function of (scenario, seed, run) and of nothing else."""

from __future__ import annotations

import numpy as np

from consistency.errors import InputError
from consistency.models import motion, point, stereo
from consistency.scenario import ListedLandmarks, Scenario, Truth, UvdSensor
from consistency.simulation.path import planned_controls, start_pose
from consistency.types import Array, Indices, Trial

MOTION_NOISE, OBSERVATION_NOISE = 0, 1  # purposes in the spawn key of the seed
BLOCK = 8192  # numbers in each array of a search for what is in view: they stay in the processor's cache

SOME = 50  # steps of the planned path that are searched at a time for a landmark


class World:
    """What all trials of a scenario share, worked out once; any number of threads may ask it for trials."""

    def __init__(self, truth: Truth) -> None:
        self.truth = truth
        self.landmarks = draw_landmarks(truth)
        self.start = start_pose(truth)
        self.planned = planned_controls(truth)
        self.reference = motion.dead_reckoning(self.start, self.planned)
        self.linear = truth.sensor.model == "linear"
        # noise on the odometry leaves the path as planned, and a linear world looks from it
        self.undisturbed = not self.linear and truth.motion.noise_on != "motion"
        always = self.linear or self.undisturbed
        self._in_view = _in_view(truth, self.reference, self.landmarks) if always else None
        self._z = self._noise_free(self.reference, *self._in_view) if self._in_view and self.undisturbed else None

    def trial(self, run: int, seed: int) -> Trial:
        """Truth, controls and observations of run ``run``, as :func:`simulate`."""
        truth, landmarks = self.truth, self.landmarks
        true_path, told = self._drive(generator(seed, run, MOTION_NOISE))
        step, landmark = self._in_view or _in_view(truth, true_path, landmarks)
        noise = generator(seed, run, OBSERVATION_NOISE).standard_normal((len(step), 3))
        z = self._noise_free(true_path, step, landmark) if self._z is None else self._z
        z = z + noise * np.array(truth.sensor.sigma)
        if isinstance(truth.sensor, UvdSensor):
            low, high = truth.sensor.disparity
            found = (z[:, 2] >= low) & (z[:, 2] <= high)
            step, landmark, z = step[found], landmark[found], z[found]
        first = np.searchsorted(step, np.arange(truth.steps + 1))
        return Trial(run, self.start, told, first, landmark, z, len(landmarks), true_path, landmarks)

    def _noise_free(self, path: Array, step: Indices, landmark: Indices) -> Array:
        """Observations (M, 3) of landmarks in steps (from 0)."""
        if self.linear:
            return _linear(self.truth, path[step + 1], self.reference[step + 1], self.landmarks[landmark])
        return _measure(self.truth, path[step + 1], self.landmarks[landmark])

    def _drive(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """True poses (T + 1, 3) and the controls (T, 3) that the filter is told."""
        truth, planned = self.truth, self.planned
        noise = np.zeros_like(planned)
        noise[:, 1:] = rng.standard_normal((truth.steps, 2)) * [truth.motion.sigma_v, truth.motion.sigma_omega]
        if self.linear:
            return _drive_linear(self.reference, planned, noise), planned
        if self.undisturbed:
            return self.reference, planned - noise
        return motion.dead_reckoning(self.start, planned + noise), planned


def simulate(scenario: Scenario, run: int = 0, seed: int = 0) -> Trial:
    """Truth, controls and observations of run ``run``.

    Returns
    -------
    Trial
        Observations are ordered by step, then by landmark.
    """
    return World(scenario.truth).trial(run, seed)


def generator(seed: int, run: int, purpose: int) -> np.random.Generator:
    """The random stream of one purpose in one run: independent of every other run and purpose."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(run, purpose)))


def draw_landmarks(truth: Truth) -> Array:
    """True landmark positions of the scenario's world in m, shape (N, 3); the same in every run."""
    layout = truth.landmarks
    if isinstance(layout, ListedLandmarks):
        return np.array(layout.points)
    low, high = np.array([layout.x, layout.y, layout.z]).T
    return np.random.default_rng(layout.seed).uniform(low, high, size=(layout.count, 3))


def require_landmarks_in_view(scenario: Scenario) -> World:
    """The scenario's world; raises :class:`InputError` if no landmark comes into view on the planned path."""
    truth = scenario.truth
    world = World(truth)
    for k in range(0, truth.steps, SOME):
        path = world.reference[k : k + SOME + 1]
        step, landmark = _in_view(truth, path, world.landmarks)
        if isinstance(truth.sensor, UvdSensor):
            d = _measure(truth, path[step + 1], world.landmarks[landmark])[:, 2]
            low, high = truth.sensor.disparity
            slack = 6.0 * truth.sensor.sigma[2]
            step = step[(d > low - slack) & (d < high + slack)]
        if len(step):
            return world
    raise InputError(
        f"scenario '{scenario.name}': no landmark comes into view in {truth.steps} steps; "
        "check truth.sensor (range, image, f, disparity, mount), truth.landmarks and truth.path"
    )


def _drive_linear(reference: Array, planned: Array, noise: Array) -> Array:
    """Eq. 18 to first order about the reference: error <- F error + G noise, exactly linear."""
    heading, (dt, v, _), (_, v_noise, omega_noise) = reference[:-1, 2], planned.T, noise.T
    turned = np.cumsum(dt * omega_noise)
    before = np.concatenate([[0.0], turned[:-1]])
    along = dt * v_noise
    path = reference.copy()
    for axis, slope, share in zip(
        (0, 1), motion.unicycle_jacobian(heading, dt, v), (np.cos(heading), np.sin(heading)), strict=True
    ):
        path[1:, axis] += np.cumsum(np.column_stack([slope * before, along * share]))[1::2]
    path[1:, 2] += turned
    return path


def _in_view(truth: Truth, path: Array, landmarks: Array) -> tuple[Indices, Indices]:
    """Steps (from 0) and landmarks whose true position is in range and in the image in steps 1..T, by step."""
    x, y, heading = path[1:].T[..., None]
    c, s = np.cos(heading), np.sin(heading)
    rows = max(BLOCK // len(landmarks), 1)
    seen = np.empty((len(path) - 1, len(landmarks)), bool)
    for k in range(0, len(seen), rows):
        here = slice(k, k + rows)
        body = point.turned_to_robot(x[here], y[here], c[here], s[here], *landmarks.T)
        seen[here] = _visible(truth, *point.to_sensor(*body, truth.sensor.mount.packed()))
    step, landmark = np.nonzero(seen)
    return step, landmark


def _visible(truth: Truth, x: Array, y: Array, z: Array) -> Array:
    """Which of the points in the sensor frame are in range and in the image."""
    sensor = truth.sensor
    distance = np.sqrt(x * x + y * y + z * z)
    seen: Array = (distance >= sensor.range[0]) & (distance <= sensor.range[1])
    if sensor.image is None:
        return seen
    assert sensor.f is not None
    (width, height), (column, row) = sensor.image, sensor.centre
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v, _ = stereo.project(x, y, z, sensor.f, 0.0)
    inside = (u >= -column) & (u < width - column) & (v >= -row) & (v < height - row)
    return np.asarray(seen & (x > 0) & inside)


def _measure(truth: Truth, poses: Array, landmarks: Array) -> Array:
    """Landmarks (M, 3) as the sensor at the poses (M, 3) gives them, without noise."""
    p = point.to_sensor(*point.to_robot(*poses.T, *landmarks.T), truth.sensor.mount.packed())
    if isinstance(truth.sensor, UvdSensor):
        p = stereo.project(*p, truth.sensor.f, truth.sensor.B)
    return np.stack(p, axis=-1)


def _linear(truth: Truth, pose: Array, reference: Array, landmark: Array) -> Array:
    """Eq. 19 to first order in the pose about ``reference``, shapes (M, 3)."""
    x, y, z = point.to_robot(*reference.T, *landmark.T)
    c, s = np.cos(reference[:, 2]), np.sin(reference[:, 2])
    dx, dy, dh = (pose - reference).T
    body = x - c * dx - s * dy + y * dh, y + s * dx - c * dy - x * dh, z
    return np.column_stack(point.to_sensor(*body, truth.sensor.mount.packed()))
