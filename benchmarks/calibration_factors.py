"""The factor by which a wrong bound has to grow: does its 95 % interval cover the right one, and how wide is it?

Intervals of all gates are found at once, by the tests and the search of ``Exceedance.factor``; the first gates of each
cell are compared with it. ``calibration.py`` puts the rows into its table.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
from calibration_bounds import CORRELATIONS, GATES, QUICK_GATES, WRONG, drawn, errors_of
from calibration_gates import row
from scipy.special import ndtri

from consistency.referee.diagnostics.exceedance import TAIL, Exceedance, gaffke
from consistency.referee.types import Array, Indices

CELLS = {0.68: 100, 0.95: 100, 0.99: 400}  # runs by level
STEPS, CHUNK, ALIKE = 50, 100, 3
NARROW = 1.5  # upper over lower end
CORRECTED_RUNS, HELD_OUT = (20, 60, 200), 200  # runs that ``correct`` has, and draws whose held-out rate is printed
COVERS, WIDTH, LEAVES = "bounds, factor covered", "bounds, factor known", "bounds, corrected"
ABOUT = {
    COVERS: "the 95 % interval of the factor by which a wrong bound must grow holds the right factor",
    WIDTH: f"the upper end of that interval is at most {NARROW:g} times the lower; nothing is promised",
    LEAVES: "a step of a new run leaves a bound that `correct` has corrected",
}


def rows(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Rows of the calibration table; the median interval of each cell is printed."""
    gates = QUICK_GATES if quick else GATES
    table: list[dict[str, Any]] = []
    for (q, runs), (name, phi) in product(CELLS.items(), CORRELATIONS.items()):
        world = f"{name}, {100 * q:g} %"
        for wrong in (WRONG, 1.0 / WRONG):
            rng = drawn(seed, f"{world} factor {wrong:.3g}", runs)
            low, high = _intervals(rng, phi, q, runs, wrong, gates)
            covered = int(((low <= wrong) & (wrong <= high)).sum())
            table.append(row(world, COVERS, wrong**2, runs, 0.95, ">=", gates, covered))
            table.append(row(world, WIDTH, wrong**2, runs, 0.0, ">=", gates, int((high <= NARROW * low).sum())))
            middle = " ".join(f"{np.median(end) / wrong:.3f}" for end in (low, high, high / low * wrong))
            print(f"{world} x{wrong:.3g}: median ends over the right factor, and their ratio: {middle}", flush=True)
    for runs, (name, phi) in product(CORRECTED_RUNS, CORRELATIONS.items()):
        world = f"{name}, 95 %"
        outside, rates = _corrected(drawn(seed, f"{world} corrected", runs), phi, 0.95, runs, gates)
        table.append(row(world, LEAVES, WRONG**2, runs, 0.05, "<=", gates, outside))
        rate, error = rates.mean(), 1.96 * rates.std() / len(rates) ** 0.5
        print(f"{world}, {runs} runs: held out, {rate:.4f} +- {error:.4f} leave the corrected bound", flush=True)
    return table


def _corrected(rng: np.random.Generator, phi: float, q: float, runs: int, gates: int) -> tuple[int, Array]:
    """Draws in which a step of a new run leaves the corrected bound, and the held-out rate of some draws."""
    found, rates = 0, []
    for gate in range(gates):
        r = np.abs(errors_of(rng, (runs + 1, STEPS), phi)) * WRONG / -ndtri((1.0 - q) / 2.0)
        factor, left_out = Exceedance(r[:-1], np.zeros(runs, int), q).covering_factors()
        found += int(r[-1, rng.integers(STEPS)] > factor)
        if gate < HELD_OUT:
            rates.append((r[:-1] > left_out[:, None]).mean())
    return found, np.array(rates)


def _intervals(
    rng: np.random.Generator, phi: float, q: float, runs: int, wrong: float, gates: int
) -> tuple[Array, Array]:
    """Ends (gates,) of the intervals of bounds of errors that are ``wrong`` times as large as they are right for."""
    ends = []
    for start in range(0, gates, CHUNK):
        shape = (min(CHUNK, gates - start), runs, STEPS)
        r = np.abs(errors_of(rng, shape, phi)) * wrong / -ndtri((1.0 - q) / 2.0)
        at = np.sort(np.concatenate([np.zeros((shape[0], 1)), r.reshape(shape[0], -1)], axis=1))

        def shares(i: Indices, r: Array = r, at: Array = at) -> Array:
            factor = at[np.arange(len(at)), np.minimum(i, at.shape[1] - 1)]
            return np.asarray((r > factor[:, None, None]).mean(axis=-1))

        found = (
            _first(lambda i: gaffke(shares(i), 1.0 - q) > TAIL, at),
            _first(lambda i: gaffke(1.0 - shares(i), q) <= TAIL, at),
        )
        if not start:
            for g in range(min(ALIKE, len(at))):
                one = Exceedance(np.asarray(r[g]), np.zeros(runs, int), q).factor()
                assert np.allclose((one.low, one.high), [end[g] for end in found]), (one, g)
        ends.append(found)
    low, high = np.concatenate(ends, axis=1)
    return low, high


def _first(holds: Callable[[Indices], Array], at: Array) -> Array:
    """The first of the factors (gates, K) of each gate for which something holds; infinite if for none."""
    low, high = np.zeros(len(at), int), np.full(len(at), at.shape[1])
    while (low < high).any():
        middle = (low + high) // 2
        is_there = holds(middle)
        open_ = low < high
        high = np.where(open_ & is_there, middle, high)
        low = np.where(open_ & ~is_there, middle + 1, low)
    return np.asarray(np.column_stack([at, np.full(len(at), np.inf)])[np.arange(len(at)), low])
