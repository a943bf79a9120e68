"""Ensembles and repeats as normal numbers: exact for what their few members know of a covariance.

Ranks of the truth among members; mean and covariance of N members; repeats of the same true values, without truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy import special

from consistency.referee.diagnostics.record import Ensemble, RatioTable, Record
from consistency.referee.diagnostics.verdict_parts import BIAS
from consistency.referee.diagnostics.whitening import all_finite, every_entry, squared_length, whiten
from consistency.referee.errors import InputError
from consistency.referee.types import Array

MOST_RANKS = 21  # that are counted apart
SEED = 20261129  # of what is random within a rank
TOGETHER = "all together"  # name of the joint number
RATIOS = np.exp2(np.r_[-10, -7, -5, np.arange(-4.0, 4.01, 0.25), 5, 7, 10, 14])
JOINT_RATIOS = np.exp2(np.r_[-10, -4, -2, -1, -0.5, -0.25, 0, 0.25, 0.5, 0.75, 1, 1.5, 2, 3, 4, 7, 10])
MOST_MEMBERS = 500  # of a table: that of more differs by less than 2 % below a ratio of 4
DRAWS = (400, 4000)  # fewest and most of a table of joint numbers
WORK = 2e7  # multiplications for one ratio of it
RIDGE = 1e-9  # of correlations, so that members that all lie in a plane have distances, too
EQUAL = 1e-9  # relative difference of distances that are rounding
NO_BIAS = "without truth, an error that all repeats share cannot be seen"


# --- members ---------------------------------------------------------------------------------------------


def rank_numbers(members: Array, truth: Array, rng: np.random.Generator) -> Array:
    """Standard normal numbers where the truth and its m members are exchangeable, whatever their distribution.

    The rank of the truth among the members is uniform; the number is random within its rank. With m > n > 1 the rank
    of the distance of the truth from the mean of all m + 1, by their covariance, follows as a last number, of random
    sign: it is far from 0 where the truth lies outside in any direction (Talagrand et al. 1997; Smith & Hansen 2004).

    Parameters
    ----------
    members : (k, m, n), finite
    truth : (k, n)

    Returns
    -------
    (k, n), or (k, n + 1) with the number of all components together
    """
    k, m, n = members.shape
    below = (members < truth[:, None]).sum(axis=1)
    equal = (members == truth[:, None]).sum(axis=1)
    numbers = special.ndtri((below + rng.random((k, n)) * (equal + 1)) / (m + 1))
    if not is_joint(m, n):
        return np.asarray(numbers)
    distance = _distances(np.concatenate([truth[:, None], members], axis=1))
    gap = distance[:, 1:] - distance[:, :1]
    same = np.abs(gap) <= EQUAL * distance[:, :1]
    below = ((gap < 0) & ~same).sum(axis=1)
    u = (below + rng.random(k) * (same.sum(axis=1) + 1)) / (m + 1)
    joint = special.ndtri(0.5 * (1.0 + u)) * rng.choice([-1.0, 1.0], k)
    return np.column_stack([numbers, joint])


def is_joint(m: int, n: int) -> bool:
    """Whether m members of n components have a number of all components together."""
    return m > n > 1


def _distances(points: Array) -> Array:
    """Squared distances of points (k, m, n) from their mean by their own covariance, (k, m)."""
    centred = points - points.mean(axis=1, keepdims=True)
    size = np.sqrt(np.square(centred).mean(axis=1, keepdims=True))
    centred /= np.where(size > 0, size, 1.0)
    inverse = np.linalg.inv(np.swapaxes(centred, 1, 2) @ centred + RIDGE * np.eye(points.shape[-1]))
    return np.asarray(((centred @ inverse) * centred).sum(axis=-1))


@lru_cache(maxsize=16)
def rank_tables(m: int, n: int) -> tuple[RatioTable, ...]:
    """What the numbers of :func:`rank_numbers` show of Gaussian errors, one table for each of them."""
    m = min(m, MOST_MEMBERS)
    z, weight = _nodes()
    edges = special.ndtri(np.arange(m + 2) / (m + 1))
    squares = (m + 1) * np.diff(_partial_square(edges))  # mean square of the number in each rank
    shown = []
    for ratio in RATIOS:
        p = special.ndtr(np.sqrt(ratio) * z)[:, None]
        r = np.arange(m + 1)
        log_choose = special.gammaln(m + 1) - special.gammaln(r + 1) - special.gammaln(m - r + 1)
        chance = np.exp(log_choose + special.xlogy(r, p) + special.xlog1py(m - r, -p))
        shown.append(2.0 * float(weight @ (chance @ squares)))
    tables = (_table(RATIOS, shown),) * n
    if is_joint(m, n):
        tables += (_joint_table(m, n),)
    return tables


def _joint_table(m: int, n: int) -> RatioTable:
    """That of the number of all components together, which does not depend on the covariance, by simulation."""
    rng = np.random.default_rng((SEED, m, n))
    points = rng.standard_normal((int(np.clip(WORK / ((m + 1) * n * n), *DRAWS)), m + 1, n))
    truth = points[:, :1].copy()
    edges = special.ndtri(0.5 * (1.0 + np.arange(m + 2) / (m + 1)))
    squares = 2.0 * (m + 1) * np.diff(_partial_square(edges))
    shown = []
    for ratio in JOINT_RATIOS:
        points[:, :1] = np.sqrt(ratio) * truth
        distance = _distances(points)
        shown.append(float(squares[(distance[:, 1:] < distance[:, :1]).sum(axis=1)].mean()))
    return _table(JOINT_RATIOS, shown)


def _partial_square(z: Array) -> Array:
    """Integral of x^2 times the normal density up to ``z``."""
    finite = np.where(np.isfinite(z), z, 0.0)
    return np.asarray(special.ndtr(z) - finite * np.exp(-0.5 * finite**2) / np.sqrt(2.0 * np.pi))


def _nodes() -> tuple[Array, Array]:
    """Normal numbers below 0, and weights that add to 1/2: an even function has half of its mean there."""
    z = np.linspace(-9.0, 0.0, 121)
    weight = np.exp(-0.5 * z**2)
    weight[-1] /= 2.0
    return z, 0.5 * weight / weight.sum()


def _table(ratios: Array, shown: Sequence[float]) -> RatioTable:
    """A table whose mean squares are 1 at the ratio 1 and increase."""
    values = np.maximum.accumulate(np.maximum(shown, 1e-9))
    values /= values[ratios == 1.0]
    values *= 1.0 + 1e-12 * np.arange(len(values))
    return RatioTable(ratios, values / values[ratios == 1.0])


def of_ranks(record: Record, components: Sequence[int], members: Array, truth: Array) -> Record:
    """The record of numbers of :func:`rank_numbers`, with what they say of the covariance, and what is drawn.

    Parameters
    ----------
    components : of the record, among all numbers
    members : (k, m, n), of all runs and steps
    truth : (k, n)
    """
    m, n = members.shape[1:]
    tables = rank_tables(m, n)
    own = [i for i in components if i < n]
    square = np.square(truth - members.mean(axis=1))[:, own]
    of_components = tuple(tables[i] for i in components)
    ensemble = Ensemble(m, of_components, members.var(axis=1, ddof=1)[:, own], square)
    return replace(record, errors=replace(record.errors, ensemble=ensemble))


# --- mean and covariance of N members --------------------------------------------------------------------


def step_down_numbers(whitened: Array, N: int) -> Array:
    """Standard normal numbers of errors about the mean of N Gaussian members with their sample covariance, n < N.

    Whitened component k = 0, 1, ... given those before it is Student's t with N - 1 - k degrees of freedom once it is
    scaled, and independent of them (Roy & Bargmann 1958).

    Parameters
    ----------
    whitened : (..., n), truth less mean of the members, over the Cholesky factor of their covariance, whose divisor is
        N - 1
    """
    w = whitened / np.sqrt((N - 1) * (1.0 + 1.0 / N))
    dof = N - 1.0 - np.arange(w.shape[-1])
    before = np.cumsum(np.square(w), axis=-1) - np.square(w)
    return _normal_of(w * np.sqrt(dof / (1.0 + before)), dof)


def _normal_of(t: Array, dof: Any) -> Array:
    """The normal number at the quantile of each of Student's, far into its tails."""
    tail = np.maximum(special.stdtr(dof, -np.abs(t)), 1e-300)
    return np.asarray(-np.sign(t) * special.ndtri(tail))


@lru_cache(maxsize=16)
def step_down_tables(N: int, n: int) -> tuple[RatioTable, ...]:
    """What the numbers of :func:`step_down_numbers` show where the truth spreads more than the members, (n,).

    With g the ratio of the covariances of the whole error, t becomes t (g / (1 + (g - 1) B))^1/2, where B, the share
    of those before it, is beta(k / 2, (N - k) / 2).
    """
    z, weight = _nodes()
    tables = []
    for k in range(n):
        dof = N - 1.0 - k
        t = special.stdtrit(dof, special.ndtr(z))[:, None]
        share: Array = np.zeros(1)
        if k:
            share = special.betaincinv(k / 2.0, (N - k) / 2.0, (np.arange(8) + 0.5) / 8)
        shown = []
        for ratio in RATIOS:
            g = (ratio + 1.0 / N) / (1.0 + 1.0 / N)
            squares = np.square(_normal_of(t * np.sqrt(g / (1.0 + (g - 1.0) * share)), dof))
            shown.append(2.0 * float(weight @ squares.mean(axis=1)))
        tables.append(_table(RATIOS, shown))
    return tuple(tables)


def of_ensemble(record: Record, N: int) -> Record:
    """The record of errors about the mean of ``N`` members with their sample covariance, as normal numbers.

    Components without cross terms are mapped one by one.

    Raises
    ------
    InputError
        The record has no errors with covariances.
    """
    if record.errors.error is None or record.errors.covariance is None:
        raise InputError(f"--ensemble {N}: {record.name} needs errors with covariances; NEES alone have lost them")
    n = record.errors.error.shape[-1]
    numbers = np.empty(record.errors.error.shape)
    tables: list[RatioTable | None] = [None] * n
    for part in record.errors.parts or (tuple(range(n)),):
        index = list(part)
        whitened = whiten(record.errors.error[..., index], record.errors.covariance[..., index, :][..., index])
        numbers[..., index] = step_down_numbers(whitened, N)
        for i, table in zip(index, step_down_tables(N, len(index)), strict=True):
            tables[i] = table
    if record.errors.nees is not None:
        numbers[~np.isfinite(record.errors.nees)] = np.nan
    variances = np.diagonal(record.errors.covariance, axis1=2, axis2=3)
    square = np.square(record.errors.error).reshape(-1, n)
    ensemble = Ensemble(N, tuple(filter(None, tables)), variances.reshape(-1, n), square)
    note = (
        f"{record.name}: of {N} members, so that each error is Student's t; below it is the normal number at the same "
        "quantile, and ratios are those of the covariance"
    )
    errors = replace(
        record.errors,
        error=numbers,
        covariance=np.where(all_finite(numbers)[..., None, None], np.eye(n), np.nan),
        nees=squared_length(numbers),
        ensemble=ensemble,
    )
    return replace(record, errors=errors).with_notes(note)


# --- repeats without truth -------------------------------------------------------------------------------


def of_repeats(record: Record) -> Record:
    """The record of N runs of the same true values as N - 1 runs without a truth.

    Each run is compared with the weighted mean of those before it: x_k - m_(k-1) has the covariance P_k + M_(k-1),
    with M that of the mean, and is independent of those before (recursive residuals; Brown, Durbin & Evans 1975). These
    are the (N - 1) n numbers that are left of whitened runs when their common value is projected out, and exact
    whatever the covariances are. An error that all runs share is lost with that value.

    Parameters
    ----------
    record : errors from any one value in each step, (N, steps, n), as from the estimates of a run

    Raises
    ------
    InputError
        The record has no errors with covariances, or fewer than two runs.
    """
    if record.errors.error is None or record.errors.covariance is None or len(record.errors.error) < 2:
        raise InputError(f"--truth repeats: {record.name} needs estimates of 2 runs or more, with covariances")
    error = np.full(record.errors.error[1:].shape, np.nan)
    covariance = np.full(record.errors.covariance[1:].shape, np.nan)
    counted = all_finite(record.errors.error) & every_entry(np.isfinite, record.errors.covariance)
    if record.errors.nees is not None:  # a covariance that is singular, or not positive definite, is of no use
        counted &= np.isfinite(record.errors.nees)
    mean = np.where(counted[0, :, None], record.errors.error[0], 0.0)
    M = record.errors.covariance[0].copy()
    begun = counted[0].copy()
    for k in range(1, len(record.errors.error)):
        e = record.errors.error[k]
        P = record.errors.covariance[k]
        both = np.flatnonzero(counted[k] & begun)
        error[k - 1, both] = e[both] - mean[both]
        S = covariance[k - 1, both] = P[both] + M[both]
        gain = np.swapaxes(np.linalg.solve(S, M[both]), 1, 2)
        mean[both] += (gain @ error[k - 1, both, :, None])[..., 0]
        M[both] -= gain @ M[both]
        M[both] = 0.5 * (M[both] + np.swapaxes(M[both], 1, 2))
        first = np.flatnonzero(counted[k] & ~begun)
        mean[first] = e[first]
        M[first] = P[first]
        begun |= counted[k]
    if not np.isfinite(error).any():
        raise InputError(f"--truth repeats: {record.name} has no step that two runs or more share")
    rest = record.of_runs(slice(1, None)).with_errors(error, covariance, squared_length(whiten(error, covariance)))
    return replace(
        rest,
        failures=record.failures,
        fit=replace(record.fit, unavailable=(*record.fit.unavailable, *BIAS), caption=NO_BIAS),
        origin=replace(rest.origin, path=None),
    ).with_notes(f"{record.name}: each run is compared with the mean of those before it")


def rank_shares(record: Record) -> tuple[dict[str, Array], float]:
    """Shares of truths in each rank among the members, by component, (k,), and by how much all lie near 1 / k.

    The half-width of the band holds in all ranks with 95 %, by the spread between runs, which are independent.
    """
    if record.errors.ensemble is None or record.errors.error is None:
        return {}, float("nan")
    ranks = min(record.errors.ensemble.members + 1, MOST_RANKS)
    names = list(record.errors.names or range(record.errors.error.shape[-1]))[: record.errors.ensemble.spread.shape[1]]
    shares = {}
    widths = []
    for i, name in enumerate(names):
        place = np.floor(special.ndtr(record.errors.error[..., i]) * ranks).clip(max=ranks - 1)
        inside = place[..., None] == np.arange(ranks)
        counts, size = inside.sum(axis=1), np.isfinite(place).sum()
        shares[str(name)] = counts.sum(axis=0) / max(size, 1)
        apart = counts - np.isfinite(place).sum(axis=1)[:, None] / ranks
        widths.append(np.sqrt(np.square(apart).sum(axis=0).mean()) / max(size, 1))
    return shares, float(-special.ndtri(0.025 / ranks) * np.mean(widths))
