"""Do the intervals of ``consistency tune`` hold the true factors, is the tuned filter consistent, and how fast is it?

    python benchmarks/tuning.py                                   # 100 fits with verdicts, 800 without, and the speed
    python benchmarks/tuning.py --repetitions 20 --fits 50        # quicker

In each repetition the Kalman filter of ``linear-gaussian``, exact in its world, believes in variances of Q and R that
are off by factors drawn between 1/4 and 4. Fits without verdicts have few, short runs: in two worlds Q can hardly be
told, and in one the noise of the observations has another, unknown size in each run, so that the likelihood is wrong
but for its second moments. Exit status 1 if an interval holds its factor less often, or the tuned filter is found at
fault more often, than the stated rate explains (binomial, 1 % each).
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats
from script_options import options_of

import consistency as cs
from consistency.bench.tuning.noise_factor_fit import BeliefScorer, FactorFit, noise_groups_of, scaled
from consistency.bench.tuning.tune import fitted, parts_of
from consistency.bench.types import Trial
from consistency.referee.types import Array

SURE = 0.01  # probability that a rate exactly as stated is called broken
COVERAGE, FALSE_ALARM = 0.95, 0.05
FACTOR = 4.0  # believed variances are off by it at most
SPEED = (("linear-gaussian", "kf"), ("herath2007-stereo", "ekf-uvd"))
SETTINGS, SPEED_RUNS = 200, 50


@dataclass(frozen=True)
class World:
    """Runs of ``linear-gaussian`` to fit on."""

    runs: int
    steps: int
    process: float = 1.0  # factor on the true standard deviations of Q
    uneven: bool = False  # a further error in each observation, as large as R in the mean, of another size in each run

    def scenario(self) -> cs.Scenario:
        """As the filter is told."""
        world = cs.load_scenario("linear-gaussian")
        motion = world.truth.motion
        sigma_v, sigma_omega = self.process * motion.sigma_v, self.process * motion.sigma_omega
        return world.variant(
            "short",
            truth__steps=self.steps,
            truth__motion__sigma_v=sigma_v,
            truth__motion__sigma_omega=sigma_omega,
            belief__motion__sigma_v=sigma_v,
            belief__motion__sigma_omega=sigma_omega,
        )

    def observed(self, trial: Trial, rng: np.random.Generator) -> Trial:
        """The trial with the further error: of variance R times an exponential number of the run."""
        sigma = np.array(cs.load_scenario("linear-gaussian").truth.sensor.sigma)
        size = sigma * np.sqrt(rng.exponential())
        return replace(trial, z=trial.z + size * rng.standard_normal(trial.z.shape)) if self.uneven else trial


WORLDS = {
    "well told": World(8, 50),
    "Q hardly told: short runs": World(6, 4),
    "Q hardly told: tiny": World(6, 10, process=0.1),
    "R uneven": World(20, 10, uneven=True),
}


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
    options = options_of(
        __doc__,
        repetitions=(100, None),
        fits=(200, "without verdicts, in each of the other worlds"),
        runs=(20, "of each fit, and of each verdict"),
        seed=(31_000, "of the first repetition"),
        jobs=(-1, None),
    )
    broken = coverage(options) if options.repetitions else False
    for name, world in WORLDS.items():
        broken |= intervals(name, world, options) if options.fits else False
    speed(options)
    sys.exit(1 if broken else 0)


def coverage(options: argparse.Namespace) -> bool:
    """Whether a stated rate is broken."""
    world = cs.load_scenario("linear-gaussian")
    held, widths, statuses, before, settings = Counter[str](), [], Counter[str](), Counter[str](), []
    for repetition in range(options.repetitions):
        seed = options.seed + repetition
        true = FACTOR ** np.random.default_rng((seed, 1)).uniform(-1.0, 1.0, 2)
        tuning = cs.tune(wrong(world, *true), "kf", runs=options.runs, seed=seed, jobs=options.jobs)
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


def intervals(name: str, world: World, options: argparse.Namespace) -> bool:
    """Whether intervals hold the true factors less often than stated."""
    held, open_ends, settings, widths = np.zeros(2, int), np.zeros((2, 2), int), [], []
    for seed in range(options.seed, options.seed + options.fits):
        fit, true = fit_in(world, seed, options.jobs)
        held += (fit.interval[:, 0] <= np.log(true)) & (np.log(true) <= fit.interval[:, 1])
        open_ends += np.isinf(fit.interval)
        settings.append(fit.settings)
        widths.append(np.diff(fit.interval, axis=1)[:, 0] / 2.0)
    half = np.exp(np.median(widths, axis=0))
    rates = stats.binom.cdf(held, options.fits, COVERAGE)
    for group, count, p, (low, high), width in zip("QR", held, rates, open_ends, half, strict=True):
        print(
            f"{name}, {world.runs} runs of {world.steps} steps: true factor of {group} inside in {count} of "
            f"{options.fits} (p {p:.3f}), half width x{width:.3f}, open below in {low}, above in {high}"
        )
    print(f"settings in a fit: {np.mean(settings):.1f} in the mean, {max(settings)} at most", flush=True)
    return bool(min(rates) <= SURE)


def fit_in(world: World, seed: int, jobs: int) -> tuple[FactorFit, Array]:
    """A fit without a verdict, and the true factors (2,)."""
    rng = np.random.default_rng((seed, 1))
    true = FACTOR ** rng.uniform(-1.0, 1.0, 2)
    parts = parts_of(wrong(world.scenario(), *true), world.runs, seed)
    parts = replace(parts, trials=[world.observed(trial, rng) for trial in parts.trials])
    kf, groups = cs.get_filter("kf"), noise_groups_of("Q,R", parts.belief)
    with BeliefScorer(kf, parts.trials, parts.belief, jobs) as scorer:
        scorer.compile()
        fit = fitted(scorer, parts.belief, groups, parts.world.name)
    return fit, true * [1.0, 2.0 if world.uneven else 1.0]


def speed(options: argparse.Namespace) -> None:
    """Seconds that so many settings of so many runs take."""
    for world, name in SPEED:
        scenario = cs.load_scenario(world)
        trials = [cs.simulate(scenario, run, options.seed) for run in range(SPEED_RUNS)]
        groups = noise_groups_of("Q,R", scenario.belief)
        with BeliefScorer(cs.get_filter(name), trials, scenario.belief, options.jobs) as bench:
            bench.compile()
            began = time.monotonic()
            for log_factors in np.random.default_rng(options.seed).uniform(-1.0, 1.0, (SETTINGS, 2)):
                bench(scaled(scenario.belief, groups, log_factors))
        print(f"{name} on {world}: {SETTINGS} settings of {SPEED_RUNS} runs in {time.monotonic() - began:.1f} s")


if __name__ == "__main__":
    main()
