"""Noise models of odometry: recovery of known noise, coverage of intervals, and how often "consistent" is wrong.

    python benchmarks/fit_covariance.py                # 200 draws a case, about an hour on one core
    python benchmarks/fit_covariance.py --draws 20     # quicker

Drives are simulated, of 1 km, and of 500 m for verdicts: an odometry that errs as white noise a metre and a radian, in
the plane, on a road that winds, and in space, or in the plane also by a scale that persists in a drive, by noise with a
memory, by jumps, by loops that are closed, by a scale that is not metric, in another body frame. Each is fitted and
judged as ``consistency fit-covariance --span 10m`` does. Exit status 1 if a promise is broken (binomial, 1 % for all
rows together).
"""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy import stats
from scipy.spatial.transform import Rotation
from script_options import options_of

from consistency.referee.defaults import DETECT
from consistency.referee.diagnostics.nees import binomial_interval
from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.covariance_ratios import folds_of, judged_by
from consistency.referee.fit_covariance.drives import PLANE, SPACE, Drive, DriveWindows, cut_windows, drive_of, span_of
from consistency.referee.fit_covariance.mean_and_noise import fit_noise, terms_of, variance_intervals
from consistency.referee.fit_covariance.noise_model import decided
from consistency.referee.fit_covariance.refusals import (
    doubts,
    mean_by_motion,
    persistent_errors,
    require_sound,
    rotation_growth,
)
from consistency.referee.geometry import composed, matrices, vectors
from consistency.referee.types import Array

SPAN, STEP, LENGTH = "10m", 0.5, 1000.0  # m
SHORT = 500.0  # m, of drives whose verdicts are counted
PER_M = (4e-4, 2e-4, 4e-6)  # m^2/m and rad^2/m: x, y, yaw
PER_RAD = (4e-4, 1e-4, 2e-5)  # m^2/rad and rad^2/rad
WITHIN, SHARE, OWN = (0.7, 1.5), 0.80, 0.5  # of the true variance; of fits; of the variance of a window
COVERED = (0.90, 0.98)
WRONG, SURE = 0.05, 0.01  # share of wrong "consistent"; probability that a promise kept exactly is called broken
FRESH = 40  # drives that tell the true ratio of a fit


@dataclass(frozen=True)
class World:
    """Where a drive goes, and how its odometry errs: as white noise, and beyond it."""

    per_m: tuple[float, ...] = PER_M  # 3, or 6 in space: x, y, z, roll, pitch, yaw
    per_rad: tuple[float, ...] = PER_RAD
    times: float = 1.0  # factor on both
    winds: bool = False  # the road
    scale: float = 0.0  # sd of the scale of the way between drives
    turn: float = 0.0  # sd of the scale of turns between drives
    drift: float = 0.0  # rad/m, sd of the drift of the heading between drives
    slip: float = 0.0  # m a rad, of the true way less the estimated one
    spread: float = 0.0  # sd of the logarithm of the variance between drives
    memory: float = 0.0  # m, over which an additional error of the heading rate decays
    coloured: float = 0.0  # rad/m, its sd
    jumps: int = 0  # of 1 m, in a drive
    closed: bool = False  # poses err about the truth by a fixed amount
    metric: float = 1.0  # true over estimated way
    turned: float = 0.0  # rad, between the body frames
    offset: float = 0.0  # m along x at both ends: jitter


ROADS = (  # that known noise is recovered on
    ("", World()),
    ("winding, ", World(per_rad=(2e-2, 2e-2, 1e-4), winds=True)),  # wheels that slip where they turn
    ("in space, ", World((4e-4, 2e-4, 3e-4, 2e-6, 3e-6, 4e-6), (4e-4, 1e-4, 2e-4, 1e-5, 1e-5, 2e-5))),
    (
        "winding in space, ",
        World((4e-4, 2e-4, 3e-4, 2e-6, 3e-6, 4e-6), (2e-2, 2e-2, 2e-2, 1e-4, 1e-4, 1e-4), winds=True),
    ),
)
ROWS = 36  # of terms on these roads


def steps_of(rng: np.random.Generator, length: float, world: World) -> Array:
    """True motions (N, 3) of a drive: straight roads, and corners of up to a right angle; (N, 6) in space.

    There the road rises, falls and banks as it turns, by a fifth of the angles.
    """
    n, straight = round(length / STEP), (0, 10) if world.winds else (10, 80)
    axes = len(world.per_m)
    out = np.zeros((n, axes))
    out[:, 0] = STEP
    for axis, share in ((2, 1.0),) if axes == 3 else ((5, 1.0), (4, 0.2), (3, 0.2)):
        k = 0
        while k < n:
            k += int(rng.integers(*straight))
            corner = int(rng.integers(8, 24))
            out[k : k + corner, axis] = share * rng.uniform(-np.pi / 2, np.pi / 2) / corner
            k += corner
    return out


def matrices_of(motions: Array) -> Array:
    """Matrices of motions x, y, heading (N, 3), or of a position and a rotation vector (N, 6)."""
    if motions.shape[1] == 6:
        motions = np.column_stack([motions[:, :3], Rotation.from_rotvec(motions[:, 3:]).as_quat()])
    return matrices(motions)


def drive(rng: np.random.Generator, world: World = World(), name: str = "drive", length: float = LENGTH) -> Drive:
    """One drive, whose estimate errs at the end of each step."""
    true = steps_of(rng, length, world)
    angles = slice(3, None) if true.shape[1] == 6 else slice(2, None)
    turn = np.linalg.norm(true[:, angles], axis=1, keepdims=True)
    variance = world.times * (STEP * np.array(world.per_m) + turn * np.array(world.per_rad))
    factor = np.exp(0.5 * world.spread * rng.normal())
    error = factor * np.sqrt(variance) * rng.normal(size=true.shape)
    if world.memory:
        keep = np.exp(-STEP / world.memory)
        rate = world.coloured * np.sqrt(1 - keep**2) * rng.normal(size=len(true))
        rate[0] = world.coloured * rng.normal()
        for k in range(1, len(rate)):
            rate[k] += keep * rate[k - 1]
        error[:, -1] += STEP * rate
    if world.jumps:
        error[rng.choice(len(true), world.jumps, replace=False), 1] += rng.choice([-1.0, 1.0], world.jumps)
    motions = matrices_of(true)
    start = np.eye(motions.shape[-1])[None]
    truth = composed(np.concatenate([start, motions]))
    motions[:, 0, -1] *= (1.0 + world.scale * rng.normal()) / world.metric
    if world.turn or world.drift or world.slip:
        turned = np.array(true)
        turned[:, angles] *= 1.0 + world.turn * rng.normal()
        turned[:, -1] += STEP * world.drift * rng.normal()
        motions[:, :-1, :-1] = matrices_of(turned)[:, :-1, :-1]
        motions[:, 0, -1] -= world.slip * turn[:, 0]
    T = composed(np.concatenate([start, motions @ matrices_of(error)]))
    if world.closed:
        T = truth @ matrices_of(np.sqrt(10 * np.array(PER_M)) * rng.normal(size=(len(truth), 3)))
    if world.turned:
        T = T @ matrices_of(np.array([[0.0, 0.0, world.turned]]))
    if world.offset:
        T = T @ matrices_of(world.offset * rng.normal(size=(len(T), 1)) * [[1.0, 0.0, 0.0]])
    return drive_of(name, vectors(T), vectors(truth), STEP * np.arange(len(truth)))


def drives(rng: np.random.Generator, number: int, world: World = World(), length: float = LENGTH) -> list[Drive]:
    return [drive(rng, world, f"drive {i + 1}", length) for i in range(number)]


# --- recovery ------------------------------------------------------------------------------------------


class Recovered(NamedTuple):
    """One term over the draws."""

    name: str
    ratios: Array  # (draws,), fitted over true variance
    covered: Array  # (draws,), whether the interval holds the truth
    best: float  # share of the values of an efficient estimator that are within 0.7 to 1.5


def recovery(rng: np.random.Generator, world: World, number: int, draws: int) -> tuple[list[Recovered], Array]:
    """Terms that make up an axis, and fitted over true variance of all axes over the span (draws, n)."""
    theta, n = np.array([*world.per_m, *world.per_rad]), len(world.per_m)
    names = [f"{axis} per {unit}" for unit in ("m", "rad") for axis in (PLANE if n == 3 else SPACE)]
    ratios, covered, whole = np.empty((draws, 2 * n)), np.empty((draws, 2 * n), bool), np.empty((draws, n))
    main, best = np.zeros(2 * n), np.zeros(2 * n)
    for k in range(draws):
        windows = cut_windows(drives(rng, number, world), span_of(SPAN))
        F = terms_of(windows.pieces)
        own = np.diagonal(F.mean(axis=0), axis1=1, axis2=2)  # (2 n, n)
        main += theta * own[np.arange(2 * n), np.arange(2 * n) % n] / np.tile(theta @ own, 2) / draws
        best += within_at_best(theta, F) / draws
        found = variance_intervals(fit_noise(windows), windows)
        fitted = np.array([each.value for each in found])
        ratios[k], whole[k] = fitted / theta, fitted @ own / (theta @ own)
        covered[k] = [each.holds(true) for each, true in zip(found, theta, strict=True)]
    return [Recovered(names[p], ratios[:, p], covered[:, p], best[p]) for p in np.flatnonzero(main >= OWN)], whole


def within_at_best(theta: Array, F: Array) -> Array:
    """Share within 0.7 to 1.5 of Gaussian values with the least variance (Cramér and Rao), (p,)."""
    G = np.linalg.inv(np.tensordot(theta, F, (0, 1)))[:, None] @ F
    flat, turned = (each.reshape(*G.shape[:2], -1) for each in (G, np.swapaxes(G, -1, -2)))
    information = 0.5 * np.tensordot(flat, turned, ((0, 2), (0, 2)))
    sd = np.sqrt(np.diag(np.linalg.inv(information))) / theta
    return np.asarray(stats.norm.cdf((WITHIN[1] - 1) / sd) - stats.norm.cdf((WITHIN[0] - 1) / sd))


def share_within(ratios: Array) -> float:
    return float(((ratios >= WITHIN[0]) & (ratios <= WITHIN[1])).mean())


def surely(share: float, draws: int) -> float:
    """Lower 99 % limit of a share of the draws (Clopper & Pearson 1934)."""
    return float(stats.beta.ppf(SURE, share * draws, (1 - share) * draws + 1)) if share else 0.0


def recovery_rows(draws: int, seed: int, tests: int, only: str) -> bool:
    """Print recovery and coverage; whether both promises hold.

    Beside a term that an efficient estimator would not recover as often, or not surely, stands how often that would.
    """
    held = True
    print(f"\nknown noise, {draws} draws; terms with at least {OWN:g} of their axis' variance over {SPAN}")
    print(
        "| drives | term | fitted over true, 5 % to 95 % | within 0.7 to 1.5 | covered (0.95) |\n|---|---|---|---|---|"
    )
    for row, number in product(range(len(ROADS)), (1, 10)):
        road, world = ROADS[row]
        if only not in f"known noise, {road}{number} drives":
            continue
        terms, whole = recovery(np.random.default_rng([seed, 1000 * row + number]), world, number, draws)
        for term in terms:
            inside, cover = share_within(term.ratios), int(term.covered.sum())
            least, possible = surely(inside, draws), surely(term.best, draws) >= SHARE
            low, high = binomial_interval(cover, draws, 1.0 - SURE / tests)
            held &= bool((least >= SHARE or draws < 200) and low <= COVERED[1] and high >= COVERED[0])
            five, rest = np.quantile(term.ratios, [0.05, 0.95])
            print(
                f"| {road}{number} | {term.name} | {five:.2f} to {rest:.2f} | {inside:.3f}, at least {least:.3f} "
                f"(99 %){'' if possible else f'; {term.best:.2f} at best'} | {cover / draws:.3f} |",
                flush=True,
            )
        print(f"| {road}{number} | all over {SPAN}, each axis | | {min(map(share_within, whole.T)):.3f} or more | |")
    return held


# --- wrong verdicts --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """Drives that are fitted and drives that are judged; None judges each by the others."""

    name: str
    world: World
    fitted: int = 5
    judged: int = 0
    times: float = 1.0  # variance of the judged drives over that of the fitted ones
    length: float = SHORT  # m
    by_turn: bool = False

    @property
    def later(self) -> World:
        return replace(self.world, times=self.times)


CASES = (
    Case("right, each by the others", World()),
    Case("judged x1.5", World(), 5, 5, 1.5),
    Case("judged x0.67", World(), 5, 5, 1 / 1.5),
    Case("judged x2", World(), 5, 5, 2.0),
    Case("variance differs, s 0.5", World(spread=0.5)),
    Case("variance differs, s 1", World(spread=1.0)),
    Case("variance differs, s 1, 5 and 5", World(spread=1.0), 5, 5),
    Case("scale persists, sd 1 %", World(scale=0.01)),
    Case("heading remembers 50 m", World(memory=50.0, coloured=2e-3)),
    Case("two jumps a drive", World(jumps=2)),
    Case("jitter 5 cm", World(offset=0.05)),
    Case("right, 10 drives of 250 m", World(), 10, length=250.0),
    Case("right in space, 10 drives of 250 m", ROADS[2][1], 10, length=250.0),
    Case("way by turn, -0.4 m a rad", World(slip=-0.4)),
    Case("way by turn, corrected", World(slip=-0.4), by_turn=True),
    Case("one drive, halves", World(), 1),
    Case("loops closed", World(closed=True)),
    Case("one camera, x2.2", World(metric=2.2)),
    Case("body turned by 5 degrees", World(turned=np.deg2rad(5.0))),
)


def told(rng: np.random.Generator, case: Case, fresh: DriveWindows) -> tuple[str, float, str]:
    """Status, true ratio of the exported model on ``fresh`` drives, and the reason of a refusal or first warning.

    The parts of :func:`consistency.fit_covariance` that decide, without those that describe.
    """
    made = drives(rng, case.fitted, case.world, case.length)
    judged = [drive(rng, case.later, f"judged {i}", case.length) for i in range(case.judged)]
    names = ",".join(each.name for each in judged) or (None if case.fitted > 1 else "half")
    every = [*made, *judged]
    try:
        windows = cut_windows(every, span_of(SPAN))
        require_sound(windows, True)
        noise, folds = folds_of(windows, names, partial(fit_noise, by_turn=case.by_turn))
    except InputError as error:
        return "refused", np.nan, str(error)
    lasting = persistent_errors(noise, windows)
    depends = mean_by_motion(noise, windows).is_found
    judged_status = judged_by(folds, windows, case.fitted > 1).status
    status = decided(judged_status, any(each.decides for each in lasting), depends)
    growth = rotation_growth(windows, noise.mean)
    warnings = doubts(noise, windows, growth, lasting)
    nees = noise.nees(fresh)[0]
    means = [nees[fresh.drive == i].mean() for i in range(FRESH)]
    return status, float(np.exp(np.log(means).mean())), warnings[0] if warnings else ""


def verdict_rows(draws: int, seed: int, tests: int, only: str) -> bool:
    """Print statuses and wrong ones; whether no case has too many."""
    held = True
    print(f"\nverdicts at {SPAN}, {draws} draws; wrong: consistent though the true ratio is outside 0.67 to 1.5")
    print("| drives | statuses | true ratio, 5 % to 95 % | wrong | refused or warned |\n|---|---|---|---|---|")
    for number, case in enumerate(CASES):
        if only not in case.name:
            continue
        rng = np.random.default_rng([seed, 100 + number])
        fresh = cut_windows([drive(rng, case.later, f"fresh {i}", SHORT) for i in range(FRESH)], span_of(SPAN))
        found = [told(rng, case, fresh) for _ in range(draws)]
        ratio = np.array([each[1] for each in found])
        outside = (ratio < 1 / DETECT) | (ratio > DETECT)
        wrong = sum(status == "consistent" and out for (status, _, _), out in zip(found, outside, strict=True))
        held &= bool(binomial_interval(wrong, draws, 1.0 - 2 * SURE / tests)[0] <= WRONG)
        statuses = ", ".join(
            f"{word} {count / draws:.2f}" for word, count in Counter(f[0] for f in found).most_common()
        )
        words = Counter(each[2].split(":")[0] if each[0] == "refused" else each[2] for each in found if each[2])
        said = f"{sum(words.values()) / draws:.2f}: {words.most_common(1)[0][0]}" if words else "0"
        known = ratio[np.isfinite(ratio)]
        spread = "{:.2f} to {:.2f}".format(*np.quantile(known, [0.05, 0.95])) if len(known) else "-"
        print(f"| {case.name} | {statuses} | {spread} | {wrong / draws:.3f} | {said} |", flush=True)
    return held


# --- a mean that depends on the motion -------------------------------------------------------------------

OWN_CONSTANTS: dict[str, Any] = {"scale": 0.02, "turn": 0.02, "drift": 1e-3}
ALLOWED, FOUND = 0.05, 0.90  # share of right drives with a dependence that is found, and of wrong ones at least
BY_MOTION = (  # name, world, drives, span, whether the mean depends on the motion
    ("right", World(), 5, SPAN, False),
    ("constants of their own", World(**OWN_CONSTANTS), 5, SPAN, False),
    ("constants of their own, winding", replace(ROADS[1][1], **OWN_CONSTANTS), 5, SPAN, False),
    ("constants of their own, 10 s", World(**OWN_CONSTANTS), 5, "10s", False),
    ("constants of their own, 12 drives", World(**OWN_CONSTANTS), 12, SPAN, False),
    ("constants of their own, one drive", World(**OWN_CONSTANTS), 1, SPAN, False),
    ("constants of their own, in space", replace(ROADS[2][1], **OWN_CONSTANTS), 5, SPAN, False),
    ("turns as large as their noise", World((4e-4, 2e-4, 4e-3), winds=True, **OWN_CONSTANTS), 5, SPAN, False),
    ("heading remembers", World(memory=50.0, coloured=2e-3), 5, SPAN, False),
    ("way by turn, -0.4 m a rad", World(slip=-0.4, **OWN_CONSTANTS), 5, SPAN, True),
)


def motion_rows(draws: int, seed: int, tests: int, only: str) -> bool:
    """Print how often a mean error is said to depend on the motion; whether as often as allowed."""
    held = True
    print(f"\nmean by motion, {draws} draws of drives of {SHORT:g} m")
    print("| drives | found | p below 0.05 | p below 0.01 |\n|---|---|---|---|")
    for number, (name, world, count, span, is_there) in enumerate(BY_MOTION):
        if only not in f"mean by motion, {name}":
            continue
        rng, found = np.random.default_rng([seed, 500 + number]), []
        for _ in range(draws):
            made = drives(rng, count, world, SHORT)
            windows = cut_windows(made, span_of(span))
            found.append(mean_by_motion(fit_noise(windows), windows))
        hits, p = sum(each.is_found for each in found), np.array([each.p_value for each in found])
        low, high = binomial_interval(hits, draws, 1.0 - 2 * SURE / tests)
        held &= bool(high >= FOUND if is_there else low <= ALLOWED)
        print(f"| {name} | {hits / draws:.3f} | {(p < 0.05).mean():.3f} | {(p < 0.01).mean():.3f} |", flush=True)
    return held


def main() -> int:
    arguments = options_of(
        __doc__,
        draws=(200, None),
        seed=(0, None),
        only=("", "rows with this in their names; the numbers are the same"),
    )
    draws, seed, only, tests = arguments.draws, arguments.seed, arguments.only, len(CASES) + ROWS + len(BY_MOTION)
    roads = any(only in f"known noise, {road}{number} drives" for road, _ in ROADS for number in (1, 10))
    held = recovery_rows(draws, seed, tests, only) if roads else True
    if any(only in case.name for case in CASES):
        held &= verdict_rows(draws, seed, tests, only)
    held &= motion_rows(draws, seed, tests, only)
    print("\nall promises hold" if held else "\na promise is broken")
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main())
