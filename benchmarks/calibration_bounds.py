"""Bounds at a level: is a right one found at fault too often, and a wrong one called consistent?

Errors over bounds are drawn for all gates at once, and judged by the functions that a verdict on bounds calls; the rows
of whole verdicts show that it calls them so. ``calibration.py`` puts the rows into its table.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
from calibration_gates import row
from scipy.signal import lfilter
from scipy.special import ndtri

from consistency.diagnostics import Settings, judge
from consistency.referee.diagnostics.exceedance import betting, bound_runs, fewest_runs, gaffke
from consistency.referee.diagnostics.record import Bound, BoundErrors, Errors, Record
from consistency.referee.types import Array

STEPS, GATES, QUICK_GATES, CHUNK = 50, 2000, 100, 250
MANY_GATES = 20_000  # where shares are 0 or 1, so that tests are exact and each cell is near what is promised
VERDICTS, QUICK_VERDICTS = 400, 20
LEVELS, RUNS = (0.68, 0.95, 0.99), (30, 100, 400)
WRONG = 1.5  # ratio of covariances; the bound is wrong by its root, or for power by it
SIDE, SMALL_SIDE, SHOWN = 0.025, 0.0005, 0.05
FALSE, RARE, CLEAR, FLOOR, POWER, RIGHT, ENDS, WHOLE = (
    "bounds, false alarm", "bounds, false alarm at .1 %", "bounds, wrong all-clear", "bounds, below the fewest runs",
    "bounds, power", "bounds, all-clear", "bounds, measured ends", "bounds, whole verdicts",
)  # fmt: skip
CORRELATIONS = {"white": 0.0, "AR(.9)": 0.9, "AR(.99)": 0.99, "constant": 1.0}
ABOUT = {f"{name}, {100 * q:g} %": f"a bound of {100 * q:g} % on errors of a run that are {name}"
         for name in CORRELATIONS for q in LEVELS}  # fmt: skip
ABOUT |= {
    f"{kind}, {name}, {100 * q:g} %": f"{text}; {name}, a bound of {100 * q:g} %"
    for kind, text in (
        ("unlike lengths", "runs of 2 to 50 steps"),
        ("first outside", "runs end at the first step outside"),
        ("lost", "runs that are once beyond 1.5 bounds are lost"),
    )
    for name in CORRELATIONS
    for q in LEVELS
} | {
    FALSE: "a right bound is found too small or too large; its complement is how often the 95 % interval of the factor "
           "covers",
    RARE: "that at a false-alarm rate of .1 %, by the betting martingale",
    CLEAR: "a bound wrong by the root of `detect` is called consistent",
    FLOOR: "with fewer than ln(.05) / ln(level) runs, a right bound, or one wrong by a root of 1.5, is consistent or "
           "conservative",
    POWER: "a bound wrong by 1.5 is found, with the runs of `plan --level`",
    RIGHT: "a right bound is called consistent, with the runs of `plan --level`",
    ENDS: "a right bound is found at fault, steps after the end counted as the verdict does",
    WHOLE: "a right bound is found at fault in a whole verdict, and in bounds on two components",
}  # fmt: skip


def rows(quick: bool, seed: int, only: str = "") -> list[dict[str, Any]]:
    """Rows of the calibration table, of worlds whose name has the text ``only``."""
    table: list[dict[str, Any]] = []
    for name, phi in CORRELATIONS.items():
        for q in LEVELS:
            world = f"{name}, {100 * q:g} %"
            for runs in RUNS if only in world else ():
                gates = QUICK_GATES if quick else MANY_GATES if phi == 1.0 and runs == RUNS[-1] else GATES
                counts = _counted(drawn(seed, world, runs), phi, q, runs, gates)
                table.append(row(world, FALSE, 1.0, runs, 0.05, "<=", gates, counts["fault"]))
                if runs != RUNS[1]:
                    table.append(row(world, RARE, 1.0, runs, 0.001, "<=", gates, counts["rare"]))
                if runs < fewest_runs(q):
                    table.append(row(world, FLOOR, 1.0, runs, 0.0, "<=", gates, counts["floor"]))
                for ratio in (WRONG, 1.0 / WRONG) if runs == RUNS[-1] else ():
                    table.append(row(world, CLEAR, ratio, runs, 0.05, "<=", gates, counts[f"clear {ratio > 1.0}"]))
    gates = QUICK_GATES if quick else GATES
    for q in LEVELS:
        planned = bound_runs(q)
        world = f"constant, {100 * q:g} %"
        for question, ratio, needed in (
            (POWER, WRONG**2, planned.small), (POWER, WRONG**-2, planned.large), (RIGHT, 1.0, planned.consistent),
        ):  # fmt: skip
            if only not in world:
                continue
            assert needed is not None
            counts = _counted(drawn(seed, world, needed), 1.0, q, needed, gates, ratio**0.5)
            found = counts["shown" if ratio == 1.0 else "small" if ratio > 1.0 else "large"]
            table.append(row(world, question, ratio, needed, 0.95, ">=", gates, found))
    for kind in ENDED:
        for name, phi in CORRELATIONS.items():
            for q in LEVELS:
                world = f"{kind}, {name}, {100 * q:g} %"
                if only not in world:
                    continue
                counts = _counted(drawn(seed, world, 100), phi, q, 100, gates, end=ENDED[kind])
                table.append(row(world, ENDS, 1.0, 100, 0.05, "<=", gates, counts["fault"]))
    some = QUICK_VERDICTS if quick else VERDICTS
    for name in ("AR(.9)", "constant"):
        if only not in f"{name}, 95 %":
            continue
        rng = drawn(seed, f"{name} verdicts", 100)
        bad = sum(_is_fault(rng, CORRELATIONS[name]) for _ in range(some))
        table.append(row(f"{name}, 95 %", WHOLE, 1.0, 100, 0.05, "<=", some, bad))
    return table


def drawn(seed: int, world: str, runs: int) -> np.random.Generator:
    """Random numbers of one cell."""
    return np.random.default_rng((seed, zlib.crc32(world.encode()), runs))


def errors_of(rng: np.random.Generator, shape: tuple[int, ...], phi: float) -> Array:
    """Stationary unit Gaussian errors (..., steps)."""
    first = rng.standard_normal((*shape[:-1], 1))
    if phi == 1.0:
        return np.broadcast_to(first, shape)
    noise = rng.standard_normal(shape) * np.sqrt(1.0 - phi * phi)
    noise[..., :1] = first
    return np.asarray(lfilter([1.0], [1.0, -phi], noise, axis=-1))


def _whole(rng: np.random.Generator, outside: Array, sizes: Array) -> Array:
    return np.full(sizes.shape[:-1], sizes.shape[-1])


def _unlike(rng: np.random.Generator, outside: Array, sizes: Array) -> Array:
    return np.exp(rng.uniform(np.log(2), np.log(STEPS + 1), sizes.shape[:-1])).astype(int)


def _first_outside(rng: np.random.Generator, outside: Array, sizes: Array) -> Array:
    return np.where(outside.any(axis=-1), outside.argmax(axis=-1) + 1, STEPS)


def _lost(rng: np.random.Generator, outside: Array, sizes: Array) -> Array:
    return np.where((sizes > 1.5).any(axis=-1), 0, STEPS)


End = Callable[[np.random.Generator, Array, Array], Array]
ENDED: dict[str, End] = {"unlike lengths": _unlike, "first outside": _first_outside, "lost": _lost}


def _counted(
    rng: np.random.Generator, phi: float, q: float, runs: int, gates: int, size: float = 1.0, end: End = _whole
) -> dict[str, int]:
    """How many gates find what, where errors are ``size`` times those that the bound is right for."""
    counts: dict[str, int] = {}
    a, near = 1.0 - q, WRONG**0.5
    for start in range(0, gates, CHUNK):
        shape = (min(CHUNK, gates - start), runs, STEPS)
        r = np.abs(errors_of(rng, shape, phi)) * size / -ndtri(a / 2.0)
        length = end(rng, r > 1.0, r)
        there = np.arange(STEPS) < length[..., None]
        longest = np.maximum(length.max(axis=1, keepdims=True), 1)

        def shares(factor: float, r: Array = r, there: Array = there, longest: Array = longest) -> tuple[Array, Array]:
            outside = ((r > factor) & there).sum(axis=-1)
            missing = longest - there.sum(axis=-1)
            return outside / longest, (outside + missing) / longest

        low, high = shares(1.0)
        small, large = gaffke(low, a), gaffke(1.0 - high, q)
        found = {"fault": np.minimum(small, large) <= SIDE, "small": small <= SIDE, "large": large <= SIDE}
        found["rare"] = np.minimum(betting(low, a), betting(1.0 - high, q)) <= SMALL_SIDE
        if end is _whole:
            shown = {}
            for f in (near**-2, near**-1, 1.0, near, near**2):
                low, high = shares(f)
                shown[f] = gaffke(low, a) <= SHOWN, gaffke(1.0 - high, q) <= SHOWN
            found["shown"] = shown[near**-1][0] & shown[near][1]
            found["clear True"] = shown[near**-2][0] & shown[1.0][1]  # of a bound too small by the root of 1.5
            found["clear False"] = shown[1.0][0] & shown[near**2][1]
            found["floor"] = found["shown"] | found["clear True"] | found["clear False"] | found["large"]
        for name, each in found.items():
            counts[name] = counts.get(name, 0) + int(each.sum())
    return counts


def _is_fault(rng: np.random.Generator, phi: float) -> bool:
    """Whether a whole verdict finds right bounds of 95 % on two components at fault."""
    ratios = np.moveaxis(errors_of(rng, (2, 100, STEPS), phi), 0, -1) / -ndtri(0.025)
    bounds = (Bound("bound_x", ("x",), 0.95), Bound("bound_y", ("y",), 0.95))
    return bool(judge(Record("gate", Errors(bounded=BoundErrors(bounds, ratios))), Settings()).faults)
