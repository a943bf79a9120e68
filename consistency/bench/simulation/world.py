"""Trials of a scenario, each a function of (scenario, seed, run) and of nothing else."""

from __future__ import annotations

import numpy as np

from consistency.bench.models import motion
from consistency.bench.scenario import (
    AnnularLandmarks,
    CircularLandmarks,
    ListedLandmarks,
    Scenario,
    Truth,
    UvdSensor,
)
from consistency.bench.scenario.effects import Context, FieldOfView, Observations
from consistency.bench.simulation.path import planned_controls, start_pose
from consistency.bench.simulation.sensing import MOTION_NOISE, EffectChain, effects_of, generator
from consistency.bench.types import Trial
from consistency.referee.errors import InputError
from consistency.referee.types import Array

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
        self._chain = EffectChain(effects_of(truth.sensor))
        self._number = 1 if self.linear else self._chain.leading() if self.undisturbed else 0
        self._shared = self._chain.shared(self.context(self.reference), self._number) if self._number else None
        if self._shared is not None and self.undisturbed:
            _ = self._shared.z  # now, and not in several threads at once
        self._ends = np.arange(1, truth.steps + 2)

    def context(self, path: Array) -> Context:
        """What an effect may know of a trial along ``path`` (T + 1, 3)."""
        return Context(self.truth.sensor, self.landmarks, path, self.reference)

    def trial(self, run: int, seed: int) -> Trial:
        """Truth, controls and observations of run ``run``, as :func:`simulate`."""
        true_path, controls = self._drive(generator(seed, run, MOTION_NOISE))
        context = self.context(true_path)
        observations = self._chain.rest(self._begin(context), context, self._number, run, seed)
        first = np.searchsorted(observations.step, self._ends)
        return Trial(
            run,
            self.start,
            controls,
            first,
            observations.landmark,
            observations.z,
            observations.ids,
            true_path,
            self.landmarks,
            None if np.array_equal(observations.sources, observations.landmark) else observations.source,
        )

    def _begin(self, context: Context) -> Observations:
        """The observations of a run after the effects that are the same in every run."""
        if self._shared is None:
            return context.ideal()
        return context.at(self._shared.step, self._shared.landmark) if self.linear else self._shared

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


def draw_landmarks(truth: Truth) -> Array:
    """True landmark positions of the scenario's world in m, shape (N, 3); the same in every run."""
    layout = truth.landmarks
    if isinstance(layout, ListedLandmarks):
        return np.array(layout.points)
    if isinstance(layout, CircularLandmarks):
        angle = 2.0 * np.pi * np.arange(layout.count) / layout.count
        return _around(layout.centre, np.full(layout.count, layout.radius), angle)
    if isinstance(layout, AnnularLandmarks):
        rng, (near, far) = np.random.default_rng(layout.seed), np.array(layout.rings).T
        radius = rng.uniform(near, far, size=(layout.count, len(near))).T.ravel()
        return _around(layout.centre, radius, rng.uniform(0.0, 2.0 * np.pi, size=len(radius)))
    low, high = np.array([layout.x, layout.y, layout.z]).T
    return np.random.default_rng(layout.seed).uniform(low, high, size=(layout.count, 3))


def _around(centre: tuple[float, float], radius: Array, angle: Array) -> Array:
    """Points (N, 3) at height 0 at some distances (N,) in some directions (N,) from a centre."""
    points = centre + radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.column_stack([points, np.zeros(len(points))])


def require_landmarks_in_view(scenario: Scenario) -> World:
    """The scenario's world; raises :class:`InputError` if no landmark comes into view on the planned path."""
    truth, sensor = scenario.truth, scenario.truth.sensor
    world = World(truth)
    for k in range(0, truth.steps, SOME):
        here = slice(k, k + SOME + 1)
        context = Context(sensor, world.landmarks, world.reference[here], world.reference[here])
        observations = EffectChain([FieldOfView()]).shared(context, 1)
        # effects that are listed may bring any disparity into the search range
        if isinstance(sensor, UvdSensor) and not sensor.effects:
            low, high = sensor.disparity
            slack = 6.0 * sensor.sigma[2]
            observations = observations.keep(
                (observations.z[:, 2] > low - slack) & (observations.z[:, 2] < high + slack)
            )
        if len(observations):
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
