"""Truth with a covariance of its own: is an honest filter called a fault, and is a wrong one found?

Errors of filter and truth are Gaussian with the covariances that they state; the truth has the share s of the sum.
Errors of the filter are AR(.5) over the steps. ``calibration.py`` puts the rows into its table.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from calibration_gates import row, stationary
from scipy import optimize

from consistency.diagnostics import Record, judge, make_record
from consistency.referee.types import Array

RUNS, STEPS, DOF = 50, 20, 3
SHARES = (0.2, 0.4)
DECLARED = {"white": "independent", "AR(.9)": "independent", "constant per run": "per-run", "common to all": "common"}
SIGNS = "common to all but for its sign"  # of each run: nothing can be declared
GATES, QUICK_GATES = 2000, 40
POWER = 0.3  # of what is not declared, at least: about half of it is found
DECLARED_POWER = 0.95
# kind, share, ratio -> what 50 runs reach: the sum is wrong by x0.7 alone, and every run has one error of the truth
REACHED = {("constant per run", 0.4, 0.5): 0.93}
FALSE, POWERS, BOUNDED, CONSISTENT = (
    "uncertain truth, false alarm", "uncertain truth, power", "uncertain truth, power without a declaration",
    "uncertain truth, wrong all-clear",
)  # fmt: skip
ABOUT = {
    **{
        f"truth {kind}, {how}, s = {s:g}": f"n = {DOF}; errors of the truth {kind}, {how}; {100 * s:.0f} % of the sum"
        for s in SHARES
        for kind in (*DECLARED, SIGNS)
        for how in ("declared", "not declared")
    },
    FALSE: "a right filter is found at fault against a truth with a covariance of its own",
    POWERS: "a wrong covariance is called as it is, and errors of the truth are declared",
    BOUNDED: "a wrong covariance is called as it is, and errors of the truth are not declared",
    CONSISTENT: "a covariance wrong by exactly `detect` is called consistent against such a truth",
}


def covariance(rng: np.random.Generator) -> Array:
    A = rng.standard_normal((DOF, DOF))
    return np.asarray(A @ A.T / DOF + 0.3 * np.eye(DOF))


def gate(rng: np.random.Generator, kind: str, s: float, ratio: float, errors: str | None) -> Record:
    """Errors of 50 runs with covariances P, and those of the truth beside them."""
    P, Q = covariance(rng), covariance(rng)
    Q *= optimize.brentq(lambda c: np.trace(np.linalg.solve(P + c * Q, c * Q)) / DOF - s, 1e-6, 1e6)
    e = (
        stationary(rng.standard_normal((RUNS, STEPS, DOF)), 0.5, 1) @ np.linalg.cholesky(ratio * P).T
        + errors_of_truth(rng, kind) @ np.linalg.cholesky(Q).T
    )
    shape = (RUNS, STEPS, DOF, DOF)
    return make_record(
        "gate", e, np.broadcast_to(P, shape), truth_covariance=np.broadcast_to(Q, shape), truth_errors=errors
    )


def errors_of_truth(rng: np.random.Generator, kind: str) -> Array:
    """Standard normal errors, (runs, steps, n)."""
    if kind in ("white", "AR(.9)"):
        white = rng.standard_normal((RUNS, STEPS, DOF))
        return white if kind == "white" else stationary(white, 0.9, 1)
    if kind == "constant per run":
        return np.broadcast_to(rng.standard_normal((RUNS, 1, DOF)), (RUNS, STEPS, DOF))
    one = np.broadcast_to(rng.standard_normal((1, 1, DOF)), (RUNS, STEPS, DOF))
    return one * rng.choice([-1.0, 1.0], (RUNS, 1, 1)) if kind == SIGNS else one


def rows(quick: bool, seed: int) -> list[dict[str, Any]]:
    table, gates = [], QUICK_GATES if quick else GATES
    for k, s in enumerate(SHARES[:1] if quick else SHARES):
        for kind in (*DECLARED, SIGNS):
            for errors in dict.fromkeys((DECLARED.get(kind), None)):
                how = "not declared" if errors is None else "declared"
                for ratio in (1.0, 2.0, 0.5, 1.5):
                    key = (seed, k, *map(ord, kind[:5]), len(how), round(100 * ratio))
                    rng = np.random.default_rng(key)
                    found = [judge(gate(rng, kind, s, ratio, errors)) for _ in range(gates)]
                    fault = sum(bool(v.faults) for v in found)
                    side = "overconfident" if ratio > 1.0 else "conservative"
                    power = REACHED.get((kind, s, ratio), DECLARED_POWER)
                    called = sum(v.status == side for v in found)
                    consistent = sum(v.status == "consistent" for v in found)
                    question, stated, bound, count = {
                        1.0: (FALSE, 0.05, "<=", fault),
                        1.5: (CONSISTENT, 0.05, "<=", consistent),
                    }.get(ratio, (POWERS, power, ">=", called) if errors else (BOUNDED, POWER, ">=", called))
                    world = f"truth {kind}, {how}, s = {s:g}"
                    if errors or s == SHARES[0] or bound == "<=":
                        table.append(row(world, question, ratio, RUNS, stated, bound, gates, count))
    return table
