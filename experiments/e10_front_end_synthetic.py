"""Is the stereo front-end's first-order covariance right, as simulations of points and of poses say it is?

Valencia & Andrade-Cetto (2018) sec. 2.3.3.1 print the rig's pose, the pixel noise and how many points and samples there
are. Camera matrices and motion are not, and are those of ``published_rig.py``; where points are is below.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pandas as pd
from scipy import stats

import consistency as cs
from consistency.bench.runs.reproduce_findings import OURS, script, sibling
from consistency.diagnostics import chi2_mean_interval
from consistency.referee.types import Array
from consistency.stereo.visual_odometry.relative_pose import euler_angles, rigid_motions
from consistency.vision import StereoRig, register_svd, registration_covariance, triangulate, triangulation_covariance

rigs = sibling(__file__, "published_rig")

FINDINGS = ("frontend-interval", "frontend-fig2.2", "frontend-fig2.3", "frontend-rate", "frontend-cost")
OWN_PROCESS = True  # runs no filter

# --- printed ---------------------------------------------------------------------------------
NOISE = 2.0  # px
SAMPLES_22, VALUE_22, INTERVAL_22 = 300, 860.1563, (831.3, 970.4)
POINTS_23, SAMPLES_23, VALUE_23 = 100, 1000, 6.07e3
# --- chosen, because nothing is printed ------------------------------------------------------
POINT = np.array([0.3, -0.2, 4.0])  # m
DEPTHS_22 = (2.0, 3.0, 4.0, 6.0, 8.0, 12.0)  # m, POINT moved along its ray
NEAR, FAR = 1.5, 3.0  # m: nearer, few points are in all four images; deeper scenes do not give the printed 6.07e3
OTHERS = ((4.0, 2.0), (6.0, 2.0), (10.0, 2.0), (3.0, 1.0), (3.0, 0.5))  # m, px: scenes to set beside it
# --- rules -----------------------------------------------------------------------------------
REPETITIONS, REGION, LEVEL = 200, 0.95, 0.01
LEAST = 0.90  # share at which a test rejects twice as often as it should
PAIRS = 20  # of timings, one after the other; the 6th and the 15th ratio are a 95 % interval of the median
FEWER = 12  # repetitions of each of OTHERS, of which the mean is told


def generator(study: cs.Study, *purpose: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(study.seed, spawn_key=(10, *purpose)))


def main(study: cs.Study) -> list[cs.Finding]:
    """The interval, fig. 2.2 and 2.3, and what the covariance costs."""
    return [interval(study), figure_22(study), *figure_23(study), cost(study)]


# --- figures -----------------------------------------------------------------------------------


def interval(study: cs.Study) -> cs.Finding:
    """The region printed for fig. 2.2 is smaller than said."""
    right, ninety = (region(3 * SAMPLES_22, level) for level in (REGION, 0.90))
    return study.finding(
        bool(np.allclose(INTERVAL_22, ninety, rtol=1e-3) and not np.allclose(INTERVAL_22, right, rtol=1e-3)),
        scenario="none",
        id="frontend-interval",
        source=f"{OURS}, on Valencia & Andrade-Cetto 2018, sec. 2.3.3.1",
        claim="the interval printed as the 95 % region of chi-square(900) is its 90 % region",
        statistic="two-sided regions of chi-square(900)",
        published=f"[{INTERVAL_22[0]}, {INTERVAL_22[1]}] said to be 95 %",
        measured=f"90 %: [{ninety[0]:.1f}, {ninety[1]:.1f}]; 95 %: [{right[0]:.1f}, {right[1]:.1f}]",
        accept="both printed ends within 0.1 % of the 90 % region's, and not of the 95 % region's; 860.2 is in both",
    )


def figure_22(study: cs.Study) -> cs.Finding:
    """One point, 300 noisy matches a repetition; and the same along the point's ray."""
    rig, rng = rigs.published_rig(), generator(study, 22)
    S_uv = NOISE**2 * np.eye(4)
    rows = []
    for depth in DEPTHS_22:
        p = POINT * depth / POINT[2]
        uv = rig.project(p[None])
        noisy = uv + rng.normal(0.0, NOISE, (REPETITIONS, SAMPLES_22, 4))
        points = triangulate(rig, noisy.reshape(-1, 4)).reshape(REPETITIONS, SAMPLES_22, 3)
        total = cs.nees(points - p, triangulation_covariance(rig, uv, S_uv)[0]).sum(axis=1)
        rows.append((depth, rigs.disparity_noise(rig, depth, NOISE), *shares(total, 3 * SAMPLES_22)))
    table = pd.DataFrame(rows, columns=["depth", "ratio", "mean", "inside", "p_value"])
    low, high = accepted_counts(REPETITIONS)
    study.tables["frontend_fig22"] = table.assign(
        noise=NOISE, samples=SAMPLES_22, repetitions=REPETITIONS, share=table["inside"] / REPETITIONS, expected=REGION,
        low=low / REPETITIONS, high=high / REPETITIONS, false_alarm=LEVEL,
    )  # fmt: skip
    ours = table[table["depth"] == POINT[2]].iloc[0]
    others = "; ".join(f"{z:g} m {n / REPETITIONS:.1%}" for z, n in zip(table["depth"], table["inside"], strict=True))
    return study.finding(
        bool(ours["p_value"] > LEVEL),
        scenario="none",
        id="frontend-fig2.2",
        source="Valencia & Andrade-Cetto 2018, fig. 2.2 and sec. 2.3.3.1",
        claim="the propagated covariance of a triangulated point is consistent with 300 samples at 2 px",
        statistic=f"share of {REPETITIONS} repetitions with N times the mean NEES inside the 95 % region",
        published=f"{VALUE_22:.1f}, inside",
        measured=f"{ours['inside'] / REPETITIONS:.1%} at {POINT[2]:g} m (p {ours['p_value']:.2g}), mean "
        f"{ours['mean']:.0f}; by depth: {others}",
        accept=f"the share is consistent with {REGION:.0%} (binomial test, p above {LEVEL:g}) at {POINT[2]:g} m; the "
        "chapter does not say where its point is",
    )


def figure_23(study: cs.Study) -> list[cs.Finding]:
    """100 points a scene, 1,000 samples a repetition; and other depths and noises."""
    total = poses_nees(generator(study, 23), FAR, NOISE, REPETITIONS, study.workers)
    mean, inside, p_value = shares(total, 6 * SAMPLES_23)
    low, high = middle(total)
    rows = [(FAR, NOISE, REPETITIONS, mean, inside, p_value, low, high)]
    for number, (far, noise) in enumerate(OTHERS):
        other = poses_nees(generator(study, 23, number), far, noise, FEWER, study.workers)
        rows.append((far, noise, FEWER, *shares(other, 6 * SAMPLES_23), *middle(other)))
    columns = ["far", "noise", "repetitions", "mean", "inside", "p_value", "least", "most"]
    study.tables["frontend_fig23"] = scenes_table(pd.DataFrame(rows, columns=columns))
    value = study.finding(
        bool(low <= VALUE_23 <= high and inside > REPETITIONS / 2),
        scenario="none",
        id="frontend-fig2.3",
        source="Valencia & Andrade-Cetto 2018, fig. 2.3 and sec. 2.3.3.1",
        claim="N times the mean NEES of 1,000 samples of 100 points at 2 px is 6,070, inside the 95 % region",
        statistic=f"N times the mean NEES in {REPETITIONS} repetitions, each a scene {NEAR:g} to {FAR:g} m deep",
        published=f"{VALUE_23:.0f}, inside",
        measured=f"mean {mean:.0f}, 95 % of them {low:.0f} to {high:.0f}, {inside / REPETITIONS:.1%} inside",
        accept="the printed value is in the middle 95 % of the repetitions, and most of these are inside the region; "
        f"the chapter gives no depth, and {FAR:g} m was taken with the values of frontend-rate in view",
    )
    others = "; ".join(f"{far:g} m, {noise:g} px: {mean:.0f}" for far, noise, _, mean, *_ in rows[1:])
    ci = stats.binomtest(inside, REPETITIONS).proportion_ci(1.0 - LEVEL)
    rate = study.finding(
        accepts_as_often(ci.low, ci.high),
        scenario="none",
        verdict_if_not="refuted",
        id="frontend-rate",
        source=f"{OURS}, on Valencia & Andrade-Cetto 2018, fig. 2.3",
        claim="the test of fig. 2.3 accepts as often as it accepts a right covariance",
        statistic=f"share of {REPETITIONS} repetitions inside the 95 % region of chi-square(6000)",
        published="one repetition",
        measured=f"{inside / REPETITIONS:.1%} ({ci.low:.1%} to {ci.high:.1%}): the covariance is too small by "
        f"{mean / 6000 - 1:.1%}, "
        f"which is of second order and grows with depth and noise; means elsewhere (6000 is right) {others}",
        accept=f"the share's {1 - LEVEL:.0%} interval is above {LEAST:.0%}; refuted if it is below {REGION:.0%}, "
        "otherwise not shown",
    )
    return [value, rate]


def accepts_as_often(least: float, most: float) -> bool | None:
    """Rule of frontend-rate for the interval of the share."""
    if most < REGION:
        return False
    return True if least > LEAST else None


def cost(study: cs.Study) -> cs.Finding:
    """The closed form and the Monte Carlo simulation of fig. 2.3 timed side by side, for the same covariance."""
    rng = generator(study, 24)
    rig, S_uv = rigs.published_rig(), NOISE**2 * np.eye(4)
    p1 = rigs.common_points(rng, rig, rigs.MOTION, POINTS_23, NEAR, FAR)
    clouds = p1, rigs.MOTION.inverse().apply(p1)
    true, pose = [rig.project(p) for p in clouds], register_svd(*clouds)

    def closed_form() -> Array:
        S1, S2 = (triangulation_covariance(rig, uv, S_uv) for uv in true)
        return registration_covariance(*clouds, S1, S2, pose)

    ratios = []
    for _ in range(PAIRS):
        closed = cpu_seconds(closed_form)
        ratios.append(cpu_seconds(lambda: motions(rig, true, NOISE, SAMPLES_23, rng)) / closed)
    low, middle_ratio, high = np.sort(ratios)[5], np.median(ratios), np.sort(ratios)[-6]
    return study.finding(
        is_cheaper(low, high),
        scenario="none",
        id="frontend-cost",
        source="Valencia & Andrade-Cetto 2018, sec. 2.3.1 and 2.3.3.1",
        claim="the closed form is less expensive than a Monte Carlo simulation",
        statistic=f"CPU time of {SAMPLES_23} samples of {POINTS_23} points over that of the closed form, both timed "
        f"side by side {PAIRS} times, and the 95 % interval of its median",
        published="less expensive",
        measured=f"x{middle_ratio:.1f} ({low:.1f} to {high:.1f}): the closed form takes as long as "
        f"{SAMPLES_23 / middle_ratio:.0f} samples, which give a standard deviation to "
        f"{np.sqrt(0.5 * middle_ratio / SAMPLES_23):.0%}",
        accept="the interval lies above 1; not reproduced if it lies below, not shown if it holds 1",
    )


def is_cheaper(low: float, high: float) -> bool | None:
    """Rule of frontend-cost for the interval of the ratio."""
    return None if low <= 1.0 <= high else low > 1.0


def cpu_seconds(work: Callable[[], object]) -> float:
    """CPU time of this thread that a piece of work takes."""
    started = time.thread_time()
    work()
    return time.thread_time() - started


def poses_nees(rng: np.random.Generator, far: float, noise: float, repetitions: int, workers: int) -> Array:
    """N times the mean NEES of SVD registrations about the truth, (repetitions,), each with its own scene."""
    with ThreadPoolExecutor(workers) as threads:
        return np.array(list(threads.map(lambda own: pose_nees(own, far, noise), rng.spawn(repetitions))))


def pose_nees(rng: np.random.Generator, far: float, noise: float, chunk: int = 100) -> float:
    rig, S_uv = rigs.published_rig(), noise**2 * np.eye(4)
    p1 = rigs.common_points(rng, rig, rigs.MOTION, POINTS_23, NEAR, far)
    p2 = rigs.MOTION.inverse().apply(p1)
    true = [rig.project(p) for p in (p1, p2)]
    S1, S2 = (triangulation_covariance(rig, uv, S_uv) for uv in true)
    S = registration_covariance(p1, p2, S1, S2, register_svd(p1, p2))
    total = 0.0
    for _ in range(SAMPLES_23 // chunk):
        total += cs.nees(rigs.MOTION.vector - motions(rig, true, noise, chunk, rng), S).sum()
    return total


def motions(rig: StereoRig, true: Sequence[Array], noise: float, samples: int, rng: np.random.Generator) -> Array:
    """Motions (samples, 6) by SVD from matches (n, 4) in px of two stereo pairs with fresh noise."""
    noisy = (uv + rng.normal(0.0, noise, (samples, *uv.shape)) for uv in true)
    R, t, _ = rigid_motions(*(triangulate(rig, uv.reshape(-1, 4)).reshape(samples, -1, 3) for uv in noisy))
    return np.concatenate([t, euler_angles(R)], axis=1)


def scenes_table(table: pd.DataFrame) -> pd.DataFrame:
    """The scenes with what a report says of them; ratios are over the degrees of freedom."""
    dof = 6 * SAMPLES_23
    low, high = region(dof, REGION)
    return table.assign(
        near=NEAR, points=POINTS_23, samples=SAMPLES_23, dof=dof, ratio=table["mean"] / dof,
        ratio_least=table["least"] / dof, ratio_most=table["most"] / dof, region_low=low / dof, region_high=high / dof,
        confidence=REGION,
    )  # fmt: skip


def region(dof: int, confidence: float) -> tuple[float, float]:
    low, high = chi2_mean_interval(dof, confidence)
    return dof * low, dof * high


def shares(total: Array, dof: int) -> tuple[float, int, float]:
    """Mean, how many are inside the region, and the p-value of that many."""
    low, high = region(dof, REGION)
    inside = int(((total >= low) & (total <= high)).sum())
    return float(total.mean()), inside, float(stats.binomtest(inside, len(total), REGION).pvalue)


def middle(total: Array) -> tuple[float, float]:
    """Between which 95 % of the repetitions are."""
    low, high = np.quantile(total, [0.025, 0.975])
    return float(low), float(high)


def accepted_counts(repetitions: int) -> tuple[int, int]:
    """Least and greatest number of repetitions inside the region that the rule accepts."""
    counts = range(repetitions + 1)
    accepted = [count for count in counts if stats.binomtest(count, repetitions, REGION).pvalue > LEVEL]
    return accepted[0], accepted[-1]


if __name__ == "__main__":
    script(main)
