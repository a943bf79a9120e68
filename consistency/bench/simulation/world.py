"""Trials of a scenario, each a function of (scenario, seed, run) and of nothing else."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from consistency.bench.models import motion
from consistency.bench.scenario import (
    AnnularLandmarks,
    CircularLandmarks,
    ListedLandmarks,
    Scenario,
    TrueSensor,
    Truth,
    UvdSensor,
    load_scenario,
)
from consistency.bench.scenario.effects import (
    Context,
    Effect,
    FieldOfView,
    ListedEffect,
    Noise,
    Observations,
    SearchRange,
)
from consistency.bench.simulation.path import planned_controls, start_pose
from consistency.bench.types import Trial
from consistency.referee.errors import InputError
from consistency.referee.types import Array

MOTION_NOISE, OBSERVATION_NOISE = 0, 1  # purposes in the spawn key of the seed


def generator(seed: int, run: int, purpose: int) -> np.random.Generator:
    """The random stream of one purpose in one run: independent of every other run and purpose."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(run, purpose)))


def purpose_of(label: str) -> int:
    """Purpose of an effect's random stream: a hash of its label, and 1 for the noise that every sensor has."""
    if label == Noise.label:
        return OBSERVATION_NOISE
    return int.from_bytes(hashlib.sha256(label.encode()).digest()[:8], "big")


def effects_of(sensor: TrueSensor) -> list[Effect]:
    """Field of view, noise, what the scenario lists, search range; a listed effect may stand before the noise."""
    early = [effect for effect in sensor.effects if effect.before_noise]
    late = [effect for effect in sensor.effects if not effect.before_noise]
    search = [SearchRange(*sensor.disparity)] if isinstance(sensor, UvdSensor) else []
    noise = Noise(sensor.sigma, sensor.disparity_growth if isinstance(sensor, UvdSensor) else None)
    return [FieldOfView(), *early, noise, *late, *search]


class EffectChain:
    """Effects applied one after the other, each with the purpose of its random stream, None if it draws nothing.

    What the first effects do is the same in every run if it depends on the path alone and the path is the same:
    :meth:`shared` works it out once.
    """

    def __init__(self, effects: Sequence[Effect]) -> None:
        self._links = [(effect, purpose_of(effect.label) if effect.draws else None) for effect in effects]

    def leading(self) -> int:
        """How many effects come before the first that draws random numbers."""
        return next((i for i, (_, purpose) in enumerate(self._links) if purpose is not None), len(self._links))

    def shared(self, context: Context, number: int) -> Observations:
        """The ideal observations after the first ``number`` effects, which draw no random numbers."""
        return _after(self._links[:number], context.ideal(), context, 0, 0)

    def rest(self, observations: Observations, context: Context, number: int, run: int, seed: int) -> Observations:
        """``observations`` after all effects but the first ``number``, in one run."""
        return _after(self._links[number:], observations, context, run, seed)


def _after(
    links: list[tuple[Effect, int | None]], observations: Observations, context: Context, run: int, seed: int
) -> Observations:
    for effect, purpose in links:
        rng = generator(seed, run, purpose) if purpose is not None else _NoNumbers(effect.label)
        observations = effect.apply(observations, cast(np.random.Generator, rng), context)
        if isinstance(effect, ListedEffect):
            _require_sound(effect.label, observations, context)
    return observations


class _NoNumbers:
    """In the place of a generator for an effect that says it draws nothing."""

    def __init__(self, label: str) -> None:
        self._label = label

    def __getattr__(self, name: str) -> Any:
        raise TypeError(f"the effect '{self._label}' says draws = False and asks for random numbers")


def _require_sound(label: str, observations: Observations, context: Context) -> None:
    """Refuse what a filter cannot be given: a mistake in the effect, not in the scenario."""
    step, z = observations.step, observations.z
    shape = len(step), context.sensor.size
    if z.shape != shape or not np.isfinite(z).all():
        raise ValueError(f"the effect '{label}' must give finite values of shape {shape}")
    if len(step) and (step[0] < 1 or step[-1] > context.steps):
        raise ValueError(f"the effect '{label}' must give steps from 1 to {context.steps}")
    if (np.diff(step * observations.ids + observations.landmark) <= 0).any():
        raise ValueError(f"the effect '{label}' must give each landmark once in a step, in order of step and landmark")
    if context.linear and observations.ids > len(context.landmarks):
        raise InputError(
            f"the effect '{label}' (truth.sensor.effects) observes things that are not landmarks, and a linear sensor "
            "has nothing to be linearised about for them; use the model 'xyz' or 'uvd'"
        )


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
        self._number = 0
        if self.linear:
            self._number = 1
        elif self.undisturbed:
            self._number = self._chain.leading()
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
        begun = self._shared
        if begun is None:
            begun = context.ideal()
        elif self.linear:
            begun = context.at(begun.step, begun.landmark)
        observations = self._chain.rest(begun, context, self._number, run, seed)
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
            seed=seed,
        )

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


def simulate(scenario: Scenario | str | Path, run: int = 0, seed: int = 0) -> Trial:
    """Truth, controls and observations of run ``run`` of a scenario, which may be given by its name or file.

    Returns
    -------
    Trial
        Observations are ordered by step, then by landmark.
    """
    return World(load_scenario(scenario).truth).trial(run, seed)


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
    pose_before = np.concatenate([[0.0], turned[:-1]])
    along = dt * v_noise
    path = reference.copy()
    for axis, slope, share in zip(
        (0, 1), motion.unicycle_jacobian(heading, dt, v), (np.cos(heading), np.sin(heading)), strict=True
    ):
        path[1:, axis] += np.cumsum(np.column_stack([slope * pose_before, along * share]))[1::2]
    path[1:, 2] += turned
    return path
