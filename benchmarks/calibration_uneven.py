"""Runs that differ from each other: the covariance is right in some and wrong in others, or steps depend in some alone.

Whole verdicts in which a study is called conservative or consistent, the number of runs that a pilot gives, and beside
these the whiteness of innovations of many components. ``calibration.py`` puts the rows into its table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from calibration_cases import DETECT, FALSE_ALARM, MOST, POWER
from calibration_gates import row, shared, stationary

from consistency.diagnostics import Settings, Verdict, follow, judge, make_record, sequential_design
from consistency.referee.diagnostics.planning import pilot_plan
from consistency.referee.diagnostics.scale import scale_test
from consistency.referee.diagnostics.verdict_parts import MAIN, SHARES
from consistency.referee.diagnostics.whiteness import whiteness
from consistency.referee.types import Array

GATES, PILOTS, DRAWS = 2000, 400, 3000
QUICK_GATES, QUICK_PILOTS, QUICK_DRAWS = 40, 30, 100
ALIKE, WHITE_STEPS = 4, 50  # steps of a run
ALLOWED, CLEAR = "conservative allowed, false alarm", "uneven runs, wrong all-clear"
DECIDED, NAMED = "uneven runs, until decided, wrong all-clear", "a block is called right"
PLANNED, WHITE = "plan --like, power", "many components, whiteness"

Squares = Callable[[np.random.Generator, int], Array]  # ratios of true to stated covariance of so many runs


def mixed(share: float, ratio: float, other: float) -> Squares:
    """A share of the runs has one ratio, the others have another."""
    return lambda rng, runs: np.where(rng.random(runs) < share, ratio, other)


CONSERVATIVE = {
    "P right in 20 %, x4": (50, mixed(0.2, 1.0, 0.25), "P right in 20 % of the runs, 4 times too large in the others"),
    "P right in 10 %, x2": (102, mixed(0.1, 1.0, 0.5), "P right in 10 % of the runs, twice too large in the others"),
}
UNEVEN = {
    "10 % x6": (mixed(0.1, 6.0, 1.0), "P 6 times too small in 10 % of the runs, right in the others"),
    "lognormal": (
        lambda rng, runs: DETECT * np.exp(rng.standard_normal(runs) - 0.5),
        "ratios of runs are lognormal, of mean 1.5 and a deviation of the logarithm of 1",
    ),
    "5 % x11": (mixed(0.05, 11.0, 1.0), "P 11 times too small in 5 % of the runs, right in the others"),
}
# Rates that are reached where those of 1 - POWER are not: of 50 runs, none is wrong in 8 % of the studies if 5 % of all
# runs are, and one or two in another 46 %; no test of the runs alone tells these from even ones.
CLEARED = {
    ("10 % x6", 3, 50): 0.09,
    ("5 % x11", 3, 50): 0.15,
    ("5 % x11", 3, 102): 0.07,
    ("5 % x11", 1, 102): 0.13,
    ("10 % x6", 1, 102): 0.08,
}
# A look shows nothing with fewer than 30 runs; of 48, none is wrong in 8 % of the studies if 5 % of all runs are.
DECIDED_CLEARED = {
    ("10 % x6", 3): 0.05,
    ("10 % x6", 6): 0.05,
    ("lognormal", 3): 0.05,
    ("5 % x11", 6): 0.13,
}
FEW = {(15, 30): (0.08, 0.25), (6, 31): (0.08, 0.2)}  # n and runs of a plan: rates reached with 10 % x6, and 5 % x11
BLOCKS = {
    "yaw right": (1.0, ">=", 0.85),
    "yaw x1.5": (1.5, "<=", 0.15),
    "yaw x0.67": (1.0 / 1.5, "<=", 0.15),
}
BLOCK_RUNS, BLOCK_STEPS = 50, 20
PILOT_RUNS, LONG, SLIGHT = 40, 200, 1.2


@dataclass(frozen=True)
class Pilot:
    """A world to plan in, of errors of ``dof`` components."""

    dof: int
    means: Callable[[np.random.Generator, int], Array]  # mean NEES of so many runs over ``dof``
    about: str
    power: float = POWER  # that the planned number reaches
    power_large: float = POWER  # that on a covariance which is too large


def some_slow(share: float, dof: int, slow: int) -> Callable[[np.random.Generator, int], Array]:
    """``slow`` of the axes have one error in all steps in a share of the runs; all else is well mixed."""

    def means(rng: np.random.Generator, runs: int) -> Array:
        fixed = 1.0 + (rng.chisquare(slow, runs) - slow) / dof
        return np.where(rng.random(runs) < share, fixed, 1.0 + 0.013 * rng.standard_normal(runs))

    return means


# A pilot of 40 runs tells how much run means spread, and not how skewed they are, or holds no slow run. Where some
# axes or runs alone are slow, the rates that are reached.
PLANS = {
    "plan, fully dependent": Pilot(3, some_slow(1.0, 3, 3), "one error in all steps of a run, n = 3"),
    "plan, one axis slow": Pilot(6, some_slow(1.0, 6, 1), "one of six axes has one error in all steps", 0.9, 0.45),
    "plan, axis slow in 30 %": Pilot(6, some_slow(0.3, 6, 1), "one of six axes slow in 30 % of the runs", 0.9, 0.47),
    "plan, axis slow in 10 %": Pilot(6, some_slow(0.1, 6, 1), "one of six axes slow in 10 % of the runs", 0.72, 0.65),
    "plan, 5 % slow": Pilot(3, some_slow(0.05, 3, 3), "one error in all steps in 5 % of the runs, n = 3", 0.52, 0.6),
}
INNOVATIONS = {3: 20, 15: 30, 30: 60}  # components, and runs of 20 steps: the fewest that are judged

ABOUT = {
    **{world: f"{about}; independent steps, n = 3" for world, (_, _, about) in CONSERVATIVE.items()},
    **{
        _world: f"{about}; one error in all steps of a run, n = {n}"
        for world, (_, about) in UNEVEN.items() for n in (3, 1, 6) for _world in (f"{world}, n = {n}",)
    },
    **{
        f"{world}, steps independent, n = {n}": f"{UNEVEN[world][1]}; independent steps, n = {n}"
        for world in ("10 % x6", "5 % x11") for n, _ in FEW
    },
    **{world: f"a pose with position x2.2, {world}, all else right, AR(.9)" for world in BLOCKS},
    **{world: pilot.about for world, pilot in PLANS.items()},
    **{f"{m} components": f"white innovations of {m} components, 20 steps a run" for m in INNOVATIONS},
    ALLOWED: "a covariance that is right or too large in every run is found at fault with `allow='conservative'`",
    CLEAR: "a covariance of mean ratio `detect`, made of unlike runs, is called consistent",
    DECIDED: "`--until-decided` calls a covariance of mean ratio `detect`, made of unlike runs, consistent",
    NAMED: "the sentence calls the attitude right, whose yaw alone has another ratio",
    PLANNED: "the number of runs that a pilot of 40 gives finds a covariance wrong by the ratio",
    WHITE: "white innovations of many components are found correlated, at the share of this question",
}  # fmt: skip


def rows(quick: bool, seed: int) -> list[dict[str, Any]]:
    return [
        *_allowed(quick, seed),
        *_cleared(quick, seed),
        *_few(quick, seed),
        *_decided(quick, seed),
        *_named(quick, seed),
        *_planned(quick, seed),
        *_white(quick, seed),
    ]


def verdict_of(rng: np.random.Generator, squares: Array, n: int, settings: Settings, white: bool = False) -> Verdict:
    """On runs of these ratios, whose steps are independent or all alike."""
    runs = len(squares)
    steps = WHITE_STEPS if white else 1
    error = np.sqrt(squares)[:, None, None] * rng.standard_normal((runs, steps, n))
    if not white:
        error = np.repeat(error, ALIKE, axis=1)
    return judge(make_record("uneven", error, shared(np.eye(n), error)), settings)


def _allowed(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    gates, settings = QUICK_GATES if quick else GATES, Settings(FALSE_ALARM, DETECT, POWER, allow="conservative")
    for k, (world, (runs, squares, _)) in enumerate(CONSERVATIVE.items()):
        rng = np.random.default_rng((seed, 111, k))
        found = sum(bool(verdict_of(rng, squares(rng, runs), 3, settings, True).faults) for _ in range(gates))
        yield row(world, ALLOWED, 1.0, runs, FALSE_ALARM, "<=", gates, found)


def _cleared(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    gates, settings = QUICK_GATES if quick else GATES, Settings(FALSE_ALARM, DETECT, POWER)
    for k, (world, (squares, _)) in enumerate(UNEVEN.items()):
        for n in (3,) if quick else (3, 1):
            for runs in (102,) if quick else (50, 102):
                rng = np.random.default_rng((seed, 112, k, n, runs))
                found = sum(verdict_of(rng, squares(rng, runs), n, settings).consistent for _ in range(gates))
                stated = CLEARED.get((world, n, runs), round(1.0 - POWER, 3))
                yield row(f"{world}, n = {n}", CLEAR, DETECT, runs, stated, "<=", gates, found)


def _few(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    """The numbers of runs that a plan gives for many components."""
    gates, settings = QUICK_GATES if quick else GATES, Settings(FALSE_ALARM, DETECT, POWER)
    for (n, runs), rates in FEW.items():
        for k, (world, stated) in enumerate(zip(("10 % x6", "5 % x11"), rates, strict=True)):
            rng = np.random.default_rng((seed, 115, k, n, runs))
            draw = UNEVEN[world][0]
            found = sum(verdict_of(rng, draw(rng, runs), n, settings, True).consistent for _ in range(gates))
            yield row(f"{world}, steps independent, n = {n}", CLEAR, DETECT, runs, stated, "<=", gates, found)


def _decided(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    if quick:
        return
    for k, ((world, n), stated) in enumerate(DECIDED_CLEARED.items()):
        rng = np.random.default_rng((seed, 116, k))
        gates = [_decision(rng, UNEVEN[world][0](rng, MOST), n) for _ in range(GATES)]
        found, took = sum(consistent for consistent, _ in gates), [runs for _, runs in gates]
        yield row(f"{world}, n = {n}", DECIDED, DETECT, MOST, stated, "<=", GATES, found) | {
            "looks": 0,
            "mean_runs": round(float(np.mean(took)), 1),
            "late_runs": float(np.quantile(took, 0.95, method="higher")),
        }


def _decision(rng: np.random.Generator, squares: Array, n: int) -> tuple[bool, int]:
    """Is it consistent once it is decided, and after how many runs is it?"""
    error = np.repeat(np.sqrt(squares)[:, None, None] * rng.standard_normal((MOST, 1, n)), ALIKE, axis=1)
    record = make_record("uneven", error, shared(np.eye(n), error))
    verdict, runs = follow(sequential_design(n, DETECT, FALSE_ALARM, POWER, MOST), record.first_runs)
    return verdict.consistent, runs


def _named(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    gates = QUICK_GATES if quick else GATES
    for k, (world, (ratio, bound, stated)) in enumerate(BLOCKS.items()):
        rng = np.random.default_rng((seed, 117, k))
        scale = np.sqrt([2.2, 2.2, 2.2, 1.0, 1.0, ratio])
        found = 0
        for _ in range(gates):
            error = scale * stationary(rng.standard_normal((BLOCK_RUNS, BLOCK_STEPS, 6)), 0.9, axis=1)
            record = make_record(
                "uneven", error, shared(np.eye(6), error), axes=("x", "y", "z", "roll", "pitch", "yaw")
            )
            found += "attitude right" in judge(record, Settings(FALSE_ALARM)).reasons[0]
        yield row(world, NAMED, ratio, BLOCK_RUNS, stated, bound, gates, found)


def _planned(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    pilots = QUICK_PILOTS if quick else PILOTS
    for k, (world, pilot) in enumerate(PLANS.items()):
        for ratio, stated in ((SLIGHT, pilot.power), (1.0 / SLIGHT, pilot.power_large)):
            rng = np.random.default_rng((seed, 113, k, int(ratio > 1.0)))
            found = sum(_is_found(rng, pilot, ratio) for _ in range(pilots))
            yield row(world, PLANNED, ratio, PILOT_RUNS, stated, ">=", pilots, found)


def _is_found(rng: np.random.Generator, pilot: Pilot, ratio: float) -> bool:
    """Does the number of runs that a pilot gives find the ratio?"""
    runs = pilot_plan(pilot.means(rng, PILOT_RUNS), pilot.dof, LONG, ratio).runs
    test = scale_test(ratio * pilot.means(rng, runs), pilot.dof, LONG)
    return test.p_value <= SHARES[MAIN] * FALSE_ALARM


def _white(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    draws, share = QUICK_DRAWS if quick else DRAWS, 0.5 * FALSE_ALARM  # scale has the other half
    for m, runs in INNOVATIONS.items():
        rng = np.random.default_rng((seed, 114, m))
        found = sum(_p_of_white(rng, runs, m) <= share for _ in range(draws))
        yield row(f"{m} components", WHITE, 1.0, runs, share, "<=", draws, found)


def _p_of_white(rng: np.random.Generator, runs: int, m: int) -> float:
    innovation = rng.standard_normal((runs, 20, m))
    return whiteness(innovation, shared(np.eye(m), innovation)).p_value
