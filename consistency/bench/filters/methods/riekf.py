"""Right-invariant EKF-SLAM, compiled. Equations and source: :mod:`consistency.bench.filters.textbook.riekf`."""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.compiled import variants
from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.linalg import add_transposed_times, fill
from consistency.bench.filters.kernel.part_functions import (
    Slam,
    State,
    insert_error,
    landmark_width,
    move,
    noise_columns,
    pose_covariance,
    propagate,
    retract,
    to_error,
)
from consistency.bench.filters.kernel.update_steps import Scratch, add_gram_to_state
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.parts.invariant_pose import exponential, shifted_covariance
from consistency.bench.filters.textbook.riekf import RightInvariantKalman
from consistency.referee.types import Array


@part(landmark="WorldPoint PlanarPoint", point="AtEstimate", update="Joint", covariance="Dense")
class RightInvariant(NamedTuple):
    """No parameters. Motion moves the error of every landmark, so updating is dense."""


@implement(propagate, RightInvariant)
def propagate_right(
    error: RightInvariant, slam: Slam, state: State, k: int, u: Array, Phi: Array, scratch: Scratch[NamedTuple]
) -> None:
    """x <- f(x) and P <- P + Ad G Q G' Ad': F is the identity, and the noise turns with the world, (n, q)."""
    x, n, w, G = state.x, state.n, landmark_width(slam.landmark), scratch.small
    noise_columns(slam.motion, x[:3], u, G)
    move(x[:3], u, x[:3])
    noise = scratch.rows[:2, :n]
    for c in range(2):
        turn = G[2, c]
        noise[c, 0], noise[c, 1], noise[c, 2] = G[0, c] + x[1] * turn, G[1, c] - x[0] * turn, turn
        for o in range(3, n, w):
            noise[c, o], noise[c, o + 1] = x[o + 1] * turn, -x[o] * turn
            fill(noise[c, o + 2 : o + w], 0.0)
    add_gram_to_state(1.0, noise, state.P, n)


@implement(to_error, RightInvariant)
def to_right(error: RightInvariant, pose: Array, values: Array, Hp: Array, Hl: Array) -> None:
    for a in range(len(Hp)):
        Hp[a, 2] += pose[0] * Hp[a, 1] - pose[1] * Hp[a, 0] + values[0] * Hl[a, 1] - values[1] * Hl[a, 0]


@implement(insert_error, RightInvariant)
def insert_right(error: RightInvariant, pose: Array, values: Array, Jp: Array) -> None:
    for a in range(len(Jp)):
        Jp[a, 2] += pose[0] * Jp[a, 1] - pose[1] * Jp[a, 0]
    Jp[0, 2] += values[1]
    Jp[1, 2] -= values[0]


@implement(retract, RightInvariant)
def retract_right(
    error: RightInvariant, slam: Slam, state: State, A: Array, y: Array, scratch: Scratch[NamedTuple]
) -> None:
    """x (n,) <- exp(A' y) x, of the robot and of every landmark, with A (k, n) and y (k,)."""
    x, delta = state.x, scratch.delta[: state.n]
    fill(delta, 0.0)
    add_transposed_times(A, y, delta)
    c, s, along, across = exponential(delta[2])
    _move(x, delta, 0, c, s, along, across)
    x[2] += delta[2]
    w = landmark_width(slam.landmark)
    for o in range(3, state.n, w):
        _move(x, delta, o, c, s, along, across)
        for a in range(2, w):
            x[o + a] += delta[o + a]


@inner
def _move(x: Array, delta: Array, o: int, c: float, s: float, along: float, across: float) -> None:
    """x, y at ``o`` <- R x + V delta, the planar exponential."""
    x0, x1, d0, d1 = x[o], x[o + 1], delta[o], delta[o + 1]
    x[o] = c * x0 - s * x1 + along * d0 - across * d1
    x[o + 1] = s * x0 + c * x1 + across * d0 + along * d1


@implement(pose_covariance, RightInvariant)
def right_pose_covariance(error: RightInvariant, x: Array, P: Array, out: Array) -> None:
    shifted_covariance(x, P, out)


FILTERS = variants(RightInvariantKalman, "ri-ekf", ekf.parts, error=RightInvariant())
