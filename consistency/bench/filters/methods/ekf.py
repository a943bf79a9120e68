"""EKF-SLAM, compiled, and its parts, most of which other methods have as well.

Equations and source: :mod:`consistency.bench.filters.textbook.ekf`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from consistency.bench.filters.compiled import variants
from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.kernel.part_functions import (
    Data,
    Factors,
    Slam,
    State,
    Unicycle,
    correct,
    landmark_width,
    place,
    predict_innovation,
    stands_apart,
)
from consistency.bench.filters.kernel.update_steps import (
    Scratch,
    add_noise,
    combine_seen,
    correct_at_once,
    gather,
    innovate,
    linearise_seen,
    place_observed,
)
from consistency.bench.filters.parts.sensors import RangeBearing, RelativeXy, Uvd, Xyz
from consistency.bench.filters.parts.world_point import PlanarPoint, WorldPoint
from consistency.bench.filters.textbook.ekf import ExtendedKalman
from consistency.bench.protocols import Problem
from consistency.bench.scenario import PLANAR_SENSORS, Belief
from consistency.referee.types import Array


@part()
class Additive(NamedTuple):
    """Truth minus estimate, variable by variable, in world coordinates. No parameters."""


@part()
class Dense(NamedTuple):
    """Every step works on the whole state, and nothing is kept beside it. No parameters."""


@part()
class AtEstimate(NamedTuple):
    """Jacobians at the current estimate. No parameters."""


@implement(stands_apart, AtEstimate)
def estimate_stands_apart(point: AtEstimate) -> bool:
    return False


@implement(place, AtEstimate)
def place_at_estimate(
    point: AtEstimate, slam: Slam, state: State, k: int, label: int, z: Array, scratch: Scratch[NamedTuple]
) -> None:
    place_observed(slam, state.x[:3], z, state.x[state.n : state.n + landmark_width(slam.landmark)], scratch)


@part()
class Joint(NamedTuple):
    """One joint update with all landmarks seen in a step. No parameters."""


implement(correct, Joint)(correct_at_once)


@implement(predict_innovation, Joint)
def predict_innovation_linearised(
    update: NamedTuple,
    slam: Slam,
    state: State,
    data: Data,
    k: int,
    m: int,
    factors: Factors,
    scratch: Scratch[NamedTuple],
) -> tuple[int, float]:
    """Innovation and S with Jacobians at the prediction, eq. 11; an iterated update begins there, too."""
    gather(slam, state, m, factors, scratch)
    linearise_seen(slam, state, k, m, scratch)
    combine_seen(slam, state, m, scratch)
    innovate(slam, state, data, m, scratch)
    return 0, add_noise(slam, state, data, m, scratch)


def sensor_of(belief: Belief, uvd: bool) -> Any:
    """Eq. 22 with the believed rig, a sensor of landmarks in the plane, or eq. 19."""
    sensor = belief.sensor
    mount = sensor.mount.packed()
    if uvd and sensor.model not in PLANAR_SENSORS:
        return Uvd(sensor.f or 0.0, sensor.B or 0.0, mount)
    return {"relative-xy": RelativeXy, "range-bearing": RangeBearing}.get(sensor.model, Xyz)(mount)


def parts(problem: Problem, controls: Array, uvd: bool) -> Slam:
    """Eq. 18 with the believed noise, the sensor, and points in the world, in its plane if no heights are measured."""
    belief = problem.belief
    landmark = PlanarPoint() if belief.sensor.model in PLANAR_SENSORS else WorldPoint()
    motion, sensor = Unicycle(belief.motion.sigma_v, belief.motion.sigma_omega), sensor_of(belief, uvd)
    return Slam(motion, sensor, landmark, Additive(), AtEstimate(), Joint(), Dense())


FILTERS = variants(ExtendedKalman, "ekf", parts)
