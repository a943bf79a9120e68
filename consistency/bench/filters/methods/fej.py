"""EKF-SLAM with first-estimates Jacobians, compiled.

Equations and source: :mod:`consistency.bench.filters.textbook.fej`.

First-estimates Jacobians, Huang, Mourikis & Roumeliotis (2010), "Observability-based rules ...", IJRR 29(5).

Each variable is linearised at its first estimate: a pose p_k at the prediction p_k|k-1, a landmark where it was put.
f and h are those of the estimate. With J the quarter turn, F of step k + 1 has in its column of the heading
J (p_k+1|k - p_k|k-1), and H of a landmark l turns with -J (l_first - p_k+1|k): a turn of robot and map about the
world's origin, (J p_k|k-1, 1, J l_first), is carried by F to the same with p_k+1|k, and H does not see it. A new
landmark is treated alike: its Jacobian by the heading is J (l_first - p_k|k-1).
"""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.compiled import variants
from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.kernel.linalg import copy, matrix
from consistency.bench.filters.kernel.part_functions import (
    Slam,
    State,
    landmark_point,
    landmark_width,
    make_point_arrays,
    move,
    place,
    propagate_covariance_at,
    propagate_covariance_by,
)
from consistency.bench.filters.kernel.update_steps import Scratch, place_observed
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.textbook.fej import FirstEstimateKalman
from consistency.referee.types import Array


@part(landmark="WorldPoint PlanarPoint", error="Additive", update="Joint")
class FirstEstimate(NamedTuple):
    """No parameters."""


class FirstEstimates(NamedTuple):
    """The first estimate of every variable."""

    path: Array  # (T + 1, 3), as predicted
    landmarks: Array  # (labels, w)


@implement(make_point_arrays, FirstEstimate)
def note_first_estimates(point: FirstEstimate, w: int, steps: int, labels: int) -> FirstEstimates:
    return FirstEstimates(matrix(steps + 1, 3), matrix(labels, w))


@implement(propagate_covariance_at, FirstEstimate)
def propagate_covariance_between_first_estimates(
    point: FirstEstimate, slam: Slam, state: State, k: int, u: Array, Phi: Array, scratch: Scratch[NamedTuple]
) -> None:
    """F by the displacement p_k+1|k - p_k|k-1 between first estimates; notes the prediction."""
    before, after = scratch.of_point.path[k], scratch.of_point.path[k + 1]
    if k == 0:
        copy(state.x[:3], before)
    move(state.x[:3], u, after)
    propagate_covariance_by(after[0] - before[0], after[1] - before[1], state.P, state.n, Phi, state.base)


@implement(landmark_point, FirstEstimate)
def landmark_at_first_estimate(point: FirstEstimate, values: Array, label: int, scratch: Scratch[NamedTuple]) -> Array:
    first: Array = scratch.of_point.landmarks[label]
    return first


@implement(place, FirstEstimate)
def place_first_estimate(
    point: FirstEstimate, slam: Slam, state: State, k: int, label: int, z: Array, scratch: Scratch[NamedTuple]
) -> None:
    """x[n:n + w] <- the inverse of h at the estimated pose, noted; its Jacobian by the heading at the prediction."""
    w = landmark_width(slam.landmark)
    pose, values, predicted = state.x[:3], state.x[state.n : state.n + w], scratch.of_point.path[k + 1]
    place_observed(slam, pose, z, values, scratch)
    copy(values, scratch.of_point.landmarks[label])
    scratch.Jp[0, 2] -= pose[1] - predicted[1]
    scratch.Jp[1, 2] += pose[0] - predicted[0]


FILTERS = variants(FirstEstimateKalman, "fej-ekf", ekf.parts, point=FirstEstimate())
