"""Guards in plain NumPy: which observations of a step each kind keeps, and a guard before any filter.

The guard of compiled filters, with these rules in kernels, is ``compiled_guard``.

Of m known landmarks with s values each, a guard is given the innovation y (s m,) and its covariance S (s m, s m), both
as the filter says them. Every decision needs no more than these two:

- *gate*: an observation whose own squared distance y_i' S_ii^-1 y_i is beyond the quantile of chi-square with s degrees
  of freedom is rejected (Cox 1993).
- *joint*: of the observations that pass the gate, the largest set F whose y_F' S_FF^-1 y_F is within the quantile with
  s |F| degrees of freedom is kept (Neira & Tardos 2001); of several as large the one with the smallest distance. Which
  landmark an observation is of is known from tracking, so that the tree has two branches at each observation.
- *ransac*: each observation that passes the gate is a hypothesis: the state is updated by it alone. What is left of the
  innovations of the others, y_j - S_ji S_ii^-1 y_i with covariance S_jj - S_ji S_ii^-1 S_ij, is what the updated state
  expects of them, to first order. The hypothesis with most support wins; with its support the state is updated, and an
  observation with a high innovation is rescued if it passes the gate after that (Civera et al. 2010, algorithm 1).
  With a hypothesis for each observation nothing is drawn at random.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any, cast

import numpy as np
from scipy import special

from consistency.bench.protocols import Filter, Problem, name_of
from consistency.bench.scenario import GuardSettings
from consistency.bench.types import Control, Gaussian, Info, Observation
from consistency.referee.types import Array, Indices

MOST_NODES = 2000  # of the search for a joint set; some 2 ms in a kernel. Below it the set is the largest
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
        self.name = f"{name_of(filter_)}+{kind}"
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


@dataclass(frozen=True)
class Limits:
    """Squared Mahalanobis distances up to which observations of s values are accepted."""

    joint: Array  # (m + 1,), of 0, 1, ... m observations together
    support: float  # of what a hypothesis leaves of an observation

    @property
    def own(self) -> float:
        """Of an observation alone."""
        return float(self.joint[1])


def limits_of(settings: GuardSettings, s: int, m: int) -> Limits:
    """Limits of up to ``m`` observations of ``s`` values in a step."""
    return Limits(np.array(_quantiles(settings.confidence, s, max(m, 1))), settings.threshold**2)


@cache
def _quantiles(confidence: float, s: int, m: int) -> tuple[float, ...]:
    """Of chi-square with 0, s, ... s m degrees of freedom; asked in every trial, or in every step by a plain filter."""
    return 0.0, *map(float, 2.0 * special.gammaincinv(0.5 * s * np.arange(1, m + 1), confidence))


def kept_observations(kind: str, y: Array, S: Array, s: int, limits: Limits) -> Array:
    """Which observations (m,) a guard of this kind keeps, of an innovation y (s m,) with covariance S (s m, s m).

    Raises
    ------
    numpy.linalg.LinAlgError
        The covariance of some observations is not positive definite.
    """
    own = np.array([distance(y, S, component_rows([i], s)) for i in range(len(y) // s)])
    passed = own <= limits.own
    if kind == "gate":
        return passed
    decide = largest_compatible if kind == "joint" else best_supported
    keep = np.zeros(len(own), bool)
    keep[decide(y, S, s, own, np.flatnonzero(passed), limits)] = True
    return keep


def component_rows(which: list[int] | Indices, s: int) -> Indices:
    """Rows (s k,) of k observations in an innovation."""
    return (s * np.asarray(which, np.int64)[:, None] + np.arange(s)).ravel()


def distance(y: Array, S: Array, rows: Indices) -> float:
    """Squared Mahalanobis distance of some rows of an innovation."""
    white = np.linalg.solve(np.linalg.cholesky(S[np.ix_(rows, rows)]), y[rows])
    return float(white @ white)


def conditional_distance(y: Array, S: Array, rows: Indices, known: Indices) -> float:
    """Squared distance of ``rows`` after an update with the rows ``known``."""
    W = np.linalg.solve(S[np.ix_(known, known)], S[np.ix_(known, rows)]).T
    left, among = y[rows] - W @ y[known], S[np.ix_(rows, rows)] - W @ S[np.ix_(known, rows)]
    return distance(left, among, np.arange(len(rows)))


def largest_compatible(y: Array, S: Array, s: int, own: Array, candidates: Indices, limits: Limits) -> Indices:
    """The largest jointly compatible set of ``candidates``: branch and bound, nearest observations first.

    A branch is left where even all that is still to come would not make a larger set, or where the distance of what is
    chosen is beyond the limit of that many.
    """
    order = candidates[np.argsort(own[candidates], kind="stable")]
    best: tuple[int, float, list[int]] = (0, 0.0, [])
    nodes = 0

    def follow(chosen: list[int], total: float, level: int) -> None:
        nonlocal best, nodes
        if level == len(order):
            if total <= limits.joint[len(chosen)] and (len(chosen), -total) > (best[0], -best[1]):
                best = (len(chosen), total, chosen)
            return
        more = [*chosen, int(order[level])]
        for branch in (more, chosen):
            nodes += 1
            if nodes > MOST_NODES:
                return
            far = distance(y, S, component_rows(branch, s)) if branch is more else total
            most = len(branch) + len(order) - level - 1
            if (most, -far) > (best[0], -best[1]) and far <= limits.joint[most]:
                follow(branch, far, level + 1)

    follow([], 0.0, 0)
    return np.array(best[2], np.int64)


def best_supported(y: Array, S: Array, s: int, own: Array, candidates: Indices, limits: Limits) -> Indices:
    """The observations that support the best hypothesis, and those that are rescued."""
    best: tuple[int, float, list[int]] = (0, 0.0, [])
    for i in candidates:
        support = [
            int(j)
            for j in candidates
            if j == i or conditional_distance(y, S, component_rows([j], s), component_rows([i], s)) <= limits.support
        ]
        if (len(support), -own[i]) > (best[0], -best[1]):
            best = (len(support), own[i], support)
    low = best[2]
    rescued = [
        int(j)
        for j in candidates
        if j not in low and conditional_distance(y, S, component_rows([j], s), component_rows(low, s)) <= limits.own
    ]
    return np.array(low + rescued, np.int64)
