"""Do the errors of a well-tuned filter stay within 2 sigma, and those of an optimistic one not?"""

from __future__ import annotations

import numpy as np
from scipy import stats

import consistency as cs
from consistency.findings import script
from consistency.judge import Curves

FINDINGS = ("fig2b", "fig2c")

TWO_SIGMA = 0.9545  # P(|N(0, 1)| <= 2)
FALSE_ALARM = 1e-3  # of the one-sided test on each of the three axes

ACCEPT_BOUNDED = (
    f"on no axis is the share of errors within 2 sigma below {TWO_SIGMA} by a one-sided t test over the runs "
    f"at {FALSE_ALARM:g} (runs are independent, steps are not)"
)
ACCEPT_OPTIMISTIC = (
    f"on some axis that share is below {TWO_SIGMA} by the same test, and the ANEES leaves the simultaneous 95 % band "
    "upwards: both must say that the covariance is too small"
)


def main(study: cs.Study) -> list[cs.Finding]:
    """ekf-xyz in the same world with the right belief (fig. 2b) and with half of it (fig. 2c)."""
    tuned, tuned_curves = study.judged("herath2007-xyz", "ekf-xyz")
    small, small_curves = study.judged("herath2007-optimistic", "ekf-xyz")
    return [
        study.finding(
            not too_few_inside(tuned_curves).any(),
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
            bool(too_few_inside(small_curves).any()) and small.status == "overconfident",
            scenario="herath2007-optimistic",
            id="fig2c",
            source="Herath 2007, fig. 2c and sec. 2.4",
            claim="an inconsistent filter has become optimistic: errors leave the 2-sigma limits",
            statistic="share of pose errors within 2 sigma by axis, and the verdict on ANEES",
            published="errors outside the bounds (one run shown, tuning not given)",
            measured=f"{shares(small_curves)}; {small.status}, mean ANEES {small.statistics['mean_anees']:.1f} "
            f"against {tuned.statistics['mean_anees']:.1f} well tuned",
            accept=ACCEPT_OPTIMISTIC,
        ),
    ]


def inside(curves: Curves) -> np.ndarray:
    """Share of steps within 2 sigma, for each run and axis, shape (runs, 3)."""
    assert curves.error is not None
    assert curves.nees is not None
    sigma = np.sqrt(np.diagonal(curves.covariance, axis1=-2, axis2=-1))
    judged = np.isfinite(curves.nees)[..., None]  # where the covariance has full rank
    return np.asarray(np.nanmean(np.where(judged, np.abs(curves.error) <= 2 * sigma, np.nan), axis=1))


def too_few_inside(curves: Curves) -> np.ndarray:
    """For each axis, whether the mean share over runs is significantly below its value under normality."""
    test = stats.ttest_1samp(inside(curves), TWO_SIGMA, axis=0, alternative="less")
    return np.asarray(test.pvalue < FALSE_ALARM)


def shares(curves: Curves) -> str:
    """The shares in words."""
    return ", ".join(
        f"{axis} {100 * share:.1f} %"
        for axis, share in zip(("x", "y", "heading"), inside(curves).mean(axis=0), strict=True)
    )


if __name__ == "__main__":
    script(main)
