"""Does a comparison keep its false-alarm rate? Measured where it is hardest to keep: only one of the filters is slow.

Both filters are right. The runs of the slow one have one and the same error in all steps, those of the other 100
independent steps. ``calibration.py`` puts the rows into its table.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from consistency.diagnostics import RunSummary, compare

STEPS = 100
RUNS = (8, 21, 100)
STATES = (1, 3)


def rows(gates_5: int, gates_1: int, seed: int) -> list[dict[str, Any]]:
    """One row a pair, number of states, number of runs and rate: ``gates_5`` at 5 %, ``gates_1`` at 1 %.

    The lower limit of other rows does not apply: the well-mixed filter is hardly ever called worse than the slow one.
    """
    table = []
    for world, slow_first in (("slow against well mixed", True), ("well mixed against slow", False)):
        for dof in STATES:
            for runs in RUNS:
                rng = np.random.default_rng((seed, int(slow_first), dof, runs))
                p = np.array([_p_value(rng, runs, dof, slow_first) for _ in range(max(gates_5, gates_1))])
                for rate, gates in ((0.05, gates_5), (0.01, gates_1)):
                    found = int((p[:gates] <= rate).sum())
                    row = {"world": f"compare, {world}", "dof": dof, "ratio": 1.0, "runs": runs, "looks": 1}
                    table.append(row | {"mean_runs": runs, "false_alarm": rate, "gates": gates, "found": found})
    return table


def _p_value(rng: np.random.Generator, runs: int, dof: int, slow_first: bool) -> float:
    slow, mixed = (_summary(rng.chisquare(k, runs) / k, dof) for k in (dof, STEPS * dof))
    a, b = (slow, mixed) if slow_first else (mixed, slow)
    return compare(a, b).p_value


def _summary(means: np.ndarray, dof: int) -> RunSummary:
    none = np.empty((len(means), 0))
    return RunSummary(np.arange(len(means)), dof, means, none, none)
