"""What can be plugged in: a motion model, a sensor, a filter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from consistency.scenario import Belief
from consistency.types import Array, Control, Gaussian, Info, Observation


@dataclass(frozen=True)
class Problem:
    """What a filter is told before step 1."""

    belief: Belief
    start: Array  # (3,), pose at step 0, known exactly
    landmarks: Array | None = None  # (N, 3): reference of a linear world, None in any other


class Motion(Protocol):
    """f of eq. 9 with its Jacobians, as a textbook filter calls it."""

    def move(self, pose: Array, control: Control) -> Array: ...
    def jacobians(self, pose: Array, control: Control) -> tuple[Array, Array]: ...


class Sensor(Protocol):
    """h of eq. 11 with its inverse and Jacobians, as a textbook filter calls it."""

    def measure(self, pose: Array, landmark: Array) -> Array: ...
    def jacobians(self, pose: Array, landmark: Array) -> tuple[Array, Array]: ...
    def locate(self, pose: Array, z: Array) -> tuple[Array, Array, Array]: ...


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
