"""How often does ``consistency challenge`` find a right filter overconfident? Many searches, each with another seed.

    python benchmarks/challenge_rate.py                          # the promise: 200 searches of 10 s, some 40 minutes
    python benchmarks/challenge_rate.py --of map                 # that of the map
    python benchmarks/challenge_rate.py --searches 40 --trials 200   # quicker, and the same on each machine
    python benchmarks/challenge_rate.py --filter dead-reckoning  # in worlds of a stereo camera, with tilt and height

``kf`` is right in linear worlds, whose sensor has no mount. Dead reckoning ignores the camera, and is right wherever
the camera stands as long as the odometry is so exact that errors of the heading stay small.

Exit status 1 if more searches found something than a rate as stated explains (binomial, 1 %).
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from scipy import stats
from script_options import options_of

import consistency as cs
from consistency.bench.challenging.challenge import Plan, challenge
from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.compiler.jit import Outlook
from consistency.bench.filters.methods.ekf import parts
from consistency.bench.scenario.models import dead_reckoning, unicycle_jacobian, unicycle_noise
from consistency.bench.types import Estimates

SURE = 0.01  # probability that a rate exactly as stated is called broken
EXACT = {"sigma_v": 0.001, "sigma_omega": 0.001}  # m/s, rad/s: in 500 s the heading errs by 0.03 rad at most


class DeadReckoning(Compiled):
    """The odometry added up, with its covariance to first order; observations are ignored.

    It is taken for a filter of the bench, and so run in this process: a start of a process takes a second.
    """

    def __init__(self) -> None:
        ekf = cs.get_filter("ekf-uvd")  # whose memory is more than enough
        assert isinstance(ekf, Compiled)
        super().__init__(ekf.textbook, parts, ekf.sensors)
        self.name = "dead-reckoning"

    def is_ready(self, trial: Any, belief: Any) -> bool:
        return True

    def outlook(self, trial: Any, belief: Any) -> Outlook:
        return Outlook(self.name, is_ready=True, is_shared=True, size=0)

    def run(self, trial: Any, belief: Any, halt: Any = None) -> Estimates:
        controls, T = np.asarray(trial.controls, float), trial.steps
        poses, P = dead_reckoning(trial.start, controls), np.zeros((T + 1, 3, 3))
        for k, (dt, v, _) in enumerate(controls):
            heading, F, Q = poses[k, 2], np.eye(3), np.zeros((3, 3))
            F[0, 2], F[1, 2] = unicycle_jacobian(heading, dt, v)
            terms = unicycle_noise(heading, dt, belief.motion.sigma_v, belief.motion.sigma_omega)
            Q[0, 0], Q[0, 1], Q[1, 1], Q[2, 2] = terms
            Q[1, 0] = Q[0, 1]
            P[k + 1] = F @ P[k] @ F.T + Q
        nothing = np.full(T, np.nan), np.zeros(T, np.int64), None
        return Estimates(self.name, trial.run, poses[1:], P[1:], *nothing)


def opponents(name: str) -> tuple[Any, Any]:
    """A filter by name, and the world from which its worlds differ."""
    if name != "dead-reckoning":
        return name, None
    changes = {f"{half}__motion__{key}": value for half in ("truth", "belief") for key, value in EXACT.items()}
    return DeadReckoning(), cs.load_scenario("herath2007-stereo").variant("exact-odometry", **changes)


def main() -> None:
    options = options_of(
        __doc__,
        searches=(200, None),
        seconds=(10.0, "of each search"),
        trials=(int, "of each search, in place of --seconds"),
        filter=("kf", "one that is right in the worlds of its scenario"),
        false_alarm=(0.05, None),
        seed=(0, "of the first search"),
        jobs=(-1, None),
    )
    minutes = None if options.trials is not None else options.seconds / 60.0
    found, worlds, longest = 0, 0, 0.0
    filter_, base = opponents(options.filter)
    for seed in range(options.seed, options.seed + options.searches):
        plan = Plan(minutes, options.trials, seed, options.jobs, options.false_alarm)
        outcome = challenge(filter_, base, plan)
        found, worlds = found + outcome.found, worlds + outcome.worlds
        longest = max(longest, outcome.seconds)
        if outcome.found:
            print(f"seed {seed}: {outcome.verdict.status} in {outcome.space.text(outcome.point)}", flush=True)
    p_value = float(stats.binom.sf(found - 1, options.searches, options.false_alarm))
    high = stats.binomtest(found, options.searches).proportion_ci(0.98, "exact").high
    print(f"{options.filter}: found in {found} of {options.searches} searches")
    print(
        f"(at most {high:.1%}, 99 % binomial; stated "
        f"{options.false_alarm:.1%}, p {p_value:.3f}); {worlds / options.searches:.0f} worlds a search, the longest "
        f"{longest:.1f} s"
    )
    sys.exit(1 if p_value <= SURE else 0)


if __name__ == "__main__":
    main()
