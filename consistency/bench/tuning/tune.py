"""Fit the noises that a filter believes in, and judge it before and after on runs that the fit has not seen."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from consistency.bench.filters import get_filter
from consistency.bench.filters.stepping import name_of
from consistency.bench.protocols import Filter
from consistency.bench.runs.analyse_results import analyse
from consistency.bench.runs.montecarlo import resolve_filters
from consistency.bench.scenario import Belief, Scenario, load_scenario
from consistency.bench.store.log import Log
from consistency.bench.tuning.faults import Probe, balanced, is_at_fault, nearest, reasons_of
from consistency.bench.tuning.fit import FactorFit, maximise
from consistency.bench.tuning.noise_groups import NoiseGroup, groups_of, rounded, scaled
from consistency.bench.tuning.result import Factor, Setting, Tuning
from consistency.bench.tuning.scores import BeliefScorer, require_scorable
from consistency.bench.tuning.split import Judging, Parts, parts_of
from consistency.referee.diagnostics import Settings, Verdict
from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.errors import InputError
from consistency.referee.system.progress import quiet, say
from consistency.referee.types import Array

OTHER_STARTS = (10.0, 0.1, 100.0)  # common factors to begin with where a run fails at the one that the data ask for

MOST_TOLERATED = 1.1  # ratio of true to stated covariance: what a verdict may excuse as the uncertainty of a fit


# another setting, how many were tried, whether none is consistent, and why
Explanation = tuple[Setting | None, int, bool, tuple[str, ...]]


def tune(
    world: Scenario | Log | str | Path,
    filter_: str | Filter,
    *,
    by: str = "innovations",
    groups: str = "Q,R",
    runs: int = 50,
    seed: int = 0,
    jobs: int = -1,
    timeout: float | None = None,
    settings: Settings | None = None,
) -> Tuning:
    """Fit factors on the process and measurement noise that a filter believes in, and judge what they do.

    A scenario gives ``runs`` trials to the fit and as many others to the verdicts; a log its first half to the fit and
    its second to the verdicts. All settings see the same trials.

    Parameters
    ----------
    world : a scenario, its name or file, or a log (:func:`consistency.read_log`)
    filter_ : name of a built-in filter, or an object with ``init``, ``predict``, ``update`` and ``pose``, which takes
        its noises from ``problem.belief``
    by : "innovations", by their likelihood, which needs no truth; "nees", by the density that the filter states at the
        true pose
    groups : noises with one factor each: "Q,R", or single ones such as "Q.v,Q.omega,R.range,R.bearing"; "+" joins
    timeout : seconds a trial, after which the process of a filter that is not compiled is killed
    settings : of the verdicts

    Raises
    ------
    InputError
        Unknown names, numbers out of range, nothing to fit by, or a filter that fails at every start.
    """
    began = time.monotonic()
    world = load_scenario(world) if isinstance(world, str | Path) else world
    instance = get_filter(filter_) if isinstance(filter_, str) else filter_
    resolve_filters([instance], world.belief, world.name if isinstance(world, Log) else None)
    parsed = groups_of(groups, world.belief)
    parts = parts_of(world, runs, seed)
    require_scorable(instance, by, parts.has_truth)
    tuner = _Tuner(instance, parts, parsed, jobs, timeout, settings or Settings())
    chosen = tuner.fitted(by)
    before = tuner.verdict(parts.on_fresh, parts.belief, tuner.settings)
    other, tried, no_setting, why = tuner.explained(chosen) if is_at_fault(chosen.verdict) else (None, 0, False, ())
    seconds = time.monotonic() - began
    return Tuning(name_of(instance), parts, before, chosen, other, tried, no_setting, why, seconds)


class _Tuner:
    def __init__(
        self,
        filter_: Filter,
        parts: Parts,
        groups: Sequence[NoiseGroup],
        jobs: int,
        timeout: float | None,
        settings: Settings,
    ) -> None:
        self.filter, self.parts, self.groups = filter_, parts, groups
        self.jobs, self.timeout, self.settings = jobs, timeout, settings

    def fitted(self, by: str) -> Setting:
        """The best setting by a score, with the verdict on it."""
        with BeliefScorer(self.filter, self.parts.trials, self.parts.belief, by, self.jobs, self.timeout) as bench:
            bench.compile()
            fit = self._fit(bench)
        return self._setting(by, fit.log_factors, fit.interval, fit.edge, bench.settings)

    def explained(self, chosen: Setting) -> Explanation:
        """For a setting with a fault: another one, how many were tried, whether none is consistent, and why."""
        probe, scenario = None, self.parts.world
        if isinstance(scenario, Scenario):
            say("a fault is found; asking whether it is there with the true noises, too")
            count, seed = len(self.parts.trials), self.parts.spare_seed
            probe = Probe(self.filter, scenario, count, seed, self.jobs, self.timeout, self.settings)
            if not is_at_fault(at_truth := probe()):
                return None, 0, False, (
                    f"with the true noises, on other runs: {at_truth.reasons[0]}",
                    "so the fit is off, or the fault was found by chance, as in one of "
                    f"{1.0 / self.settings.false_alarm:.3g} verdicts on a right filter: fit on more runs (--runs)",
                )  # fmt: skip
        other, tried = self.nearest(chosen) if self.parts.has_truth else (None, 0)
        if other is not None and not is_at_fault(other.verdict):
            return other, tried, False, ()
        return other, tried, True, reasons_of(chosen.verdict, probe)

    def nearest(self, fitted: Setting) -> tuple[Setting | None, int]:
        """Of settings at which errors have the size that is stated, the one nearest to consistent; and their number."""
        say("looking for settings at which errors are as large as stated")

        def ratio(log_factors: Array) -> float:
            scores = bench(scaled(self.parts.belief, self.groups, log_factors))
            return np.nan if scores.failures else scores.ratio

        def judge(log_factors: Array) -> Verdict:
            belief = scaled(self.parts.belief, self.groups, log_factors)
            return self.verdict(self.parts.on_fitted, belief, self.settings)

        centre = np.array([0.0 if factor.edge else np.log(factor.value) for factor in fitted.factors])
        with BeliefScorer(self.filter, self.parts.trials, self.parts.belief, "nees", self.jobs, self.timeout) as bench:
            settings = balanced(centre, ratio, judge)
        best = nearest(settings)
        if best is None:
            return None, 0
        x = best.log_factors
        return self._setting("size", x, np.full((len(x), 2), np.nan), (0,) * len(x), bench.settings), len(settings)

    def _setting(self, by: str, x: Array, interval: Array, edge: Sequence[int], settings: int) -> Setting:
        factors = tuple(map(_factor, self.groups, x, interval, edge))
        belief = rounded(scaled(self.parts.belief, self.groups, x))
        verdict = self.verdict(self.parts.on_fresh, belief, tolerant(self.settings, interval))
        return Setting(by, factors, belief, verdict, settings)

    def verdict(self, judging: Judging, belief: Belief, settings: Settings) -> Verdict:
        with quiet():
            results = judging(self.filter, belief, self.jobs, self.timeout)
        return analyse(results, settings=settings)[name_of(self.filter)]

    def _fit(self, bench: BeliefScorer) -> FactorFit:
        at_first = bench(self.parts.belief)
        if not at_first.failures and not np.isfinite(at_first.ratio):
            wanted = "an innovation" if bench.by == "innovations" else "a NEES"
            raise InputError(f"{self.parts.world.name}: no step has {wanted} to fit; give longer runs")
        common = at_first.ratio if np.isfinite(at_first.ratio) and at_first.ratio > 0.0 else 1.0
        factors = (common, 1.0, *OTHER_STARTS)  # as all covariances scale together, so do the squares: a good guess

        def score(log_factors: Array) -> Array | None:
            scores = bench(scaled(self.parts.belief, self.groups, log_factors))
            return None if scores.failures else scores.log_density

        fit = maximise(score, [np.full(len(self.groups), np.log(factor)) for factor in factors])
        if fit is None:
            count, first = len(at_first.failures), at_first.failures[0]
            raise InputError(
                f"filter '{name_of(self.filter)}' fails at every noise that the fit could begin with; as believed, in "
                f"{count} of {len(self.parts.trials)} runs ({first})"
            )
        return fit


def tolerant(settings: Settings, interval: Array) -> Settings:
    """Settings that take no ratio for a fault that is within the uncertainty of a fit, (groups, 2) in log factors.

    A verdict knows the size of innovations as well as the fit does, and would find the error of the fit.
    """
    half_widths = np.diff(interval, axis=1) / 2.0
    unsure = float(np.exp(half_widths[np.isfinite(half_widths)].max(initial=0.0)))
    known = unsure if np.isfinite(half_widths).all() else MOST_TOLERATED
    tolerance = max(settings.tolerated, min(known, MOST_TOLERATED))
    return replace(settings, tolerance=tolerance) if tolerance > 1.0 else settings


def _factor(group: NoiseGroup, log_factor: float, interval: Array, edge: int) -> Factor:
    value, (low, high) = float(np.exp(log_factor)), np.exp(interval)
    return Factor(group, value, Interval(value, float(low), float(high)), edge)
