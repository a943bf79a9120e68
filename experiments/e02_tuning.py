"""Do the errors of a well-tuned filter stay within 2 sigma, and those of an optimistic one not?"""

from __future__ import annotations

import numpy as np
from scipy import stats

import consistency as cs
from consistency.bench.runs.reproduce_findings import script
from consistency.referee.diagnostics.nees import TWO_SIGMA

FINDINGS = ("fig2b", "fig2c")
KERNELS = {"herath2007-xyz": ("ekf-xyz",)}

LIMIT = 0.8975  # P(|N(0, 1)| <= 2 / sqrt(1.5)): 2-sigma coverage when the covariance is too small by x1.5
LEVEL = 0.05  # of each one-sided t test over the runs

ACCEPT_BOUNDED = (
    f"on every axis the lower {1 - LEVEL:.0%} confidence bound of the share of errors within 2 sigma is above {LIMIT}, "
    f"what a covariance too small by x1.5 would give ({TWO_SIGMA:.3f} is right); t over runs, which are independent "
    f"where steps are not; a failed run counts as outside. Not reproduced if an upper bound is below {LIMIT}; "
    "otherwise not shown"
)
ACCEPT_OPTIMISTIC = (
    f"on some axis the upper {1 - LEVEL:.0%} bound of that share is below {TWO_SIGMA:.3f}, and the ANEES leaves the "
    "simultaneous 95 % band upwards: both must say that the covariance is too small. Not "
    "reproduced if the verdict is consistent; otherwise not shown"
)


def main(study: cs.Study) -> list[cs.Finding]:
    """ekf-xyz in the same world with the right belief (fig. 2b) and with half of it (fig. 2c)."""
    tuned, tuned_curves = study.judged("herath2007-xyz", "ekf-xyz")
    small, small_curves = study.judged("herath2007-optimistic", "ekf-xyz")
    return [
        study.finding(
            is_bounded(bound(tuned_curves, "lower"), bound(tuned_curves, "upper")),
            scenario="herath2007-xyz",
            id="fig2b",
            source="Herath 2007, fig. 2b and sec. 2.4",
            claim="when the filter is well tuned the error lies bounded within the 2-sigma limits",
            statistic="share of pose errors within 2 sigma, by axis, over runs and steps",
            published="bounded (one run shown)",
            measured=shares(tuned_curves),
            accept=ACCEPT_BOUNDED,
        ),
        study.finding(
            is_optimistic(bound(small_curves, "upper"), small.status),
            scenario="herath2007-optimistic",
            id="fig2c",
            source="Herath 2007, fig. 2c and sec. 2.4",
            claim="an inconsistent filter has become optimistic: errors leave the 2-sigma limits",
            statistic="share of pose errors within 2 sigma by axis, and the verdict on ANEES",
            published="errors outside the bounds (one run shown, tuning not given)",
            measured=f"{shares(small_curves)}; {small.status}, mean ANEES {small.statistic:.1f} "
            f"against {tuned.statistic:.1f} well tuned",
            accept=ACCEPT_OPTIMISTIC,
        ),
    ]


def is_bounded(lower: np.ndarray, upper: np.ndarray) -> bool | None:
    """Rule of fig. 2b for the bounds (3,) of the axes; None where they hold the limit, or are NaN."""
    return True if (lower > LIMIT).all() else False if (upper < LIMIT).any() else None


def is_optimistic(upper: np.ndarray, status: str) -> bool | None:
    """Rule of fig. 2c for the upper bounds (3,) of the axes and the verdict; None where they do not decide."""
    if status == "consistent":
        return False
    return True if (upper < TWO_SIGMA).any() and status == "overconfident" else None


def inside(curves: cs.Record) -> np.ndarray:
    """Share of judged steps within 2 sigma, for each run and axis, shape (runs, 3); 0 after a failure."""
    assert curves.errors.error is not None
    assert curves.errors.nees is not None
    sigma = np.sqrt(np.diagonal(np.asarray(curves.errors.covariance), axis1=-2, axis2=-1))
    deficient = np.isfinite(curves.errors.error).all(axis=-1) & ~np.isfinite(curves.errors.nees)
    within = np.nan_to_num(np.abs(curves.errors.error), nan=np.inf) <= 2 * np.nan_to_num(sigma)
    return np.asarray((within & ~deficient[..., None]).sum(axis=1) / (~deficient).sum(axis=1)[:, None])


def bound(curves: cs.Record, side: str) -> np.ndarray:
    """One-sided confidence bound of the mean share for each axis; NaN, which passes no rule, with one run."""
    shares, sign = inside(curves), {"lower": -1.0, "upper": 1.0}[side]
    if len(shares) < 2:
        return np.full(3, np.nan)
    error = shares.std(axis=0, ddof=1) / np.sqrt(len(shares))
    return np.asarray(shares.mean(axis=0) + sign * stats.t.ppf(1 - LEVEL, len(shares) - 1) * error)


def shares(curves: cs.Record) -> str:
    rows = zip(
        ("x", "y", "heading"), inside(curves).mean(axis=0), bound(curves, "lower"), bound(curves, "upper"), strict=True
    )
    return ", ".join(
        f"{axis} {100 * mean:.1f} % ({100 * low:.1f} to {100 * high:.1f})" for axis, mean, low, high in rows
    )


if __name__ == "__main__":
    script(main)
