"""Does a wider baseline lower the effect of the nonlinearity on consistency?"""

from __future__ import annotations

import consistency as cs
from consistency.bench.runs.reproduce_findings import script
from consistency.bench.runs.scores_by_run import mean_nees_of_runs

FINDINGS = ("baseline-reduces-nonlinearity",)
KERNELS = {"herath2007-stereo": ("ekf-xyz", "ekf-uvd")}

BASELINES = (0.09, 0.2, 0.5)  # m: published, between, and that of fig. 12b

ACCEPT = (
    "mean ANEES of ekf-xyz falls from each baseline of 0.09, 0.2 and 0.5 m to the next; the three worlds share path, "
    "landmarks and noise in pixels, and the random numbers too, so that the order is not left to chance"
)


def main(study: cs.Study) -> list[cs.Finding]:
    """ekf-xyz on stereo in the same world with three baselines."""
    narrow = cs.load_scenario("herath2007-stereo")
    between = narrow.variant(
        "herath2007-baseline-20cm",
        summary="The world of herath2007-stereo with a baseline of 20 cm",
        truth__sensor__B=BASELINES[1],
        belief__sensor__B=BASELINES[1],
        truth__sensor__disparity=(1.0, 32.0 * BASELINES[1] / BASELINES[0]),
    )
    wide = cs.load_scenario("herath2007-wide-baseline")
    study.results(wide, ["ekf-xyz", "ekf-uvd"])
    judged = [study.judged(world, "ekf-xyz") for world in (narrow, between, wide)]
    verdicts = [verdict for verdict, _ in judged]
    means = [float(mean_nees_of_runs(curves).mean()) for _, curves in judged]
    best = study.judged(wide, "ekf-uvd")[0]
    return [
        study.finding(
            means[0] > means[1] > means[2],
            scenario="herath2007-wide-baseline",
            id="baseline-reduces-nonlinearity",
            source="Herath 2007, sec. 4.5",
            claim="larger baselines give rise to lower nonlinearity effects",
            statistic="mean ANEES of ekf-xyz at baselines of 0.09, 0.2 and 0.5 m",
            published="lower with larger baselines",
            measured=", ".join(
                f"{mean:.2f} at {baseline:g} m ({verdict.status})"
                for mean, baseline, verdict in zip(means, BASELINES, verdicts, strict=True)
            )
            + f"; ekf-uvd at 0.5 m: {best.statistic:.2f} ({best.status})",
            accept=ACCEPT,
        )
    ]


if __name__ == "__main__":
    script(main)
