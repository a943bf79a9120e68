"""Does the question of the scale keep its rate where runs differ? One axis with one error in a share of the runs.

Run means of right filters are drawn directly: in a share of the runs one axis has one error in all steps; everything
else is well mixed. Intervals of the ratio are counted in the same worlds. ``calibration.py`` puts the rows into its
table.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from calibration_gates import row

from consistency.referee.diagnostics import Evidence, judge, ratio_interval
from consistency.referee.diagnostics.questions.scale import scale_test
from consistency.referee.types import Array

STEPS, GATE_STEPS = 2000, 300
# dimension, share of the runs, runs
WORLDS = ((3, 0.3, 34), (3, 0.5, 102), (6, 0.5, 21), (6, 0.5, 50), (6, 1.0, 21), (15, 1.0, 25))
QUICK = WORLDS[3:4]
DRAWS = {1e-3: 100_000, 1e-4: 300_000}  # of the question, by the stated rate
GATES, INTERVALS, QUICK_COUNT = 2000, 2000, 300
GATE_RATE, MISSED = 0.05, 0.05
QUESTION, INTERVAL = "scale where runs differ", "interval of true / stated misses"


def _world(n: int, share: float) -> str:
    return f"one axis constant in {share:.0%} of runs, n = {n}"


ABOUT = {
    **{
        _world(n, share): "one axis has one error in all steps of so many runs, the rest is white"
        for n, share, _ in WORLDS
    },
    QUESTION: "a right filter's scale is found wrong by this question alone",
    INTERVAL: "the 95 % interval does not hold 1",
}


def rows(quick: bool, seed: int) -> list[dict[str, Any]]:
    return list(_rows(quick, seed))


def _rows(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    for n, share, runs in QUICK if quick else WORLDS:
        world, rng = _world(n, share), np.random.default_rng((seed, 101, n, int(100 * share), runs))
        most = QUICK_COUNT if quick else max(DRAWS.values())
        p = np.array([scale_test(run_means(rng, n, share, runs), n, STEPS).p_value for _ in range(most)])
        for rate, draws in DRAWS.items():
            found = int((p[:draws] <= rate).sum())
            yield row(world, QUESTION, 1.0, runs, rate, "<=", min(draws, most), found)
        count = QUICK_COUNT if quick else INTERVALS
        missed = sum(not ratio_interval(run_means(rng, n, share, runs), n).holds(1.0) for _ in range(count))
        yield row(world, INTERVAL, 1.0, runs, MISSED, "<=", count, missed)
        if not quick:
            faults = sum(judge(_evidence(rng, n, share, runs)).p_value <= GATE_RATE for _ in range(GATES))
            yield row(world, "false alarm", 1.0, runs, GATE_RATE, "<=", GATES, int(faults))


def run_means(rng: np.random.Generator, n: int, share: float, runs: int) -> Array:
    """Mean NEES of each run over n, (runs,)."""
    constant = rng.random(runs) < share
    mixed = rng.chisquare(np.where(constant, n - 1, n) * STEPS) / STEPS
    return np.asarray((mixed + np.where(constant, rng.chisquare(1, runs), 0.0)) / n)


def _evidence(rng: np.random.Generator, n: int, share: float, runs: int) -> Evidence:
    error = rng.standard_normal((runs, GATE_STEPS, n))
    constant = rng.random(runs) < share
    error[constant, :, 0] = rng.standard_normal((int(constant.sum()), 1))
    return Evidence("spread", error=error, covariance=np.broadcast_to(np.eye(n), (*error.shape, n)))
