"""Iterated sigma points, compiled. Equations and source: :mod:`consistency.bench.filters.textbook.ispkf`."""

from __future__ import annotations

from typing import Any, NamedTuple

from consistency.bench.filters.compiled import variants
from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.kernel.part_functions import (
    Data,
    Factors,
    Slam,
    State,
    correct,
    innovate_again,
    landmark_width,
    make_update_arrays,
    predict,
    predict_innovation,
)
from consistency.bench.filters.kernel.update_steps import Scratch, correct_iterated, innovate, state_index
from consistency.bench.filters.methods import ukf
from consistency.bench.filters.methods.ukf import SigmaArrays, Unscented, innovate_by_points
from consistency.bench.filters.textbook.ispkf import PASSES, IteratedPointsKalman
from consistency.bench.protocols import Problem
from consistency.referee.types import Array


@part(error="Additive", point="AtEstimate")
class IteratedPoints(NamedTuple):
    """The sigma points, and the number of times that they are drawn in an update."""

    points: Unscented
    passes: int


@implement(make_update_arrays, IteratedPoints)
def iterated_points_arrays(update: IteratedPoints, w: int, s: int, m: int, n: int) -> Any:
    return make_update_arrays(update.points, w, s, m, n)


@implement(predict, IteratedPoints)
def predict_by_points(
    update: IteratedPoints,
    slam: Slam,
    state: State,
    k: int,
    u: Array,
    factors: Factors,
    scratch: Scratch[SigmaArrays],
) -> None:
    """Motion as the unscented filter has it: there is no observation to iterate on."""
    predict(update.points, slam, state, k, u, factors, scratch)


implement(correct, IteratedPoints)(correct_iterated)


@implement(predict_innovation, IteratedPoints)
def predict_innovation_by_first_points(
    update: IteratedPoints,
    slam: Slam,
    state: State,
    data: Data,
    k: int,
    m: int,
    factors: Factors,
    scratch: Scratch[SigmaArrays],
) -> tuple[int, float]:
    """Innovation and S of the first pass, which are those of the unscented filter."""
    return predict_innovation(update.points, slam, state, data, k, m, factors, scratch)


@implement(innovate_again, IteratedPoints)
def innovate_about_points(
    update: IteratedPoints, slam: Slam, state: State, data: Data, k: int, m: int, scratch: Scratch[SigmaArrays]
) -> bool:
    """The innovation is z - z_i - A (prior - x_i)."""
    w = landmark_width(slam.landmark)
    if not innovate_by_points(update.points, slam, state, m, scratch):
        return False
    y = innovate(slam, state, data, m, scratch)
    for a in range(3 + w * m):
        away = scratch.prior[a] - state.x[state_index(w, a, scratch.at)]
        for row in range(len(y)):
            y[row] -= scratch.of_update.Mt[a, row] * away
    return True


def parts(problem: Problem, controls: Array, uvd: bool) -> Slam:
    slam = ukf.parts(problem, controls, uvd)
    return slam._replace(update=IteratedPoints(slam.update, PASSES))


FILTERS = variants(IteratedPointsKalman, "ispkf", parts, "xyz uvd")
