"""What is left to try and to say where a fitted filter has a fault.

Settings at which errors have the size that is stated: any setting that is consistent lies among them. And why no
setting of the noises makes a filter consistent: what the referee finds, and what other noise tells.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import qmc

from consistency.bench.filters.stepping import name_of
from consistency.bench.protocols import Filter
from consistency.bench.runs.analyse_results import analyse
from consistency.bench.runs.montecarlo import run_trials
from consistency.bench.scenario import Scenario, misbelief
from consistency.referee.diagnostics import Settings, Verdict
from consistency.referee.diagnostics.verdict.answers import BIAS, SCALE
from consistency.referee.diagnostics.words.numbers import short
from consistency.referee.system.progress import quiet
from consistency.referee.types import Array

LESS = 0.1  # of all standard deviations: what is of second order in the errors is then a hundredth
FIT = 1.1  # NIS per degree of freedom within this factor of 1: innovations look right
PROBE = 50  # runs of a probe, at least
SPAN = float(np.log(100.0))  # of one factor to another, up and down from a fit; beyond it a filter hardly uses one
ALONG = 9  # settings for two factors: ratios a factor of 3.2 apart
AROUND = 16  # settings for more
CORRECTIONS = 2  # of the common scale; the first is nearly right, for gains hardly change with it


def is_at_fault(verdict: Verdict) -> bool:
    """Was a fault found? An undecided verdict has none."""
    return verdict.status not in ("consistent", "undecided")


class Probe:
    """A filter that is told the true noises, in a world with these or with smaller ones, on runs of its own."""

    def __init__(
        self, filter_: Filter, scenario: Scenario, runs: int, seed: int, jobs: int, timeout: float | None,
        settings: Settings,
    ) -> None:  # fmt: skip
        self.filter, self.scenario, self.runs, self.seed = filter_, scenario, max(runs, PROBE), seed
        self.jobs, self.timeout, self.settings = jobs, timeout, settings

    def __call__(self, factor: float = 1.0) -> Verdict:
        """The verdict where all standard deviations are ``factor`` times those of the world."""
        world = with_noise(self.scenario, factor)
        with quiet():
            results = run_trials(world, [self.filter], self.runs, self.seed, self.jobs, self.timeout)
        return analyse(results, settings=self.settings)[name_of(self.filter)]

    def cause(self) -> str:
        """What is wrong with the filter: something that it is not told, its linearisation, or something else."""
        if unknown := misbelief(with_noise(self.scenario, 1.0)):
            return f"cause: the belief is wrong in more than its noises: {unknown}"
        small = self(LESS)
        if is_at_fault(small):
            return (
                f"cause: neither its noises nor linearisation alone. With {LESS:g} times the true standard deviations "
                f"in world and belief it still is {small.reasons[0]}"
            )
        return (
            f"cause: linearisation. With {LESS:g} times the true standard deviations in world and belief no fault is "
            f"found in {self.runs} runs; take a filter of another kind (docs/filters.md), or better sensors"
        )


def reasons_of(verdict: Verdict, probe: Probe | None) -> tuple[str, ...]:
    """What the referee says of a filter whose noises are fitted, and where a scenario shows it, the cause."""
    found = [verdict.reasons[0]]
    innovations, scale = verdict.innovations, verdict.scale
    if set(verdict.faults) & set(BIAS):
        found.append("errors have a mean, which no covariance can hold: calibrate it away, or estimate it")
    elif innovations is not None and scale is not None and _is_blind(verdict, innovations.ratio, scale.inflation.value):
        found.append(
            f"innovations are as large as stated (NIS per degree of freedom {innovations.ratio:.3f}) while errors are "
            f"not (covariance ratio {short(scale.inflation.value)}): what is wrong with them, innovations do not show"
        )
    return (*found, probe.cause()) if probe is not None else tuple(found)


def _is_blind(verdict: Verdict, nis: float, ratio: float) -> bool:
    """Do innovations look right where errors are larger than stated?"""
    return 1.0 / FIT < nis < FIT and ratio > 1.0 and bool(set(verdict.faults) & set(SCALE))


def with_noise(scenario: Scenario, factor: float) -> Scenario:
    """The world with all standard deviations times ``factor``, and a belief that knows them."""
    motion, sensor = scenario.truth.motion, scenario.truth.sensor
    v, omega, sigma = factor * motion.sigma_v, factor * motion.sigma_omega, tuple(factor * s for s in sensor.sigma)
    noises = {
        f"{half}__{key}": value
        for half in ("truth", "belief")
        for key, value in (("motion__sigma_v", v), ("motion__sigma_omega", omega), ("sensor__sigma", sigma))
    }
    return scenario.variant(scenario.name, summary=scenario.summary, **noises)


class Balanced(NamedTuple):
    """Log factors (p,), and the verdict on the runs of the fit."""

    log_factors: Array
    verdict: Verdict

    @property
    def rank(self) -> tuple[float, float]:
        """Greater is nearer to consistent: by the p-value of all questions, then by the size of the errors."""
        p = self.verdict.p_value
        ratio = self.verdict.inflation
        return (p if np.isfinite(p) else 0.0, -abs(np.log(ratio)) if ratio > 0.0 else -np.inf)


def directions(p: int) -> Array:
    """Log factors (settings, p) of mean zero: how factors may differ from each other."""
    if p == 1:
        return np.zeros((1, 1))
    if p == 2:
        apart = np.linspace(-SPAN, SPAN, ALONG)
        return np.column_stack([-apart / 2.0, apart / 2.0])
    points: Array = SPAN * (qmc.Sobol(p, scramble=False).random(AROUND) - 0.5)
    return np.asarray(points - points.mean(axis=1, keepdims=True))


def balanced(centre: Array, ratio: Callable[[Array], float], judge: Callable[[Array], Verdict]) -> list[Balanced]:
    """Settings at which the mean NEES is as stated, one for each direction from a fit, with the verdict on each.

    Scaling all covariances together leaves the gains of a linear filter as they are and divides its NEES, so that each
    direction has one such setting, and finding it takes one step or two. Directions in which a run fails are left out.

    Parameters
    ----------
    centre : log factors (p,) of the fit
    ratio : mean NEES over its degrees of freedom at log factors (p,); not finite where a run fails
    judge : the verdict there, on the same runs
    """
    settings = []
    for direction in directions(len(centre)):
        x = centre + direction
        for _ in range(CORRECTIONS):
            x = x + np.log(ratio(x))
        if np.isfinite(x).all():
            settings.append(Balanced(x, judge(x)))
    return settings


def nearest(settings: Sequence[Balanced]) -> Balanced | None:
    """The one that comes nearest to consistent; None of none."""
    return max(settings, key=lambda setting: setting.rank, default=None)
