"""Robot-centred EKF-SLAM in inverse range, compiled.

Equations and source: :mod:`consistency.bench.filters.textbook.robocentric`.
"""

from __future__ import annotations

import numpy as np

from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.kernel.part_functions import Slam
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.parts import reactivation  # noqa: F401, registers the update
from consistency.bench.filters.parts.converting import Converted, Converting
from consistency.bench.filters.parts.invariant_pose import InvariantPose
from consistency.bench.filters.parts.inverse_range import InverseRange, Pixels
from consistency.bench.filters.parts.parking import Parking
from consistency.bench.filters.parts.sensors import growth_of
from consistency.bench.filters.textbook.inverse_range import Corrections, searched
from consistency.bench.filters.textbook.robocentric import (
    ADRIFT,
    BLURRED,
    COOLING,
    COOLING_EARLY,
    DOUBT,
    KNOWN,
    NEAR,
    PASSES,
    PASSES_CHAINED,
    PASSES_EARLY,
    TEMPERED,
    UNTURNED,
    RobotCentredKalman,
    rounds,
)
from consistency.bench.protocols import Problem
from consistency.referee.types import Array


def compiled(textbook: RobotCentredKalman) -> Compiled:
    """The filter with its kernel."""
    which = textbook.which

    def parts(problem: Problem, controls: Array, uvd: bool) -> Slam:
        sensor = problem.belief.sensor
        low, high = searched(sensor, textbook.name) if which.truncation else (0.0, 0.0)
        su, sv, sd = sensor.sigma
        pixels = Pixels(
            su, sv, sd, growth_of(sensor), low, high, which.truncation, which.debiasing, which.prediction
        )  # fmt: skip
        every, unseen = rounds(which)
        doubt, clones = DOUBT**2 if which.iteration else np.inf, len(controls) // every if every > 0 else 0
        adrift = ADRIFT**2 if which.iteration and which.adrift else np.inf
        passes, chain = PASSES if which.iteration else 1, PASSES_CHAINED if which.tempering else PASSES_EARLY
        decades, cooling = (0.0, COOLING) if which.tempering else (TEMPERED, COOLING_EARLY)
        blurred = BLURRED if which.forgetting else 0.0
        unturned, held = (UNTURNED**2, DOUBT**2) if which.waiting else (np.inf, np.inf)
        return ekf.parts(problem, controls, uvd)._replace(
            landmark=InverseRange(sensor.mount.packed()), error=InvariantPose(which.moments), point=Converted(),
            update=Converting(
                pixels, passes, chain if which.turning else 0, clones, which.recency, which.curvature,
                which.spread, which.own_spread, decades, cooling, which.waiting, unturned, held, KNOWN, blurred, NEAR,
            ),
            covariance=Parking(every, unseen, doubt, adrift, which.turning, which.patience),
        )  # fmt: skip

    return Compiled(textbook, parts, textbook.sensors)


PLAIN = Corrections(parking=False, turning=False, iteration=False, own_spread=False, forgetting=False)
FILTERS = {
    "parked-ekf-uvd": compiled(RobotCentredKalman("parked-ekf-uvd", Corrections())),
    "robocentric-ekf-uvd": compiled(RobotCentredKalman("robocentric-ekf-uvd", PLAIN)),
}
