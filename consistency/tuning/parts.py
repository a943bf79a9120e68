"""What is fitted and what is judged: fresh runs of a scenario, other runs of a log, or the second part of a drive."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from consistency.errors import InputError
from consistency.protocols import Filter
from consistency.runs.montecarlo import run_log, run_trials
from consistency.runs.work import Simulated
from consistency.scenario import Belief, Scenario
from consistency.store.log import Log
from consistency.store.results import Results
from consistency.types import Trial


class Parts(ABC):
    """Two parts of one world that share no noise."""

    name: str
    belief: Belief  # as it is before
    has_truth: bool

    @abstractmethod
    def fitted(self) -> list[Trial]:
        """Trials of the fit."""

    @abstractmethod
    def run(self, filter_: Filter, belief: Belief, jobs: int, timeout: float | None) -> Results:
        """The filter with a belief on the trials that are judged."""

    @property
    @abstractmethod
    def about(self) -> tuple[str, str]:
        """What is fitted, and what is judged, for a sentence."""


@dataclass(frozen=True)
class Fresh(Parts):
    """So many runs of a scenario for the fit, and as many with another seed."""

    scenario: Scenario
    runs: int
    seed: int
    has_truth = True

    @property
    def name(self) -> str:  # type: ignore[override]
        return self.scenario.name

    @property
    def belief(self) -> Belief:  # type: ignore[override]
        return self.scenario.belief

    @property
    def seeds(self) -> tuple[int, int]:
        """Of the fit, and of the runs that are judged."""
        fit, judged = np.random.SeedSequence(self.seed).generate_state(2)
        return int(fit), int(judged)

    def fitted(self) -> list[Trial]:
        simulated = Simulated(self.scenario, self.seeds[0])
        return [simulated(run) for run in range(self.runs)]

    def run(self, filter_: Filter, belief: Belief, jobs: int, timeout: float | None) -> Results:
        return run_trials(with_belief(self.scenario, belief), [filter_], self.runs, self.seeds[1], jobs, timeout)

    @property
    def about(self) -> tuple[str, str]:
        count = f"{self.runs} run{'s' * (self.runs != 1)}"
        return count, f"{count} that the fit has not seen"


@dataclass(frozen=True)
class Recorded(Parts):
    """The first half of the runs of a log for the fit, or of the steps of its only run.

    Raises
    ------
    InputError
        The only run is too short, or of a linear world, in which a filter is told the path from its beginning.
    """

    log: Log

    def __post_init__(self) -> None:
        _ = self._halves

    @property
    def name(self) -> str:  # type: ignore[override]
        return self.log.name

    @property
    def belief(self) -> Belief:  # type: ignore[override]
        return self.log.belief

    @property
    def has_truth(self) -> bool:  # type: ignore[override]
        return all(trial.truth is not None for trial in self.log.trials)

    @cached_property
    def _halves(self) -> tuple[list[Trial], list[Trial]]:
        trials = self.log.trials
        if len(trials) > 1:
            half = (len(trials) + 1) // 2
            return trials[:half], trials[half:]
        [only] = trials
        if self.log.belief.sensor.model == "linear":
            raise InputError(f"--log {self.log.name}: one run of a linear world cannot be divided; give two or more")
        if only.steps < 2:
            raise InputError(f"--log {self.log.name}: one run of one step cannot be divided; give a longer one")
        middle = only.steps // 2
        return [part_of(only, 0, middle)], [part_of(only, middle, only.steps)]

    def fitted(self) -> list[Trial]:
        return self._halves[0]

    def run(self, filter_: Filter, belief: Belief, jobs: int, timeout: float | None) -> Results:
        return run_log(replace(self.log, trials=self._halves[1], belief=belief), [filter_], jobs, timeout)

    @property
    def about(self) -> tuple[str, str]:
        if len(self.log.trials) > 1:
            first, second = map(len, self._halves)
            return f"the first {first} runs", f"the other {second}"
        first, second = (trials[0].steps for trials in self._halves)
        return f"the first {first} steps", f"the other {second}, which begin anew"


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


def with_belief(scenario: Scenario, belief: Belief, name: str | None = None, summary: str = "") -> Scenario:
    """The scenario with another belief."""
    named = {"summary": summary} if summary else {}
    return scenario.variant(name or scenario.name, belief=belief.model_dump(), **named)


def parts_of(world: Scenario | Log, runs: int, seed: int) -> Parts:
    """The two parts of a scenario or of a log."""
    return Recorded(world) if isinstance(world, Log) else Fresh(world, runs, seed)


def numbers(trials: Sequence[Trial]) -> int:
    """Observations of all trials."""
    return sum(len(trial.landmark) for trial in trials)
