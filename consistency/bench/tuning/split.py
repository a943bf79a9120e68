"""What is fitted and what is judged: fresh runs of a scenario, other runs of a log, or the second part of a drive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from consistency.bench.protocols import Filter
from consistency.bench.runs.montecarlo import require_counts, run_log, run_trials
from consistency.bench.runs.trial_work import Simulated
from consistency.bench.scenario import Belief, Scenario
from consistency.bench.store.log import Log
from consistency.bench.store.results import Results
from consistency.bench.types import Trial
from consistency.referee.errors import InputError

Judging = Callable[[Filter, Belief, int, float | None], Results]  # with so many jobs, and seconds a trial


@dataclass(frozen=True)
class Parts:
    """Two parts of one world that share no noise."""

    world: Scenario | Log
    trials: list[Trial]  # of the fit
    on_fitted: Judging  # results on these
    on_fresh: Judging  # and on the other part
    about: tuple[str, str]  # what is fitted, and what is judged
    spare_seed: int  # of runs for neither
    again: str  # options by which ``consistency run`` judges again; empty where it cannot
    has_truth: bool

    @property
    def belief(self) -> Belief:
        """Belief before the fit."""
        return self.world.belief


def parts_of(world: Scenario | Log, runs: int, seed: int) -> Parts:
    """So many runs of a scenario and as many fresh ones; or the first half of a log and its second.

    A log of one run is divided in the middle of its steps. The second part begins anew, with an empty map.

    Raises
    ------
    InputError
        A number out of its range, nothing in view, or a log that cannot be divided.
    """
    if isinstance(world, Log):
        return _of_log(world)
    require_counts(runs, seed)
    for_fit, for_verdict, spare = (int(state) for state in np.random.SeedSequence(seed).generate_state(3))
    simulated = Simulated(world, for_fit)
    count = f"{runs} run{'s' * (runs != 1)}"
    return Parts(
        world, [simulated(run) for run in range(runs)], partial(_simulated, world, runs, for_fit),
        partial(_simulated, world, runs, for_verdict),
        (count, f"{count} that the fit has not seen"), spare, f"--runs {runs} --seed {for_verdict}", True,
    )  # fmt: skip


def _simulated(
    scenario: Scenario, runs: int, seed: int, filter_: Filter, belief: Belief, jobs: int, timeout: float | None
) -> Results:
    return run_trials(with_belief(scenario, belief), [filter_], runs, seed, jobs, timeout)


def _of_log(log: Log) -> Parts:
    trials = log.trials
    if len(trials) > 1:
        half = (len(trials) + 1) // 2
        first, second = trials[:half], trials[half:]
        about = f"the first {half} run{'s' * (half != 1)}", f"the other {len(second)}"
    else:
        [only] = trials
        if log.belief.sensor.model == "linear":
            raise InputError(f"--log {log.name}: one run of a linear world cannot be divided; give two or more")
        middle = only.steps // 2
        if middle < 1:
            raise InputError(f"--log {log.name}: one run of one step cannot be divided; give a longer one")
        first, second = [part_of(only, 0, middle)], [part_of(only, middle, only.steps)]
        about = f"the first {middle} steps", f"the other {only.steps - middle}, which begin with an empty map"

    has_truth = all(trial.truth is not None for trial in trials)
    return Parts(log, first, partial(_recorded, log, first), partial(_recorded, log, second), about, 0, "", has_truth)


def _recorded(
    log: Log, trials: list[Trial], filter_: Filter, belief: Belief, jobs: int, timeout: float | None
) -> Results:
    return run_log(replace(log, trials=trials, belief=belief), [filter_], jobs, timeout)


def part_of(trial: Trial, start: int, end: int) -> Trial:
    """Steps ``start`` + 1 to ``end`` as a trial of its own: it begins at the true pose, or at the origin without."""
    rows = slice(trial.first[start], trial.first[end])
    truth = None if trial.truth is None else trial.truth[start : end + 1]
    pose = trial.start if start == 0 else np.zeros(3) if truth is None else truth[0]
    source = None if trial.source is None else trial.source[rows]
    return replace(
        trial, start=pose, controls=trial.controls[start:end], first=trial.first[start : end + 1] - trial.first[start],
        landmark=trial.landmark[rows], z=trial.z[rows], truth=truth, source=source,
    )  # fmt: skip


def with_belief(scenario: Scenario, belief: Belief, name: str | None = None) -> Scenario:
    return scenario.variant(name or scenario.name, belief=belief.model_dump(), summary=scenario.summary)
