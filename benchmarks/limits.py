"""What the referee does not promise: how often it errs in worlds that its rates do not cover.

    python benchmarks/limits.py                 # some two minutes
    python benchmarks/limits.py --gates 100     # quicker

Filters are right, and the share of gates is counted in which a fault is found nevertheless, at a stated 5 %. Of
deviations alone one axis is wrong, by as much as a verdict promises to find with a power of 95 %, and the share is
counted in which it is found. No other row is held to a promise: docs/reference/rates.md says how far off
the rate may be there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from calibration_compare import summary
from calibration_gates import Draw, first_order
from calibration_monitor import Monitors, Velocity
from calibration_windows import undoubted, windows_of
from scipy import stats
from script_options import options_of

from consistency.diagnostics import Verdict, compare, e_process, judge, make_record
from consistency.referee.readers.pipeline.arrays_in_memory import record_of_arrays
from consistency.referee.types import Array

Rng = np.random.Generator
SEED, GATES, RATE, DOF, STEPS = 20070101, 400, 0.05, 3, 100
SHARE = 0.05  # of the runs that are of the rare type, and of the chi-square that is theirs
LOST = stats.chi2.isf(0.05, DOF)  # NEES at which a run ends
FITTED, MISSION = (500, 10_000), 10_000  # steps of a log to which the covariance is fitted; that are monitored
CANDIDATES = 8, 21, 100  # runs of a comparison
AXES = 2, 3, 6, 12  # of an estimator that states deviations alone


@dataclass(frozen=True)
class Limit:
    """A world, what goes wrong in it, and how often it does: of ``gates`` gates, a number."""

    world: str
    what: str
    runs: int
    count: Callable[[int, Rng], int]


def typed(rng: Rng, runs: int) -> Array:
    """NEES (runs, steps): of 5 % of the runs from the upper 5 % of chi-square, of the others from the rest of it."""
    rare = rng.uniform(size=runs) < SHARE
    u = rng.uniform(size=(runs, STEPS))
    return np.asarray(stats.chi2.isf(np.where(rare[:, None], SHARE * u, SHARE + (1.0 - SHARE) * u), DOF))


def lost(rng: Rng, runs: int) -> Array:
    """NEES (runs, steps) of errors AR(.95); a run ends in the first step in which it is above its 95 % quantile."""
    nees = np.square(first_order(Draw(rng, runs, STEPS), np.float64(0.95), DOF)).sum(axis=-1)
    ended = np.cumsum(nees > LOST, axis=1) - (nees > LOST) > 0
    return np.asarray(np.where(ended, np.nan, nees))


def faults(draw: Callable[[Rng, int], Array], runs: int, gates: int, rng: Rng) -> int:
    """Gates in which any question finds a fault."""
    return sum(bool(judge(make_record("gate", nees=draw(rng, runs), dof=DOF)).faults) for _ in range(gates))


def unnamed(draw: Callable[[Rng, int], Array], runs: int, gates: int, rng: Rng) -> int:
    """Gates in which a fault is found and early ends are not named."""
    verdicts = (judge(make_record("gate", nees=draw(rng, runs), dof=DOF)) for _ in range(gates))
    return sum(bool(v.faults) and not (v.ends is not None and v.ends.lost) for v in verdicts)


def bets(draw: Callable[[Rng, int], Array], runs: int, gates: int, rng: Rng) -> int:
    """Gates in which the e-process ever reaches 1 / ``RATE``."""
    means = (draw(rng, runs).mean(axis=1) / DOF for _ in range(gates))
    return sum(bool(e_process(each, DOF).both.max() >= 1.0 / RATE) for each in means)


def fitted_monitor(steps: int, gates: int, rng: Rng) -> int:
    """Missions that alarm, with the covariance of innovations that makes the mean NIS of the first ``steps`` right."""
    world, monitors = Velocity(rng, gates), Monitors(gates, Velocity.dof, 1.0, None)
    nis, alarmed = np.empty((MISSION, gates)), np.zeros(gates, bool)
    for step in range(MISSION):
        nis[step] = world.nis()
        world.move(nis[step] <= np.inf)
    nis /= nis[:steps].mean(axis=0)
    for step in range(MISSION):
        alarmed |= monitors.update(nis[step]) >= 1.0 / RATE
    return int(alarmed.sum())


def mixed(rng: Rng, runs: int) -> Array:
    """Mean NEES of runs of independent steps, over its degrees of freedom."""
    return rng.chisquare(DOF * STEPS, runs) / (DOF * STEPS)


HEAVY: dict[str, Callable[[Rng, int], Array]] = {
    "t3 by run": lambda rng, runs: rng.chisquare(DOF * STEPS, runs) / (DOF * STEPS) / rng.chisquare(3.0, runs),
    "5 % of the runs make half of the mean": lambda rng, runs: (
        mixed(rng, runs) * np.where(rng.uniform(size=runs) < SHARE, 0.5 / SHARE, 0.5 / (1.0 - SHARE))
    ),
    "lognormal by run, sigma 1": lambda rng, runs: np.exp(rng.standard_normal(runs) - 0.5),
    "lognormal by run, sigma 2": lambda rng, runs: np.exp(2.0 * rng.standard_normal(runs) - 2.0),
}  # mean NEES of a run over its degrees of freedom, with the mean 1


def worse(candidate: Callable[[Rng, int], Array], reference: Callable[[Rng, int], Array], runs: int,
          gates: int, rng: Rng) -> int:  # fmt: skip
    """Comparisons in which the candidate is called less consistent."""
    both = ((summary(candidate(rng, runs), DOF), summary(reference(rng, runs), DOF)) for _ in range(gates))
    return sum(compare(a, b, RATE).worse for a, b in both)


def slow_sizes(gates: int, rng: Rng) -> int:
    """Logs of 200 windows in which a fault is found and independence is not doubted."""
    return sum(undoubted(windows_of(rng, 200, 0.98, slow=0.3)) for _ in range(gates))


def of_deviations(rng: Rng, runs: int, n: int, ratio: float) -> Verdict:
    """Verdict on deviations of n axes in one step, correlated by 0.5, of which the first is too small."""
    errors = rng.standard_normal((runs, 1, n)) + rng.standard_normal((runs, 1, 1))
    errors[..., 0] *= np.sqrt(ratio)
    stated = np.full(errors.shape, np.sqrt(2.0))
    return judge(record_of_arrays({"errors": errors, "deviations": stated}, None, "gate"))


def found_axes(n: int, ratio: float, runs: int, gates: int, rng: Rng) -> int:
    """Gates in which the wrong axis is found."""
    return sum(bool(of_deviations(rng, runs, n, ratio).parts["axis 0"].faults) for _ in range(gates))


def limits() -> Iterator[Limit]:
    for runs in (21, 50, 100):
        yield Limit("runs of two hidden types", "any fault", runs, partial(faults, typed, runs))
    yield Limit("runs of two hidden types", "e-process ever at 20", 100, partial(bets, typed, 100))
    for runs in (21, 50, 100):
        yield Limit("runs that end because they are lost", "any fault", runs, partial(faults, lost, runs))
    yield Limit("runs that end because they are lost", "any fault, ends not named", 50, partial(unnamed, lost, 50))
    for steps in FITTED:
        world = f"covariance fitted to the first {steps:,} of {MISSION:,} steps"
        yield Limit(world, "monitor alarms", 1, partial(fitted_monitor, steps))
    yield Limit("windows, 30 % of the sizes' variance AR(.98)", "any fault, not doubted", 200, slow_sizes)
    for name, heavy in HEAVY.items():
        for pair, a, b in (("against well mixed", heavy, mixed), ("both", heavy, heavy)):
            for runs in CANDIDATES:
                yield Limit(f"{name}, {pair}", "`compare` calls it worse", runs, partial(worse, a, b, runs))
    for n in AXES:
        scale = of_deviations(np.random.default_rng(SEED), 50, n, 1.0).scale
        assert scale is not None
        world = f"deviations alone, one of {n} axes too small by x{scale.detectable:.2f}"
        yield Limit(world, "it is found", 50, partial(found_axes, n, scale.detectable, 50))


def table(gates: int, seed: int, only: str = "") -> Iterator[str]:
    yield "| world | what is counted | runs | share |"
    yield "| --- | --- | --- | --- |"
    for number, limit in enumerate(limits()):
        if only not in limit.world:
            continue
        found = limit.count(gates, np.random.default_rng((seed, number)))
        low, high = stats.binomtest(found, gates).proportion_ci(0.95, "exact")
        share = f"{found / gates:.1%} [{low:.1%}, {high:.1%}]"
        yield f"| {limit.world} | {limit.what} | {limit.runs} | {share} |"


def main() -> None:
    options = options_of(
        __doc__,
        gates=(GATES, "of a row"),
        seed=(SEED, None),
        only=("", "rows with this in their worlds; the numbers are the same"),
    )
    for line in table(options.gates, options.seed, options.only):
        print(line, flush=True)


if __name__ == "__main__":
    main()
