"""Where does a filter on triangulated points put a landmark that it watches from one place for ever?

The closed forms are derived in docs/consistent.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special, stats

import consistency as cs
from consistency.bench.runs.reproduce_findings import OURS, script
from consistency.bench.types import Trial
from consistency.referee.types import Array

FINDINGS = ("static-limit", "static-growth", "static-lateral", "static-predicted")

DEPTHS = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)  # m, straight ahead
NEAR = (1.0, 2.0, 3.0, 4.0)  # where a disparity of 0 is 5 sigma away: beyond, a triangulated point has no mean
OBSERVATIONS = 2000  # of a run: the estimate's own error is then a fiftieth of that of one observation
ALARM = 1e-3  # probability that a right closed form fails a finding, by chance at any depth

COMMON = {
    "scenario": "none",
    "source": f"{OURS}, docs/consistent.md",
    "published": "in brackets beside what is measured",
}
ACCEPT = (
    f"at every depth the closed form is within the sampling error of the mean over runs: t interval of {1 - ALARM:.1%} "
    "over all depths together (Bonferroni)"
)


def main(study: cs.Study) -> list[cs.Finding]:
    """Limit of the estimate and growth of the NEES, from the filters themselves and in closed form."""
    watches = {
        lateral: [watched(study, "ekf-xyz", depth, lateral, number) for number, depth in enumerate(DEPTHS)]
        for lateral in (False, True)
    }
    ahead, whole = watches[False], watches[True]
    return [*ahead_findings(study, ahead), lateral_finding(study, whole), predicted_finding(study)]


# --- closed forms ------------------------------------------------------------------------------------


def limit_ratio(rho: Array, lateral: bool) -> Array:
    """Limit of the estimated depth over the true one with R at the measurement; ``lateral``: u and v are noisy, too."""
    extra = 2.0 * (rho**2 + rho**4) if lateral else 0.0
    ratio: Array = (1.0 + 3.0 * rho**2) / (1.0 + 6.0 * rho**2 + 3.0 * rho**4 + extra)
    return ratio


def growth(rho: Array, lateral: bool) -> Array:
    """By how much an observation raises the NEES in the end, with R at the measurement."""
    ratio = limit_ratio(rho, lateral)
    added: Array = (1.0 - ratio) ** 2 * (1.0 + 3.0 * rho**2) / (ratio * rho**2)
    return added


def mean_ratio(rho: Array) -> Array:
    """Mean of the triangulated depth over the true one: 1 + rho^2 + 3 rho^4 + ..., as a principal value."""
    ratio: Array = np.sqrt(2.0) / rho * special.dawsn(1.0 / (np.sqrt(2.0) * rho))
    return ratio


def debiased_ratio(rho: Array) -> Array:
    """The q with q (1 + (q rho)^2) = mean_ratio(rho), by Newton's method: the limit of ``debiased-ekf-xyz``."""
    q = np.ones_like(rho)
    for _ in range(20):
        q -= (q + rho**2 * q**3 - mean_ratio(rho)) / (1.0 + 3.0 * rho**2 * q**2)
    return q


# --- the filters themselves --------------------------------------------------------------------------


@dataclass(frozen=True)
class Watch:
    """A landmark at a known depth, watched in many runs."""

    depth: float  # m
    ratio: Array  # (runs,) estimated depth over the true one after the last observation
    slope: Array  # (runs,) growth of the NEES by an observation, in the second half


def watched(study: cs.Study, name: str, depth: float, lateral: bool, number: int) -> Watch:
    """A landmark straight ahead of a robot that stands still and knows where."""
    belief = (
        cs.load_scenario("herath2007-stereo")
        .variant("static", belief__motion__sigma_v=0.0, belief__motion__sigma_omega=0.0)
        .belief
    )
    sensor, filter_, half = belief.sensor, cs.get_filter(name), OBSERVATIONS // 2
    assert sensor.f is not None
    assert sensor.B is not None
    sigma = np.array(sensor.sigma) * (lateral, lateral, True)
    ratio, slope = np.empty(study.runs), np.empty(study.runs)
    for run in range(study.runs):
        rng = np.random.default_rng(np.random.SeedSequence(study.seed, spawn_key=(18, number, run)))
        z = [0.0, 0.0, sensor.f * sensor.B / depth] + rng.normal(size=(OBSERVATIONS, 3)) * sigma
        nees = []
        for steps in (half, OBSERVATIONS):
            landmarks = filter_.run(still(run, depth, z[:steps]), belief).map
            assert landmarks is not None
            nees.append(float(cs.nees(landmarks.mean[0] - [depth, 0.0, 0.0], landmarks.covariance[0])))
            ratio[run] = landmarks.mean[0, 0] / depth
        slope[run] = (nees[1] - nees[0]) / (OBSERVATIONS - half)
    return Watch(depth, ratio, slope)


def still(run: int, depth: float, z: Array) -> Trial:
    """A trial of a robot that stands still, with an observation z (T, 3) of the one landmark in each step."""
    steps = len(z)
    return Trial(
        run=run,
        start=np.zeros(3),
        controls=np.tile([0.1, 0.0, 0.0], (steps, 1)),
        first=np.arange(steps + 1),
        landmark=np.zeros(steps, np.int64),
        z=z,
        n_landmarks=1,
        truth=np.zeros((steps + 1, 3)),
        landmarks=np.array([[depth, 0.0, 0.0]]),
    )


def noise_ratio(watches: list[Watch]) -> Array:
    """rho = sigma_d / d of each."""
    sensor = cs.load_scenario("herath2007-stereo").belief.sensor
    assert sensor.f is not None
    assert sensor.B is not None
    return sensor.sigma[2] * np.array([watch.depth for watch in watches]) / (sensor.f * sensor.B)


# --- findings ----------------------------------------------------------------------------------------


def agreement(samples: list[Array], expected: Array) -> tuple[bool, str]:
    """Whether the means over runs agree with what is expected, and both in words."""
    runs = len(samples[0])
    quantile = stats.t.ppf(1.0 - ALARM / (2 * len(samples)), runs - 1)
    mean = np.array([sample.mean() for sample in samples])
    error = np.array([sample.std(ddof=1) for sample in samples]) / np.sqrt(runs)
    worst = float(np.max(np.abs(mean - expected) / error))
    text = ", ".join(f"{m:.4f} ({e:.4f})" for m, e in zip(mean, expected, strict=True))
    return worst <= quantile, f"{text}; largest distance {worst:.1f} standard errors, of {quantile:.1f} allowed"


def ahead_findings(study: cs.Study, watches: list[Watch]) -> list[cs.Finding]:
    """Limit and growth with noise in the disparity alone."""
    rho = noise_ratio(watches)
    limits = agreement([watch.ratio for watch in watches], limit_ratio(rho, lateral=False))
    slopes = agreement([watch.slope for watch in watches], growth(rho, lateral=False))
    return [
        study.finding(
            limits[0],
            id="static-limit",
            claim="with R at the measured point and noise in the disparity alone, the depth of a landmark converges to "
            "x (1 + 3 rho^2) / (1 + 6 rho^2 + 3 rho^4)",
            statistic=f"estimate over truth of ekf-xyz after {OBSERVATIONS} observations, mean over runs, at "
            f"{', '.join(f'{depth:g}' for depth in DEPTHS)} m",
            measured=limits[1],
            accept=ACCEPT,
            **COMMON,
        ),
        study.finding(
            slopes[0],
            id="static-growth",
            claim="the NEES of that landmark grows without bound, by (1 - ratio)^2 (1 + 6 rho^2 + 3 rho^4) / rho^2 an "
            "observation",
            statistic=f"growth of the NEES by an observation over the second half of {OBSERVATIONS}, mean over runs",
            measured=slopes[1],
            accept=ACCEPT,
            **COMMON,
        ),
    ]


def lateral_finding(study: cs.Study, watches: list[Watch]) -> cs.Finding:
    rho = noise_ratio(watches)
    limits, limit_text = agreement([watch.ratio for watch in watches], limit_ratio(rho, lateral=True))
    slopes, slope_text = agreement([watch.slope for watch in watches], growth(rho, lateral=True))
    alone, _ = agreement([watch.ratio for watch in watches], limit_ratio(rho, lateral=False))
    return study.finding(
        limits and slopes and not alone,
        id="static-lateral",
        claim="noise in u and v draws the landmark nearer still, whatever its size: to "
        "x (1 + 3 rho^2) / (1 + 8 rho^2 + 5 rho^4)",
        statistic="as in static-limit and static-growth, with noise in u, v and d",
        measured=f"limits {limit_text}. Growth {slope_text}",
        accept=f"{ACCEPT}, for limits and for growth; and the limits of static-limit are not",
        **COMMON,
    )


def predicted_finding(study: cs.Study) -> cs.Finding:
    text, holds = [], True
    for name, ratio_of in (("predicted-ekf-xyz", mean_ratio), ("debiased-ekf-xyz", debiased_ratio)):
        watches = [watched(study, name, depth, True, number) for number, depth in enumerate(NEAR)]
        rho, samples = noise_ratio(watches), [watch.ratio for watch in watches]
        agrees, words = agreement(samples, ratio_of(rho))
        at_measurement, _ = agreement(samples, limit_ratio(rho, lateral=True))
        holds = holds and agrees and not at_measurement
        text.append(f"{name} {words}")
    return study.finding(
        holds,
        id="static-predicted",
        claim="with R at the prediction the landmark converges to the mean of the triangulated points, 1 + rho^2 + ... "
        "times too far; with the bias subtracted the error is of fourth order in rho",
        statistic=f"estimate over truth after {OBSERVATIONS} observations, mean over runs, at "
        f"{', '.join(f'{depth:g}' for depth in NEAR)} m",
        measured="; ".join(text),
        accept=f"{ACCEPT}, for both filters; and the limits of ekf-xyz are not",
        **COMMON,
    )


if __name__ == "__main__":
    script(main)
