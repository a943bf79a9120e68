"""Fit the noises that a filter believes in, and judge it before and after on runs that the fit has not seen."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from consistency.bench.filters import get_filter
from consistency.bench.filters.filter_declarations import name_of
from consistency.bench.filters.resolve_filters import resolve_filters
from consistency.bench.protocols import Filter
from consistency.bench.runs.analyse_results import analyse
from consistency.bench.scenario import Belief, Scenario, load_scenario
from consistency.bench.store.recorded_log import Log
from consistency.bench.tuning.fit_and_verdict_trials import parts_of
from consistency.bench.tuning.innovation_likelihood import BeliefScorer, require_scorable
from consistency.bench.tuning.noise_factor_fit import FactorFit, fit_log_factors
from consistency.bench.tuning.noise_groups import NoiseGroup, noise_groups_of, rounded, scaled
from consistency.bench.tuning.tuning_result import Factor, Setting, Tuning
from consistency.referee.diagnostics.verdict.answers import Settings
from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.diagnostics.verdict.verdict import Verdict
from consistency.referee.errors import InputError
from consistency.referee.system.progress import quiet
from consistency.referee.types import Array

OTHER_STARTS = (10.0, 0.1, 100.0)  # common factors to begin with where a run fails at the one that the data ask for
MOST_TOLERATED = 1.1  # ratio of true to stated covariance: what a verdict may excuse as the uncertainty of a fit


def tune(
    world: Scenario | Log | str | Path,
    filter_: str | Filter,
    *,
    groups: str = "Q,R",
    runs: int = 50,
    seed: int = 0,
    jobs: int = -1,
    timeout: float | None = None,
    settings: Settings | None = None,
) -> Tuning:
    """Fit factors on the process and measurement noise that a filter believes in, and judge what they do.

    The likelihood of the innovations is maximised, which needs no truth. A scenario gives ``runs`` trials to the fit
    and as many others to the verdicts; a log its first half to the fit and its second to the verdicts. All settings
    see the same trials.

    Parameters
    ----------
    world : a scenario, its name or file, or a log (:func:`consistency.read_log`)
    filter_ : name of a built-in filter, or an object with ``init``, ``predict``, ``update`` and ``pose``, which takes
        its noises from ``problem.belief`` and returns innovations
    groups : noises with one factor each: "Q,R", or single ones such as "Q.v,Q.omega,R.range,R.bearing"; "+" joins
    timeout : seconds a trial, after which the process of a filter that is not compiled is killed
    settings : of the verdicts

    Raises
    ------
    InputError
        Unknown names, numbers out of range, nothing to fit by, or a filter that fails at every start.
    """
    began = time.monotonic()
    world = world if isinstance(world, Log) else load_scenario(world)
    instance = get_filter(filter_) if isinstance(filter_, str) else filter_
    resolve_filters([instance], world.belief, world.name if isinstance(world, Log) else None)
    noise_groups = noise_groups_of(groups, world.belief)
    parts = parts_of(world, runs, seed)
    require_scorable(instance)
    settings = settings or Settings()

    def verdict_on(belief: Belief, how: Settings) -> Verdict:
        with quiet():
            results = parts.on_fresh(instance, belief, jobs, timeout)
        return analyse(results, settings=how)[name_of(instance)]

    with BeliefScorer(instance, parts.trials, parts.belief, jobs, timeout) as scorer:
        scorer.compile()
        fit = fitted(scorer, parts.belief, noise_groups, world.name)
    belief = rounded(scaled(parts.belief, noise_groups, fit.log_factors))
    factors = tuple(map(_factor, noise_groups, fit.log_factors, fit.interval, fit.edge))
    chosen = Setting(factors, belief, verdict_on(belief, tolerant(settings, fit.interval)), fit.settings)
    before = verdict_on(parts.belief, settings)
    return Tuning(name_of(instance), parts, before, chosen, time.monotonic() - began)


def fitted(scorer: BeliefScorer, belief: Belief, groups: Sequence[NoiseGroup], world: str) -> FactorFit:
    """Return the factors of greatest likelihood on a belief about the ``world`` of that name.

    Raises
    ------
    InputError
        No step has an innovation, or a run fails at every start.
    """
    at_first = scorer(belief)
    if not at_first.failures and not np.isfinite(at_first.ratio):
        raise InputError(f"{world}: no step has an innovation to fit; give longer runs")
    starts = [1.0, *OTHER_STARTS]
    if np.isfinite(at_first.ratio) and at_first.ratio > 0.0:
        starts.insert(0, at_first.ratio)  # as all covariances scale together, so does the NIS: a good guess

    def score(log_factors: Array) -> Array | None:
        scores = scorer(scaled(belief, groups, log_factors))
        return None if scores.failures else scores.log_density

    fit = fit_log_factors(score, [np.full(len(groups), np.log(factor)) for factor in starts])
    if fit is None:
        count, first = len(at_first.failures), at_first.failures[0]
        raise InputError(
            f"filter '{name_of(scorer.filter)}' fails at every noise that the fit could begin with; as believed, in "
            f"{count} of {len(scorer.trials)} runs ({first})"
        )
    return fit


def tolerant(settings: Settings, interval: Array) -> Settings:
    """Return settings that take no ratio for a fault within the uncertainty of a fit, (groups, 2) in log factors.

    A verdict knows the size of innovations as well as the fit does, and would find the error of the fit.
    """
    half_widths = np.diff(interval, axis=1) / 2.0
    unsure = MOST_TOLERATED
    if np.isfinite(half_widths).all():
        unsure = min(float(np.exp(half_widths.max())), MOST_TOLERATED)
    tolerance = max(settings.tolerated, unsure)
    return replace(settings, tolerance=tolerance) if tolerance > 1.0 else settings


def _factor(group: NoiseGroup, log_factor: float, interval: Array, edge: int) -> Factor:
    value, (low, high) = float(np.exp(log_factor)), np.exp(interval)
    return Factor(group, value, Interval(value, float(low), float(high)), edge)
