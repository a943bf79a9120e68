"""A textbook filter joined with its compiled twin: the same numbers, a whole trial at once."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np
from threadpoolctl import ThreadpoolController

from consistency.errors import InputError
from consistency.filters.jit import is_compiled
from consistency.filters.local import LOCAL_FROM
from consistency.filters.textbook import ExtendedKalman, sensor_noise
from consistency.filters.trial import REASONS, run_trial
from consistency.models.motion import dead_reckoning
from consistency.protocols import Problem
from consistency.scenario import Belief
from consistency.types import Control, Estimates, Failure, Gaussian, Info, Observation, Trial

_lock = threading.Lock()
_inside: list[Any] = []  # the limit in force, once for every trial that is running


@cache
def _libraries() -> Any:
    return ThreadpoolController()  # looking for them takes longer than a short trial


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """The last bits depend on the number of BLAS threads, and matrices of this size are slower with two."""
    with _lock:
        _inside.append(_inside[-1] if _inside else _libraries().limit(limits=1))
    try:
        yield
    finally:
        with _lock:
            limit = _inside.pop()
            if not _inside:
                limit.restore_original_limits()


class Compiled:
    """``init``, ``predict``, ``update``, ``pose`` of the twin, and ``run`` of the kernel.

    ``local_from``: variables in the state from which the kernel updates locally; the numbers are the same.
    ``innovations``: "optimal" where they are white if the belief is right, see :class:`consistency.protocols.Filter`.
    """

    local_from = LOCAL_FROM

    def __init__(
        self, twin: ExtendedKalman, rule: int, model: int, sensors: tuple[str, ...], innovations: str | None = None
    ) -> None:
        self.twin, self.rule, self.model, self.sensors = twin, rule, model, sensors
        self.innovations = innovations
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
        return is_compiled(run_trial)

    def run(self, trial: Trial, belief: Belief) -> Estimates:
        """Estimates of all steps of ``trial``."""
        sensor, points = belief.sensor, belief.sigma_points
        z, R = sensor_noise(trial.z, sensor, converted=sensor.model == "uvd" and not self.twin.uvd)
        linear = sensor.model == "linear"
        if linear and trial.landmarks is None:
            raise InputError(f"filter '{self.name}' needs the landmarks that its world is linearised about")
        landmarks0 = trial.landmarks if linear else np.zeros((trial.n_landmarks, 3))
        arrays = (
            (trial.controls, float), (trial.first, np.int64), (trial.landmark, np.int64), (z, float), (R, float),
            (trial.start, float), (dead_reckoning(trial.start, trial.controls), float), (landmarks0, float),
            ([belief.motion.sigma_v, belief.motion.sigma_omega], float), (sensor.packed(), float),
            ([points.alpha, points.beta, points.kappa], float),
        )  # fmt: skip
        # copies: writable and C-contiguous, so that one compiled signature serves every caller
        copies = [np.array(a, dtype=kind, order="C") for a, kind in arrays]
        try:
            with one_blas_thread():
                out = run_trial(self.rule, self.model, trial.n_landmarks, *copies, self.local_from)
        except SystemError as error:  # Ctrl-C in the main thread comes out of a kernel like this
            raise KeyboardInterrupt from error
        pose, covariance, nis, nis_dof, step, code = out
        failure = Failure(self.name, trial.run, step, REASONS[code]) if step else None
        return Estimates(self.name, trial.run, pose, covariance, nis, nis_dof, failure)
