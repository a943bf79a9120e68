"""Is a stereo point Gaussian at 10 m, with a baseline of 9 cm and of 50 cm?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import stats

import consistency as cs
from consistency.bench.runs.reproduce_findings import script
from consistency.bench.scenario.models import project, triangulate, triangulate_jacobian
from consistency.diagnostics import Normality, normality
from consistency.referee.types import Array

FINDINGS = ("fig12a", "fig12b", "fig12a-xy", "fig12b-xy")

F, X, Y = 150.0, 10.0, 1.0  # px, m, m: Herath 2007 sec. 4.5
SIGMA_U, SIGMA_D = 1.34, 0.65  # px
SEARCH = (1.0, 32.0)  # px, the stereo matcher's disparities, sec. 3.4
SAMPLES = 20_000
BATCH = 100  # a test of all samples finds any skewness: batches of a fixed size measure how large it is
LEVEL = 0.05  # of the test of a batch
REJECTED = 0.9  # share of batches
OVERLAP = 0.9  # a tenth of the area is what a reader sees in a printed figure

ACCEPT_A = (
    f"normality of x is rejected (D'Agostino-Pearson, {LEVEL:.0%}) in at least {REJECTED:.0%} of batches of {BATCH} "
    f"samples ({LEVEL:.0%} for Gaussian ones): 'clearly' is what a small sample shows"
)
ACCEPT_B = (
    f"the linearised Gaussian and the one with the samples' moments share at least {OVERLAP:.0%} of their area: "
    "'overlapping'. The share of rejecting batches is reported beside it"
)


def main(study: cs.Study) -> list[cs.Finding]:
    """Moments and normality of eq. 21 applied to Gaussian (u, d), fig. 12a and 12b: of x alone, and of (x, y)."""
    rows, text, overlaps, rejecting, planes = [], [], [], [], []
    for index, baseline in enumerate((0.09, 0.5)):
        sample = transformed(baseline, np.random.default_rng([study.seed, index]))
        found = sample[sample["d"].between(*SEARCH)]
        rows.append(found.assign(baseline=baseline))
        moments = normality(found["x"].to_numpy())
        rejecting.append(rejected(sample["x"].to_numpy()))
        overlaps.append(overlap((X, linear_std(baseline)), (moments.mean, moments.std)))
        planes.append(plane(sample, found, baseline))
        text.append(described(moments, linear_std(baseline), overlaps[-1], rejecting[-1], len(found) / len(sample)))
    study.tables["fig12"] = pd.concat(rows, ignore_index=True)[["baseline", "x", "y", "u", "d"]]
    common = {
        "scenario": "none",
        "statistic": "normality of x = B f / d in batches of 100; its moments for disparities within the search range",
    }
    return [
        study.finding(
            rejecting[0] >= REJECTED,
            id="fig12a",
            source="Herath 2007, fig. 12a and sec. 4.5",
            claim="with a 9 cm baseline the transformed observation is clearly not Gaussian",
            published="not Gaussian",
            measured=text[0],
            accept=ACCEPT_A,
            **common,
        ),
        study.finding(
            overlaps[1] >= OVERLAP,
            id="fig12b",
            source="Herath 2007, fig. 12b and sec. 4.5",
            claim="with a 50 cm baseline the linearised and the approximated Gaussian overlap",
            published="overlapping Gaussians",
            measured=text[1],
            accept=ACCEPT_B,
            **common,
        ),
        *in_the_plane(study, planes),
    ]


# --- (x, y), as the chapter plots it -----------------------------------------------------------------


@dataclass(frozen=True)
class Plane:
    """What :func:`main` finds of x, of (x, y)."""

    rejecting: float  # share of batches
    shared: float  # volume that both Gaussians have in common
    measured: tuple[Array, Array]  # mean (2,) and covariance (2, 2) within the search range
    linear: Array  # (2, 2), covariance by the Jacobian

    @property
    def words(self) -> str:
        mean, covariance = self.measured
        return (
            f"normality rejected in {100 * self.rejecting:.0f} % of batches; within the search range mean "
            f"({mean[0]:.2f}, {mean[1]:.2f}) m (true {X:g}, {Y:g}), {deviations(covariance)}; linearised "
            f"{deviations(self.linear)}; Gaussians share {100 * self.shared:.0f} % of their volume"
        )


def deviations(covariance: Array) -> str:
    std = np.sqrt(np.diagonal(covariance))
    return f"std ({std[0]:.2f}, {std[1]:.2f}) m, correlation {covariance[0, 1] / std.prod():.2f}"


def plane(sample: pd.DataFrame, found: pd.DataFrame, baseline: float) -> Plane:
    u0, v0, d0 = project(X, Y, 0.0, F, baseline)
    J = np.reshape(triangulate_jacobian(u0, v0, d0, F, baseline), (3, 3))[np.ix_([0, 1], [0, 2])]
    linear = J @ np.diag([SIGMA_U**2, SIGMA_D**2]) @ J.T
    points = found[["x", "y"]].to_numpy()
    moments = points.mean(axis=0), np.cov(points.T)
    batches = sample[["x", "y"]].to_numpy().reshape(-1, BATCH, 2)
    rejecting = float(np.mean([skewness_p(batch) < LEVEL for batch in batches]))
    return Plane(rejecting, shared_volume((np.array([X, Y]), linear), moments), moments, linear)


def skewness_p(points: Array) -> float:
    """p value of Mardia's test of multivariate skewness (1970), of points (n, p), with its correction for small n."""
    n, p = points.shape
    away = points - points.mean(axis=0)
    products = away @ np.linalg.solve(away.T @ away / n, away.T)
    correction = (p + 1) * (n + 1) * (n + 3) / (n * ((n + 1) * (p + 1) - 6))
    statistic = n * correction * (products**3).mean() / 6
    return float(stats.chi2.sf(statistic, p * (p + 1) * (p + 2) / 6))


def shared_volume(a: tuple[Array, Array], b: tuple[Array, Array]) -> float:
    """Volume that two Gaussian densities (mean (2,), covariance (2, 2)) share, on a grid of 8 sigma about both."""
    axes = []
    for i in range(2):
        ends = [of[0][i] + sign * 8 * np.sqrt(of[1][i, i]) for of in (a, b) for sign in (-1, 1)]
        axes.append(np.linspace(min(ends), max(ends), 401))
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    least = np.minimum(*(stats.multivariate_normal.pdf(grid, *of) for of in (a, b)))
    return float(least.sum() * (axes[0][1] - axes[0][0]) * (axes[1][1] - axes[1][0]))


def in_the_plane(study: cs.Study, planes: Sequence[Plane]) -> list[cs.Finding]:
    common = {"scenario": "none", "statistic": "Mardia's test of skewness of (x, y) in batches of 100; both Gaussians"}
    return [
        study.finding(
            planes[0].rejecting >= REJECTED,
            id="fig12a-xy",
            source="Herath 2007, fig. 12a and sec. 4.5",
            claim="with a 9 cm baseline the transformed (x, y) is clearly not Gaussian",
            published="not Gaussian",
            measured=planes[0].words,
            accept=f"normality of (x, y) is rejected ({LEVEL:.0%}) in at least {REJECTED:.0%} of batches of {BATCH} "
            "samples",
            **common,
        ),
        study.finding(
            planes[1].shared >= OVERLAP,
            id="fig12b-xy",
            source="Herath 2007, fig. 12b and sec. 4.5",
            claim="with a 50 cm baseline the linearised and the approximated Gaussian of (x, y) overlap",
            published="overlapping Gaussians",
            measured=planes[1].words,
            accept=f"they share at least {OVERLAP:.0%} of their volume, the rule of fig12b",
            **common,
        ),
    ]


def transformed(baseline: float, rng: np.random.Generator) -> pd.DataFrame:
    """Samples of eq. 21 (m and px) for Gaussian u and d."""
    u0, _, d0 = project(X, Y, 0.0, F, baseline)
    u = u0 + SIGMA_U * rng.standard_normal(SAMPLES)
    d = d0 + SIGMA_D * rng.standard_normal(SAMPLES)
    x, y, _ = triangulate(u, np.zeros(SAMPLES), d, F, baseline)
    return pd.DataFrame({"x": x, "y": y, "u": u, "d": d})


def rejected(x: np.ndarray) -> float:
    return float(np.mean([normality(batch).p_value < LEVEL for batch in x.reshape(-1, BATCH)]))


def linear_std(baseline: float) -> float:
    """Standard deviation of x in m by the Jacobian of eq. 21 at the mean."""
    u0, v0, d0 = project(X, Y, 0.0, F, baseline)
    return float(abs(triangulate_jacobian(u0, v0, d0, F, baseline)[2]) * SIGMA_D)


def overlap(a: tuple[float, float], b: tuple[float, float]) -> float:
    """Area that two Gaussian densities (mean, standard deviation) share."""
    low = min(a[0] - 8 * a[1], b[0] - 8 * b[1])
    high = max(a[0] + 8 * a[1], b[0] + 8 * b[1])
    grid = np.linspace(low, high, 20_001)
    return float(np.trapezoid(np.minimum(stats.norm.pdf(grid, *a), stats.norm.pdf(grid, *b)), grid))


def described(test: Normality, linear: float, shared: float, rejecting: float, found: float) -> str:
    return (
        f"normality rejected in {100 * rejecting:.0f} % of batches; within the search range ({100 * found:.0f} % of "
        f"samples) mean {test.mean:.2f} m (true 10), std {test.std:.2f} m (linearised {linear:.2f}), "
        f"skewness {test.skewness:.2f}, excess kurtosis {test.excess_kurtosis:.2f}; Gaussians share "
        f"{100 * shared:.0f} % of their area"
    )


if __name__ == "__main__":
    script(main)
