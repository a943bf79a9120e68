"""What can be plugged in: a filter, step by step or a whole trial at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from consistency.scenario import Belief
from consistency.types import Array, Control, Estimates, Gaussian, Info, Observation, Trial


@dataclass(frozen=True)
class Problem:
    """What a filter is told before step 1."""

    belief: Belief
    start: Array  # (3,), pose at step 0, known exactly
    landmarks: Array | None = None  # (N, 3): reference of a linear world, None in any other


@runtime_checkable
class Filter(Protocol):
    """Any object with these four; ``name`` is optional and defaults to the class name.

    ``update`` may return None in the place of Info: then there is no NIS. An attribute ``innovations = "optimal"``
    declares that the gain is optimal and no measurement is gated away, so that innovations are white if the
    filter is right; they are then judged, and otherwise only reported.
    """

    def init(self, problem: Problem) -> Any: ...
    def predict(self, state: Any, control: Control) -> Any: ...
    def update(self, state: Any, observation: Observation) -> tuple[Any, Info | None]: ...
    def pose(self, state: Any) -> Gaussian: ...


@runtime_checkable
class WholeTrial(Protocol):
    """A filter that also runs whole trials, with the numbers that its four methods give."""

    def run(self, trial: Trial, belief: Belief) -> Estimates: ...
    def is_ready(self, trial: Trial, belief: Belief) -> bool: ...
