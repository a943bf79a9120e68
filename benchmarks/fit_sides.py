"""Noise models of odometry whose turns are not larger than their noise: on whose side is the noise?

    python benchmarks/fit_sides.py              # 20 draws a cell, about half an hour on one core
    python benchmarks/fit_sides.py --draws 5    # quicker

Drives wind for 2 m at a time, with turns over 1 m that have 10, 3 or 1 times the variance of their white noise. That
noise is of the odometry, which measures the motion, or of the motion, which does what the odometry says. The truth is
exact, or jitters by row with half the variance of the noise. The scale of turns is 1 or 0.95. Then the truth drifts.
Exit status 1 if a promise is broken.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from fit_covariance import matrices_of
from scipy import stats
from scipy.signal import lfilter
from script_options import options_of

from consistency.referee.fit_covariance.drives import Drive, cut_windows, span_of
from consistency.referee.fit_covariance.mean_and_noise import MeanFit, fit_noise, jitter_of
from consistency.referee.geometry import composed
from consistency.referee.types import Array

STEP, LENGTH = 0.05, 120.0  # m
DRIVES = {False: 10, True: 5}  # in the plane and in space, where a scale is that of three turns
LASTS = 2.0  # m that a turn lasts for
SIGMA = (0.02, 0.01, 0.03)  # of x, y and yaw after 1 m, in m and rad; roll and pitch, and their turns, have 0.3 of it
JITTER = 0.5  # variance of a turn's jitter over that of its noise, over 1 m
LONG = 20  # spans
COVERED, POOLED, MADE, WITHIN = 0.95, 0.90, 0.80, 1.25
SURE = 0.01
DRIFT, DRIFTS = 0.03, 5.0  # rad/m, the rate at which the heading of a truth drifts, and the way that it lasts for, m


@dataclass(frozen=True)
class Side:
    """Where the noise is, and how large the turns are beside it."""

    snr: float
    of_odometry: bool = True
    in_space: bool = False
    jitters: bool = False
    drifts: bool = False
    scale: float = 1.0  # true over estimated turns

    def __str__(self) -> str:
        truth = "drifts" if self.drifts else "jitters" if self.jitters else "exact"
        return (
            f"{'space' if self.in_space else 'plane'} | {'odometry' if self.of_odometry else 'motion'} | {truth} | "
            f"{self.snr:g} | {self.scale:g}"
        )


def coloured(rng: np.random.Generator, size: tuple[int, int], lasts: float) -> Array:
    """Values of variance 1, whose correlation falls with the way."""
    keep = np.exp(-STEP / lasts)
    white = rng.normal(size=size) * np.sqrt(1 - keep**2)
    white[0] /= np.sqrt(1 - keep**2)
    return np.asarray(lfilter([1.0], [1.0, -keep], white, axis=0))


def drive(rng: np.random.Generator, side: Side, name: str) -> Drive:
    n, d = round(LENGTH / STEP), 3 if side.in_space else 2
    x, y, yaw = SIGMA
    share = np.array([0.3, 0.3, 1.0]) if side.in_space else np.ones(1)
    over_span = 2 * LASTS**2 * (1 / LASTS - 1 + np.exp(-1 / LASTS))  # variance of a turn of rate 1 over 1 m
    turns = STEP * np.sqrt(side.snr / over_span) * yaw * share * coloured(rng, (n, len(share)), LASTS)
    way = np.zeros((n, d))
    way[:, 0] = STEP
    sigma = np.array([x, *[y] * (d - 1), *(yaw * share)])
    noise = matrices_of(np.sqrt(STEP) * sigma * rng.normal(size=(n, len(sigma))))
    true, estimated = (
        matrices_of(np.column_stack([way, turns])),
        matrices_of(np.column_stack([way, turns / side.scale])),
    )
    if side.of_odometry:
        estimated = estimated @ noise
    else:
        true = true @ noise
    if side.drifts:
        rates = np.zeros((n, len(sigma)))
        rates[:, -1] = STEP * DRIFT * coloured(rng, (n, 1), DRIFTS)[:, 0]
        true = true @ matrices_of(rates)
    start = np.eye(d + 1)[None]
    truth, estimate = (composed(np.concatenate([start, each])) for each in (true, estimated))
    if side.jitters:
        ends = np.sqrt(0.5 * JITTER) * np.append(np.full(d, yaw), yaw * share)
        truth = truth @ matrices_of(ends * rng.normal(size=(n + 1, len(sigma))))
    return Drive(name, STEP * np.arange(n + 1), np.arange(n + 1), estimate, truth)


def drives(rng: np.random.Generator, side: Side) -> list[Drive]:
    return [drive(rng, side, f"drive {i + 1}") for i in range(DRIVES[side.in_space])]


def fitted(rng: np.random.Generator, side: Side) -> tuple[MeanFit, float]:
    """The mean, and the ratio of true to stated covariance at 20 spans of other drives."""
    made, others = drives(rng, side), drives(rng, side)
    windows = cut_windows(made, span_of("1m"))
    noise = fit_noise(windows, jitter=jitter_of(fit_noise(windows), windows))
    judged = replace(windows, drives=tuple(others)).over(float(LONG))
    assert judged is not None
    assert noise.mean_fit is not None
    nees = noise.nees(judged)[0]
    means = [nees[judged.drive == i].mean() for i in range(len(others))]
    return noise.mean_fit, float(np.exp(np.log(means).mean()))


def cells() -> Iterator[Side]:
    for space, odometry, jitters, snr, scale in product(
        (False, True), (True, False), (False, True), (10, 3, 1), (1, 0.95)
    ):
        yield Side(snr, odometry, space, jitters, scale=scale)


def side_rows(draws: int, seed: int, only: str = "") -> bool:
    """Print a row for each cell; whether all promises hold."""
    head = "space or plane | noise of | truth | snr | scale | in its interval | corrected | scale made |"
    print(f"\nturns beside their noise, {draws} draws\n| {head} ratio at {LONG} m |\n|{'---|' * 9}")
    held, total, inside = True, 0, 0
    for number, side in enumerate(cells()):
        if only not in str(side):
            continue
        found = [fitted(np.random.default_rng([seed, number, draw]), side) for draw in range(draws)]
        covered = sum(fit.low[1] <= side.scale <= fit.high[1] for fit, _ in found)
        made = sum(bool(fit.free[1]) for fit, _ in found)
        ratio = float(np.exp(np.mean([np.log(each) for _, each in found])))
        scale = float(np.mean([fit.mean.turn for fit, _ in found]))
        held &= bool(stats.binom.cdf(covered, draws, COVERED) >= SURE and 1 / WITHIN <= ratio <= WITHIN)
        held &= bool(side.scale == 1 or side.snr < 10 or made >= MADE * draws)
        total, inside = total + draws, inside + covered
        print(f"| {side} | {covered}/{draws} | {made}/{draws} | {scale:.3f} | {ratio:.2f} |", flush=True)
    if total:
        print(f"| all | | | | | {inside}/{total} | | | |")
        held &= inside >= POOLED * total or bool(only)
    return held & drift_rows(draws, seed, only)


def drift_rows(draws: int, seed: int, only: str) -> bool:
    """Print how often it is said that a truth that drifts leaves the scale open; whether it is in most draws."""
    held = True
    head = "space or plane | noise of | truth | snr | scale | said"
    print(f"\na truth that drifts, {draws} draws\n| {head} |\n|{'---|' * 6}")
    for number, (space, odometry, snr) in enumerate(product((False, True), (True, False), (10, 1))):
        side = Side(snr, odometry, space, drifts=True)
        if only not in str(side):
            continue
        said = 0
        for draw in range(draws):
            windows = cut_windows(drives(np.random.default_rng([seed, 1000 + number, draw]), side), span_of("1m"))
            fit = fit_noise(windows).mean_fit
            said += fit is not None and fit.is_open
        held &= said >= MADE * draws
        print(f"| {side} | {said}/{draws} |", flush=True)
    return held


def main() -> int:
    arguments = options_of(__doc__, draws=(20, None), seed=(0, None), only=("", "rows with this in them"))
    held = side_rows(arguments.draws, arguments.seed, arguments.only)
    print("\nall promises hold" if held else "\na promise is broken")
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main())
