"""Do the intervals of ``consistency tune`` hold the true factors, is the tuned filter consistent, and how fast is it?

    python benchmarks/tuning.py                                   # 100 fits, and the speed: some 15 minutes
    python benchmarks/tuning.py --repetitions 20 --seed 500       # quicker

In each repetition the Kalman filter of ``linear-gaussian``, exact in its world, believes in variances of Q and R that
are off by factors drawn between 1/4 and 4. Exit status 1 if an interval holds its factor less often, or the tuned
filter is found at fault more often, than the stated rate explains (binomial, 1 % each).
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter

import numpy as np
from scipy import stats

import consistency as cs

SURE = 0.01  # chance that a rate exactly as stated is called broken
COVERAGE, FALSE_ALARM = 0.95, 0.05
FACTOR = 4.0  # believed variances are off by it at most
SPEED = (("linear-gaussian", "kf"), ("herath2007-stereo", "ekf-uvd"))
SETTINGS, SPEED_RUNS = 200, 50


def wrong(scenario: cs.Scenario, true_q: float, true_r: float) -> cs.Scenario:
    """The scenario with believed variances that have to be multiplied by these factors to be right."""
    motion, sensor = scenario.belief.motion, scenario.belief.sensor
    return scenario.variant(
        "wrong",
        belief__motion__sigma_v=motion.sigma_v / np.sqrt(true_q),
        belief__motion__sigma_omega=motion.sigma_omega / np.sqrt(true_q),
        belief__sensor__sigma=tuple(s / np.sqrt(true_r) for s in sensor.sigma),
    )


def main() -> None:
    """Fit, count, and compare with the stated rates; then time a long search."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=100)
    parser.add_argument("--runs", type=int, default=20, help="of each fit, and of each verdict")
    parser.add_argument("--by", default="innovations", help="innovations or nees")
    parser.add_argument("--seed", type=int, default=31_000, help="of the first repetition")
    parser.add_argument("--jobs", type=int, default=-1)
    options = parser.parse_args()
    broken = coverage(options)
    speed(options)
    sys.exit(1 if broken else 0)


def coverage(options: argparse.Namespace) -> bool:
    """Whether a stated rate is broken."""
    world = cs.load_scenario("linear-gaussian")
    held, widths, statuses, before, settings = Counter[str](), [], Counter[str](), Counter[str](), []
    for repetition in range(options.repetitions):
        seed = options.seed + repetition
        true = FACTOR ** np.random.default_rng((seed, 1)).uniform(-1.0, 1.0, 2)
        tuning = cs.tune(
            wrong(world, *true), "kf", by=options.by, runs=options.runs, seed=seed, jobs=options.jobs
        )  # fmt: skip
        inside = [factor.interval.holds(value) for factor, value in zip(tuning.factors, true, strict=True)]
        held.update(factor.group.name for factor, holds in zip(tuning.factors, inside, strict=True) if holds)
        widths.append([f.interval.high / f.interval.low for f in tuning.factors])
        statuses[tuning.verdict.status] += 1
        before[tuning.before.status] += 1
        settings.append(tuning.chosen.settings)
        if tuning.verdict.status not in ("consistent", "undecided"):
            print(f"seed {seed}: {tuning.verdict.reasons[0]}; found {tuning.verdict.faults}", flush=True)
        if not all(inside):
            missed = ", ".join(
                f"{f.group.name} {f.interval} (true {v:.3f})" for f, v in zip(tuning.factors, true, strict=True)
            )
            print(f"seed {seed}: {missed}", flush=True)
    n = options.repetitions
    rates = []
    for name, width in zip(("Q", "R"), np.sqrt(np.median(widths, axis=0)), strict=True):
        p = float(stats.binom.cdf(held[name], n, COVERAGE))
        rates.append(p)
        print(
            f"{name}: true factor inside its 95 % interval in {held[name]} of {n} (p {p:.3f}), half width x{width:.3f}"
        )
    faults = n - statuses["consistent"] - statuses["undecided"]
    rates.append(float(stats.binom.sf(faults - 1, n, FALSE_ALARM)))
    print(f"before: {dict(before)}; after: {dict(statuses)}, a fault in {faults} of {n} (p {rates[-1]:.3f})")
    print(f"settings in a fit: {np.median(settings):.0f} in the median, {max(settings)} at most")
    return min(rates) <= SURE


def speed(options: argparse.Namespace) -> None:
    """Seconds that so many settings of so many runs take."""
    from consistency.tuning.bench import Bench
    from consistency.tuning.groups import groups_of, scaled

    for world, name in SPEED:
        scenario = cs.load_scenario(world)
        trials = [cs.simulate(scenario, run, options.seed) for run in range(SPEED_RUNS)]
        bench, groups = (
            Bench(cs.get_filter(name), trials, "innovations", options.jobs),
            groups_of("Q,R", scenario.belief),
        )
        bench.compile(scenario.belief)
        began = time.monotonic()
        for log_factors in np.random.default_rng(options.seed).uniform(-1.0, 1.0, (SETTINGS, 2)):
            bench(scaled(scenario.belief, groups, log_factors))
        print(f"{name} on {world}: {SETTINGS} settings of {SPEED_RUNS} runs in {time.monotonic() - began:.1f} s")


if __name__ == "__main__":
    main()
