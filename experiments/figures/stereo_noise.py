"""How a stereo observation is distributed after eq. 21, Herath et al. (2007) fig. 12."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from scipy import stats

from consistency.bench.pages.sections.published_findings import extra_table
from consistency.bench.pages.sections.report_input import Report
from consistency.bench.scenario.models import project, triangulate_jacobian
from consistency.bench.types import Gaussian
from consistency.referee.show.blocks import Figure, Look, style
from consistency.referee.show.figures import add_legend, canvas, path, points, stroke
from consistency.referee.types import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

CHAPTER = ("distributions", "What eq. 21 does to Gaussian pixels (fig. 12)", "Stereo noise")
ON_PAPER = True  # of a report of several studies
FILE = "fig12.parquet"
POINT, FOCAL = (10.0, 1.0), 150.0  # m, px: Herath et al. (2007) sec. 4.5
SIGMA_U, SIGMA_D = 1.34, 0.65  # px, ibid.
COLUMNS = ["baseline", "x", "y", "u", "d"]
DRAWN, BINS = 1000, 60
SAMPLES, DOTS = Look("#c4c4c4"), Look("#555555", size=1.0, alpha=0.6)
LINEAR, FITTED = replace(style(0), width=1.4), replace(style(1), width=1.4)


@dataclass(frozen=True)
class Distribution:
    """Eq. 21 applied to Gaussian (u, d) for one baseline, as Herath et al. (2007) fig. 12."""

    baseline: float  # m
    samples: Array  # (n, 2), m
    linear: Gaussian  # J diag(sigma^2) J' at the true point
    fitted: Gaussian  # moments of the samples

    @property
    def window(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Drawn range of x and y, m."""
        return _range(self.samples[:, 0], self.linear, 0), _range(self.samples[:, 1], self.linear, 1)

    @property
    def inside(self) -> Array:
        """Which samples (n,) lie within the drawn range."""
        low, high = np.transpose(self.window)
        return np.asarray(((low <= self.samples) & (self.samples <= high)).all(axis=1))

    @property
    def drawn(self) -> Array:
        """The first samples, without those beyond the drawn range, (N, 2)."""
        return np.asarray(self.samples[:DRAWN][self.inside[:DRAWN]])


def read(report: Report) -> tuple[Distribution, ...]:
    """One record a baseline; none where the file does not exist.

    Raises
    ------
    InputError
        The file is damaged or lacks a column.
    """
    table = extra_table(report.folder / FILE, COLUMNS)
    if table is None:
        return ()
    parts = (part for _, part in table.groupby("baseline", sort=True))
    return tuple(_distribution(float(part["baseline"].iloc[0]), part) for part in parts)


def _distribution(baseline: float, table: pd.DataFrame) -> Distribution:
    samples = table[["x", "y"]].to_numpy(float)
    linear = Gaussian(np.array(POINT), _linear_covariance(baseline))
    return Distribution(baseline, samples, linear, Gaussian(samples.mean(axis=0), np.cov(samples.T)))


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


def ellipse(gaussian: Gaussian) -> Array:
    """Points (73, 2) at two standard deviations."""
    angle = np.linspace(0.0, 2 * np.pi, 73)
    values, vectors = np.linalg.eigh(gaussian.covariance)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(gaussian.mean + 2.0 * (circle * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def blocks(report: Report) -> tuple[Figure, ...]:
    """For each baseline samples with two ellipses, and the histogram of x with two densities."""
    return tuple(Figure(f"Baseline {d.baseline:g} m", noise_caption(d), (partial(_draw, d),)) for d in read(report))


def _draw(d: Distribution) -> Drawing:
    figure, (cloud, histogram) = canvas(2.0, 2, 2)
    points(cloud, d.drawn[:, 0], d.drawn[:, 1], DOTS, limit=DRAWN)
    of_x, of_y = d.window
    cloud.set(xlabel="x (m)", ylabel="y (m)", xlim=of_x, ylim=of_y)
    count, edges = np.histogram(d.samples[:, 0], BINS, of_x)
    density = count / (len(d.samples) * np.diff(edges))
    histogram.stairs(density, edges, fill=True, color=SAMPLES.colour, label="samples")
    x = np.linspace(*of_x, 201)
    for gaussian, look, label in (
        (d.linear, LINEAR, "linearised Gaussian"),
        (d.fitted, FITTED, "Gaussian with the samples' moments"),
    ):
        path(cloud, ellipse(gaussian), look)
        sd = np.sqrt(gaussian.covariance[0, 0])
        histogram.plot(x, stats.norm.pdf(x, gaussian.mean[0], sd), label=label, **stroke(look))
    histogram.set(xlabel="x (m)", ylabel="density (1/m)", xlim=of_x)
    return add_legend(figure)


def noise_caption(d: Distribution) -> str:
    """What one panel pair of fig. 12 shows, with its numbers."""
    linear, fitted = (float(np.sqrt(g.covariance[0, 0])) for g in (d.linear, d.fitted))
    outside = 1.0 - d.inside.mean()
    beyond = f" {100 * outside:.1f} % of the samples lie beyond the axes." if outside >= 0.0005 else ""
    return (
        f"{len(d.samples)} samples of eq. 21 within the search range, for a point at "
        f"x = 10 m, y = 1 m ({len(d.drawn)} drawn). Standard deviation of x: {linear:.2f} m linearised, {fitted:.2f} m "
        f"from the samples' moments; mean {d.fitted.mean[0]:.2f} m.{beyond} Ellipses at 2 sigma."
    )
