"""Iterated EKF-SLAM, compiled. Equations and source: :mod:`consistency.bench.filters.textbook.iekf`."""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.compiled import variants
from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.kernel.part_functions import (
    Data,
    Slam,
    State,
    correct,
    innovate_again,
    landmark_width,
    observed_width,
    predict_innovation,
)
from consistency.bench.filters.kernel.update_steps import (
    Scratch,
    combine_seen,
    correct_iterated,
    innovate,
    linearise_seen,
)
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.methods.ekf import predict_innovation_linearised
from consistency.bench.filters.textbook.iekf import PASSES, IteratedKalman


@part(error="Additive", point="AtEstimate")
class Iterated(NamedTuple):
    """Number of linearisations of an update."""

    passes: int


implement(predict_innovation, Iterated)(predict_innovation_linearised)
implement(correct, Iterated)(correct_iterated)


@implement(innovate_again, Iterated)
def innovate_about_estimate(
    update: Iterated, slam: Slam, state: State, data: Data, k: int, m: int, scratch: Scratch[NamedTuple]
) -> bool:
    """The innovation is z - h(x) - H (prior - x)."""
    w, s = landmark_width(slam.landmark), observed_width(slam.sensor)
    linearise_seen(slam, state, k, m, scratch)
    combine_seen(slam, state, m, scratch)
    x, prior, y = state.x, scratch.prior, innovate(slam, state, data, m, scratch)
    for i in range(m):
        o = scratch.at[i]
        for a in range(s):
            for c in range(3):
                y[s * i + a] -= scratch.Hp[i, a, c] * (prior[c] - x[c])
            for c in range(w):
                y[s * i + a] -= scratch.Hl[i, a, c] * (prior[3 + w * i + c] - x[o + c])
    return True


FILTERS = variants(IteratedKalman, "iekf", ekf.parts, update=Iterated(PASSES))
