"""Noises that a filter should believe in: fitted, judged on runs that the fit has not seen, and told in words."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from consistency.bench.filters import get_filter
from consistency.bench.filters.run_filter import resolve_filters
from consistency.bench.protocols import Filter, name_of
from consistency.bench.runs.montecarlo import require_counts, run_log, run_trials
from consistency.bench.runs.results_to_records import analyse
from consistency.bench.runs.run_outcome import Simulated
from consistency.bench.scenario import Belief, Scenario, load_scenario, scenario_text, toml_text
from consistency.bench.scenario.toml_tables import SIGMA_UNITS
from consistency.bench.store.parquet import write_tables, write_texts
from consistency.bench.store.recorded_log import Log, sensor_text
from consistency.bench.store.results import Tables
from consistency.bench.tuning.noise_factor_fit import (
    LIMIT,
    BeliefScorer,
    FactorFit,
    NoiseGroup,
    fit_log_factors,
    noise_groups_of,
    require_scorable,
    rounded,
    scaled,
    sigma_by_channel,
)
from consistency.bench.types import Trial
from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.number_words import plural, short
from consistency.referee.diagnostics.verdict import Verdict, plain
from consistency.referee.diagnostics.verdict_parts import Interval, Settings
from consistency.referee.errors import InputError
from consistency.referee.system import manifest_of, quiet
from consistency.referee.types import Array

OTHER_STARTS = (10.0, 0.1, 100.0)  # common factors to begin with where a run fails at the one that the data ask for
MOST_TOLERATED = 1.1  # ratio of true to stated covariance: what a verdict may excuse as the uncertainty of a fit
Judging = Callable[[Filter, Belief, int, float | None], Tables]  # with so many jobs, and seconds a trial
KIND = "tuning"


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


@dataclass(frozen=True)
class Parts:
    """Two parts of one world that share no noise."""

    world: Scenario | Log
    trials: list[Trial]  # of the fit
    on_fresh: Judging  # results on the other part
    fitted_on: str  # in words
    judged_on: str
    again: str  # options by which ``consistency run`` judges again; empty where it cannot

    @property
    def belief(self) -> Belief:
        """Belief before the fit."""
        return self.world.belief


def parts_of(world: Scenario | Log, runs: int, seed: int) -> Parts:
    """So many runs of a scenario and as many fresh ones; or the first half of a log and its second.

    A log of one run is divided in the middle of its steps. The second part begins with an empty map.

    Raises
    ------
    InputError
        A number out of its range, nothing in view, or a log that cannot be divided.
    """
    return _parts_of_log(world) if isinstance(world, Log) else _parts_of_scenario(world, runs, seed)


def _parts_of_scenario(scenario: Scenario, runs: int, seed: int) -> Parts:
    require_counts(runs, seed)
    fit_seed, verdict_seed = (int(state) for state in np.random.SeedSequence(seed).generate_state(2))
    simulated = Simulated(scenario, fit_seed)
    trials = [simulated(run) for run in range(runs)]

    def on_fresh(filter_: Filter, belief: Belief, jobs: int, timeout: float | None) -> Tables:
        return run_trials(scenario_with_belief(scenario, belief), [filter_], runs, verdict_seed, jobs, timeout)

    runs_text = plural(runs, "run")
    judged_on = f"{runs_text} that the fit has not seen"
    return Parts(scenario, trials, on_fresh, runs_text, judged_on, f"--runs {runs} --seed {verdict_seed}")


def _parts_of_log(log: Log) -> Parts:
    trials = log.trials
    if len(trials) > 1:
        fitted_runs = (len(trials) + 1) // 2
        fit_trials, verdict_trials = trials[:fitted_runs], trials[fitted_runs:]
        fitted_on, judged_on = f"the first {plural(fitted_runs, 'run')}", f"the other {len(verdict_trials)}"
    else:
        [only_trial] = trials
        if log.belief.sensor.model == "linear":
            raise InputError(f"--log {log.name}: one run of a linear world cannot be divided; give two or more")
        middle_step = only_trial.steps // 2
        if middle_step < 1:
            raise InputError(f"--log {log.name}: one run of one step cannot be divided; give a longer one")
        fit_trials = [part_of(only_trial, 0, middle_step)]
        verdict_trials = [part_of(only_trial, middle_step, only_trial.steps)]
        fitted_on = f"the first {middle_step} steps"
        judged_on = f"the other {only_trial.steps - middle_step}, which begin with an empty map"

    def on_fresh(filter_: Filter, belief: Belief, jobs: int, timeout: float | None) -> Tables:
        return run_log(replace(log, trials=verdict_trials, belief=belief), [filter_], jobs, timeout)

    return Parts(log, fit_trials, on_fresh, fitted_on, judged_on, "")


def part_of(trial: Trial, start: int, end: int) -> Trial:
    """Steps ``start`` + 1 to ``end`` as a trial of its own: it begins at the true pose, or at the origin without."""
    rows = slice(trial.first[start], trial.first[end])
    truth = source = None
    pose = trial.start if start == 0 else np.zeros(3)
    if trial.truth is not None:
        truth = trial.truth[start : end + 1]
        pose = trial.start if start == 0 else truth[0]
    if trial.source is not None:
        source = trial.source[rows]
    return replace(
        trial,
        start=pose,
        controls=trial.controls[start:end],
        first=trial.first[start : end + 1] - trial.first[start],
        landmark=trial.landmark[rows],
        z=trial.z[rows],
        truth=truth,
        source=source,
    )


def scenario_with_belief(scenario: Scenario, belief: Belief, name: str | None = None) -> Scenario:
    """The scenario with another belief."""
    return scenario.variant(name or scenario.name, belief=belief.model_dump(), summary=scenario.summary)


@dataclass(frozen=True)
class Factor:
    """Factor on the variances of a group of noises, with a 95 % interval.

    The interval is open, with an end of 0 or infinity, on a side on which the data do not bound the factor.
    ``edge`` is -1 or 1 where the factor lies at the lower or upper limit of what is tried, which is then no estimate.
    """

    group: NoiseGroup
    value: float
    interval: Interval
    edge: int = 0


@dataclass(frozen=True)
class Setting:
    """A fit, the belief that it leads to, and the verdict on it."""

    factors: tuple[Factor, ...]
    belief: Belief
    verdict: Verdict
    settings: int  # that were tried


@dataclass(frozen=True)
class Tuning:
    """Result of a fit, with the verdicts before and after it."""

    filter: str
    parts: Parts
    before: Verdict  # with the belief as it was, on the runs that are judged
    chosen: Setting
    seconds: float

    @property
    def verdict(self) -> Verdict:
        """After the fit, on runs that it has not seen."""
        return self.chosen.verdict

    @property
    def consistent(self) -> bool:
        return self.verdict.consistent

    @property
    def has_fault(self) -> bool:
        """Whether a fault is found after the fit; an undecided verdict has none."""
        return self.verdict.status not in ("consistent", "undecided")

    @property
    def factors(self) -> tuple[Factor, ...]:
        return self.chosen.factors

    @property
    def belief(self) -> Belief:
        """With the noises of the chosen setting."""
        return self.chosen.belief

    def __str__(self) -> str:
        return "\n".join(tuning_lines(self))


def tuning_lines(tuning: Tuning, out: Path | None = None) -> list[str]:
    """What to print beside the table of verdicts; ``out`` is the folder that was written."""
    parts, chosen = tuning.parts, tuning.chosen
    lines = [
        f"{tuning.filter} on {parts.world.name}: fitted by the likelihood of the innovations on {parts.fitted_on}, "
        f"judged on {parts.judged_on} ({chosen.settings} settings, {tuning.seconds:.0f} s)",
        *_factor_lines(chosen, parts.belief),
        f"before: {tuning.before.reasons[0]}{_power(tuning.before)}",
        f"after: {chosen.verdict.reasons[0]}{_power(chosen.verdict)}",
    ]
    if tuning.has_fault:
        names = ", ".join(factor.group.name for factor in chosen.factors)
        chance = f"one of {1.0 / chosen.verdict.settings.false_alarm:.3g} verdicts on a right filter"
        lines.append(
            f"the size of {names} is not all that is wrong, unless the fault was found by chance, as in {chance}; "
            "docs/tuning.md says what else may be"
        )
    lines += ["", noise_table(tuning).rstrip()]
    if out is not None:
        lines += ["", f"{out} has {', '.join(files(tuning))}{_next(tuning, out)}"]
    return lines


def _factor_lines(setting: Setting, before: Belief) -> list[str]:
    sigma_before, sigma_after = sigma_by_channel(before), sigma_by_channel(setting.belief)
    rows = []
    for factor in setting.factors:
        changes = [f"{name} {sigma_before[name]:.4g} -> {sigma_after[name]:.4g}" for name in factor.group.channels]
        rows.append(f"  {factor.group.name} {factor_text(factor)} (sigma: {', '.join(changes)})")
    return rows


def factor_text(factor: Factor) -> str:
    """x1.02 [0.97, 1.07], of variances; "at most" or "at least" where the data bound it on one side alone."""
    low, high = factor.interval.low, factor.interval.high
    factor_value, confidence = f"x{short(factor.value)}", f"with {100.0 * CONFIDENCE:g} %"
    bound_of_factor = ""
    if np.isfinite(high):
        bound_of_factor = f"at most x{short(high)}"
    elif low > 0.0:
        bound_of_factor = f"at least x{short(low)}"
    if factor.edge:
        limit = np.exp(factor.edge * LIMIT)
        return f"is at the limit of what is tried, x{limit:g}; {bound_of_factor or 'not known'} {confidence}"
    if low > 0.0 and np.isfinite(high):
        return f"{factor_value} [{short(low)}, {short(high)}]"
    if bound_of_factor:
        return f"{factor_value}, {bound_of_factor} {confidence}"
    return f"{factor_value}, which these data do not bound"


def _power(verdict: Verdict) -> str:
    if verdict.scale is None or not np.isfinite(verdict.scale.detectable):
        return ""
    ratio = short(verdict.scale.detectable)
    return f" (a covariance too small by x{ratio} would be found with power {verdict.settings.power:g})"


def noise_table(tuning: Tuning) -> str:
    """The believed noises as TOML to paste: into a scenario, or into ``sensor.toml`` of a log."""
    belief = tuning.belief
    motion = {"sigma_v": belief.motion.sigma_v, "sigma_omega": belief.motion.sigma_omega}
    sigma = {f"sigma{SIGMA_UNITS[belief.sensor.model]}": list(belief.sensor.sigma)}
    if isinstance(tuning.parts.world, Log):
        return toml_text(sigma | {"motion": motion})
    return toml_text({"belief": {"motion": motion, "sensor": sigma}})


def files(tuning: Tuning) -> dict[str, str]:
    """Text of the tuned world, or sensor, by name of its file."""
    world, belief = tuning.parts.world, tuning.belief
    comment = (
        f"{tuning.filter} tuned by the likelihood of the innovations on {tuning.parts.fitted_on}: "
        f"{tuning.verdict.status}"
    )
    if isinstance(world, Log):
        return {"sensor.toml": f"# {comment}\n{sensor_text(Path(world.name), belief)}"}
    name = f"{world.name}-tuned"
    return {f"{name}.toml": scenario_text(scenario_with_belief(world, belief, name), comment)}


def _next(tuning: Tuning, out: Path) -> str:
    world, run = tuning.parts.world, "consistency run"
    if isinstance(world, Log):
        use = f"{run} --log {world.name} --filter {tuning.filter} --out results"
        return f"; put it in the place of {Path(world.name) / 'sensor.toml'}, and run: {use}"
    [name] = files(tuning)
    return f"; judged again by: {run} {out / name} --filter {tuning.filter} {tuning.parts.again} --out results"


def tuning_verdicts(tuning: Tuning) -> dict[str, Verdict]:
    """Rows of the table of verdicts, by name."""
    return {f"{tuning.filter}, as believed": tuning.before, f"{tuning.filter}, tuned": tuning.verdict}


def write(tuning: Tuning, out: Path, overwrite: bool) -> None:
    """Write the files of a fit, with its outcome, as a folder that appears whole."""
    tuning_json = json.dumps(tuning_data(tuning, out), indent=2, allow_nan=False) + "\n"
    texts_by_file = files(tuning) | {"tuning.json": tuning_json}
    world = tuning.parts.world
    origin: dict[str, Any] = {"scenario": world.name}
    if isinstance(world, Log):
        origin = {"log": world.name, "log_sha256": world.sha256}
    manifest = manifest_of(KIND, wall=tuning.seconds, filters=[tuning.filter], **origin)
    write_tables(out, {}, manifest, lambda at: write_texts(at, texts_by_file), overwrite)


def tuning_data(tuning: Tuning, out: Path | None = None) -> dict[str, Any]:
    """The outcome for programs; numbers that are not finite become null. An open interval has low 0 or high null."""
    factors = []
    for factor in tuning.factors:
        group, interval = factor.group, factor.interval
        row = {"group": group.name, "channels": list(group.channels), "factor": factor.value}
        factors.append(row | {"low": interval.low, "high": interval.high, "edge": factor.edge})
    chosen = {
        "factors": factors,
        "sigma": sigma_by_channel(tuning.belief),
        "settings": tuning.chosen.settings,
        "verdict": _verdict_data(tuning.verdict),
    }
    data = {
        "filter": tuning.filter,
        "world": tuning.parts.world.name,
        "fitted_on": tuning.parts.fitted_on,
        "judged_on": tuning.parts.judged_on,
        "before": _verdict_data(tuning.before),
        "chosen": chosen,
        "consistent": tuning.consistent,
        "seconds": tuning.seconds,
        "out": None if out is None else str(out),
    }
    return dict(plain(data))


def _verdict_data(verdict: Verdict) -> Mapping[str, Any]:
    return {
        "status": verdict.status,
        "reasons": list(verdict.reasons),
        "runs": verdict.runs,
        "statistics": plain(verdict.statistics),
        "detectable": None if verdict.scale is None else verdict.scale.detectable,
    }
