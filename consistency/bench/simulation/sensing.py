"""The effects of a sensor in the order in which they are applied, each with a random stream of its own."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from consistency.bench.scenario import TrueSensor, UvdSensor
from consistency.bench.scenario.effects import (
    Context,
    Effect,
    FieldOfView,
    ListedEffect,
    Noise,
    Observations,
    SearchRange,
)
from consistency.referee.errors import InputError

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
