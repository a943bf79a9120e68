"""Windows of a log that are declared to be independent: is a fault said without a doubt where they are not?

Signs of the errors are independent and their sizes are not: chi-square values whose normal scores are AR(1). Each
window by itself is right. Windows are judged as ``consistency analyse --relative 1 --windows independent`` judges them.
``calibration.py`` puts the rows into its table.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from calibration_gates import row, stationary
from scipy import stats

from consistency.diagnostics import judge, make_record
from consistency.referee.diagnostics.whiteness import ENOUGH, independence
from consistency.referee.types import Array

DOF = 3
MEMORIES = (0.3, 0.5, 0.8, 0.95)  # correlation of the normal scores of neighbouring sizes
WINDOWS = (ENOUGH, 200)
GATES, QUICK_GATES = 2000, 60
RIGHT, QUICK_RIGHT = 10_000, 1000  # logs whose windows are independent
FEW = (20, 60, 200, 1000)  # windows of those
UNDOUBTED, DOUBTED = "windows, fault without a doubt", "windows, doubted"
ABOUT = {
    **{
        f"sizes AR({rho:g})": f"windows whose sizes go on as AR({rho:g}), n = {DOF}; runs are windows"
        for rho in MEMORIES
    },
    **{f"independent windows, n = {n}": f"windows of a log with {n} components; runs are windows" for n in (1, 3)},
    UNDOUBTED: "windows that are declared to be independent, and are not, are found at fault without a word on it",
    DOUBTED: "windows that are independent are said not to seem so",
}


def windows_of(rng: np.random.Generator, count: int, rho: float, n: int = DOF, slow: float = 1.0) -> Array:
    """Whitened errors (count, n), each standard normal by itself; ``slow`` is the share of the scores that is AR."""
    score = np.sqrt(slow) * stationary(rng.standard_normal(count), rho)
    score += np.sqrt(1.0 - slow) * rng.standard_normal(count)
    way = rng.standard_normal((count, n))
    length = np.sqrt(stats.chi2.isf(stats.norm.sf(score), n))
    return np.asarray(way * (length / np.linalg.norm(way, axis=1))[:, None])


def undoubted(w: Array) -> bool:
    """A fault is found, and the windows are not doubted."""
    count, n = w.shape
    if independence(w).doubtful:
        return False
    covariance = np.broadcast_to(np.eye(n), (count, 1, n, n))
    return bool(judge(make_record("log", w[:, None], covariance, unit="window")).faults)


def rows(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Rows of the calibration table; ``runs`` are windows."""
    table = []
    for runs in WINDOWS[:1] if quick else WINDOWS:
        for rho in MEMORIES:
            rng, gates = np.random.default_rng((seed, runs, round(100 * rho))), QUICK_GATES if quick else GATES
            found = sum(undoubted(windows_of(rng, runs, rho)) for _ in range(gates))
            table.append(row(f"sizes AR({rho:g})", UNDOUBTED, 1.0, runs, 0.05, "<=", gates, found))
    for runs in FEW:
        for n in (1, 3):
            rng, gates = np.random.default_rng((seed, runs, n)), QUICK_RIGHT if quick else RIGHT
            found = sum(independence(rng.standard_normal((runs, n))).doubtful for _ in range(gates))
            table.append(row(f"independent windows, n = {n}", DOUBTED, 1.0, runs, 0.005, "<=", gates, found))
    return table
