"""How often a fault that is the same in all steps is said to be in the first steps only.

    python benchmarks/first_steps.py [DRAWS]

Errors of runs that are overconfident, conservative or biased throughout, or right, with steps that depend on each other
in different ways; and, for the power, errors whose covariance is too small in the first steps alone. The share of hints
is printed with its exact 99 % interval; of uniform faults it may be 5 %.
"""

from __future__ import annotations

import itertools
import sys

import numpy as np
from calibration_gates import stationary
from scipy import stats

from consistency.diagnostics import Settings, judge, make_record
from consistency.referee.types import Array

WORLDS = {"independent": 0.0, "AR(0.9)": 0.9, "AR(0.99)": 0.99, "one error a run": 1.0}
RATIOS, BIASES = (0.3, 0.7, 1.0, 1.4, 4.0), (0.0, 0.5, 1.5)
SIZES = ((10, 100), (30, 20), (30, 500), (100, 100))
SETTINGS = Settings()


def errors(rng: np.random.Generator, rho: float, runs: int, steps: int, tails: bool) -> Array:
    """Errors (runs, steps, 3) of unit variance, each a stationary autoregression; t of 5 degrees where ``tails``."""
    e = rng.normal(size=(runs, steps, 3))
    if tails:
        e = rng.standard_t(5, size=e.shape) * np.sqrt(3.0 / 5.0)
    if rho == 1.0:
        return np.repeat(e[:, :1], steps, axis=1)
    return stationary(e, rho, 1)


def hinted(error: Array) -> tuple[bool, bool]:
    """Whether a fault was found, and said to be in the first steps only."""
    runs, steps, n = error.shape
    verdict = judge(make_record("filter", error, np.broadcast_to(np.eye(n), (runs, steps, n, n))), SETTINGS)
    assert verdict.location is not None
    return bool(verdict.faults), verdict.location.until is not None


def row(name: str, found: list[tuple[bool, bool]]) -> None:
    faults, hints, draws = sum(f for f, _ in found), sum(h for _, h in found), len(found)
    low, high = stats.binomtest(hints, draws).proportion_ci(0.99)
    share = f"{100 * hints / draws:5.1f} % [{100 * low:.1f}, {100 * high:.1f}]"
    print(f"{name:<34} {draws:>6} draws {faults:>6} at fault {hints:>5} hints {share}", flush=True)


def main(draws: int) -> None:
    rng = np.random.default_rng(11)
    cases = list(itertools.product(WORLDS, RATIOS, BIASES, SIZES, (False, True)))
    of_world: dict[str, list[tuple[bool, bool]]] = {name: [] for name in WORLDS}
    every = []
    for i in range(draws):
        world, ratio, bias, size, tails = cases[rng.integers(len(cases))] if i else cases[0]
        error = np.sqrt(ratio) * errors(rng, WORLDS[world], *size, tails) + np.array([bias, 0.0, 0.0])
        every.append(hinted(error))
        of_world[world].append(every[-1])
    for name, found in of_world.items():
        row(f"same in all steps, {name}", found)
    row("same in all steps", every)
    for (name, rho), (ratio, first) in itertools.product(WORLDS.items(), ((4.0, 5), (2.0, 20), (0.25, 10))):
        found = []
        for _ in range(max(draws // 40, 10)):
            error = errors(rng, rho, 50, 100, False)
            error[:, :first] *= np.sqrt(ratio)
            found.append(hinted(error))
        row(f"x{ratio:g} in {first} of 100, {name}", found)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2000)
