"""Is a stereo point Gaussian at 10 m, with a baseline of 9 cm and of 50 cm?"""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy import stats

import consistency as cs
from consistency.bench.models.stereo import project, triangulate, triangulate_jacobian
from consistency.bench.runs.reproduce_findings import script
from consistency.diagnostics import Normality, normality

FINDINGS = ("fig12a", "fig12b")

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
    """Moments and normality of eq. 21 applied to Gaussian (u, d), fig. 12a and 12b."""
    rows, text, overlaps, rejecting = [], [], [], []
    for index, baseline in enumerate((0.09, 0.5)):
        sample = transformed(baseline, np.random.default_rng([study.seed, index]))
        found = sample[sample["d"].between(*SEARCH)]
        rows.append(found.assign(baseline=baseline))
        moments = normality(found["x"].to_numpy())
        rejecting.append(rejected(sample["x"].to_numpy()))
        overlaps.append(overlap((X, linear_std(baseline)), (moments.mean, moments.std)))
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
