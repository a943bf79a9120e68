"""Observability-constrained EKF-SLAM, compiled. Equations and source: :mod:`consistency.bench.filters.textbook.oc`.

Points nearest to the estimates under which a turn of robot and map stays unobserved.

Huang, Mourikis & Roumeliotis (2010), IJRR 29(5), state the problem; what follows is derived here from the constraint.
With J the quarter turn, let (J a_k, 1, J l_1, ..., J l_m) be the direction of the state that is not observed, carried
to step k. F of step k + 1, with points p*_k|k and p*_k+1|k in the place of the estimates, carries it on to

    a_k+1 = a_k + p*_k+1|k - p*_k|k,

and H of landmark i, with the point l*_i, does not see it if l*_i - p*_k+1|k = l_i - a_k+1. Both together are

    l*_i - l_i = p*_k|k - a_k    for all i:

p*_k+1|k is free and is the prediction itself. The other points are those with the least sum of squares

    |p*_k|k - p_k|k|^2 + sum_i |l*_i - l_i,k|k|^2    under these constraints, with multipliers lambda_i:

    p*_k|k = p_k|k + sum_i lambda_i / 2,    l*_i = l_i,k|k - lambda_i / 2,
    lambda_i / 2 = (l_i,k|k - l_i) - e,     e = (p_k|k - a_k + sum_i (l_i,k|k - l_i)) / (1 + m).

With one landmark lambda / 2 is half of what the estimates miss the constraint by. All landmarks of the map count, so
that the points of F are known before anything is observed. A landmark that is new after the update of step k is
placed and linearised at the estimate, so that l_i = a_k + l_i,k|k - p_k|k. Headings and heights have no part in the
constraint, and are linearised at the estimate.

Were every l*_i held at its first estimate, the same constraint would leave one choice, p*_k|k = p_k|k-1: that is the
filter of ``fej``.
"""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.compiled import variants
from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.kernel.linalg import filled, integers, matrix, vector
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
from consistency.bench.filters.textbook.oc import ConstrainedKalman
from consistency.referee.types import Array, Indices


@part(landmark="WorldPoint PlanarPoint", error="Additive", update="Joint", covariance="Dense")
class ObservabilityConstrained(NamedTuple):
    """No parameters. The points depend on the estimates of the whole map, so updating is dense."""


class UnobservedTurn(NamedTuple):
    """The direction that is not observed, and where it puts the points."""

    path: Array  # (T + 1, 2), a
    landmarks: Array  # (labels, 2), l by label
    order: Indices  # (labels,), label of the i-th landmark of the state
    shift: Array  # (2,), e
    at: Array  # (w,), the point of the landmark asked for last


@implement(make_point_arrays, ObservabilityConstrained)
def note_unobserved_turn(point: ObservabilityConstrained, w: int, steps: int, labels: int) -> UnobservedTurn:
    path, landmarks = matrix(steps + 1, 2), matrix(labels, 2)
    return UnobservedTurn(path, landmarks, integers(labels, 0), filled(2, 0.0), vector(w))


@implement(propagate_covariance_at, ObservabilityConstrained)
def propagate_covariance_constrained(
    point: ObservabilityConstrained,
    slam: Slam,
    state: State,
    k: int,
    u: Array,
    Phi: Array,
    scratch: Scratch[NamedTuple],
) -> None:
    """F by the displacement p_k+1|k - p*_k|k; notes a_k+1 and e."""
    x, of_point, predicted, w = state.x, scratch.of_point, scratch.pose, landmark_width(slam.landmark)
    before, after, shift = of_point.path[k], of_point.path[k + 1], of_point.shift
    move(x[:3], u, predicted)
    count = (state.n - 3) // w
    for a in range(2):
        if k == 0:
            before[a] = x[a]
        total = x[a] - before[a]
        for i in range(count):
            total += x[3 + w * i + a] - of_point.landmarks[of_point.order[i], a]
        shift[a] = total / (1 + count)
        after[a] = predicted[a] - shift[a]
    propagate_covariance_by(after[0] - before[0], after[1] - before[1], state.P, state.n, Phi, state.base)


@implement(landmark_point, ObservabilityConstrained)
def landmark_constrained(
    point: ObservabilityConstrained, values: Array, label: int, scratch: Scratch[NamedTuple]
) -> Array:
    """l*_i = l_i + e (w,) of landmark ``label``, at the height of the estimate."""
    of_point = scratch.of_point
    at: Array = of_point.at
    for a in range(2):
        at[a] = of_point.landmarks[label, a] + of_point.shift[a]
    for a in range(2, len(values)):
        at[a] = values[a]
    return at


@implement(place, ObservabilityConstrained)
def place_constrained(
    point: ObservabilityConstrained,
    slam: Slam,
    state: State,
    k: int,
    label: int,
    z: Array,
    scratch: Scratch[NamedTuple],
) -> None:
    """x[n:n + w] <- the inverse of h at the estimated pose, with its Jacobians; notes l_i."""
    x, n, of_point, w = state.x, state.n, scratch.of_point, landmark_width(slam.landmark)
    place_observed(slam, x[:3], z, x[n : n + w], scratch)
    of_point.order[(n - 3) // w] = label
    for a in range(2):
        of_point.landmarks[label, a] = of_point.path[k + 1, a] + x[n + a] - x[a]


FILTERS = variants(ConstrainedKalman, "oc-ekf", ekf.parts, point=ObservabilityConstrained())
