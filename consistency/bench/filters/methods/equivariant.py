"""Equivariant filter SLAM, compiled. Equations and source: :mod:`consistency.bench.filters.textbook.equivariant`."""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.compiled import variants
from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.error.polar import Polar, SensorPoint, sight
from consistency.bench.filters.kernel.part_functions import (
    Data,
    Factors,
    Slam,
    State,
    correct,
    locate,
    measure_jacobian,
    predict_innovation,
)
from consistency.bench.filters.kernel.update_steps import (
    add_noise,
    combine_seen,
    correct_at_once,
    gather,
    innovate,
    linearise_seen,
)
from consistency.bench.filters.kernel.work_arrays import Work
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.sensor.models import Uvd
from consistency.bench.filters.textbook.equivariant import EquivariantKalman
from consistency.bench.protocols import Problem
from consistency.referee.types import Array


@part(sensor="Uvd", landmark="SensorPoint", error="Polar")
class EquivariantOutput(NamedTuple):
    """No parameters. The joint update with C* in the place of the Jacobian."""


implement(correct, EquivariantOutput)(correct_at_once)


@implement(predict_innovation, EquivariantOutput)
def predict_innovation_equivariant(
    update: EquivariantOutput,
    slam: Slam,
    state: State,
    data: Data,
    k: int,
    m: int,
    local: Factors,
    work: Work[NamedTuple],
) -> tuple[int, float]:
    gather(slam, state, m, local, work)
    linearise_seen(slam, state, k, m, work)
    for i in range(m):
        _average(slam.sensor, data.z[work.known[i]], state.x[work.at[i] : work.at[i] + 3], work.Hl[i])
    combine_seen(slam, state, m, work)
    innovate(slam, state, data, m, work)
    return 0, add_noise(slam, state, data, m, work)


@inner
def _average(sensor: Uvd, z: Array, q: Array, H: Array) -> None:
    """H (3, 3) <- C*, the mean of H, at the estimate q (3,), and of the derivative along the group at z (3,)."""
    if z[2] <= 0.0:  # of no point
        return
    e, _ = sight(q)
    x, y, w = locate(sensor, z)
    J = measure_jacobian(sensor, x, y, w)
    columns = (
        (e[4] * w - e[5] * y, e[5] * x - e[3] * w, e[3] * y - e[4] * x),  # b2 x y
        (e[2] * y - e[1] * w, e[0] * w - e[2] * x, e[1] * x - e[0] * y),  # -b1 x y
        (x, y, w),
    )
    for b in range(3):
        for a in range(3):
            along = J[3 * a] * columns[b][0] + J[3 * a + 1] * columns[b][1] + J[3 * a + 2] * columns[b][2]
            H[a, b] = 0.5 * (H[a, b] + along)


def parts(problem: Problem, controls: Array, uvd: bool) -> Slam:
    slam = ekf.parts(problem, controls, uvd)
    return slam._replace(landmark=SensorPoint(slam.sensor.mount), error=Polar(), update=EquivariantOutput())


(FILTER,) = variants(EquivariantKalman, "eqf", parts, "uvd")
