"""Does small-baseline stereo make EKF and UKF SLAM inconsistent, do (u, v, d) or the UKF mend it, and what does?"""

from __future__ import annotations

import numpy as np

import consistency as cs
from consistency.bench.runs.reproduce_findings import script
from consistency.bench.runs.scores_by_run import mean_nees_of_runs, wins

FINDINGS = ("fig11b", "fig13a", "fig13b", "consistent-stereo")

SCENARIO = "herath2007-stereo"
ANSWER = "parked-ekf-uvd"  # in 36 worlds and beside ten others: e13
UPPER = 3.72  # upper end of the published band
FILTERS = ("ekf-xyz", "ekf-uvd", "ukf-xyz", "ukf-uvd", ANSWER)
KERNELS = {SCENARIO: FILTERS}
SIGN_TEST = 1e-3  # two-sided level of the paired sign test over runs
MINIMAL = 0.5  # share of the way to consistency below which an improvement is minimal

ACCEPT_11B = f"mean ANEES above {UPPER}, the published band's upper end, and the verdict overconfident"
ACCEPT_13A = (
    "ekf-uvd has the lower mean NEES in significantly more runs than ekf-xyz (paired sign test over runs, "
    f"{SIGN_TEST:g}; runs, because one diverging run decides an average) and is still overconfident"
)
ACCEPT_ANSWER = f"the verdict on {ANSWER} is consistent, and none of its runs fails"
ACCEPT_13B = (
    f"ukf-uvd is still overconfident, and in the median run it goes between 0 and {MINIMAL:.0%} of the way from "
    "ekf-uvd's mean NEES to 3: no worse, and most of the excess remains"
)


def main(study: cs.Study) -> list[cs.Finding]:
    """Average NEES of the robot pose on the stereo sensor, fig. 11b, 13a and 13b, and that of the answer."""
    study.results(SCENARIO, FILTERS)
    xyz, xyz_curves = study.judged(SCENARIO, "ekf-xyz")
    uvd, uvd_curves = study.judged(SCENARIO, "ekf-uvd")
    ukf, ukf_curves = study.judged(SCENARIO, "ukf-uvd")
    answer, answer_curves = study.judged(SCENARIO, ANSWER)
    better, p_value = wins(uvd_curves, xyz_curves)
    gain, low, high = removed(uvd_curves, ukf_curves, study.seed)
    return [
        study.finding(
            mean_nees_of_runs(xyz_curves).mean() > UPPER and xyz.status == "overconfident",
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
            measured=f"lower in {better} of {study.runs} runs; {said(uvd, uvd_curves)}; {said(xyz, xyz_curves)}",
            accept=ACCEPT_13A,
        ),
        study.finding(
            0.0 <= gain < MINIMAL and ukf.status == "overconfident",
            scenario=SCENARIO,
            id="fig13b",
            source="Herath 2007, fig. 13b and sec. 4.5",
            claim="the UKF on (u, v, d) improves consistency only minimally",
            statistic="share of the median run's excess NEES that ukf-uvd removes from ekf-uvd's, and its verdict",
            published="minimal improvement, inconsistent",
            measured=f"removes {100 * gain:.0f} % of the median run's excess (95 % bootstrap {100 * low:.0f} to "
            f"{100 * high:.0f}: {study.runs} runs leave it wide), lower in {wins(ukf_curves, uvd_curves)[0]} of "
            f"{study.runs} runs; {said(ukf, ukf_curves)}; ekf-uvd's mean {mean_nees_of_runs(uvd_curves).mean():.1f}",
            accept=ACCEPT_13B,
        ),
        study.finding(
            answer.status == "consistent" and not answer.failures,
            scenario=SCENARIO,
            id="consistent-stereo",
            source="this project, on the open question of Herath 2007 sec. 5",
            claim="a robot-centred filter in inverse range is consistent on the stereo sensor at 9 cm",
            statistic=f"mean ANEES of {ANSWER} and the verdict",
            published="none of the filters tried is",
            measured=said(answer, answer_curves),
            accept=ACCEPT_ANSWER,
        ),
    ]


def removed(ekf: cs.Record, ukf: cs.Record, seed: int) -> tuple[float, float, float]:
    """Share of the median run's excess NEES that the UKF removes, with a 95 % bootstrap interval over paired runs."""
    pairs = np.column_stack([mean_nees_of_runs(ekf), mean_nees_of_runs(ukf)])
    drawn = np.random.default_rng(seed).integers(len(pairs), size=(2000, len(pairs)))
    medians = np.median(np.concatenate([pairs[None], pairs[drawn]]), axis=1) - 3.0
    gains = (medians[:, 0] - medians[:, 1]) / medians[:, 0]
    low, high = np.quantile(gains[1:], [0.025, 0.975])
    return float(gains[0]), float(low), float(high)


def said(verdict: cs.Verdict, curves: cs.Record) -> str:
    """Filter, verdict, and mean NEES over all, in the median and in the worst run, in words."""
    runs, accuracy = mean_nees_of_runs(curves), verdict.accuracy
    assert accuracy is not None
    return (
        f"{verdict.filter} {verdict.status}, mean ANEES {runs.mean():.1f}, median run {np.median(runs):.1f}, "
        f"worst run {runs.max():.0f}, RMSE {accuracy.rmse_position:.2f} m"
    )


if __name__ == "__main__":
    script(main)
