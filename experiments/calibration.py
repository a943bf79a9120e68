"""Does the referee keep its promises? False-alarm rates and power of the verdict, measured over thousands of gates.

``calibration.py [GATES] [FILE]`` writes the table that docs/referee.md and the report's appendix show. Three worlds:

- ``independent``: NEES values drawn from chi-square(3), no errors given;
- ``autocorrelated``: Gaussian errors with lag-1 correlation 0.95 and a covariance that changes from step to step;
- ``linear-gaussian``: the Kalman filter on 100 steps of that scenario. The runs are drawn once; gates for false
  alarms are disjoint groups of them, gates for power are drawn without replacement within a gate.

The number of runs of a gate is what ``gate_runs`` plans for the ratio. A fault of ratio r is a stated covariance r
times smaller than the right one.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

import consistency as cs
from consistency.diagnostics import gate_runs, judge
from consistency.judge import curves

GATES, STEPS, DOF, SEED = 2000, 100, 3, 20070101
FALSE_ALARMS = (0.05, 0.01)
RATIOS = (1.2, 1.5, 2.0, 0.67)
HARDEST = 2.0  # ratio whose plan takes the fewest runs: there calibration is hardest
POWER = 0.95
CORRELATION = 0.95  # of the errors in neighbouring steps
CHUNK = 2000  # runs of the Kalman filter in memory at once
BATCH = 25  # gates handed to a worker at once

Gate = dict[str, Any]  # arguments of judge


def main(gates: int = GATES, power_gates: int | None = None, workers: int = 2) -> dict[str, Any]:
    """The table, as a JSON document."""
    started = time.monotonic()
    power_gates = power_gates or gates // 2
    rows = []
    with ProcessPoolExecutor(workers) as pool:
        pool_of_runs = kalman_runs(gates * max(gate_runs(DOF, HARDEST, a, POWER) for a in FALSE_ALARMS))
        for world in WORLDS:
            for false_alarm in FALSE_ALARMS:
                runs = gate_runs(DOF, HARDEST, false_alarm, POWER)
                drawn = WORLDS[world](np.random.default_rng((SEED, 1)), gates, runs, pool_of_runs, True)
                rows.append(_row(pool, world, drawn, 1.0, runs, false_alarm, gates))
            for ratio in RATIOS:
                runs = gate_runs(DOF, ratio, FALSE_ALARMS[0], POWER)
                drawn = WORLDS[world](np.random.default_rng((SEED, 2)), power_gates, runs, pool_of_runs, False)
                rows.append(_row(pool, world, drawn, ratio, runs, FALSE_ALARMS[0], power_gates))
    return {
        "steps": STEPS, "dof": DOF, "seed": SEED, "power": POWER, "rows": rows,
        "wall_time_s": round(time.monotonic() - started, 1),
    }  # fmt: skip


def promises_kept(row: dict[str, Any], confidence: float = 0.99) -> bool:
    """Is the row within its promise, as far as its number of gates can tell?

    False alarms: not above the stated rate (upper binomial quantile) and not below a fifth of it (lower
    quantile). Power: at least the stated one minus 2 points (lower quantile).
    """
    gates, found, rate = row["gates"], row["found"], row["false_alarm"]
    if row["ratio"] == 1.0:
        high = stats.binom.ppf(confidence, gates, rate)
        return bool(stats.binom.ppf(1 - confidence, gates, rate / 5) <= found <= high)
    return bool(found >= stats.binom.ppf(1 - confidence, gates, row["power"] - 0.02))


def _row(
    pool: ProcessPoolExecutor,
    world: str,
    drawn: Iterator[Gate],
    ratio: float,
    runs: int,
    false_alarm: float,
    gates: int,
) -> dict[str, Any]:
    wanted = None if ratio == 1.0 else "overconfident" if ratio > 1.0 else "conservative"
    found = 0
    pending = []
    for batch in _batches(drawn, ratio, false_alarm):
        pending.append(pool.submit(_statuses, batch))
        if len(pending) > 8:
            found += _count(pending.pop(0).result(), wanted)
    found += sum(_count(future.result(), wanted) for future in pending)
    row = {
        "world": world, "ratio": ratio, "runs": runs, "false_alarm": false_alarm, "power": POWER, "gates": gates,
        "found": found,
    }  # fmt: skip
    print(f"{world:<16} ratio {ratio:<4} {runs:>4} runs, false alarm {false_alarm}: {found} of {gates}", flush=True)
    return row


def _batches(drawn: Iterator[Gate], ratio: float, false_alarm: float) -> Iterator[list[Gate]]:
    batch: list[Gate] = []
    for gate in drawn:
        if "nees" in gate:
            gate["nees"] = gate["nees"] * ratio
        else:
            gate["covariance"] = gate["covariance"] / ratio
        batch.append(gate | {"false_alarm": false_alarm})
        if len(batch) == BATCH:
            yield batch
            batch = []
    if batch:
        yield batch


def _statuses(batch: list[Gate]) -> list[str]:
    for gate in batch:  # one covariance for all runs, sent once
        if "covariance" in gate:
            gate["covariance"] = np.broadcast_to(gate["covariance"], (len(gate["error"]), *gate["covariance"].shape))
    return [judge("gate", **gate).status for gate in batch]


def _count(statuses: list[str], wanted: str | None) -> int:
    return sum(status != "consistent" if wanted is None else status == wanted for status in statuses)


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
}


if __name__ == "__main__":
    table = main(int(sys.argv[1]) if len(sys.argv) > 1 else GATES)
    target = Path(sys.argv[2] if len(sys.argv) > 2 else "reports/calibration.json")
    target.write_text(json.dumps(table, indent=2) + "\n", encoding="utf-8")
    print(f"{table['wall_time_s']} s; {target}")
    sys.exit(not all(promises_kept(row) for row in table["rows"]))
