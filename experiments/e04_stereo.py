"""Does small-baseline stereo make EKF and UKF SLAM inconsistent, and do (u, v, d) or the UKF mend it?"""

from __future__ import annotations

import numpy as np
from scipy import stats

import consistency as cs
from consistency.findings import script
from consistency.judge import Curves

FINDINGS = ("fig11b", "fig13a", "fig13b")

SCENARIO = "herath2007-stereo"
UPPER = 3.72  # upper end of the published band
SIGN_TEST = 1e-3  # two-sided level of the paired sign test over runs
MINIMAL = 0.5  # share of the way to consistency below which an improvement is minimal

ACCEPT_11B = f"mean ANEES above {UPPER}, the published band's upper end, and the verdict overconfident"
ACCEPT_13A = (
    "ekf-uvd has the lower mean NEES in significantly more runs than ekf-xyz (paired sign test over runs, "
    f"{SIGN_TEST:g}; runs, because one diverging run decides a mean) and is still overconfident"
)
ACCEPT_13B = (
    f"ukf-uvd is still overconfident, and in the median run it goes less than {MINIMAL:.0%} of the way from ekf-uvd's "
    "mean NEES to 3: an improvement is minimal while most of the excess remains"
)


def main(study: cs.Study) -> list[cs.Finding]:
    """Average NEES of the robot pose on the stereo sensor, fig. 11b, 13a and 13b."""
    study.results(SCENARIO, ["ekf-xyz", "ekf-uvd", "ukf-xyz", "ukf-uvd"])
    xyz, xyz_curves = study.judged(SCENARIO, "ekf-xyz")
    uvd, uvd_curves = study.judged(SCENARIO, "ekf-uvd")
    ukf, ukf_curves = study.judged(SCENARIO, "ukf-uvd")
    better, p_value = wins(uvd_curves, xyz_curves)
    excess_ekf, excess_ukf = (np.median(run_means(c)) - 3.0 for c in (uvd_curves, ukf_curves))
    gain = float((excess_ekf - excess_ukf) / excess_ekf)
    return [
        study.finding(
            xyz.statistics["mean_anees"] > UPPER and xyz.status == "overconfident",
            scenario=SCENARIO,
            id="fig11b",
            source="Herath 2007, fig. 11b and sec. 4.5",
            claim="straightforward SLAM on stereo points is inconsistent: unacceptably large average NEES",
            statistic="mean ANEES of ekf-xyz and the verdict",
            published="unacceptably large",
            measured=said(xyz, xyz_curves),
            accept=ACCEPT_11B,
        ),
        study.finding(
            better > study.runs / 2 and p_value < SIGN_TEST and uvd.status == "overconfident",
            scenario=SCENARIO,
            id="fig13a",
            source="Herath 2007, fig. 13a and sec. 4.5",
            claim="observing (u, v, d) improves on (x, y, z), but the filter remains optimistic",
            statistic="runs in which ekf-uvd has the lower mean NEES than ekf-xyz, and its verdict",
            published="improved, still optimistic",
            measured=f"lower in {better} of {study.runs} runs; {said(uvd, uvd_curves)}",
            accept=ACCEPT_13A,
        ),
        study.finding(
            gain < MINIMAL and ukf.status == "overconfident",
            scenario=SCENARIO,
            id="fig13b",
            source="Herath 2007, fig. 13b and sec. 4.5",
            claim="the UKF on (u, v, d) improves consistency only minimally",
            statistic="share of the median run's excess NEES that ukf-uvd removes from ekf-uvd's, and its verdict",
            published="minimal improvement, inconsistent",
            measured=f"removes {100 * gain:.0f} % of the median run's excess; {said(ukf, ukf_curves)}",
            accept=ACCEPT_13B,
        ),
    ]


def run_means(curves: Curves) -> np.ndarray:
    """Mean NEES of each run over its steps, shape (runs,); a failed run counts as infinite."""
    assert curves.nees is not None
    means = np.nanmean(curves.nees, axis=1)
    means[np.isin(curves.runs, [f.run for f in curves.failures])] = np.inf
    return np.asarray(means)


def wins(a: Curves, b: Curves) -> tuple[int, float]:
    """Runs in which ``a`` has the lower mean NEES than ``b``, and the two-sided p value of a sign test."""
    better, worse = (int((run_means(x) < run_means(y)).sum()) for x, y in ((a, b), (b, a)))
    return better, float(stats.binomtest(better, better + worse).pvalue)


def said(verdict: cs.Verdict, curves: Curves) -> str:
    """Verdict, mean over all and median over runs in words."""
    mean, runs = verdict.statistics["mean_anees"], run_means(curves)
    return f"{verdict.status}, mean ANEES {mean:.1f}, median run {np.median(runs):.1f}, worst run {runs.max():.0f}"


if __name__ == "__main__":
    script(main)
