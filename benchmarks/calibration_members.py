"""Ensembles, their mean and covariance, and repeats without truth: is a right one called a fault, a wrong one right?

Truth and members are drawn from one distribution, the truth with its deviation from the mean times the root of the
ratio. ``calibration.py`` puts the rows into its table.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from calibration_gates import row, stationary

import consistency as cs
from consistency.diagnostics import Verdict
from consistency.referee.types import Array

RUNS, STEPS = 60, 10
GATES, SOME_GATES, SLOW_GATES, QUICK_GATES = 2000, 400, 60, 40  # by what a verdict costs
SHAPES: dict[str, Callable[[Array], Array]] = {
    "Gaussian": lambda z: z,
    "skewed": lambda z: np.expm1(z),  # log-normal
    "heavy-tailed": lambda z: z * np.abs(z),
}
# members, components, shape, errors of a run; the ranks of one component are the same in any shape
RANKS = (
    *((m, n, "Gaussian", "AR(.5)") for m in (10, 20, 100) for n in (1, 3)),
    *((m, 1, "Gaussian", "constant") for m in (10, 20, 100)),
    *((m, 3, shape, "AR(.5)") for m in (10, 20, 100) for shape in ("skewed", "heavy-tailed")),
    (20, 3, "skewed", "constant"),
)  # fmt: skip
WIDE = ((20, 40, "Gaussian", "AR(.5)"), (100, 40, "Gaussian", "AR(.5)"))
ENSEMBLES = (*((N, 3, errors) for N in (5, 10, 50) for errors in ("AR(.5)", "constant")), (5, 8, "AR(.5)"))
REPEATS = tuple((N, n, spread) for N in (3, 5, 20) for n in (1, 3) for spread in (0, 1))
FALSE, RARE, POWER, CLEAR = (
    "ensembles and repeats, false alarm", "ensembles and repeats, false alarm at .1 %", "ensembles and repeats, power",
    "ensembles and repeats, wrong all-clear",
)  # fmt: skip
ABOUT = {
    FALSE: "right members, a right mean and covariance of members, or right repeats are found at fault",
    RARE: "the same where the rate of false alarms is .1 %",
    POWER: "a covariance wrong by that ratio is found at fault",
    CLEAR: "a covariance wrong by exactly `detect` is called consistent",
    **{f"{m} members, n = {n}, {shape}, {errors}": f"ranks among {m} members of {n} components, {shape}; truth {errors}"
       for m, n, shape, errors in (*RANKS, *WIDE)},
    **{f"--ensemble {N}, n = {n}, {errors}": f"mean and covariance of {N} Gaussian members; truth {errors}"
       for N, n, errors in ENSEMBLES},
    **{f"{N} repeats, n = {n}, spread {spread:g}": f"{N} independent estimates of one value; log deviations have the "
       f"standard deviation {spread:g}" for N, n, spread in REPEATS},
}  # fmt: skip


def points(
    rng: np.random.Generator, m: int, n: int, errors: str, ratio: float, runs: int = RUNS
) -> tuple[Array, Array]:
    """Normal truth (runs, steps, n) and members (runs, steps, m, n), correlated by .6, the truth wrong by ``ratio``."""
    z = rng.standard_normal((runs, STEPS, n))
    z = stationary(z, 0.5, 1) if errors == "AR(.5)" else np.broadcast_to(z[:, :1], z.shape)
    root = np.linalg.cholesky(np.full((n, n), 0.6) + 0.4 * np.eye(n)).T
    return np.sqrt(ratio) * z @ root, rng.standard_normal((runs, STEPS, m, n)) @ root


def of_ranks(rng: np.random.Generator, ratio: float, m: int, n: int, shape: str, errors: str) -> Verdict:
    truth, members = points(rng, m, n, errors, ratio)
    return cs.judge(members=SHAPES[shape](members), truth=SHAPES[shape](truth))


def of_ensemble(rng: np.random.Generator, ratio: float, N: int, n: int, errors: str) -> Verdict:
    truth, members = points(rng, N, n, errors, ratio)
    mean = members.mean(axis=2, keepdims=True)
    P = np.swapaxes(members - mean, 2, 3) @ (members - mean) / (N - 1)
    return cs.judge(truth - mean[:, :, 0], P, ensemble=N)


def of_repeats(rng: np.random.Generator, ratio: float, N: int, n: int, spread: float) -> Verdict:
    s = np.exp(spread * rng.standard_normal((N, 1)))
    x = np.sqrt(ratio) * s * rng.standard_normal((N, n)) + 5.0
    return cs.judge(x, s[..., None] ** 2 * np.eye(n), truth="repeats", independent=True)


def cases() -> list[tuple[str, Callable[..., Verdict], tuple[Any, ...], int, int]]:
    """World, what draws and judges a gate of it, its arguments, runs and number of gates."""
    found: list[tuple[str, Callable[..., Verdict], tuple[Any, ...], int, int]] = []
    for case in (*RANKS, *WIDE):
        m, n, shape, errors = case
        gates = SLOW_GATES if case in WIDE else GATES if n == 1 else SOME_GATES
        found.append((f"{m} members, n = {n}, {shape}, {errors}", of_ranks, case, RUNS, gates))
    for N, n, errors in ENSEMBLES:
        gates = SLOW_GATES if n > N else SOME_GATES if N == 50 else GATES
        found.append((f"--ensemble {N}, n = {n}, {errors}", of_ensemble, (N, n, errors), RUNS, gates))
    for N, n, spread in REPEATS:
        found.append((f"{N} repeats, n = {n}, spread {spread:g}", of_repeats, (N, n, spread), N, GATES))
    return found


def rows_of(
    world: str, draw: Callable[..., Verdict], case: tuple[Any, ...], runs: int, gates: int, seed: int
) -> list[dict[str, Any]]:
    table = []
    for ratio in (1.0, 1.5):
        rng = np.random.default_rng((seed, *map(ord, world), round(100 * ratio)))
        found = [draw(rng, ratio, *case) for _ in range(gates)]
        faults = sum(bool(v.faults) for v in found)
        if ratio == 1.0:
            rare = sum(v.p_value <= 1e-3 for v in found)
            table.append(row(world, FALSE, ratio, runs, 0.05, "<=", gates, faults))
            table.append(row(world, RARE, ratio, runs, 1e-3, "<=", gates, rare))
            continue
        table.append(row(world, POWER, ratio, runs, 0.0, ">=", gates, faults))
        clear = sum(v.status == "consistent" for v in found)
        table.append(row(world, CLEAR, ratio, runs, 0.05, "<=", gates, clear))
    return table


def rows(quick: bool, seed: int, only: str = "", most: int = GATES) -> list[dict[str, Any]]:
    """Rows of the calibration table, of worlds whose name has the text ``only``, of ``most`` gates at most."""
    table = []
    for world, draw, case, runs, gates in cases()[::20] if quick else cases():
        if only in world:
            table += rows_of(world, draw, case, runs, QUICK_GATES if quick else min(gates, most), seed)
    return table
