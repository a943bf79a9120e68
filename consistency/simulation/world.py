"""One trial of a scenario, a function of (scenario, seed, run) and of nothing else."""

from __future__ import annotations

import numpy as np

from consistency.errors import InputError
from consistency.models import motion, point, stereo
from consistency.scenario import ListedLandmarks, Scenario, Truth, UvdSensor
from consistency.simulation.path import planned_controls, planned_path, start_pose
from consistency.types import Array, Trial

MOTION_NOISE, OBSERVATION_NOISE = 0, 1  # purposes in the spawn key of the seed


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


def simulate(scenario: Scenario, run: int = 0, seed: int = 0) -> Trial:
    """Truth, controls and observations of run ``run``.

    Returns
    -------
    Trial
        Observations are ordered by step, then by landmark.
    """
    truth = scenario.truth
    landmarks = draw_landmarks(truth)
    true_path, told = _drive(truth, generator(seed, run, MOTION_NOISE))
    reference = planned_path(truth)
    linear = truth.sensor.model == "linear"
    step, landmark = np.nonzero(_visible(truth, reference if linear else true_path, landmarks))
    noise = generator(seed, run, OBSERVATION_NOISE).standard_normal((len(step), 3))
    if linear:
        z = _linear(truth, true_path[step + 1], reference[step + 1], landmarks[landmark])
    else:
        z = _measure(truth, _in_sensor(truth, true_path[step + 1], landmarks[landmark]))
    z = z + noise * np.array(truth.sensor.sigma)
    if isinstance(truth.sensor, UvdSensor):
        low, high = truth.sensor.disparity
        found = (z[:, 2] >= low) & (z[:, 2] <= high)
        step, landmark, z = step[found], landmark[found], z[found]
    first = np.searchsorted(step, np.arange(truth.steps + 1))
    return Trial(run, start_pose(truth), told, first, landmark, z, len(landmarks), true_path, landmarks)


def require_landmarks_in_view(scenario: Scenario) -> None:
    """Raise :class:`InputError` if no landmark comes into view on the planned path."""
    truth = scenario.truth
    path, landmarks = planned_path(truth), draw_landmarks(truth)
    step, landmark = np.nonzero(_visible(truth, path, landmarks))
    if isinstance(truth.sensor, UvdSensor):
        d = _measure(truth, _in_sensor(truth, path[step + 1], landmarks[landmark]))[:, 2]
        low, high = truth.sensor.disparity
        slack = 6.0 * truth.sensor.sigma[2]
        step = step[(d > low - slack) & (d < high + slack)]
    if not len(step):
        raise InputError(
            f"scenario '{scenario.name}': no landmark comes into view in {truth.steps} steps; "
            "check truth.sensor (range, image, f, disparity, mount), truth.landmarks and truth.path"
        )


def _drive(truth: Truth, rng: np.random.Generator) -> tuple[Array, Array]:
    """True poses (T + 1, 3) and the controls (T, 3) that the filter is told."""
    planned = planned_controls(truth)
    noise = np.zeros_like(planned)
    noise[:, 1:] = rng.standard_normal((truth.steps, 2)) * [truth.motion.sigma_v, truth.motion.sigma_omega]
    start = start_pose(truth)
    if truth.motion.model == "linear":
        return _drive_linear(motion.dead_reckoning(start, planned), planned, noise), planned
    if truth.motion.noise_on == "motion":
        return motion.dead_reckoning(start, planned + noise), planned
    return motion.dead_reckoning(start, planned), planned - noise


def _drive_linear(reference: Array, planned: Array, noise: Array) -> Array:
    """Eq. 18 to first order about the reference: error <- F error + G noise, exactly linear."""
    path = reference.copy()
    error = np.zeros(3)
    for k, ((dt, v, _), (_, v_noise, omega_noise)) in enumerate(zip(planned, noise, strict=True)):
        heading = reference[k, 2]
        fx, fy = motion.unicycle_jacobian(heading, dt, v)
        along = dt * v_noise
        error += np.array([fx * error[2], fy * error[2], 0.0])
        error += np.array([along * np.cos(heading), along * np.sin(heading), dt * omega_noise])
        path[k + 1] += error
    return path


def _in_sensor(truth: Truth, poses: Array, landmarks: Array) -> Array:
    """Landmarks in the sensor frame; poses (..., 3) and landmarks (..., 3) broadcast to (..., 3)."""
    body = point.to_robot(*np.moveaxis(poses, -1, 0), *np.moveaxis(landmarks, -1, 0))
    return np.stack(np.broadcast_arrays(*point.to_sensor(*body, truth.sensor.mount.packed())), axis=-1)


def _visible(truth: Truth, path: Array, landmarks: Array) -> Array:
    """Which landmark's true position is in range and in the image in steps 1..T, shape (T, N)."""
    sensor = truth.sensor
    p = _in_sensor(truth, path[1:, None, :], landmarks[None, :, :])
    distance = np.linalg.norm(p, axis=-1)
    seen: Array = (distance >= sensor.range[0]) & (distance <= sensor.range[1])
    if sensor.image is None:
        return seen
    assert sensor.f is not None
    (width, height), (column, row) = sensor.image, sensor.centre
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v, _ = stereo.project(p[..., 0], p[..., 1], p[..., 2], sensor.f, 0.0)
    inside = (u >= -column) & (u < width - column) & (v >= -row) & (v < height - row)
    return np.asarray(seen & (p[..., 0] > 0) & inside)


def _measure(truth: Truth, p: Array) -> Array:
    if isinstance(truth.sensor, UvdSensor):
        return np.stack(stereo.project(p[:, 0], p[:, 1], p[:, 2], truth.sensor.f, truth.sensor.B), axis=-1)
    return p


def _linear(truth: Truth, pose: Array, reference: Array, landmark: Array) -> Array:
    """Eq. 19 to first order in the pose about ``reference``, shapes (M, 3)."""
    x, y, z = point.to_robot(*reference.T, *landmark.T)
    c, s = np.cos(reference[:, 2]), np.sin(reference[:, 2])
    dx, dy, dh = (pose - reference).T
    body = x - c * dx - s * dy + y * dh, y + s * dx - c * dy - x * dh, z
    return np.column_stack(point.to_sensor(*body, truth.sensor.mount.packed()))
