"""Iterated EKF-SLAM, compiled. Equations and source: :mod:`consistency.filters.textbook.iekf`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiled import variants
from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.arrays import vector
from consistency.bench.filters.kernel.covariance import state_index
from consistency.bench.filters.kernel.gain import apply, combine_seen, gather, innovate, linearise_seen, shift, whiten
from consistency.bench.filters.kernel.part_functions import (
    Data,
    Factors,
    Slam,
    State,
    correct,
    landmark_width,
    make_room,
    observed_width,
    predict_innovation,
)
from consistency.bench.filters.kernel.work_arrays import Work
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.methods.ekf import predict_innovation_linearised
from consistency.bench.filters.textbook.iekf import PASSES, IteratedKalman
from consistency.referee.types import Array


@part(error="Additive", point="AtEstimate")
class Iterated(NamedTuple):
    """Number of linearisations of an update."""

    passes: int


class PriorRoom(NamedTuple):
    """The prior of the variables involved, 3 + w m."""

    prior: Array


@implement(make_room, Iterated)
def iterated_room(update: Iterated, w: int, s: int, m: int, n: int) -> PriorRoom:
    return PriorRoom(vector(3 + w * m))


implement(predict_innovation, Iterated)(predict_innovation_linearised)


@implement(correct, Iterated)
def correct_iterated(
    update: Iterated,
    slam: Slam,
    state: State,
    data: Data,
    k: int,
    m: int,
    has_innovation: bool,
    local: Factors,
    work: Work[PriorRoom],
) -> tuple[int, float, float]:
    w = landmark_width(slam.landmark)
    involved, first_nis, first_log_det = 3 + w * m, np.nan, np.nan
    gather(slam, state, m, local, work)
    for a in range(involved):
        work.room.prior[a] = state.x[state_index(w, a, work.at)]
    for i in range(update.passes):
        linearise_seen(slam, state, k, m, work)
        combine_seen(slam, state, m, work)
        _relate_to_prior(slam, state, m, innovate(slam, state, data, m, work), work)
        code, nis, log_det = whiten(slam, state, data, m, work)
        if code > 0:
            return code, nis, log_det
        if i == 0:
            first_nis, first_log_det = nis, log_det
        is_last = i == update.passes - 1
        for a in range(involved):
            j = state_index(w, a, work.at)
            state.x[j] = work.room.prior[a] + (0.0 if is_last else shift(slam, state, m, j, work))
    apply(slam, state, m, local, work)
    return 0, first_nis, first_log_det


@inner
def _relate_to_prior(slam: Slam, state: State, m: int, y: Array, work: Work[PriorRoom]) -> None:
    """y (s m,) <- z - h(x) - H (prior - x)."""
    w, s = landmark_width(slam.landmark), observed_width(slam.sensor)
    x, prior = state.x, work.room.prior
    for i in range(m):
        o = work.at[i]
        for a in range(s):
            for c in range(3):
                y[s * i + a] -= work.Hp[i, a, c] * (prior[c] - x[c])
            for c in range(w):
                y[s * i + a] -= work.Hl[i, a, c] * (prior[3 + w * i + c] - x[o + c])


XYZ, UVD, XY, RB = variants(IteratedKalman, "iekf", ekf.parts, update=Iterated(PASSES))
