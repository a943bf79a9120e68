"""Precision and recall of a guard that rejects spurious observations, with intervals."""

from __future__ import annotations

import numpy as np

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.diagnostics.statistics.nees import binomial_interval
from consistency.referee.diagnostics.verdict.parts import Interval, RejectionScore
from consistency.referee.types import Array, Indices


def rejection_score(offered: Indices, spurious: Indices, rejected: Indices, hits: Indices) -> RejectionScore:
    """Shares over all of N runs, (N,) counts each; ``hits`` are rejected and spurious.

    Observations of one run are not independent: after a spurious one has got in, many right ones may be rejected. The
    intervals are those of :func:`clustered_share`, with runs as clusters.
    """
    return RejectionScore(
        precision=clustered_share(hits, rejected),
        recall=clustered_share(hits, spurious),
        false_alarms=clustered_share(rejected - hits, offered - spurious),
        runs=len(offered), offered=int(offered.sum()), spurious=int(spurious.sum()), rejected=int(rejected.sum()),
    )  # fmt: skip


def clustered_share(count: Array, size: Array, confidence: float = CONFIDENCE) -> Interval:
    """Share of ``size`` (N,) that is counted in ``count`` (N,), pooled over N independent clusters, and its interval.

    Korn & Graubard (1998): the exact binomial interval of Clopper & Pearson at the effective number of draws, which is
    the number over the design effect, the variance between clusters over the binomial one, and over the square of the
    ratio of quantiles t(N - 1) / t(draws - 1). The design effect is taken as 1 at least. With one cluster it cannot be
    known, and with none of what is shared out nothing can: then the interval is [0, 1].
    """
    count = np.asarray(count, float)
    size = np.asarray(size, float)
    used = size > 0
    count, size, draws = count[used], size[used], float(size.sum())
    clusters = len(size)
    tail = 0.5 * (1.0 - confidence)
    if draws == 0.0:
        return Interval(np.nan, 0.0, 1.0)
    share = float(count.sum() / draws)
    if clusters == 1 or draws == 1.0:
        return Interval(share, 0.0, 1.0)
    binomial = share * (1.0 - share) / draws
    between = clusters / (clusters - 1) * float(np.square(count - share * size).sum()) / draws**2
    effect = max(between / binomial, 1.0) if binomial > 0.0 else 1.0
    quantiles = distributions.t.isf(tail, clusters - 1) / distributions.t.isf(tail, draws - 1)
    effective = draws / effect / quantiles**2
    low, high = binomial_interval(share * effective, effective, confidence)
    return Interval(share, float(low), float(high))
