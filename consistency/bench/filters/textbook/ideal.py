"""EKF-SLAM with every Jacobian at the truth, Huang, Mourikis & Roumeliotis (2010), IJRR 29(5): the ideal EKF.

f and h are evaluated at the estimate, as in the EKF. No robot knows where it is, so this is a bound and not a filter
to use (``realisable`` is False): it shows what is lost by linearising at estimates, and what no choice of points would
mend. It needs a trial whose truth is known, simulated or recorded.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.basics import SlamState, view
from consistency.bench.filters.textbook.ekf import ExtendedKalman
from consistency.bench.protocols import Problem, TrialTruth
from consistency.bench.types import Control, Info
from consistency.referee.errors import InputError
from consistency.referee.types import Array


class IdealKalman(ExtendedKalman):
    """``points`` of the state is the step of which the truth is taken."""

    realisable = False

    def init(self, problem: Problem) -> SlamState:
        truth_of(problem)
        return replace(basics.start(problem), points=0)

    def predict(self, state: SlamState, control: Control) -> SlamState:
        before, after = truth_of(state.problem).path[state.points : state.points + 2]
        moved = basics.predict_by(state, control, after[:2] - before[:2], before)
        return replace(moved, points=state.points + 1)

    def _correct(self, state: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
        true = np.concatenate([_pose(state), *(_landmark(state, label) for label in state.landmarks)])
        return basics.correct_about(state, true, seen, z, R, self.uvd)

    def _locate(self, state: SlamState, label: int, z: Array) -> tuple[Array, Array, Array]:
        landmark, _, _ = basics.locate_point(state, z, self.uvd)
        sensor = view(state.problem.belief.sensor, self.uvd)
        Hp, Hl = sensor.jacobians(_pose(state), _landmark(state, label))
        Jz = np.linalg.inv(Hl)
        return landmark, -Jz @ Hp, Jz


def _pose(state: SlamState) -> Array:
    """The true pose (3,)."""
    return np.asarray(truth_of(state.problem).path[state.points])


def _landmark(state: SlamState, label: int) -> Array:
    """A landmark (w,) where it truly is."""
    return truth_of(state.problem).landmarks[label, : state.width]


def truth_of(problem: Problem) -> TrialTruth:
    """The truth that a problem carries.

    Raises
    ------
    InputError
        It carries none: measurements alone are not enough for this filter.
    """
    if problem.truth is None:
        raise InputError(
            "the ideal EKF takes its Jacobians at the truth and cannot be stepped on measurements alone; "
            "give it a trial with truth, by run(trial, belief)"
        )
    return problem.truth
