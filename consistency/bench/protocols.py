"""What a filter is, run step by step or a whole trial at once, what it is told, and what it declares of itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np

from consistency.bench.scenario import Belief
from consistency.bench.types import Control, Estimates, Gaussian, Info, Observation, Trial
from consistency.referee.errors import InputError
from consistency.referee.geometry import ADDITIVE, PLANAR
from consistency.referee.types import Array


@dataclass(frozen=True)
class TrialTruth:
    """True poses and landmarks of a trial."""

    path: Array  # (T + 1, 3)
    landmarks: Array  # (N, 3)


@dataclass(frozen=True)
class Problem:
    """Information given to a filter before step 1."""

    belief: Belief
    start: Array  # (3,), pose at step 0, known exactly
    landmarks: Array | None = None  # (N, 3): reference of a linear world, None in any other
    truth: TrialTruth | None = None  # told to a filter that declares ``realisable = False``, None to any other
    # random numbers of this filter in this run, a function of (seed, run, name of the filter) alone
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))


@runtime_checkable
class Filter(Protocol):
    """Any object with these four; ``name`` is optional and defaults to the class name.

    A filter that draws random numbers takes them from ``Problem.rng``: each run then has its own, and the same ones
    whenever it is repeated.

    ``update`` may return None in place of Info: then there is no NIS. An attribute ``innovations = "optimal"``
    declares that the gain is optimal and no measurement is gated away, so that innovations are white if the
    filter is right; they are then judged, and otherwise only reported.

    ``pose`` gives the covariance of the additive error in the world. A filter with another error declares it in an
    attribute ``error``, one of ``PLANAR`` in ``consistency.referee.geometry``, and gives the covariance of
    that error by ``own_covariance(state)``, (3, 3). It is then judged in its own error.

    An attribute ``realisable = False`` marks a bound: a filter that is told the truth (``Problem.truth``) and so runs
    on trials whose truth is known, and on no other. ``causal = False`` marks another: a smoother, which gives each pose
    by the data of the whole trial. It has ``run`` (:class:`WholeTrial`) and refuses to be stepped.

    Two more methods are optional, and asked after the last step, for the NEES of the map. ``map(state)`` gives the
    landmarks in the state by label, as points (3,) in the world with their covariance (3, 3). ``joint(state)`` gives
    the pose and these K points, in the order of ``map``, as one Gaussian, (3 + 3 K,) and (3 + 3 K, 3 + 3 K), of the
    additive errors.

    ``rejected(state)`` is for filters that reject observations: a mask (M,) over all observations so far, in the order
    in which they were offered. It is called in each step, and the rejections are scored. An attribute
    ``innovates = False`` says that ``update`` gives no innovations, so that no guard can be put before the filter.
    ``forget(state, label)`` gives the state without a landmark; a guard asks for it where the second sighting does not
    agree with the first.
    """

    def init(self, problem: Problem) -> Any: ...
    def predict(self, state: Any, control: Control) -> Any: ...
    def update(self, state: Any, observation: Observation) -> tuple[Any, Info | None]: ...
    def pose(self, state: Any) -> Gaussian: ...


@runtime_checkable
class WholeTrial(Protocol):
    """A filter that also runs whole trials, with the numbers that its four methods give.

    ``run`` may be called from several threads at once. ``is_ready`` says whether it starts at once; if not,
    ``compile`` does what takes seconds.
    """

    def run(self, trial: Trial, belief: Belief) -> Estimates: ...
    def is_ready(self, trial: Trial, belief: Belief) -> bool: ...
    def compile(self, trial: Trial, belief: Belief) -> None: ...


def name_of(filter_: Filter) -> str:
    """``name`` of a filter, or its class's."""
    return str(getattr(filter_, "name", type(filter_).__name__))


def error_of(filter_: Filter) -> str:
    """Convention of the filter's own error, "so2" where it declares none.

    Raises
    ------
    InputError
        No such convention, or nothing that gives the covariance of that error.
    """
    error = getattr(filter_, "error", ADDITIVE)
    if not isinstance(error, str) or error not in PLANAR:
        raise InputError(f"filter '{name_of(filter_)}': its error must be one of {', '.join(PLANAR)}, got {error!r}")
    if error != ADDITIVE and not isinstance(filter_, WholeTrial) and not hasattr(filter_, "own_covariance"):
        raise InputError(f"filter '{name_of(filter_)}': with the error '{error}' it needs own_covariance(state)")
    return error


def own_errors(filters: Sequence[Filter]) -> dict[str, str]:
    """Convention of each filter's own error, of those where it is not the additive one."""
    errors = {name_of(f): error_of(f) for f in filters}
    return {name: error for name, error in errors.items() if error != ADDITIVE}


def optimal_gain(filter_: Filter) -> bool:
    """Does the filter declare that its gain is optimal, so that its innovations may be judged?"""
    declared = getattr(filter_, "innovations", None)
    return isinstance(declared, str) and declared == "optimal"


def rejects(filter_: Filter) -> bool:
    """Does the filter say which observations it left out?"""
    return callable(getattr(filter_, "rejected", None))


def is_realisable(filter_: Any) -> bool:
    """False for a filter that declares itself a bound, to be told the truth."""
    return getattr(filter_, "realisable", True) is not False
