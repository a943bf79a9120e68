"""Why no setting of the noises makes a filter consistent: what the referee finds, and what less noise tells."""

from __future__ import annotations

from consistency.diagnostics import Settings, Verdict
from consistency.diagnostics.questions import BIAS, SCALE
from consistency.diagnostics.wording import short
from consistency.filters.stepping import name_of
from consistency.protocols import Filter
from consistency.runs.montecarlo import run_trials
from consistency.scenario import Scenario, misbelief
from consistency.terminal.progress import say
from consistency.tuning.parts import Parts
from consistency.verdicts.judge import analyse

LESS = 0.1  # of all standard deviations: what is of second order in the errors is then a hundredth
FIT = 1.1  # NIS per degree of freedom within this factor of 1: innovations look right
PROBE = 50  # runs of the world with less noise


def reasons_of(
    filter_: Filter, parts: Parts, verdict: Verdict, jobs: int, timeout: float | None, settings: Settings
) -> tuple[str, ...]:
    """Sentences: what the referee says of the fitted filter, and where a scenario shows it, the cause."""
    found = [verdict.reasons[0]]
    innovations, scale = verdict.innovations, verdict.scale
    if set(verdict.faults) & set(BIAS):
        found.append("errors have a mean, which no covariance can hold: calibrate it away, or estimate it")
    elif innovations is not None and scale is not None and _is_blind(verdict, innovations.ratio, scale.inflation.value):
        found.append(
            f"innovations are as large as stated (NIS per degree of freedom {innovations.ratio:.3f}) while errors are "
            f"not (covariance ratio {short(scale.inflation.value)}): what is wrong with them, innovations do not show"
        )
    if parts.scenario is not None:
        found.append(_cause(filter_, parts.scenario, jobs, timeout, settings))
    return tuple(found)


def _is_blind(verdict: Verdict, nis: float, ratio: float) -> bool:
    """Do innovations look right where errors are larger than stated?"""
    return 1.0 / FIT < nis < FIT and ratio > 1.0 and bool(set(verdict.faults) & set(SCALE))


def _cause(filter_: Filter, scenario: Scenario, jobs: int, timeout: float | None, settings: Settings) -> str:
    """What is wrong with the filter in a world: something that it is not told, its linearisation, or something else."""
    told = with_noise(scenario, 1.0)
    if unknown := misbelief(told):
        return f"other than by its noises the belief is wrong: {unknown}"
    say("asking whether the filter is consistent where the noise is small")
    results = run_trials(with_noise(scenario, LESS), [filter_], PROBE, jobs=jobs, timeout=timeout)
    small = analyse(results, settings=settings)[name_of(filter_)]
    if small.status in ("consistent", "undecided"):
        return (
            f"cause: linearisation. With {LESS:g} times the true standard deviations in world and belief no fault is "
            f"found in {PROBE} runs; take a filter of another kind (docs/filters.md), or better sensors"
        )
    return (
        f"cause: neither its noises nor linearisation alone. With {LESS:g} times the true standard deviations in world "
        f"and belief it still is {small.reasons[0]}"
    )


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
