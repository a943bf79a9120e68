"""What is fitted and what is judged: fresh runs of a scenario, other runs of a log, or the second part of a drive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from consistency.bench.protocols import Filter
from consistency.bench.runs.montecarlo import require_counts, run_log, run_trials
from consistency.bench.runs.trial_work import Simulated
from consistency.bench.scenario import Belief, Scenario
from consistency.bench.store.recorded_log import Log
from consistency.bench.store.results import Tables
from consistency.bench.types import Trial
from consistency.referee.errors import InputError

Judging = Callable[[Filter, Belief, int, float | None], Tables]  # with so many jobs, and seconds a trial


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
        return run_trials(with_belief(scenario, belief), [filter_], runs, verdict_seed, jobs, timeout)

    runs_text = _runs(runs)
    judged_on = f"{runs_text} that the fit has not seen"
    return Parts(scenario, trials, on_fresh, runs_text, judged_on, f"--runs {runs} --seed {verdict_seed}")


def _parts_of_log(log: Log) -> Parts:
    trials = log.trials
    if len(trials) > 1:
        fitted_runs = (len(trials) + 1) // 2
        fit_trials, verdict_trials = trials[:fitted_runs], trials[fitted_runs:]
        fitted_on, judged_on = f"the first {_runs(fitted_runs)}", f"the other {len(verdict_trials)}"
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


def _runs(count: int) -> str:
    return "1 run" if count == 1 else f"{count} runs"


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


def with_belief(scenario: Scenario, belief: Belief, name: str | None = None) -> Scenario:
    """The scenario with another belief."""
    return scenario.variant(name or scenario.name, belief=belief.model_dump(), summary=scenario.summary)
