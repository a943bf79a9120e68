"""The score of a map, whose landmarks share the errors of one run, and that of a guard.

A map is scored by itself and together with the pose; a guard by the precision and recall of what it rejects.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics import distributions
from consistency.referee.diagnostics.nees import binomial_interval, kolmogorov
from consistency.referee.diagnostics.record import JointNees, Record
from consistency.referee.diagnostics.scale import ratio_interval
from consistency.referee.diagnostics.verdict import MapScore, Verdict
from consistency.referee.diagnostics.verdict_parts import (
    JOINT,
    JOINT_DISTRIBUTION,
    Interval,
    JointScore,
    RejectionScore,
    Settings,
)
from consistency.referee.diagnostics.whitening import by_runs
from consistency.referee.types import Array, Indices

POSE, POINT = 3, 3  # degrees of freedom of a pose in the plane, and of a landmark in space
SURE = 0.04  # false-alarm rate of naming a landmark that does not stand out


def map_score(run: Indices, nees: Array, dof: int = POINT, verdict: Verdict | None = None) -> MapScore:
    """Mean NEES over ``dof`` of landmarks (M,), with an interval from the spread between their runs (M,).

    Landmarks of one run share the error of its pose, so each run counts once, by the mean of its landmarks.
    """
    judged = np.isfinite(nees)
    _, place = np.unique(run[judged], return_inverse=True)
    counts = np.bincount(place)
    means = np.bincount(place, nees[judged]) / np.maximum(counts, 1) / dof
    return MapScore(ratio_interval(means, dof), len(counts), int(judged.sum()), int((~judged).sum()), verdict)


def last_nees(record: Record) -> Array | None:
    """The last NEES that each run has, (runs,), NaN where it has none; None without NEES."""
    if record.errors.nees is None:
        return None

    def of_block(nees: Array) -> Array:
        if not nees.size:
            return np.full(len(nees), np.nan)
        step = nees.shape[1] - 1 - np.argmax(np.isfinite(nees[:, ::-1]), axis=1)
        return np.asarray(nees[np.arange(len(nees)), step])

    return by_runs(of_block, record.errors.nees)


def joint_nees(error: Array, covariance: Array, dof: int = POINT) -> Array:
    """Parts (1 + K,) of the NEES of a joint error (3 + ``dof`` K,) of a pose and K landmarks, with its covariance.

    L^-1 error with L L' = covariance has independent standard normal components if the covariance is right. So each
    part is chi-square with as many degrees of freedom as it has components, independent of the others: that of its
    components given those before. Their sum is the joint NEES. All are infinite if the covariance is not positive
    definite.
    """
    count = 1 + (len(error) - POSE) // dof
    try:
        L = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return np.full(count, np.inf)
    squares = np.square(solve_triangular(L, error, lower=True, check_finite=False))
    parts = np.append(squares[:POSE].sum(), squares[POSE:].reshape(-1, dof).sum(axis=1))
    if not np.isfinite(parts).all():
        return np.full(count, np.inf)
    return parts


@dataclass(frozen=True)
class JointTest:
    """Result of the test of the joint NEES of N runs."""

    p_values: dict[str, float]
    score: JointScore
    nees: float  # of all runs
    means: Array  # (N,), over the degrees of freedom
    dof: int  # of the smallest run


def joint_test(
    joint: JointNees, settings: Settings, run_numbers: Indices | None = None, landmarks: Indices | None = None
) -> JointTest:
    """Test that the joint NEES of N runs are chi-square with their degrees of freedom d_i, each run one observation.

    If the joint covariance is right, their sum is exactly chi-square with sum d_i degrees of freedom, and the
    distribution functions of the d_i at the N values are uniform (Kolmogorov's test). Nothing is estimated. Runs
    whose joint covariance is not positive definite have an infinite value: they are named and left out.

    Parameters
    ----------
    run_numbers, landmarks : (N,) and (L,), labels of the runs and of the columns of ``joint.landmarks``
    """
    total = joint.pose + joint.map
    given = ~np.isnan(total) & (joint.dof > 0)
    kept = given & np.isfinite(total)
    numbers = np.arange(len(total)) if run_numbers is None else run_numbers
    q = total[kept]
    d = joint.dof[kept] + POSE
    Q = float(q.sum())
    D = int(d.sum())
    p_values = dict.fromkeys((JOINT, JOINT_DISTRIBUTION), float("nan"))
    if len(q):
        above = float(distributions.chi2.sf(Q, D))
        below = float(distributions.chi2.cdf(Q, D))
        p_values[JOINT] = above
        if not settings.one_sided:
            p_values[JOINT] = min(1.0, 2.0 * min(above, below))
            p_values[JOINT_DISTRIBUTION] = kolmogorov(distributions.chi2.cdf(q, d))[1]
    least = int(d.min()) if len(d) else 2 * POSE
    score = JointScore(
        both=ratio_interval(q / d, least, CONFIDENCE),
        pose=ratio_interval(joint.pose[kept] / POSE, POSE, CONFIDENCE),
        map=ratio_interval(joint.map[kept] / joint.dof[kept], least - POSE, CONFIDENCE),
        runs=len(q),
        dof=D,
        chief=_chief(joint, landmarks),
        not_definite=tuple(int(run) for run in numbers[given & ~kept]),
    )
    return JointTest(p_values, score, Q, q / d, least)


def _chief(joint: JointNees, labels: Indices | None) -> tuple[int, ...]:
    """Landmarks (L,) whose parts (N, L), each chi-square, are beyond chance, worst first.

    Two-sided, Bonferroni over landmarks.
    """
    parts = joint.landmarks
    if parts is None or labels is None or not len(labels):
        return ()
    here = np.isfinite(parts)
    total = np.where(here, parts, 0.0).sum(axis=0)
    dof = np.maximum(joint.width * here.sum(axis=0), 1)
    p = 2.0 * np.minimum(distributions.chi2.sf(total, dof), distributions.chi2.cdf(total, dof)) * len(labels)
    return tuple(int(labels[j]) for j in np.argsort(p, kind="stable") if p[j] <= SURE and here[:, j].any())


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
