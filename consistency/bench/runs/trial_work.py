"""What is done for each run, as a value that can be sent to where it is done."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

from consistency.bench.protocols import Filter
from consistency.bench.runs.isolation.filter_process import Isolation
from consistency.bench.runs.missing_kernels import compile_all
from consistency.bench.runs.run_outcome import RunOutcome, outcome_of
from consistency.bench.scenario import Scenario
from consistency.bench.simulation import require_landmarks_in_view
from consistency.bench.simulation.world import World
from consistency.bench.types import Trial

Outcomes = Generator[RunOutcome, None, None]


@dataclass(frozen=True)
class Simulated:
    """Trials of a scenario.

    Raises
    ------
    InputError
        No landmark can ever be seen.
    """

    scenario: Scenario
    seed: int

    def __post_init__(self) -> None:
        _ = self._world

    def __call__(self, run: int) -> Trial:
        return self._world.trial(run, self.seed)

    def __reduce__(self) -> tuple[Any, ...]:
        return Simulated, (self.scenario, self.seed)

    @cached_property
    def _world(self) -> World:
        return require_landmarks_in_view(self.scenario)


@dataclass(frozen=True)
class Recorded:
    """Trials that are there, by number of their runs."""

    trials: Mapping[int, Trial]

    def __call__(self, run: int) -> Trial:
        return self.trials[run]


@dataclass(frozen=True)
class TrialWork:
    """Trials, and the filters through which each is put; it can be pickled.

    Runs are done in a ``with`` on ``isolation``.
    """

    trials: Callable[[int], Trial]
    isolation: Isolation

    def __call__(self, run: int) -> RunOutcome:
        trial = self.trials(run)
        return outcome_of(trial, self.isolation.run(trial))

    @property
    def filters(self) -> list[Filter]:
        return self.isolation.filters

    def only(self, runs: Sequence[int]) -> TrialWork:
        """Work with what these runs need: the trials of a log are many, those of a scenario are drawn."""
        if not isinstance(self.trials, Recorded):
            return self
        return replace(self, trials=Recorded({run: self.trials.trials[run] for run in runs}))

    def compile(self, trial: Trial, jobs: int) -> None:
        """Compile what a trial needs and is not yet compiled, in ``jobs`` processes at most, and say so."""
        belief = self.isolation.belief
        compile_all(((filter_, trial, belief) for filter_ in self.isolation.compiled), jobs)


class Workers(Protocol):
    """Who does runs. The bits do not depend on it: BLAS has one thread."""

    def prepare(self, work: TrialWork, run: int, /) -> None:
        """Compile what ``run`` needs, where that is done on this machine."""

    def outcomes(self, work: TrialWork, runs: Sequence[int], /) -> Outcomes:
        """What each run left, in the order in which they end; to be closed, which stops what is not done."""
