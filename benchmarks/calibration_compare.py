"""Does a comparison keep its false-alarm rate? Measured where it is hardest to keep: only one of the filters is slow.

Both filters are right. The runs of the slow one have one and the same error in all steps, those of the other 100
independent steps. ``calibration.py`` puts the rows into its table.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from calibration_gates import row

from consistency.diagnostics import RunSummary, compare

STEPS = 100
RUNS = (8, 21, 100)
STATES = (1, 3)
GATES, QUICK_GATES = {0.05: 1000, 0.01: 2000}, {0.05: 200, 0.01: 200}  # by the stated rate
PAIRS = {"slow against well mixed": True, "well mixed against slow": False}
QUESTION = "comparison, false alarm"
ABOUT = {
    **{f"{pair}, n = {dof}": f"two right filters of {dof} states" for pair in PAIRS for dof in STATES},
    QUESTION: "`compare` calls a right filter less consistent than another",
}


def rows(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Rows of the calibration table: a pair, a number of states, a number of runs and a rate each."""
    gates = QUICK_GATES if quick else GATES
    table = []
    for world, slow_first in PAIRS.items():
        for dof in STATES:
            for runs in RUNS:
                rng = np.random.default_rng((seed, int(slow_first), dof, runs))
                p = np.array([_p_value(rng, runs, dof, slow_first) for _ in range(max(gates.values()))])
                table += [
                    row(f"{world}, n = {dof}", QUESTION, 1.0, runs, rate, "<=", count, int((p[:count] <= rate).sum()))
                    for rate, count in gates.items()
                ]
    return table


def _p_value(rng: np.random.Generator, runs: int, dof: int, slow_first: bool) -> float:
    slow, mixed = (summary(rng.chisquare(k, runs) / k, dof) for k in (dof, STEPS * dof))
    a, b = (slow, mixed) if slow_first else (mixed, slow)
    return compare(a, b).p_value


def summary(means: np.ndarray, dof: int) -> RunSummary:
    none = np.empty((len(means), 0))
    return RunSummary(np.arange(len(means)), dof, means, none, none)
