"""How a stereo observation is distributed after eq. 21, Herath et al. (2007) fig. 12."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

from consistency.models.stereo import project, triangulate_jacobian
from consistency.reporting.model import Distribution
from consistency.reporting.tables import extra_table
from consistency.types import Array, Gaussian

POINT, FOCAL = (10.0, 1.0), 150.0  # m, px: Herath et al. (2007) sec. 4.5
SIGMA_U, SIGMA_D = 1.34, 0.65  # px, ibid.
COLUMNS = ["baseline", "x", "y", "u", "d"]
DRAWN, BINS = 1500, 60


def distributions(path: Path) -> tuple[Distribution, ...]:
    """One record a baseline from ``fig12.parquet``; none where the file does not exist.

    Raises
    ------
    InputError
        The file is damaged or lacks a column.
    """
    table = extra_table(path, COLUMNS)
    if table is None:
        return ()
    parts = (part for _, part in table.groupby("baseline", sort=True))
    return tuple(_distribution(float(part["baseline"].iloc[0]), part) for part in parts)


def _distribution(baseline: float, table: pd.DataFrame) -> Distribution:
    points = table[["x", "y"]].to_numpy(float)
    linear = Gaussian(np.array(POINT), _linear_covariance(baseline))
    fitted = Gaussian(points.mean(axis=0), np.cov(points.T))
    window = (_range(points[:, 0], linear, 0), _range(points[:, 1], linear, 1))
    inside = np.all([(low <= c) & (c <= high) for c, (low, high) in zip(points.T, window, strict=True)], axis=0)
    edges, grid = np.linspace(*window[0], BINS + 1), np.linspace(*window[0], 201)
    count, _ = np.histogram(points[:, 0], edges)
    return Distribution(
        baseline=baseline,
        samples=len(points),
        points=points[:DRAWN][inside[:DRAWN]],
        window=window,
        outside=float(1.0 - inside.mean()),
        edges=edges,
        density=count / (len(points) * np.diff(edges)),
        grid=grid,
        linear=linear,
        fitted=fitted,
        linear_ellipse=_ellipse(linear),
        fitted_ellipse=_ellipse(fitted),
        linear_density=stats.norm.pdf(grid, linear.mean[0], np.sqrt(linear.covariance[0, 0])),
        fitted_density=stats.norm.pdf(grid, fitted.mean[0], np.sqrt(fitted.covariance[0, 0])),
    )


def _linear_covariance(baseline: float) -> Array:
    """J diag(sigma_u^2, sigma_d^2) J' of (x, y) at the true point."""
    u, v, d = project(*POINT, 0.0, FOCAL, baseline)
    J = np.reshape(triangulate_jacobian(u, v, d, FOCAL, baseline), (3, 3))[:2][:, [0, 2]]
    covariance: Array = J @ np.diag([SIGMA_U**2, SIGMA_D**2]) @ J.T
    return covariance


def _range(values: Array, linear: Gaussian, axis: int) -> tuple[float, float]:
    """All of the linearised Gaussian that is seen, and the samples unless they lie very far out."""
    mean, std = linear.mean[axis], np.sqrt(linear.covariance[axis, axis])
    low, high = np.quantile(values, [0.002, 0.998])
    return (
        float(max(min(mean - 3.2 * std, low), mean - 9 * std)),
        float(min(max(mean + 3.2 * std, high), mean + 9 * std)),
    )


def _ellipse(gaussian: Gaussian) -> Array:
    """Points (73, 2) at two standard deviations."""
    angle = np.linspace(0.0, 2 * np.pi, 73)
    values, vectors = np.linalg.eigh(gaussian.covariance)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(gaussian.mean + 2.0 * (circle * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)
