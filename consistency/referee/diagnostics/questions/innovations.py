"""Tests that innovations are white and have the stated covariance, as those of a right filter."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from scipy import special

from consistency.referee.diagnostics.records.large_arrays import by_runs
from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.records.whitening import all_finite, whiten
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.diagnostics.verdict.parts import NisTest, Outliers
from consistency.referee.types import Array

LAGS = 10
IMPOSSIBLE, UNLIKELY = 1e-9, 1e-3  # probability that any innovation of a right filter is as large
FEW = 0.05  # share of innovations that may be called outliers
FEWEST_INNOVATIONS = 400  # innovations; below, the chi-square of the portmanteau is not to be trusted
FEWEST_EACH = 40  # innovations for each component, measured with up to 40 components


def nis_of(innovations: Array, covariances: Array) -> tuple[Array, Array]:
    """NIS and its degrees of freedom, (runs, steps, m), (runs, steps, m, m) -> (runs, steps), (runs, steps).

    NaN and 0 where there is no innovation.
    """
    u = whiten(innovations, covariances)
    return np.square(u).sum(axis=-1), np.where(np.isfinite(u[..., 0]), u.shape[-1], 0)


def nis_and_dof(record: Record) -> tuple[Array, Array] | None:
    """NIS of a record and its degrees of freedom, (runs, steps) each; None without any."""
    if record.nis is not None and record.nis_dof is not None:
        return record.nis, record.nis_dof
    if record.innovations is not None and record.innovation_covariances is not None:
        return nis_of(record.innovations, record.innovation_covariances)
    return None


def nis_test(nis: Array, dof: Array) -> NisTest:
    """Chi-square test of the total NIS, Bar-Shalom, Li & Kirubarajan (2001) sec. 5.4.

    Innovations of a right filter are independent over steps too, so all runs and steps add up, whatever
    number of degrees of freedom each step has. Shapes (runs, steps); NaN does not count.
    """
    counted = np.isfinite(nis) & (dof > 0)
    k = int(dof[counted].sum())
    total = float(nis[counted].sum())
    if k == 0:
        return NisTest(float("nan"), 0, float("nan"), float("nan"))
    return NisTest(total / k, k, float(distributions.chi2.sf(total, k)), float(distributions.chi2.cdf(total, k)))


def outliers_of(nis: Array, dof: Array) -> Outliers | None:
    """Outliers among innovations, (runs, steps); None where no NIS is impossible, or too many are.

    A right filter has any with probability ``IMPOSSIBLE`` at most, so that they may be looked for beside any question.
    """
    rows, columns = np.nonzero(np.isfinite(nis) & (dof > 0))
    values = nis[rows, columns]
    n = dof[rows, columns]
    if not len(values):
        return None
    p = np.minimum(1.0, distributions.chi2.sf(values, n) * len(values))
    far = p < UNLIKELY
    count = int(far.sum())
    worst = int(np.lexsort((-values / n, p))[0])
    if p[worst] >= IMPOSSIBLE or count > max(1.0, FEW * len(values)) or count == len(values):
        return None
    rest = nis_test(values[~far], n[~far])
    run = int(rows[worst])
    step = int(columns[worst])
    return Outliers(count, len(values), run, step, float(values[worst]), int(n[worst]), float(p[worst]), rest)


@dataclass(frozen=True)
class Whiteness:
    """Autocorrelation over steps, and the test that it is zero."""

    correlation: Array  # (lags,), of lag 1, 2, ...; mean over components
    bound: float  # that 95 % of each stay within, if white
    statistic: float  # portmanteau
    dof: int
    p_value: float


def whiteness(innovations: Array, covariances: Array, lags: int = LAGS) -> Whiteness:
    """Portmanteau test that innovations are independent over steps, from their autocorrelation matrices.

    With u the innovations in units of their stated covariance and C_l the mean of u_k u_{k+l}' over the M
    pairs of all runs, sum M ``|C_l|^2`` / s^4 is chi-square with lags m^2 degrees of freedom (Box & Pierce 1970;
    Hosking 1980 for vectors), s^2 the mean square of u: a wrong scale alone does not fire it.

    Parameters
    ----------
    innovations, covariances : (runs, steps, m), (runs, steps, m, m); NaN where there is none
    """
    return _portmanteau(whiten(innovations, covariances), lags)


def nis_whiteness(nis: Array, dof: Array, lags: int = LAGS) -> Whiteness:
    """Whiteness of the NIS alone, where no innovations are kept, shapes (runs, steps).

    The cube root of the NIS is nearly Gaussian (Wilson & Hilferty 1931). It is standardised by its exact mean and
    standard deviation, because autocorrelations are about a mean of 0; the mean of Wilson and Hilferty is 5 % of a
    standard deviation off with one degree of freedom, which over many steps looks like correlation. The remaining mean
    is removed, so that white innovations that are not Gaussian do not count as correlated.

    Correlated innovations show in their squares, with the correlation squared.
    """
    counted = np.isfinite(nis) & (dof > 0)
    if not counted.any():
        return _portmanteau(np.full((*np.shape(nis), 1), np.nan), lags)
    overall = float(nis[counted].sum() / dof[counted].sum())
    standard = functools.partial(_cube_root, overall, *cube_root_moments(np.arange(int(dof[counted].max()) + 1)))
    u = by_runs(standard, nis, dof)
    u -= np.nanmean(u) if overall > 0 else np.nan
    return _portmanteau(u[..., None], lags)


def cube_root_moments(dof: Array) -> tuple[Array, Array]:
    """Mean and standard deviation of the cube root of chi-square(dof) / dof, (...) each; NaN where ``dof`` is 0.

    E (chi-square(n) / n)^r = (2 / n)^r Gamma(n / 2 + r) / Gamma(n / 2), with r = 1/3 and 2/3.
    """
    half = np.where(dof > 0, 0.5 * dof, np.nan)
    mean, square = (half**-r * special.poch(half, r) for r in (1 / 3, 2 / 3))
    return mean, np.sqrt(square - mean**2)


def _cube_root(overall: float, mean: Array, deviation: Array, nis: Array, dof: Array) -> Array:
    """Cube root of NIS / ``overall`` (runs, steps), standardised by the moments (dof + 1,) of each dof."""
    counted = np.isfinite(nis) & (dof > 0)
    n = np.where(counted, dof, 0).astype(int)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray((np.cbrt(nis / (n * overall)) - mean[n]) / deviation[n])


def _portmanteau(u: Array, lags: int) -> Whiteness:
    _, steps, m = u.shape
    lags = min(lags, max(steps // 4, 1), max(steps - 1, 0))
    present = all_finite(u)
    unknown = Whiteness(np.full(0, np.nan), float("nan"), float("nan"), 0, float("nan"))
    if lags == 0 or present.sum() < max(FEWEST_INNOVATIONS, FEWEST_EACH * m):
        return unknown
    u = np.where(present[..., None], u, 0.0)
    power = float(np.square(u).sum() / (present.sum() * m))
    statistic = 0.0
    correlation = np.zeros(lags)
    pairs = 0
    for lag in range(1, lags + 1):
        pairs = int((present[:, lag:] & present[:, :-lag]).sum())
        if pairs == 0 or power == 0:
            return unknown
        C = np.tensordot(u[:, :-lag], u[:, lag:], axes=((0, 1), (0, 1))) / (pairs * power)
        correlation[lag - 1] = np.trace(C) / m
        statistic += pairs * float(np.square(C).sum())
    dof = lags * m * m
    bound = 1.96 / np.sqrt(pairs * m)
    return Whiteness(correlation, float(bound), statistic, dof, float(distributions.chi2.sf(statistic, dof)))


# --- probable mix-ups: another number of components, or residuals after the update ----------------------------


LEAST_GAIN = float(np.log(1e4))  # log likelihood that another number of components gains over a wrong scale
ODD = 1e-3  # probability that a NIS with this number of components is not taken for such
SMALL = 0.7  # NIS over its degrees of freedom: gates and cautious noises leave more
NEES_RIGHT = (0.8, 1.25)  # mean NEES over its degrees of freedom
AFTER_UPDATE = (
    "are the innovations residuals after the update, or is S not that of the prediction? Give z - h(x) of the "
    "predicted x, with S = H P H' + R of the predicted P"
)


def innovation_causes(nis: Array, dof: Array, nees_ratio: float) -> list[str]:
    """Hints on NIS of another number of components, or of residuals after the update; or none.

    Parameters
    ----------
    nis, dof : (runs, steps), NaN where there is no innovation
    nees_ratio : mean NEES over its degrees of freedom; NaN where no errors are known
    """
    counted = np.isfinite(nis) & (dof > 0) & (nis > 0)
    values = nis[counted]
    stated = dof[counted]
    if not len(values):
        return []
    if (stated == stated[0]).all():
        other = _other_dof(values, int(stated[0]))
        if other is not None:
            has = f"the NIS is distributed like chi-square with {other} degrees of freedom"
            return [f"{has}, not {stated[0]:.0f} as stated; give the number of components of the innovations"]
    total = float(values.sum())
    components = float(stated.sum())
    small = total < SMALL * components and distributions.chi2.cdf(total, components) < ODD
    if small and NEES_RIGHT[0] < nees_ratio < NEES_RIGHT[1]:
        return [f"the NEES is about right, and the NIS {components / total:.2g} times too small: {AFTER_UPDATE}"]
    return []


def _other_dof(nis: Array, stated: int) -> int | None:
    """Degrees of freedom of the chi-square law that NIS (N,) follow where a wrong scale of the stated one does not."""
    size = len(nis)
    mean = float(nis.mean())
    log_mean = float(np.log(nis).mean())
    scale = mean / stated
    scaled = _likelihood(stated, mean / scale, log_mean - np.log(scale)) - np.log(scale)
    for dof in {int(mean), int(mean) + 1} - {0, stated}:
        of_mean = (mean - dof) * np.sqrt(size / (2.0 * dof))
        of_log = (log_mean - np.log(2.0) - special.digamma(dof / 2)) * np.sqrt(size / special.polygamma(1, dof / 2))
        follows = max(of_mean**2, of_log**2) <= distributions.chi2.isf(ODD, 1)
        if follows and size * (_likelihood(dof, mean, log_mean) - scaled) >= LEAST_GAIN:
            return dof
    return None


def _likelihood(dof: int, mean: float, log_mean: float) -> float:
    """Mean log density of chi-square at values with a mean and a mean logarithm."""
    half = dof / 2
    return float((half - 1.0) * log_mean - mean / 2 - half * np.log(2.0) - special.gammaln(half))
