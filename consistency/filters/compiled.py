"""A textbook filter joined with its compiled twin: the same numbers, a whole trial at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from consistency.filters.jit import is_compiled
from consistency.filters.textbook import ExtendedKalman, sensor_noise
from consistency.filters.trial import REASONS
from consistency.models.motion import dead_reckoning
from consistency.protocols import Problem
from consistency.scenario import Belief
from consistency.types import Control, Estimates, Failure, Gaussian, Info, Observation, Trial


class Compiled:
    """``init``, ``predict``, ``update``, ``pose`` of the twin, and ``run`` of the kernel."""

    def __init__(self, twin: ExtendedKalman, entry: Callable[..., Any], sensors: tuple[str, ...]) -> None:
        self.twin, self.entry, self.sensors = twin, entry, sensors
        self.name = twin.name

    def init(self, problem: Problem) -> Any:
        return self.twin.init(problem)

    def predict(self, state: Any, control: Control) -> Any:
        return self.twin.predict(state, control)

    def update(self, state: Any, observation: Observation) -> tuple[Any, Info]:
        return self.twin.update(state, observation)

    def pose(self, state: Any) -> Gaussian:
        return self.twin.pose(state)

    @property
    def is_compiled(self) -> bool:
        """Whether ``run`` starts at once, or spends seconds on compiling first."""
        return is_compiled(self.entry)

    def run(self, trial: Trial, belief: Belief) -> Estimates:
        """Estimates of all steps of ``trial``."""
        sensor, points = belief.sensor, belief.sigma_points
        z, R = sensor_noise(trial.z, sensor, converted=sensor.model == "uvd" and not self.twin.uvd)
        linear = sensor.model == "linear"
        pose, covariance, nis, nis_dof, step, code = self.entry(
            trial.controls,
            trial.first,
            trial.landmark,
            np.ascontiguousarray(z),
            R,
            trial.n_landmarks,
            trial.start,
            dead_reckoning(trial.start, trial.controls),
            trial.landmarks if linear and trial.landmarks is not None else np.zeros((trial.n_landmarks, 3)),
            np.array([belief.motion.sigma_v, belief.motion.sigma_omega]),
            sensor.packed(),
            np.array([points.alpha, points.beta, points.kappa]),
        )
        failure = Failure(self.name, trial.run, step, REASONS[code]) if step else None
        return Estimates(self.name, trial.run, pose, covariance, nis, nis_dof, failure)
