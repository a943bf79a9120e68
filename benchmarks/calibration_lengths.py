"""Right filters whose runs end, or have gaps, by what they have measured, and groups of runs of unlike length.

A Kalman filter's covariance is right given all measurements so far. Which steps a run has may depend on these, and not
on the truth. Whole verdicts are counted by their p value, and so are the e-process of `--until-decided`, `correct`, and
the power where lengths depend on nothing. ``calibration.py`` puts the rows into its table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from calibration_cases import DETECT, FALSE_ALARM, MOST, POWER
from calibration_gates import row, shared

from consistency.diagnostics import Record, Settings, follow, gate_runs, judge, make_record, sequential_design
from consistency.referee.diagnostics.error_parts import run_tests
from consistency.referee.diagnostics.groups import column_of, groups_of
from consistency.referee.diagnostics.nees import e_processes, ever
from consistency.referee.diagnostics.sample import sample_of
from consistency.referee.diagnostics.verdict_parts import MAIN, SHARES, shares_of
from consistency.referee.fit_covariance.correct import are_needed, fit_groups
from consistency.referee.fit_covariance.factors import blocks_of
from consistency.referee.types import Array

GATES, FITS, CLEARS = 2000, 2000, 400
QUICK_GATES, QUICK_FITS, QUICK_CLEARS = 50, 20, 20
STEPS, RARE = 100, 1e-3
PROCESS = 0.1  # variance of the process noise in a step, over that of the measurement
FAR = {1: 3.84, 2: 5.99}  # NIS that 5 % exceed, by its dimension
WHOLE, BETS = "measured ends, false alarm", "measured ends, until decided"
FACTOR, GROUPED = "measured ends, a factor needed", "groups of unlike runs, false alarm"
POWERED, CLEARED = "unlike lengths, power", "unlike lengths, all-clear"
SOON = "unlike lengths, until decided, all-clear"

Ends = Callable[[Array], Array]  # innovations (R, T, n) over their deviations -> steps (R, T) that a run has


def filtered(rng: np.random.Generator, runs: int, n: int = 1) -> tuple[Array, Array, Array]:
    """Errors (R, T, n) of the Kalman filter of n random walks, their variances (T,), and its scaled innovations."""
    variance, error = 1.0, rng.standard_normal((runs, n))
    errors, innovations = np.empty((runs, STEPS, n)), np.empty((runs, STEPS, n))
    variances = np.empty(STEPS)
    for k in range(STEPS):
        variance, error = variance + PROCESS, error + np.sqrt(PROCESS) * rng.standard_normal((runs, n))
        innovation, gain = error + rng.standard_normal((runs, n)), variance / (variance + 1.0)
        innovations[:, k] = innovation / np.sqrt(variance + 1.0)
        error, variance = error - gain * innovation, (1.0 - gain) * variance
        errors[:, k], variances[k] = error, variance
    return errors, variances, innovations


def until(flag: Array) -> Array:
    """Steps (R, T) up to the first one with a flag."""
    return np.asarray(np.cumsum(flag, axis=1) - flag == 0)


def mean_nis(innovation: Array) -> Array:
    """Mean NIS of each run so far over its dimension, (R, T)."""
    return np.asarray(np.cumsum(np.square(innovation).mean(axis=2), axis=1) / np.arange(1.0, STEPS + 1.0))


def is_far(innovation: Array) -> Array:
    return np.asarray(np.square(innovation).sum(axis=2) > FAR[innovation.shape[2]])


def aligned(innovation: Array) -> Array:
    return until((mean_nis(innovation) < 0.7) & (np.arange(STEPS) >= 10))


def gives_up(innovation: Array) -> Array:
    count = np.cumsum(is_far(innovation), axis=1)
    count[:, 5:] -= count[:, :-5].copy()
    return until(count >= 2)


def left_out(innovation: Array) -> Array:
    """For 20 steps after a NIS that 5 % exceed."""
    count = np.cumsum(is_far(innovation), axis=1)
    before = np.zeros_like(count)
    before[:, 20:] = count[:, :-20]
    return np.asarray(count == before)


def goal(innovation: Array) -> Array:
    """The innovations of the first state have moved the estimate by 5."""
    return until(np.cumsum(innovation[..., 0], axis=1) > 5.0)


class Measured(NamedTuple):
    """A right filter, which steps its runs have, and how many runs are judged."""

    ends: Ends
    runs: int
    n: int
    about: str


WORLDS = {
    "aligned": Measured(aligned, 400, 1, "a run ends once its mean NIS so far is below 0.7"),
    "gives up": Measured(gives_up, 400, 1, "a run ends after two NIS beyond 95 % within 5 steps"),
    "left out": Measured(left_out, 400, 1, "rows are left out for 20 steps after a NIS beyond 95 %"),
    "goal": Measured(goal, 400, 2, "a run ends where its own estimate reaches a goal, n = 2"),
    "aligned, 30 runs": Measured(aligned, 30, 1, "a run ends once its mean NIS so far is below 0.7"),
}
QUICK_WORLDS = ("aligned", "goal")
COLUMN = "mean NIS so far"
ONE_LONG = {  # groups, other runs of a group, share of its steps that its one long run has, dimension
    "one drive of 30 %": (5, 20, 0.3, 1),
    "one drive of 20 %": (20, 100, 0.2, 1),
}
Lengths = Callable[[np.random.Generator, int], Array]
LENGTHS: dict[str, Lengths] = {
    "90 to 100": lambda rng, runs: rng.integers(90, STEPS + 1, runs),
    "1 to 100": lambda rng, runs: rng.integers(1, STEPS + 1, runs),
    "10 % ten times": lambda rng, runs: np.where(rng.random(runs) < 0.1, STEPS, STEPS // 10),
}
LOOK = 192  # runs at a look
REACHED, SHOWN = 0.93, 0.9  # power at DETECT, which the plan approximates, and right filters called consistent
ABOUT = {
    **{world: of.about for world, of in WORLDS.items()},
    COLUMN: "a right filter, by its mean NIS so far",
    **{
        world: f"{groups} groups of {others + 1} runs, one of which has {100 * share:g} % of the steps, n = {n}"
        for world, (groups, others, share, n) in ONE_LONG.items()
    },
    **{world: f"runs of {world} steps, one error in all of them, n = 3" for world in ("90 to 100", "1 to 100")},
    "10 % ten times": "runs of 10 steps and, in 10 %, of 100, one error in all of them, n = 3",
    WHOLE: "a right filter whose runs end, or have gaps, by what it has measured is found at fault",
    BETS: "the e-process finds the scale of such a filter wrong in up to 300 runs, at the share of this question",
    FACTOR: "`correct` says that such a filter, or one whose steps are grouped by what it measured, needs a factor",
    GROUPED: "a right filter with one error in all steps of a run is found at fault with `--by`",
    POWERED: "a covariance wrong by the ratio is found with the runs of `plan`, lengths depending on nothing",
    CLEARED: "a right filter is called consistent with 100 runs, lengths depending on nothing",
    SOON: "`--until-decided` calls a right filter consistent after 192 runs at most, lengths depending on nothing",
}


def rows(quick: bool, seed: int) -> list[dict[str, Any]]:
    return [
        *_whole(quick, seed),
        *_bets(quick, seed),
        *_factors(quick, seed),
        *_grouped(quick, seed),
        *_power(quick, seed),
        *_cleared(quick, seed),
        *_soon(quick, seed),
    ]


def measured(rng: np.random.Generator, of: Measured, runs: int) -> Record:
    """Runs of a right filter that have the steps that its measurements decide on."""
    error, variance, innovation = filtered(rng, runs, of.n)
    there = of.ends(innovation)
    error = np.where(there[..., None], error, np.nan)[there.any(axis=1)]
    covariance = np.broadcast_to(variance[:, None, None] * np.eye(of.n), (*error.shape, of.n))
    return make_record("measured", error, covariance, np.square(error).sum(axis=2) / variance, of.n)


def p_value(record: Record) -> float:
    """That of the verdict: the false-alarm rate at which some fault would just be found."""
    settings = Settings(FALSE_ALARM)
    sample = sample_of(record, settings)
    assert sample is not None
    p = run_tests(sample, settings, {}).p_values
    share = shares_of([question for question, value in p.items() if np.isfinite(value)])
    return min(p[question] / share[question] for question in share)


def counted(
    world: str, question: str, runs: int, rates: dict[float, float], p_values: list[float]
) -> Iterator[dict[str, Any]]:
    """A row for each rate, with what is stated at it."""
    for rate, stated in rates.items():
        yield row(world, question, 1.0, runs, stated, "<=", len(p_values), int((np.array(p_values) <= rate).sum()))


def _whole(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    gates = QUICK_GATES if quick else GATES
    for k, (world, of) in enumerate(WORLDS.items()):
        if not quick or world in QUICK_WORLDS:
            rng = np.random.default_rng((seed, 131, k))
            found = [p_value(measured(rng, of, of.runs)) for _ in range(gates)]
            yield from counted(world, WHOLE, of.runs, {FALSE_ALARM: FALSE_ALARM, RARE: RARE}, found)


def _bets(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    gates = QUICK_GATES if quick else GATES
    for k, world in enumerate(("aligned", "gives up", "left out")):
        if not quick or world in QUICK_WORLDS:
            rng, found = np.random.default_rng((seed, 132, k)), []
            for _ in range(gates):
                sample = sample_of(measured(rng, WORLDS[world], 300), Settings())
                assert sample is not None
                found.append(
                    max(ever(bets.both) for bets in e_processes(sample.means(), sample.dof, sample.early_means))
                )
            share = SHARES[MAIN]
            rates = {share * rate: share * rate for rate in (FALSE_ALARM, RARE)}
            yield from counted(world, BETS, 300, rates, found)


def _factors(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    gates, blocks = QUICK_FITS if quick else FITS, blocks_of(("x",), 1, False)
    for k, runs in enumerate((150,) if quick else (30, 150)):
        rng = np.random.default_rng((seed, 133, k))
        fits = (fit_groups(measured(rng, WORLDS["aligned"], runs), blocks) for _ in range(gates))
        found = sum(are_needed(tuple(fit.values())) for fit in fits)
        yield row("aligned", FACTOR, 1.0, runs, FALSE_ALARM, "<=", gates, found)
    rng = np.random.default_rng((seed, 134, 0, 30))
    found = sum(_needs_factors(rng, 30) for _ in range(gates))
    yield row(COLUMN, FACTOR, 1.0, 30, FALSE_ALARM, "<=", gates, found)


def _needs_factors(rng: np.random.Generator, runs: int) -> bool:
    """Is a factor said to be needed in some of five groups by the mean NIS so far?"""
    error, variance, innovation = filtered(rng, runs)
    values = mean_nis(innovation)
    groups = groups_of(column_of("by", values), 5, np.isfinite(values))
    covariance = np.broadcast_to(variance[:, None, None], (*error.shape, 1))
    nees = np.square(error[..., 0]) / variance
    fits = fit_groups(make_record("by", error, covariance, nees, 1, groups=groups), blocks_of(("x",), 1, False))
    return are_needed([fits[name] for name in groups.names])


def _grouped(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    gates = QUICK_GATES if quick else GATES
    for k, (world, (groups, others, share, n)) in enumerate(ONE_LONG.items()):
        if not quick or k == 0:
            rng = np.random.default_rng((seed, 135, k))
            found = [p_value(one_long(rng, groups, others, share, n)) for _ in range(gates)]
            runs = groups * (others + 1)
            yield from counted(world, GROUPED, runs, {FALSE_ALARM: FALSE_ALARM, RARE: RARE}, found)


def one_long(rng: np.random.Generator, groups: int, others: int, share: float, n: int) -> Record:
    """Groups of runs with one error in all steps, of which one has a share of the steps of its group."""
    long = max(round(others * share / (1.0 - share)), 1)
    steps = np.tile([long, *[1] * others], groups)
    error = np.repeat(rng.standard_normal((len(steps), 1, n)), long, axis=1)
    error[np.arange(long) >= steps[:, None]] = np.nan
    name = np.repeat([f"site {g}" for g in range(groups)], others + 1)
    by = groups_of(column_of("site", np.repeat(name[:, None], long, axis=1)), 5, np.isfinite(error[..., 0]))
    return make_record("sites", error, shared(np.eye(n), error), dof=n, groups=by)


def _of_lengths(rng: np.random.Generator, lengths: Lengths, runs: int, ratio: float, n: int = 3) -> Record:
    error = np.sqrt(ratio) * np.repeat(rng.standard_normal((runs, 1, n)), STEPS, axis=1)
    there = np.arange(STEPS) < lengths(rng, runs)[:, None]
    nees = np.where(there, np.square(error).sum(axis=2), np.nan)
    return make_record("lengths", nees=nees, dof=n)


def _power(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    gates, settings = QUICK_GATES if quick else GATES, Settings(FALSE_ALARM)
    for k, (world, lengths) in enumerate(LENGTHS.items()):
        for ratio in (DETECT, 1.0 / DETECT):
            rng, found, runs = np.random.default_rng((seed, 136, k, int(ratio > 1.0))), 0, gate_runs(3, ratio)
            for _ in range(gates):
                sample = sample_of(_of_lengths(rng, lengths, runs, ratio), settings)
                assert sample is not None
                found += sample.run_means().find().p_value <= SHARES[MAIN] * FALSE_ALARM
            yield row(world, POWERED, ratio, runs, REACHED, ">=", gates, found)


def _cleared(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    gates, settings = QUICK_CLEARS if quick else CLEARS, Settings(FALSE_ALARM, DETECT, POWER)
    for k, (world, lengths) in enumerate(LENGTHS.items()):
        rng = np.random.default_rng((seed, 137, k))
        found = sum(judge(_of_lengths(rng, lengths, 100, 1.0), settings).consistent for _ in range(gates))
        yield row(world, CLEARED, 1.0, 100, SHOWN, ">=", gates, found)


def _soon(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    gates, design = QUICK_CLEARS if quick else CLEARS, sequential_design(3, DETECT, FALSE_ALARM, POWER, MOST)
    for k, (world, lengths) in enumerate(LENGTHS.items()):
        rng, found = np.random.default_rng((seed, 138, k)), 0
        for _ in range(gates):
            verdict, runs = follow(design, _of_lengths(rng, lengths, MOST, 1.0).first_runs)
            found += verdict.consistent and runs <= LOOK
        yield row(world, SOON, 1.0, LOOK, SHOWN, ">=", gates, found)
