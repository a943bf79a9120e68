"""Data sets and clocks of ``bench.py``: trials built for timing, interleaved measurements, equality.

A step is timed through whole trials, never through the inside of a filter: the trials see what the row says in
each step and are so long that their first step does not count.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

import consistency as cs
from consistency.bench.filters.filter_inputs import problem_of
from consistency.bench.scenario import Belief, models
from consistency.bench.types import Estimates
from consistency.referee.types import Array

LANDMARKS, SEEN = 57, 12  # in the state and in each step: the sizes that the targets are stated for
SHIFT = 5  # landmarks by which the window of the seen ones moves on in each step
TOLERANCE = 1e-8  # poses in m and rad, covariances in correlation units
SEED = 20070102

Work = Callable[[], object]


class Unequal(AssertionError):
    """Two implementations of one filter do not say the same."""


@dataclass(frozen=True)
class Case:
    """A trial and what the filter believes."""

    trial: cs.Trial
    belief: Belief

    def run(self, name: str) -> Estimates:
        """The trial through a built-in filter; a failed run is no measurement."""
        estimates: Estimates = cs.get_filter(name).run(self.trial, self.belief)
        if estimates.failure:
            raise RuntimeError(f"{name} failed in step {estimates.failure.step}: {estimates.failure.reason}")
        return estimates

    def head(self, steps: int) -> Case:
        t, last = self.trial, self.trial.first[steps]
        short = cs.Trial(
            t.run, t.start, t.controls[:steps], t.first[: steps + 1], t.landmark[:last], t.z[:last], t.n_landmarks
        )
        return Case(short, self.belief)


def steady(steps: int, landmarks: int = LANDMARKS, seen: int = SEEN) -> Case:
    """Stereo: all landmarks are seen in step 1, then exactly ``seen`` a step, in turn, by a robot that sways."""
    rng = np.random.default_rng(SEED)
    belief = cs.load_scenario("herath2007-wide-baseline").belief
    true = rng.uniform([3.0, -3.0, -1.0], [8.0, 3.0, 1.0], (landmarks, 3))
    phase = 2 * np.pi * np.arange(steps) / 100
    path, controls = _drive(np.column_stack([0.5 * np.cos(phase), 0.2 * np.sin(phase)]), belief, rng)
    windows = [(SHIFT * k + np.arange(seen)) % landmarks for k in range(steps - 1)]
    return _observed([np.arange(landmarks), *map(np.sort, windows)], true, path, controls, belief, rng)


def growing(landmarks: int, stride: int, seen: int = SEEN) -> Case:
    """Points in metres: straight on, ``seen`` in view, a new landmark every ``stride`` steps, up to ``landmarks``."""
    starts = np.repeat(np.arange(landmarks - seen + 1), stride)
    return _corridor([start + np.arange(seen) for start in starts], landmarks, stride)


def grown(landmarks: int, steps: int, seen: int = SEEN) -> Case:
    """The same with all landmarks in the state after step 1, then a window that moves on by one a step."""
    windows = [(k + np.arange(seen)) % landmarks for k in range(steps - 1)]
    return _corridor([np.arange(landmarks), *map(np.sort, windows)], landmarks, 1)


def _corridor(views: list[Array], landmarks: int, stride: int) -> Case:
    rng = np.random.default_rng(SEED)
    belief = cs.load_scenario("herath2007-xyz").belief
    true = rng.uniform([1.0, -2.0, -1.0], [4.0, 2.0, 1.0], (landmarks, 3))
    true[:, 0] += 0.05 * stride * np.arange(landmarks)
    path, controls = _drive(np.tile([0.5, 0.0], (len(views), 1)), belief, rng)
    return _observed(views, true, path, controls, belief, rng)


def _drive(velocities: Array, belief: Belief, rng: np.random.Generator) -> tuple[Array, Array]:
    """Path (T + 1, 3) of the velocities (T, 2) in steps of 0.1 s, and the controls that the filter is told."""
    planned = np.column_stack([np.full(len(velocities), 0.1), velocities])
    controls = planned.copy()
    controls[:, 1:] += rng.standard_normal(velocities.shape) * [belief.motion.sigma_v, belief.motion.sigma_omega]
    return models.dead_reckoning(np.zeros(3), planned), controls


def _observed(
    views: list[Array], true: Array, path: Array, controls: Array, belief: Belief, rng: np.random.Generator
) -> Case:
    counts = np.array([len(view) for view in views])
    landmark, step = np.concatenate(views), np.repeat(np.arange(len(views)), counts)
    sensor = belief.sensor
    body = models.to_robot(*path[step + 1].T, *true[landmark].T)
    c = models.to_sensor(*body, sensor.mount.packed())
    z = np.column_stack(models.project(*c, sensor.f or 0.0, sensor.B or 0.0) if sensor.model == "uvd" else c)
    z += rng.standard_normal(z.shape) * np.array(sensor.sigma)
    first = np.concatenate([[0], np.cumsum(counts)])
    return Case(cs.Trial(0, path[0], controls, first, landmark, z, len(true), path), belief)


# --- equality ------------------------------------------------------------------------------------


def twin_state(case: Case, name: str, steps: int) -> tuple[Array, Array]:
    """State x (n,) and P (n, n) after the first steps, by the textbook twin: where the peers start."""
    filter_ = cs.get_filter(name)
    state = filter_.init(problem_of(case.trial, case.belief))
    for step in range(1, steps + 1):
        state = filter_.predict(state, case.trial.control(step))
        state, _ = filter_.update(state, case.trial.observation(step))
    return state.x, state.P


def require_equal(what: str, pose: Array, covariance: Array, ours: Estimates, first: int) -> float:
    """Largest difference of a peer's poses and covariances from ours, of steps ``first`` + 1 on.

    Raises
    ------
    Unequal
        It is above ``TOLERANCE``, or not a number.
    """
    steps = slice(first, first + len(pose))
    P = ours.covariance[steps]
    sigma = np.sqrt(np.einsum("kii->ki", P))
    gaps = (np.abs(pose - ours.pose[steps]), np.abs(covariance - P) / (sigma[:, :, None] * sigma[:, None, :]))
    gap = max(float(np.max(each)) for each in gaps)
    if not gap < TOLERANCE:
        raise Unequal(f"{what}: differs from ours by {gap:.2g}, allowed {TOLERANCE:g}")
    return gap


# --- time ------------------------------------------------------------------------------------------


def interleaved(works: Mapping[str, Work], repeats: int, warm: bool = True) -> dict[str, float]:
    """Median seconds of each work; in every round each is done once, so that all see the same machine."""
    if warm:
        for work in works.values():
            work()
    seconds: dict[str, list[float]] = {name: [] for name in works}
    names = list(works)
    for each in range(repeats):
        for name in names if each % 2 == 0 else names[::-1]:
            started = time.perf_counter()
            works[name]()
            seconds[name].append(time.perf_counter() - started)
    return {name: float(np.median(values)) for name, values in seconds.items()}
