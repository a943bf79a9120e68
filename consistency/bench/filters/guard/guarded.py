"""A guard before any filter, in plain Python: it asks the filter what it expects, and gives it what agrees."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, cast

import numpy as np

from consistency.bench.filters.guard.plain_rules import kept_observations, limits_of
from consistency.bench.protocols import Filter, Problem
from consistency.bench.scenario import GuardSettings
from consistency.bench.types import Control, Gaussian, Info, Observation
from consistency.referee.types import Array

DECLARED = ("sensors", "needs", "error", "realisable", "uvd")  # of a filter, that its guarded form declares as well
ASKED = ("map", "joint", "own_covariance")  # optional methods of a state


@dataclass(frozen=True)
class GuardedState:
    """The filter's state, and what is remembered of the tracks."""

    inner: Any
    settings: GuardSettings
    known: frozenset[int] = frozenset()  # landmarks that the filter was given
    sightings: dict[int, int] = field(default_factory=dict)  # of each landmark
    misses: dict[int, int] = field(default_factory=dict)  # rejected one after the other, up to the last
    begun: dict[int, int] = field(default_factory=dict)  # observation with which it began, until another agrees with it
    rejected: Array = field(default_factory=lambda: np.zeros(0, bool))  # of all observations so far


class Guarded:
    """``filter_`` with a guard of a ``kind``: "gate", "joint" or "ransac".

    ``update`` first asks the filter for innovation and S of the known landmarks, by an update whose state is thrown
    away; then it updates with what the guard keeps. So the filter's ``update`` must return :class:`Info`, whose rows
    are those of the landmarks that it knows, in the order of the observation. Innovations behind a guard are not
    white: the guarded filter declares nothing about them. :func:`guarded` is the way to one.
    """

    def __init__(self, filter_: Filter, kind: str) -> None:
        self.filter, self.kind = filter_, kind
        self.name = f"{getattr(filter_, 'name', type(filter_).__name__)}+{kind}"
        for name in DECLARED:
            if hasattr(filter_, name):
                setattr(self, name, getattr(filter_, name))
        for name in ASKED:
            if callable(getattr(filter_, name, None)):
                setattr(self, name, partial(self._ask, name))

    def init(self, problem: Problem) -> GuardedState:
        return GuardedState(self.filter.init(problem), problem.belief.guard or GuardSettings())

    def predict(self, state: GuardedState, control: Control) -> GuardedState:
        return replace(state, inner=self.filter.predict(state.inner, control))

    def update(self, state: GuardedState, observation: Observation) -> tuple[GuardedState, Info | None]:
        labels, first, s = observation.landmarks.tolist(), len(state.rejected), observation.z.shape[1]
        sightings = state.sightings | {label: state.sightings.get(label, 0) + 1 for label in labels}
        state = replace(state, sightings=sightings)
        keep = np.array([self._is_offered(state, label) for label in labels], dtype=bool)
        known, info = self._known(state, observation, keep)
        if info is not None:
            keep[known] = kept_observations(
                self.kind, info.innovation, info.S, s, limits_of(state.settings, s, len(known))
            )
        misses = state.misses | {labels[i]: 0 if keep[i] else state.misses.get(labels[i], 0) + 1 for i in known}
        agreed = {labels[i] for i in known if keep[i]}
        begun = {label: at for label, at in state.begun.items() if label not in agreed}
        again = [int(i) for i in known if not keep[i] and labels[i] in begun and hasattr(self.filter, "forget")]
        keep[again] = True
        rejected = np.append(state.rejected, ~keep)
        rejected[[begun[labels[i]] for i in again]] = True
        begins = [int(i) for i in np.flatnonzero(keep) if i in again or labels[i] not in state.known]
        begun |= {labels[i]: first + i for i in begins}
        known_now = state.known.union(observation.landmarks[keep].tolist())
        inner, forgetful = state.inner, cast(Any, self.filter)
        for i in again:
            inner = forgetful.forget(inner, labels[i])
        inner, info = self.filter.update(inner, Observation(observation.landmarks[keep], observation.z[keep]))
        return replace(state, inner=inner, known=known_now, misses=misses, begun=begun, rejected=rejected), info

    def _is_offered(self, state: GuardedState, label: int) -> bool:
        """Whether the track is old enough, and the landmark not given up."""
        limit = state.settings.forget_after
        is_given_up = limit is not None and state.misses.get(label, 0) >= limit
        return state.sightings[label] >= state.settings.min_age and not is_given_up

    def _known(self, state: GuardedState, observation: Observation, keep: Array) -> tuple[Array, Info | None]:
        """Places of the offered observations whose landmarks the filter knows, and what it says of them together.

        A filter that was given a landmark may have put it aside, as one that works on small maps does. Then it is asked
        about each observation by itself.
        """
        places, s = np.flatnonzero(keep), observation.z.shape[1]
        known = np.array([i for i in places if int(observation.landmarks[i]) in state.known], np.int64)
        if not len(known):
            return known, None
        info = self._expected(state, observation, places)
        if len(info.innovation) != s * len(known):
            known = np.array([i for i in known if len(self._expected(state, observation, [i]).innovation)], np.int64)
        if len(info.innovation) != s * len(known):
            raise TypeError(f"{len(info.innovation)} rows of innovation for {len(known)} known landmarks of {s} values")
        return known, info if len(known) else None

    def _expected(self, state: GuardedState, observation: Observation, places: Any) -> Info:
        ask = getattr(self.filter, "expected", self.filter.update)
        _, info = ask(state.inner, Observation(observation.landmarks[places], observation.z[places]))
        if info is None:
            raise TypeError("a guard needs a filter whose update returns Info")
        return info

    def pose(self, state: GuardedState) -> Gaussian:
        return self.filter.pose(state.inner)

    def rejected(self, state: GuardedState) -> Array:
        """Which of all observations so far the filter was not given, or has forgotten."""
        return state.rejected

    def _ask(self, method: str, state: GuardedState) -> Any:
        return getattr(self.filter, method)(state.inner)
