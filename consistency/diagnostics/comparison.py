"""Is one filter less consistent than another? Run by run on the same trials, or against a stored baseline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from consistency.diagnostics.scale import run_means
from consistency.types import Array, Indices

FEWEST = 8  # runs; below, a standard error is worth nothing


@dataclass(frozen=True)
class RunSummary:
    """What a comparison needs of a filter: one row a run. NaN where a run has no value."""

    runs: Indices  # (R,), run numbers
    dof: int
    nees: Array  # (R,), mean NEES over dof
    squared: Array  # (R, n) or (R, 0), mean squared error of each axis
    covered: Array  # (R, n) or (R, 0), share of steps within 2 sigma


@dataclass(frozen=True)
class Difference:
    """One quantity of two filters, and how sure the difference is."""

    name: str
    a: float
    b: float
    difference: float  # a against b: a ratio for ANEES and RMSE, a difference for coverage
    low: float
    high: float


@dataclass(frozen=True)
class Comparison:
    """``a`` against ``b``; worse means farther from consistent, in either direction."""

    runs: int
    paired: bool
    differences: tuple[Difference, ...]
    distance: float  # abs(log ratio_a) - abs(log ratio_b); above 0 a is farther from consistent
    standard_error: float
    p_value: float  # one-sided, that a is not worse
    false_alarm: float

    @property
    def worse(self) -> bool:
        """a is less consistent than b at the stated false-alarm rate."""
        return self.p_value <= self.false_alarm

    def needed_runs(self, detect: float = 1.5, power: float = 0.95) -> int:
        """Runs with which a covariance ratio farther from 1 by ``detect`` would be found with ``power``."""
        if self.standard_error == 0.0:
            return self.runs
        z = float(stats.norm.isf(self.false_alarm) + stats.norm.ppf(power))
        return max(FEWEST, int(np.ceil(self.runs * (z * self.standard_error / np.log(max(detect, 1 / detect))) ** 2)))


def summary(
    nees: Array, dof: int, error: Array | None = None, covariance: Array | None = None, runs: Indices | None = None
) -> RunSummary:
    """One row for each run, from NEES (runs, steps) and, where known, error and covariance."""
    means, _ = run_means(nees)
    counted = np.isfinite(nees)
    squared = covered = np.empty((len(nees), 0))
    if error is not None and covariance is not None:
        sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
        inside = np.abs(np.where(counted[..., None], error, 0.0)) <= 2.0 * np.where(counted[..., None], sigma, 0.0)
        count = counted.sum(axis=1)[:, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            squared = np.where(counted[..., None], np.square(error), 0.0).sum(axis=1) / count
            covered = np.where(counted[..., None], inside, False).sum(axis=1) / count
    numbers = np.arange(len(nees)) if runs is None else runs
    return RunSummary(numbers, dof, means / dof, squared, covered)


def compare(
    a: RunSummary,
    b: RunSummary,
    false_alarm: float = 0.05,
    axes: tuple[str, ...] | None = None,
    paired: bool | None = None,
    confidence: float = 0.95,
) -> Comparison:
    """Paired intervals of the ratio of ANEES and RMSE and the difference of coverage, and a verdict on 'worse'.

    Runs are the unit. The same run numbers are the same trials (common random numbers) and are compared run by
    run; ``paired=False`` treats the runs as independent samples (Welch 1947). Ratios are studentised on
    the log scale with the jackknife's first-order influence of each run (Efron & Stein 1981) and Student's t.
    'Worse' compares abs(log(ANEES / dof)): too small and too large a covariance count alike.

    Parameters
    ----------
    axes : names of the components
    paired : default: wherever both have at least 8 runs in common

    Raises
    ------
    ValueError
        Different dimensions, too few runs, or ``paired`` without common runs.
    """
    if a.dof != b.dof:
        raise ValueError(f"the errors have {a.dof} and {b.dof} dimensions; compare filters of the same state")
    common = np.intersect1d(a.runs[np.isfinite(a.nees)], b.runs[np.isfinite(b.nees)])
    paired = len(common) >= FEWEST if paired is None else paired
    if paired:
        a, b = (_rows(x, np.isin(x.runs, common)) for x in (a, b))
    else:
        a, b = (_rows(x, np.isfinite(x.nees)) for x in (a, b))
    fewest = min(len(a.runs), len(b.runs))
    if fewest < FEWEST:
        raise ValueError(f"a comparison needs at least {FEWEST} runs{' in common' if paired else ''}, got {fewest}")
    differences = [_ratio("ANEES", a.nees * a.dof, b.nees * b.dof, 1.0, paired, confidence)]
    n = min(a.squared.shape[1], b.squared.shape[1])
    names = axes if axes is not None and len(axes) == n else tuple(f"axis {i}" for i in range(n))
    for i, axis in enumerate(names):
        differences.append(_ratio(f"RMSE {axis}", a.squared[:, i], b.squared[:, i], 0.5, paired, confidence))
    for i, axis in enumerate(names):
        differences.append(_share(f"2-sigma coverage {axis}", a.covered[:, i], b.covered[:, i], paired, confidence))
    distance, error, freedom = _distance(a.nees, b.nees, paired)
    p_value = float(stats.t.sf(distance / error, freedom)) if error > 0 else float(distance <= 0)
    return Comparison(fewest, paired, tuple(differences), distance, error, p_value, false_alarm)


def _rows(x: RunSummary, chosen: Array) -> RunSummary:
    order = np.argsort(x.runs[chosen])
    return RunSummary(
        x.runs[chosen][order], x.dof, x.nees[chosen][order], x.squared[chosen][order], x.covered[chosen][order]
    )


def _distance(a: Array, b: Array, paired: bool) -> tuple[float, float, float]:
    log_a, log_b = np.log(a.mean()), np.log(b.mean())
    sides = [1.0 if value >= 0 else -1.0 for value in (log_a, log_b)]
    error, freedom = _error(sides[0] * a / a.mean(), sides[1] * b / b.mean(), paired)
    return float(abs(log_a) - abs(log_b)), error, freedom


def _ratio(name: str, a: Array, b: Array, power: float, paired: bool, confidence: float) -> Difference:
    """(mean a / mean b) ** power; power 1/2 makes an RMSE of squares."""
    mean_a, mean_b = float(a.mean()), float(b.mean())
    if not (mean_a > 0 and mean_b > 0):
        return Difference(name, mean_a**power, mean_b**power, float("nan"), float("nan"), float("nan"))
    error, freedom = _error(power * a / mean_a, power * b / mean_b, paired)
    log, half = power * np.log(mean_a / mean_b), _half(error, freedom, confidence)
    low, ratio, high = (float(np.exp(x)) for x in (log - half, log, log + half))
    return Difference(name, mean_a**power, mean_b**power, ratio, low, high)


def _share(name: str, a: Array, b: Array, paired: bool, confidence: float) -> Difference:
    error, freedom = _error(a, b, paired)
    gap, half = float(a.mean() - b.mean()), _half(error, freedom, confidence)
    return Difference(name, float(a.mean()), float(b.mean()), gap, gap - half, gap + half)


def _error(a: Array, b: Array, paired: bool) -> tuple[float, float]:
    """Standard error of mean a minus mean b, and its degrees of freedom."""
    if paired:
        return float((a - b).std(ddof=1) / np.sqrt(len(a))), float(len(a) - 1)
    of_a, of_b = a.var(ddof=1) / len(a), b.var(ddof=1) / len(b)
    if of_a + of_b == 0:
        return 0.0, 1.0
    freedom = (of_a + of_b) ** 2 / (of_a**2 / (len(a) - 1) + of_b**2 / (len(b) - 1))
    return float(np.sqrt(of_a + of_b)), float(freedom)


def _half(error: float, freedom: float, confidence: float) -> float:
    return float(stats.t.isf(0.5 * (1.0 - confidence), freedom)) * error
