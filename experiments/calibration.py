"""Does the referee keep its promises? False-alarm rates and power of the verdict, measured over thousands of gates.

``calibration.py [GATES] [FILE]`` writes the table that docs/referee.md and the report's appendix show. Three worlds:

- ``independent``: NEES values drawn from chi-square(3), no errors given;
- ``autocorrelated``: Gaussian errors with lag-1 correlation 0.95 and a covariance that changes from step to step;
- ``linear-gaussian``: the Kalman filter on 100 steps of that scenario. The runs are drawn once; gates for false
  alarms are disjoint groups of them; where they are too few for that (power, several looks) each gate draws its
  runs from all of them without replacement;
- ``fully dependent``: the same error in all steps of a run, where a trajectory is worth no more than one step.

The number of runs of a gate is what ``gate_runs`` plans for the ratio; for false alarms that of ratio 2, the fewest and
so the hardest. Rows with several looks are ``--until-decided``. A fault of ratio r is a stated covariance r
times smaller than the right one.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

import consistency as cs
from consistency.diagnostics import gate_runs, judge, sequential_design
from consistency.judge import curves

GATES, STEPS, DOF, SEED = 2000, 100, 3, 20070101
FALSE_ALARMS = (0.05, 0.01)
RATIOS = (1.2, 1.5, 2.0, 0.67)
HARDEST = 2.0  # ratio whose plan takes the fewest runs: there calibration is hardest
STOPPING = 1.5  # ratio for which --until-decided plans
POWER = 0.95
CORRELATION = 0.95  # of the errors in neighbouring steps
CHUNK = 2000  # runs of the Kalman filter in memory at once
BATCH = 25  # gates handed to a worker at once

Gate = dict[str, Any]  # arguments of judge


@dataclass(frozen=True)
class Case:
    """One row of the table: a world, a fault and a way of judging."""

    world: str
    ratio: float  # of true to stated covariance
    false_alarm: float
    looks: tuple[int, ...]  # runs at each; one look is a gate
    look_false_alarm: float

    @property
    def wanted(self) -> str | None:
        """The status that is right; None: any fault found is a false alarm."""
        return None if self.ratio == 1.0 else "overconfident" if self.ratio > 1.0 else "conservative"


def cases() -> list[Case]:
    """All rows."""
    rows = []
    for world in WORLDS:
        for false_alarm in FALSE_ALARMS:
            runs = gate_runs(DOF, HARDEST, false_alarm, POWER)
            rows.append(Case(world, 1.0, false_alarm, (runs,), false_alarm))
        for ratio in RATIOS:
            runs = gate_runs(DOF, ratio, FALSE_ALARMS[0], POWER)
            rows.append(Case(world, ratio, FALSE_ALARMS[0], (runs,), FALSE_ALARMS[0]))
        design = sequential_design(DOF, STOPPING, FALSE_ALARMS[0], POWER)
        for ratio in (1.0, STOPPING):
            rows.append(Case(world, ratio, FALSE_ALARMS[0], design.looks, design.look_false_alarm))
    return rows


def main(gates: int = GATES, power_gates: int | None = None, workers: int = 2) -> dict[str, Any]:
    """The table, as a JSON document."""
    started = time.monotonic()
    every = cases()
    of_pool = max(case.looks[-1] for case in every if case.ratio == 1.0 and len(case.looks) == 1)
    with ProcessPoolExecutor(workers) as pool:
        kalman = kalman_runs(gates * of_pool)
        rows = [_row(pool, case, gates if case.ratio == 1.0 else power_gates or gates // 2, kalman) for case in every]
    return {
        "steps": STEPS, "dof": DOF, "seed": SEED, "power": POWER, "rows": rows,
        "wall_time_s": round(time.monotonic() - started, 1),
    }  # fmt: skip


def promises_kept(row: dict[str, Any], confidence: float = 0.99) -> bool:
    """Is the row within its promise, as far as its number of gates can tell?

    False alarms: not above the stated rate (upper binomial quantile) and, of a gate, not below a fifth of it (lower
    quantile). Power: at least the stated one minus 2 points (lower quantile).
    """
    gates, found, rate = row["gates"], row["found"], row["false_alarm"]
    if row["ratio"] == 1.0:
        low = 0.0 if row["looks"] > 1 else stats.binom.ppf(1 - confidence, gates, rate / 5)
        return bool(low <= found <= stats.binom.ppf(confidence, gates, rate))
    return bool(found >= stats.binom.ppf(1 - confidence, gates, row["power"] - 0.02))


def markdown(table: dict[str, Any]) -> str:
    """The table as docs/referee.md has it."""
    lines = ["| world | runs | looks | stated | measured | gates |", "| --- | --- | --- | --- | --- | --- |"]
    for row in table["rows"]:
        rate = f"{100 * row['found'] / row['gates']:.1f} %"
        if row["ratio"] == 1.0:
            stated = f"false alarm {100 * row['false_alarm']:g} %"
        else:
            stated = f"x{row['ratio']:g} found with {100 * row['power']:g} %"
        looks = "1" if row["looks"] == 1 else f"{row['looks']}, {row['mean_runs']:.0f} runs on average"
        lines.append(f"| {row['world']} | {row['runs']} | {looks} | {stated} | {rate} | {row['gates']} |")
    return "\n".join(lines)


def _row(pool: ProcessPoolExecutor, case: Case, gates: int, kalman: Any) -> dict[str, Any]:
    runs = case.looks[-1]
    rng = np.random.default_rng((SEED, 1 if case.ratio == 1.0 else 2, len(case.looks)))
    disjoint = gates * runs <= len(kalman[0])
    drawn = WORLDS[case.world](rng, gates, runs, kalman, disjoint)
    pending, answers = [], []
    while batch := list(islice(drawn, BATCH)):
        pending.append(pool.submit(_judged, case, batch))
        if len(pending) > 8:
            answers += pending.pop(0).result()
    for future in pending:
        answers += future.result()
    found = sum(status != "consistent" if case.wanted is None else status == case.wanted for status, _ in answers)
    row = {
        "world": case.world, "ratio": case.ratio, "runs": runs, "looks": len(case.looks),
        "mean_runs": round(float(np.mean([used for _, used in answers])), 1), "false_alarm": case.false_alarm,
        "power": POWER, "gates": gates, "found": found,
    }  # fmt: skip
    print(
        f"{case.world:<16} ratio {case.ratio:<4} {runs:>4} runs in {len(case.looks)} looks, false alarm "
        f"{case.false_alarm}: {found} of {gates}", flush=True,
    )  # fmt: skip
    return row


def _judged(case: Case, batch: list[Gate]) -> list[tuple[str, int]]:
    """Status and runs used of each gate, at the first look that finds a fault or the last."""
    answers = []
    for gate in batch:
        status, used = "consistent", 0
        for used in case.looks:
            status = judge("gate", **_first(gate, used, case.ratio), false_alarm=case.look_false_alarm).status
            if status != "consistent":
                break
        answers.append((status, used))
    return answers


def _first(gate: Gate, runs: int, ratio: float) -> Gate:
    """The first runs of a gate, with a stated covariance that is ``ratio`` times too small."""
    if "nees" in gate:
        return gate | {"nees": gate["nees"][:runs] * ratio}
    error, covariance = gate["error"][:runs], gate["covariance"] / ratio  # one covariance for all runs
    return {"error": error, "covariance": np.broadcast_to(covariance, (len(error), *covariance.shape))}


# --- worlds ------------------------------------------------------------------------------------------


def independent(rng: np.random.Generator, gates: int, runs: int, pool: Any, disjoint: bool) -> Iterator[Gate]:
    """Independent NEES values."""
    for _ in range(gates):
        yield {"nees": rng.chisquare(DOF, (runs, STEPS)), "dof": DOF}


def autocorrelated(rng: np.random.Generator, gates: int, runs: int, pool: Any, disjoint: bool) -> Iterator[Gate]:
    """Stationary first-order autoregressive errors seen through a root of the covariance of each step."""
    root = np.eye(DOF) + 0.3 * np.random.default_rng(SEED).standard_normal((STEPS, DOF, DOF))
    covariance = root @ np.swapaxes(root, -1, -2)
    fresh = np.sqrt(1.0 - CORRELATION**2)
    for _ in range(gates):
        w = rng.standard_normal((runs, STEPS, DOF))
        for k in range(1, STEPS):
            w[:, k] = CORRELATION * w[:, k - 1] + fresh * w[:, k]
        yield {"error": (root @ w[..., None])[..., 0], "covariance": covariance}


def fully_dependent(rng: np.random.Generator, gates: int, runs: int, pool: Any, disjoint: bool) -> Iterator[Gate]:
    """One error a run, the same in every step: the worst case that the plan is for."""
    for _ in range(gates):
        error = np.repeat(rng.standard_normal((runs, 1, DOF)), STEPS, axis=1)
        yield {"error": error, "covariance": np.broadcast_to(np.eye(DOF), (STEPS, DOF, DOF))}


def linear_gaussian(
    rng: np.random.Generator, gates: int, runs: int, pool: tuple[np.ndarray, np.ndarray], disjoint: bool
) -> Iterator[Gate]:
    """The exact Kalman filter's errors."""
    error, covariance = pool
    for gate in range(gates):
        rows = slice(gate * runs, (gate + 1) * runs) if disjoint else rng.choice(len(error), runs, replace=False)
        yield {"error": error[rows], "covariance": covariance}


def kalman_runs(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors (count, steps, 3) and the covariance (steps, 3, 3) that all runs share, from the first full rank on."""
    scenario = cs.load_scenario("linear-gaussian").variant("linear-gaussian-short", truth__steps=STEPS + 1)
    errors = []
    for chunk in range(-(-count // CHUNK)):
        c = curves(cs.run_trials(scenario, ["kf"], runs=min(CHUNK, count - chunk * CHUNK), seed=SEED + chunk), "kf")
        assert c.error is not None
        assert (c.covariance == c.covariance[0]).all()
        errors.append(c.error[:, 1:])
    return np.concatenate(errors), c.covariance[0, 1:]


WORLDS: dict[str, Callable[..., Iterator[Gate]]] = {
    "independent": independent,
    "autocorrelated": autocorrelated,
    "linear-gaussian": linear_gaussian,
    "fully dependent": fully_dependent,
}


if __name__ == "__main__":
    table = main(int(sys.argv[1]) if len(sys.argv) > 1 else GATES)
    target = Path(sys.argv[2] if len(sys.argv) > 2 else "reports/calibration.json")
    target.write_text(json.dumps(table, indent=2) + "\n", encoding="utf-8")
    print(f"{table['wall_time_s']} s; {target}")
    sys.exit(not all(promises_kept(row) for row in table["rows"]))
