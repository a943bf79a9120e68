"""Factors and floors of ``consistency correct`` where the truth is known.

    python benchmarks/correct.py                # 300 draws a row, about an hour on one core
    python benchmarks/correct.py --draws 50     # quicker

Errors are drawn with the covariance D P D + F, where P is stated. They depend on the step before by rho, from none to
nearly all. Printed for each row: how often the intervals of factor and floor hold the truth (their product where they
cannot be told apart), their width over that of an oracle, which knows the distribution of the fit over draws of the
same world, and the mean held-out ratio after; where nothing is wrong also how often each interval of a factor holds 1,
and how often a factor is said to be needed. Then factors by group (``--by``), and, for estimators that no factor can
mend, how often "consistent after" is said. Exit status 1 if a promise is broken (binomial, 1 % for all rows together).
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy import stats
from script_options import options_of

from consistency.referee.diagnostics.groups import Groups
from consistency.referee.diagnostics.nees import binomial_interval
from consistency.referee.diagnostics.record import Record, make_record
from consistency.referee.diagnostics.scale import run_means
from consistency.referee.diagnostics.whitening import squared_length, whiten
from consistency.referee.fit_covariance.correct import are_needed, correct, fit_groups, with_factors
from consistency.referee.fit_covariance.factors import (
    SAME,
    Factors,
    Fit,
    blocks_of,
    fit_alone,
    fit_runs,
    fit_with_floors,
)
from consistency.referee.types import Array

NAMES = ("x", "y", "z", "roll", "pitch", "yaw", "vx", "vy", "vz", "bgx", "bgy", "bgz", "bax", "bay", "baz")
STEPS = 30
COVERED, FEW, OF_FEW, WIDE = 0.92, 10, 0.90, 1.5
NEAR, FROM = 1.1, 30  # of the mean held-out ratio, from so many runs on
RIGHT, WRONG, SURE = (
    0.95,
    0.05,
    0.01,
)  # 1 inside, where P is right; wrong "consistent"; chance to call a kept promise broken


@dataclass(frozen=True)
class World:
    """An estimator with n components, and what its covariance has to become."""

    n: int
    runs: int
    rho: float  # dependence of a step on the one before
    factors: tuple[float, ...]  # of each block, the last one for all further blocks
    floors: tuple[float, ...] = (0.0,)  # over the median stated variance
    spread: float = 1.0  # sd of the logarithm of the stated covariance between steps

    def drawn(self, rng: np.random.Generator) -> Record:
        """Runs of the estimator; the shape of its covariance differs between draws."""
        P = self.stated(rng)
        C = self.true.applied(P)
        return record_of((np.linalg.cholesky(C) @ self.white(rng)[..., None])[..., 0], P)

    @property
    def is_right(self) -> bool:
        """Whether the stated covariance is that of the errors."""
        return set(self.factors) == {1.0} and set(self.floors) == {0.0}

    @property
    def true(self) -> Factors:
        """The right factors and floors."""
        blocks = blocks_of(NAMES[: self.n], self.n, False)
        last = len(self.factors) - 1, len(self.floors) - 1
        factor = [self.factors[min(b, last[0])] for b in range(len(blocks))]
        floor = [self.floors[min(b, last[1])] for b in range(len(blocks))]
        return Factors(blocks, np.array(factor), np.array(floor))

    def stated(self, rng: np.random.Generator) -> Array:
        A = rng.normal(size=(self.n, self.n))
        shape = A @ A.T / self.n + np.eye(self.n)
        size = np.exp(self.spread * rng.normal(size=(self.runs, STEPS, 1, 1)))
        return np.asarray(size * shape)

    def white(self, rng: np.random.Generator) -> Array:
        """Whitened errors (runs, STEPS, n)."""
        w = rng.normal(size=(self.runs, STEPS, self.n))
        for k in range(1, STEPS):
            w[:, k] = self.rho * w[:, k - 1] + np.sqrt(1.0 - self.rho**2) * w[:, k]
        return np.asarray(w)


def record_of(error: Array, P: Array) -> Record:
    n = error.shape[-1]
    return make_record(
        "drawn", error, P, squared_length(whiten(error, P)), n, axes=NAMES[:n], runs=np.arange(len(error))
    )


class Row(NamedTuple):
    """What the draws of a world show; of its worst block."""

    covered: float
    width: float  # over the oracle's
    ratio: float  # held out, after
    one_inside: float  # NaN where something is wrong
    needed: float  # a factor is said to be needed


def before_dropping(record: Record, fit: Fit) -> Factors:
    """Factors with floors, as far as these can be told apart, whether or not they were kept."""
    blocks = fit.factors.blocks
    same = {note.partition(":")[0] for note in fit.notes if SAME in note}
    free = np.array([b for b, block in enumerate(blocks) if block.name not in same])
    if fit.factors.floor.any() or not len(free):
        return fit.factors
    return fit_with_floors(record, fit_alone(record, blocks), free).factors


def row_of(world: World, draws: int, rng: np.random.Generator) -> Row:
    """Fit draws of a world; of the factor and the floor of each block, where the floor is free."""
    true = world.true
    B = len(true.blocks)
    held = np.zeros((draws, 2 * B))
    logs, widths, ratios, needed = np.zeros((draws, B)), np.zeros((draws, B)), np.zeros(draws), np.zeros(draws)
    for i in range(draws):
        record = world.drawn(rng)
        fit = fit_runs(record, true.blocks)
        whole = before_dropping(record, fit).factor
        after = with_factors(record, [(factors,) for factors in fit.left_out])
        assert after.errors.nees is not None
        ratios[i] = run_means(after.errors.nees)[0].mean() / world.n
        needed[i] = are_needed([fit])
        for b, block in enumerate(true.blocks):
            factor, floor = fit.factor[b], fit.floor[b]
            same = any(SAME in note and note.startswith(block.name) for note in fit.notes)
            held[i, b] = factor.holds(true.factor[b] + true.floor[b] if same else true.factor[b])
            held[i, B + b] = same or floor.holds(true.floor[b])
            logs[i, b] = np.log(whole[b])
            widths[i, b] = np.log(factor.high / max(factor.low, 1e-12))
    oracle = 2 * stats.norm.isf(0.025) * logs.std(axis=0, ddof=1)
    ones = held[:, :B].mean(axis=0).min() if world.is_right else np.nan
    return Row(
        float(held.mean(axis=0).min()), float((np.median(widths, axis=0) / oracle).max()), float(ratios.mean()),
        float(ones), float(needed.mean()),
    )  # fmt: skip


def of_groups(runs: int, rho: float, draws: int, rng: np.random.Generator) -> float:
    """Share of intervals that hold the factor of a block, 4, 1 or 0.25 by the group that changes every ten steps."""
    world = World(6, runs, rho, (1.0,))
    sizes = np.array([4.0, 1.0, 0.25])
    held = np.zeros((draws, 3, 2))
    for i in range(draws):
        right = world.drawn(rng)
        index = np.repeat(rng.integers(0, 3, (runs, STEPS // 10)), 10, axis=1)
        assert right.errors.error is not None
        assert right.errors.covariance is not None
        record = record_of(right.errors.error * np.sqrt(sizes[index])[..., None], right.errors.covariance)
        groups = Groups("speed", ("low", "middle", "high"), index, (1.0, 2.0))
        fits = fit_groups(replace(record, groups=groups), world.true.blocks)
        for g, name in enumerate(groups.names):
            held[i, g] = [factor.holds(sizes[g]) for factor in fits[name].factor]
    return float(held.mean(axis=0).min())


WORLDS = (
    *(World(n, runs, rho, (30.0, 0.3, 3.0)) for n, runs, rho in product((2, 6), (10, 30, 100), (0.0, 0.9, 0.999))),
    *(World(15, 30, rho, (0.3, 30.0, 3.0, 1.0)) for rho in (0.0, 0.9, 0.999)),
    *(World(6, runs, rho, (1.0,)) for runs, rho in product((10, 30), (0.0, 0.9, 0.999))),
    *(World(3, runs, rho, (2.0,), (5.0,)) for runs, rho in product((10, 30, 100), (0.0, 0.9, 0.999))),
    *(World(6, 30, rho, (2.0, 1.0), (5.0, 0.5)) for rho in (0.0, 0.999)),
    *(World(3, runs, 0.9, (0.5,), (3.0,), 0.3) for runs in (10, 30)),
)

BY_GROUP = tuple(product((10, 30), (0.0, 0.9, 0.999)))


# --- what no factor mends ---------------------------------------------------------------------------------------------


def heavy(world: World, rng: np.random.Generator) -> Record:
    """Student's t with 3 degrees of freedom."""
    record = world.drawn(rng)
    assert record.errors.error is not None
    assert record.errors.covariance is not None
    tails = np.sqrt(3.0 / rng.chisquare(3.0, (world.runs, STEPS, 1)))
    return record_of(record.errors.error * tails, record.errors.covariance)


def biased(world: World, rng: np.random.Generator) -> Record:
    """A mean error of one sigma."""
    record = world.drawn(rng)
    assert record.errors.error is not None
    assert record.errors.covariance is not None
    sigma = np.sqrt(np.diagonal(world.true.applied(record.errors.covariance), axis1=2, axis2=3))
    return record_of(record.errors.error + sigma, record.errors.covariance)


def of_wrong_sign(world: World, rng: np.random.Generator) -> Record:
    """A correlation of 0.8 that is stated with the other sign."""
    n = world.n
    C = np.full((n, n), 0.8) + 0.2 * np.eye(n)
    sign = np.where(np.arange(n) % 2, -1.0, 1.0)
    error = world.white(rng) @ np.linalg.cholesky(C).T
    return record_of(error, np.broadcast_to(C * np.outer(sign, sign), (world.runs, STEPS, n, n)).copy())


def uneven(world: World, rng: np.random.Generator) -> Record:
    """One component four times as large as another of its block."""
    size = np.where(np.arange(world.n) == 0, 2.0, 0.5)
    return record_of(
        world.white(rng) * size, np.broadcast_to(np.eye(world.n), (world.runs, STEPS, world.n, world.n)).copy()
    )


MENDS_NONE: tuple[Callable[[World, np.random.Generator], Record], ...] = (heavy, biased, of_wrong_sign, uneven)


def broken(draws: int, rows: int, rng: np.random.Generator) -> Iterator[str]:
    """Print all rows; promises that are broken."""
    sure = SURE / rows
    for world in WORLDS:
        row = row_of(world, draws, rng)
        size = f"n {world.n:2d}, {world.runs:3d} runs, rho {world.rho:5.3f}"
        name = f"{size}, factors, floors {world.factors}, {world.floors}"
        right = f", 1 inside {row.one_inside:.3f}, said to be needed {row.needed:.3f}" if world.is_right else ""
        print(f"{name}: covered {row.covered:.3f}, width x{row.width:.2f}, ratio {row.ratio:.3f}{right}", flush=True)
        least = OF_FEW if world.runs <= FEW else COVERED
        if binomial_interval(round(row.covered * draws), draws, 1 - 2 * sure)[1] < least:
            yield f"{name}: intervals hold the truth in {row.covered:.1%}"
        if row.width > WIDE:
            yield f"{name}: intervals are x{row.width:.2f} as wide as the oracle's"
        if world.runs >= FROM and not 1 / NEAR < row.ratio < NEAR:
            yield f"{name}: the held-out ratio is {row.ratio:.3f}"
        if world.is_right and binomial_interval(round(row.one_inside * draws), draws, 1 - 2 * sure)[1] < RIGHT:
            yield f"{name}: 1 is outside in {1 - row.one_inside:.1%}"
        if world.is_right and binomial_interval(round(row.needed * draws), draws, 1 - 2 * sure)[0] > WRONG:
            yield f"{name}: a factor is invented in {row.needed:.1%}"
    for runs, rho in BY_GROUP:
        covered = of_groups(runs, rho, draws, rng)
        name = f"n  6, {runs:3d} runs, rho {rho:5.3f}, factors by group 4, 1, 0.25"
        print(f"{name}: covered {covered:.3f}", flush=True)
        least = OF_FEW if runs <= FEW else COVERED
        if binomial_interval(round(covered * draws), draws, 1 - 2 * sure)[1] < least:
            yield f"{name}: intervals hold the truth in {covered:.1%}"
    for make, runs, rho in product(MENDS_NONE, (30, 100), (0.0, 0.9)):
        world = World(3, runs, rho, (1.0,), spread=0.3)
        said = sum(correct(make(world, rng)).status == "consistent" for _ in range(draws))
        name = f"{make.__name__.replace('_', ' ')}, {runs} runs, rho {rho:.1f}"
        print(f"{name}: consistent after {said} of {draws}", flush=True)
        if binomial_interval(said, draws, 1 - 2 * sure)[0] > WRONG:
            yield f"{name}: consistent after in {said / draws:.1%}"
    for runs, rho in product((10, 30, 100), (0.0, 0.9, 0.999)):
        world = World(6, runs, rho, (9.0, 0.5))
        words = [correct(world.drawn(rng)).status for _ in range(draws)]
        shown = ", ".join(
            f"{word} {words.count(word) / draws:.0%}" for word in ("consistent", "undecided", "inconsistent")
        )
        print(f"off by factors alone, {runs} runs, rho {rho:.3f}: {shown}", flush=True)


def main() -> int:
    options = options_of(
        __doc__,
        draws=(300, "draws a row"),
        seed=(0, "of the draws"),
    )
    rows = len(WORLDS) + len(BY_GROUP) + 4 * len(MENDS_NONE)
    found = list(broken(options.draws, rows, np.random.default_rng(options.seed)))
    print("\n".join(found) or "all promises are kept")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
