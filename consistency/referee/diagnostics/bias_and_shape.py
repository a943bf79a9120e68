"""Is the mean of the errors zero, and has their covariance the stated shape?

Neither answer depends on its size, which is asked in ``scale``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import special

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics import distributions
from consistency.referee.diagnostics.distributions import weighted_chi_square_tail
from consistency.referee.diagnostics.record import Record
from consistency.referee.diagnostics.scale import UNKNOWN, RunMeans, ratio_interval
from consistency.referee.diagnostics.verdict_parts import Interval
from consistency.referee.diagnostics.whitening import all_finite, are_unlike, block_slices, by_runs, standardise
from consistency.referee.types import Array, Indices

FEWEST = 6  # runs that determine the size of an axis in a step
MOST_AXES = 12  # components whose coverage is shown
ALL_AT_ONCE = 3  # numbers, of which the test of Hotelling keeps its rate with heavy tails


@dataclass(frozen=True)
class Hotelling:
    """Test that a sample of vectors has mean zero, Hotelling (1931)."""

    mean: Array  # (n,)
    interval: Array  # (n, 2), simultaneous, Bonferroni over the components
    statistic: float  # T-squared
    p_value: float


def hotelling(sample: Array, confidence: float = CONFIDENCE) -> Hotelling:
    """T-squared test of a sample (N, n), exact for independent Gaussian rows, N > n.

    Raises
    ------
    ValueError
        Too few rows, or a value that is not finite.
    """
    x = np.asarray(sample, float)
    if x.ndim != 2 or len(x) <= x.shape[1] or not np.isfinite(x).all():
        raise ValueError(f"needs more finite rows than columns, got shape {x.shape}")
    (statistic,), (p_value,) = t_squared(x[:, None, :])
    N, n = x.shape
    half = distributions.t.isf(0.5 * (1.0 - confidence) / n, N - 1) * x.std(axis=0, ddof=1) / np.sqrt(N)
    mean = x.mean(axis=0)
    return Hotelling(mean, np.stack([mean - half, mean + half], axis=-1), float(statistic), float(p_value))


def t_squared(whitened: Array, known: StepMoments | None = None) -> tuple[Array, Array]:
    """T-squared and p value of each step, (runs, steps, n) -> (steps,), (steps,).

    T^2 (N - n) / (n (N - 1)) is F(n, N - n) distributed (Anderson 2003, Theorem 5.2.2). NaN where fewer
    than n + 1 runs are left. ``known`` are the moments, if already computed.
    """
    if known is None:
        known = step_moments(whitened)
    N, mean, S = known
    n = whitened.shape[-1]
    statistic = np.full(len(N), np.nan)
    p_value = np.full(len(N), np.nan)
    good = n + 1 <= N
    with np.errstate(all="ignore"):
        good &= np.linalg.det(np.where(good[:, None, None], S, np.eye(n))) > 0
    if good.any():
        m = mean[good]
        scatter = S[good]
        t2 = N[good] * np.einsum("ki,ki->k", m, np.linalg.solve(scatter, m[..., None])[..., 0])
        statistic[good] = t2
        p_value[good] = special.fdtrc(n, N[good] - n, t2 * (N[good] - n) / (n * (N[good] - 1)))
    return statistic, p_value


class StepMoments(NamedTuple):
    """Runs, mean and sample covariance of every step."""

    runs: Indices  # (steps,)
    mean: Array  # (steps, n)
    covariance: Array  # (steps, n, n)


def step_moments(whitened: Array) -> StepMoments:
    """Moments of whitened errors (runs, steps, n)."""
    runs, steps, n = whitened.shape
    moments = StepMoments(np.zeros(steps, int), np.zeros((steps, n)), np.zeros((steps, n, n)))
    for here in block_slices(steps, runs):
        present = all_finite(whitened[:, here])
        N = present.sum(axis=0)
        w = np.where(present[..., None], whitened[:, here], 0.0)
        mean = w.sum(axis=0) / np.maximum(N, 1)[:, None]
        w = np.where(present[..., None], w - mean, 0.0)
        by_step = np.ascontiguousarray(np.moveaxis(w, 1, 0))  # (steps, runs, n)
        moments.runs[here] = N
        moments.mean[here] = mean
        moments.covariance[here] = np.swapaxes(by_step, -1, -2) @ by_step / np.maximum(N - 1, 1)[:, None, None]
    return moments


def identity_statistic(whitened: Array) -> tuple[float, float]:
    """Likelihood ratio that whitened errors (N, n) have covariance I, mean zero: statistic and p value.

    N (tr S - ln det S - n) with S the mean of w w', chi-square with n (n + 1) / 2 degrees of freedom after
    Bartlett's correction (Anderson 2003, sec. 10.8). It tests scale and shape together; :func:`sphericity` tests the
    shape alone.
    """
    w = np.asarray(whitened, float)
    N, n = w.shape
    S = w.T @ w / N
    sign, logdet = np.linalg.slogdet(S)
    if sign <= 0:
        return float("inf"), 0.0
    statistic = N * (float(np.trace(S)) - float(logdet) - n)
    statistic *= 1.0 - (2 * n + 1 - 2 / (n + 1)) / (6 * N)
    return statistic, float(distributions.chi2.sf(statistic, n * (n + 1) / 2))


def sphericity(whitened: Array, known: StepMoments | None = None) -> tuple[Array, Array]:
    """Mauchly's (1940) test of every step: covariance of the whitened errors proportional to I.

    (runs, steps, n) -> statistic and p value, (steps,) each; the mean and the scale may be anything. Box's
    second-order expansion of the null distribution (Anderson 2003, sec. 10.7.4). NaN where fewer than 4 n runs are
    left, or n is 1. ``known`` are the moments, if already computed.
    """
    if known is None:
        known = step_moments(whitened)
    N, _, S = known
    n = whitened.shape[-1]
    statistic = np.full(len(N), np.nan)
    p_value = np.full(len(N), np.nan)
    good = (4 * n <= N) & (np.trace(S, axis1=-2, axis2=-1) > 0)
    if n == 1 or not good.any():
        return statistic, p_value
    m = N[good] - 1.0
    sign, logdet = np.linalg.slogdet(S[good])
    trace = np.trace(S[good], axis1=-2, axis2=-1) / n
    with np.errstate(divide="ignore", invalid="ignore"):
        log_w = np.where(sign > 0, logdet - n * np.log(trace), -np.inf)
    rho = 1.0 - (2 * n * n + n + 2) / (6 * n * m)
    omega = (n + 2) * (n - 1) * (n - 2) * (2 * n**3 + 6 * n**2 + 3 * n + 2) / (288 * n**2 * m**2 * rho**2)
    f = n * (n + 1) / 2 - 1
    statistic[good] = value = -m * rho * log_w
    tail = distributions.chi2.sf(value, f)
    p_value[good] = np.clip(tail + omega * (distributions.chi2.sf(value, f + 4) - tail), 0.0, 1.0)
    return statistic, p_value


def mean_shape(whitened: Array) -> tuple[Array, float]:
    """Mean of w w' over whole trajectories, scaled to trace n, and the p value of its being diagonal.

    (runs, steps, n) -> (n, n), p. Each run is one observation of the mean products of different components,
    n (n - 1) / 2 numbers with mean zero under any scale of each component; :func:`products_test`. (Scales
    that differ are seen by the test of each axis.) Where runs have unlike numbers of steps, p is at least that of the
    sums of these products, see :class:`RunMeans`. p is NaN where there are fewer than 6 (n - 1) runs: with
    fewer, only gross faults would be found.
    """
    present = all_finite(whitened)
    n = whitened.shape[-1]
    count = present.sum(axis=1)
    count = count[count > 0]
    sums = by_runs(second_moments, whitened, present)[present.any(axis=1)]
    M = sums / count[:, None, None]
    mean = M.mean(axis=0) if len(M) else np.full((n, n), np.nan)
    trace = float(np.trace(mean))
    scaled = mean * n / trace if trace > 0 else mean
    if n == 1 or len(M) < 6 * (n - 1) or not trace > 0:
        return scaled, float("nan")
    i, j = np.triu_indices(n, 1)
    p_value = products_test(M[:, i, j])
    if are_unlike(count):
        p_value = max(p_value, products_test(sums[:, i, j]))
    return scaled, p_value


def products_test(products: Array) -> float:
    """p value of the mean of run means of products (runs, numbers) being zero.

    Products of Gaussian errors have heavy tails. Hotelling's T-squared is robust to them with up to three numbers. With
    more numbers it is not, because of its inverse of a sample covariance: with 15 numbers and 50 runs it errs at 2.5
    times a rate of 1/400. Then two tests at half the rate each find a fault in a few numbers and one in many:

    - the largest Student's t, Bonferroni over the numbers. Given one factor a product is Gaussian, with a variance of
      its own for each run. For such products t errs at most as often as for equal variances (Bakirov & Szekely 2006,
      Theorem 1), however the steps of a run depend on each other;
    - the sum of the squares of the normal scores of these t, against sum l_j chi-square(1), with l the eigenvalues of
      the correlations between the numbers over the runs. Chance makes these eigenvalues differ more than they do,
      which errs on the safe side.

    NaN where a number is 0 in all runs, as with a component that has no error.
    """
    runs, size = products.shape
    if size <= ALL_AT_ONCE:
        return float(t_squared(products[:, None])[1][0])
    gap = products - products.mean(axis=0)
    length = np.sqrt(np.square(gap).sum(axis=0))
    if not length.all():
        return float("nan")
    t = products.mean(axis=0) * np.sqrt(runs * (runs - 1)) / length
    tail = special.stdtr(runs - 1, -np.abs(t))
    u = gap / length
    weights = np.linalg.eigvalsh(u @ u.T if runs < size else u.T @ u)
    scores = float(np.square(special.ndtri(tail)).sum())
    return float(min(1.0, 2.0 * min(2.0 * size * float(tail.min()), weighted_chi_square_tail(scores, weights))))


def pair_p_values(error: Array, covariance: Array, counted: Array) -> Array:
    """p value of each pair of axes being correlated as stated, whatever the factors on the variances of the axes.

    In each step the errors of an axis are taken about their mean over the runs and divided by their own standard
    deviation, so that a factor on an axis, which may change from step to step, drops out. Two axes u, v with the stated
    correlation r are whitened together,

        p + q = (u + v) / sqrt(1 + r),    p - q = (u - v) / sqrt(1 - r),

    so that p and q are not correlated if r is right. The mean of p q depends on the size of u and v in second order
    only; over N runs that leaves -r / (2 (N - 1)), which is added. In a single step the correlation of p and q is
    tested, with Student's t of N - 2 degrees of freedom. Over several steps a run is one observation of the mean of
    p q: Student's t over the runs, as in :func:`products_test`.

    Parameters
    ----------
    error, covariance : (runs, steps, n), (runs, steps, n, n)
    counted : (runs, steps) of bool; steps with fewer than 6 runs are left out

    Returns
    -------
    (n, n), NaN on the diagonal and where nothing can be tested
    """
    runs, steps, n = error.shape
    p_values, above = np.full((n, n), np.nan), np.triu_indices(n, 1)
    pairs = list(zip(*above, strict=True))
    products, size = np.zeros((runs, len(pairs))), np.zeros(len(pairs))
    count = np.zeros(runs)
    for here in block_slices(steps, runs):
        N = counted[:, here].sum(axis=0)
        known = counted[:, here] & (N >= FEWEST)
        P = covariance[:, here]
        u = _in_own_spread(standardise(error[:, here], P), known)
        count += known.sum(axis=1)
        for k, (i, j) in enumerate(pairs):
            with np.errstate(invalid="ignore", divide="ignore"):
                r = P[..., i, j] / np.sqrt(P[..., i, i] * P[..., j, j])
                total = (u[..., i] + u[..., j]) / np.sqrt(1.0 + r)
                gap = (u[..., i] - u[..., j]) / np.sqrt(1.0 - r)
            p, q = 0.5 * (total + gap), 0.5 * (total - gap)
            size[k] = np.sqrt(np.square(p[known]).sum() * np.square(q[known]).sum())
            product = p * q + r / (2.0 * np.maximum(N - 1, 1))
            products[:, k] += np.where(known, product, 0.0).sum(axis=1)
    products, count = products[count > 0], count[count > 0]
    N = len(products)
    if N < FEWEST:
        return p_values
    with np.errstate(invalid="ignore", divide="ignore"):
        if steps == 1:
            r = products.sum(axis=0) / size
            t, freedom = r * np.sqrt((N - 2) / (1.0 - r * r)), N - 2
        else:
            products /= count[:, None]
            t, freedom = products.mean(axis=0) * np.sqrt(N) / products.std(axis=0, ddof=1), N - 1
    p_values[above] = p_values.T[above] = 2.0 * special.stdtr(freedom, -np.abs(t))
    return p_values


def _in_own_spread(errors: Array, known: Array) -> Array:
    """Errors (runs, steps, n) less their mean over the ``known`` runs of each step, over their standard deviation."""
    N = np.maximum(known.sum(axis=0), 2)[:, None]
    e = np.where(known[..., None], errors, 0.0)
    e = np.where(known[..., None], e - e.sum(axis=0) / N, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(e / np.sqrt(np.square(e).sum(axis=0) / (N - 1)))


def second_moments(whitened: Array, present: Array) -> Array:
    """Sum of w w' over the steps of each run, (runs, steps, n) -> (runs, n, n)."""
    w = np.where(present[..., None], whitened, 0.0)
    return np.asarray(np.swapaxes(w, -1, -2) @ w)


@dataclass(frozen=True)
class Largest:
    """The direction in which errors are largest against the stated covariance."""

    ratio: Interval  # of true to stated variance in directions that the judged runs had no part in choosing
    direction: Array  # (n,), unit vector of whitened errors, from all runs
    p_value: float


def largest_direction(whitened: Array) -> Largest:
    """Test that no direction has errors larger than stated: largest eigenvalue of the mean of w w' at most 1.

    A covariance is conservative if P >= E e e' in every direction (Forsling, Julier & Hendeby 2025), so that the
    largest eigenvalue of the whitened second moment is at most 1; the trace, which is the mean NEES, cannot tell.
    The leading eigenvector of one half of the runs (every other run) is the direction in which the other half is
    judged, and vice versa. Runs are independent, so the errors of each half are independent of its direction, and the
    test of a single component holds (:class:`RunMeans`). Both halves count (Bonferroni).

    Parameters
    ----------
    whitened : (runs, steps, n), NaN where a run has no value. p is NaN with fewer than 2 runs or n = 1.
    """
    present = all_finite(whitened)
    n = whitened.shape[-1]
    some = present.any(axis=1)
    if some.sum() < 2 or n == 1:
        return Largest(UNKNOWN, np.full(n, np.nan), float("nan"))
    count = present.sum(axis=1)
    moments = by_runs(second_moments, whitened, present)[some] / count[some, None, None]
    halves = [np.arange(len(moments)) % 2 == k for k in (0, 1)]
    along = np.empty(len(moments))
    count = count[some]
    p_values = []
    for chosen, judged in (halves, halves[::-1]):
        u = _leading(moments[chosen])
        along[judged] = np.einsum("i,rij,j->r", u, moments[judged], u)
        p_values.append(RunMeans(along[judged], count[judged], 1).find().above)
    return Largest(ratio_interval(along), _leading(moments), min(1.0, 2.0 * min(p_values)))


def _leading(moments: Array) -> Array:
    return np.asarray(np.linalg.eigh(moments.mean(axis=0))[1][:, -1])


def observed_coverage(record: Record, p: Array) -> dict[str, Array]:
    """Share of errors inside the interval that should hold them with probability ``p`` (N,), by component and jointly.

    Of all steps of all runs, and of ``MOST_AXES`` components at most; -> (N,) each.
    """
    found: dict[str, Array] = {}
    if record.errors.error is not None and record.errors.covariance is not None:
        sigma = np.sqrt(np.diagonal(record.errors.covariance, axis1=-2, axis2=-1))
        with np.errstate(invalid="ignore", divide="ignore"):
            z = np.abs(record.errors.error) / sigma
        for i, name in enumerate(record.errors.names[:MOST_AXES]):
            found[name] = _shares(z[..., i], np.sqrt(2.0) * special.erfinv(p))
    if record.errors.nees is not None and record.errors.dof and not record.errors.parts:
        found["all together"] = _shares(record.errors.nees, distributions.chi2.ppf(p, record.errors.dof))
    return {name: shares for name, shares in found.items() if np.isfinite(shares).any()}


def _shares(values: Array, limits: Array) -> Array:
    known = np.sort(values[np.isfinite(values)])
    if not len(known):
        return np.full(len(limits), np.nan)
    return np.searchsorted(known, limits, side="right") / len(known)
