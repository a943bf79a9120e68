"""The kinds of guards, and which observations of a step each keeps, by innovation and its covariance, in plain NumPy.

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

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from scipy import special

from consistency.referee.types import Array, Indices

if TYPE_CHECKING:
    from consistency.bench.scenario import GuardSettings

MOST_NODES = 2000  # of the search for a joint set; some 2 ms in a kernel. Below it the set is the largest


KINDS = {
    "gate": "chi-square gate of each observation by its own innovation",
    "joint": "largest set of observations that is jointly compatible",
    "ransac": "one-point RANSAC: the observations that agree with the best hypothesis from one of them",
}


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
