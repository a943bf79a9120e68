"""EKF-SLAM on triangulated points, compiled.

Equations and source: :mod:`consistency.bench.filters.textbook.triangulated`.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.linalg import sum_of
from consistency.bench.filters.kernel.part_functions import (
    Data,
    Factors,
    Slam,
    State,
    Triple,
    correct,
    locate,
    locate_jacobian,
    measure,
    measure_jacobian,
    observed_width,
    predict_innovation,
)
from consistency.bench.filters.kernel.update_steps import (
    Scratch,
    combine_seen,
    correct_at_once,
    gather,
    innovate,
    linearise_seen,
)
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.parts.sensors import (
    Growth,
    growth_of,
    locate_xyz_jacobian,
    measure_xyz,
    measure_xyz_jacobian,
    ratio_at,
    three_values,
)
from consistency.bench.filters.textbook.triangulated import TriangulatedKalman
from consistency.bench.protocols import Problem
from consistency.bench.scenario import models
from consistency.bench.scenario.models import Mounting
from consistency.referee.types import Array


@part()
class DebiasedXyz(NamedTuple):
    """Disparity noise over disparity at a depth of 1 m, which grows with the depth, and where the sensor is mounted.

    ``growth`` is that of the noise with the disparity, and ``fB`` the disparity at 1 m, px.
    """

    rho: float
    growth: Growth
    fB: float
    mount: Mounting


implement(observed_width, DebiasedXyz)(three_values)
implement(measure, DebiasedXyz)(measure_xyz)
implement(measure_jacobian, DebiasedXyz)(measure_xyz_jacobian)
implement(locate_jacobian, DebiasedXyz)(locate_xyz_jacobian)  # the bias is taken as known


@implement(locate, DebiasedXyz)
def locate_debiased(sensor: DebiasedXyz, z: Array) -> Triple:
    """The point without its bias."""
    rho = sensor.rho * ratio_at(sensor.growth, sensor.fB / z[0]) * z[0]
    share = 1.0 / (1.0 + rho * rho)
    return share * z[0], share * z[1], share * z[2]


@part(sensor="Xyz DebiasedXyz")
class NoiseAtPrediction(NamedTuple):
    """Focal length in px, baseline in m, standard deviations in px, and the rho at 1 m whose bias is subtracted.

    ``growth`` is that of sd and rho with the disparity.
    """

    f: float
    B: float
    su: float
    sv: float
    sd: float
    rho: float
    growth: Growth


implement(correct, NoiseAtPrediction)(correct_at_once)


@implement(predict_innovation, NoiseAtPrediction)
def predict_innovation_with_noise_at_prediction(
    update: NoiseAtPrediction,
    slam: Slam,
    state: State,
    data: Data,
    k: int,
    m: int,
    factors: Factors,
    scratch: Scratch[NamedTuple],
) -> tuple[int, float]:
    gather(slam, state, m, factors, scratch)
    linearise_seen(slam, state, k, m, scratch)
    combine_seen(slam, state, m, scratch)
    return 0, _add_noise(update, data, m, innovate(slam, state, data, m, scratch), scratch)


@inner
def _add_noise(noise: NoiseAtPrediction, data: Data, m: int, y: Array, scratch: Scratch[NamedTuple]) -> float:
    """y (3 m,) <- y - bias, S (3 m, 3 m) <- S + R; returns a sum that is finite if all that is given is."""
    total, rows = 0.0, 3 * m
    for i in range(m):
        first = 3 * i
        p = scratch.zhat[first : first + 3]
        if p[0] > 0.0:
            u, v, d = models.project(p[0], p[1], p[2], noise.f, noise.B)
            J = models.triangulate_jacobian(u, v, d, noise.f, noise.B)
            ratio = ratio_at(noise.growth, d)
            variance = (noise.su**2, noise.sv**2, (noise.sd * ratio) ** 2)
            share = (noise.rho * ratio * p[0]) ** 2
            for a in range(3):
                y[first + a] -= share * p[a]
                for b in range(3):
                    for c in range(3):
                        scratch.S[first + a, first + b] += J[3 * a + c] * variance[c] * J[3 * b + c]
        else:  # a point behind the camera has no pixel
            for a in range(3):
                for b in range(3):
                    scratch.S[first + a, first + b] += data.R[scratch.known[i], a, b]
    for r in range(rows):
        total += y[r] + sum_of(scratch.S[r, r:rows])
    return total


def parts(problem: Problem, controls: Array, uvd: bool, debiasing: bool) -> Slam:
    """Those of the EKF, and the update; with ``debiasing`` also the sensor."""
    sensor, slam = problem.belief.sensor, ekf.parts(problem, controls, uvd)
    f, B, growth, (su, sv, sd) = sensor.f or 0.0, sensor.B or 0.0, growth_of(sensor), sensor.sigma
    rho = sd / (f * B) if debiasing else 0.0
    slam = slam._replace(update=NoiseAtPrediction(f, B, su, sv, sd, rho, growth))
    return slam._replace(sensor=DebiasedXyz(rho, growth, f * B, slam.sensor.mount)) if debiasing else slam


FILTERS = {
    name: Compiled(TriangulatedKalman(name, debiasing), partial(parts, debiasing=debiasing), ("uvd",))
    for name, debiasing in (("predicted-ekf-xyz", False), ("debiased-ekf-xyz", True))
}
