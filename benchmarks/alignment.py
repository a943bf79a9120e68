"""Does a verdict on aligned files keep its promises? False alarms, and what a frame costs, over hundreds of draws.

A draw is 60 runs of a planar estimator in the world of the truth, or in another that is turned about z and shifted: in
one of its own for each run, or in one of all. ``make calibrate-alignment`` measures all rows and writes the table of
docs/reference/rates.md; ``--quick`` measures few draws of each row with fresh
random numbers, writes nothing, and fails where a rate is beyond its promise, by chance less than once in 5,000 times.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from scipy import signal, stats
from script_options import options_of

from consistency.diagnostics import Record, Settings, Verdict, judge, make_record
from consistency.referee.diagnostics.record import TruthFit
from consistency.referee.geometry import wrap
from consistency.referee.readers.alignment import Aligned, WorldTransform, clocks_and_frames, moved
from consistency.referee.readers.clocks import clock_shift
from consistency.referee.readers.places import Places
from consistency.referee.readers.truth_matching import Poses, make_poses
from consistency.referee.types import Array

SEED, RUNS, STEPS, DRAWS, OFTEN, FEWER, QUICK = 20261123, 60, 400, 500, 400, 100, 20
FALSE_ALARM = 0.05
QUICK_FAILURE = 1.0 / 5000.0
DT, SPEED, SPIN = 0.1, 3.0, 0.1  # s, m/s, rad a step by which the heading wanders
SIGMA = np.array([0.1, 0.15, 0.02])  # m, m, rad
FINER = 8  # samples of the truth for each estimate where clocks are set; 1 where they are right
FAULTS = ("overconfident", "conservative", "biased", "heavy-tailed", "inconsistent", "failed")
MODES = {"none": "none, in one world", "offset": "none, `--time-offset estimate`"} | {
    mode: f"`--align {mode}`" for mode in ("posyaw", "posyaw-all")
}
BEGIN, END = "<!-- alignment: begin -->", "<!-- alignment: end -->"


def white(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    return rng.standard_normal(shape)


def first_order(rng: np.random.Generator, shape: tuple[int, ...], correlation: float) -> Array:
    w = rng.standard_normal(shape) * np.sqrt(1.0 - correlation**2)
    w[:, 0] /= np.sqrt(1.0 - correlation**2)
    return np.asarray(signal.lfilter([1.0], [1.0, -correlation], w, axis=1))


def drift(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Partial sums of white noise, each over its own standard deviation."""
    sums = rng.standard_normal(shape).cumsum(axis=1)
    out: Array = sums / np.sqrt(np.arange(1.0, shape[1] + 1.0))[:, None]
    return out


def turn_on(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Half of the variance is a constant of the run, half is white."""
    return np.asarray(np.sqrt(0.5) * (white(rng, shape) + white(rng, (shape[0], 1, shape[2]))))


def differences(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Of neighbouring white ones: their sum over a run is next to nothing."""
    runs, steps, n = shape
    return np.asarray(np.diff(white(rng, (runs, steps + 1, n)), axis=1) / np.sqrt(2.0))


def periods(rng: np.random.Generator, shape: tuple[int, ...], count: float, axes: Sequence[int] = (0, 1, 2)) -> Array:
    """Gaussian, of so many periods over the run in these axes, with a phase of their own; white in the others."""
    angle = 2.0 * np.pi * count * np.arange(shape[1])[:, None] / shape[1]
    a, b, out = white(rng, (shape[0], 1, 3)), white(rng, (shape[0], 1, 3)), white(rng, shape)
    out[..., list(axes)] = (a * np.cos(angle) + b * np.sin(angle))[..., list(axes)]
    return out


def second_order(rng: np.random.Generator, shape: tuple[int, ...], period: float, decay: float) -> Array:
    """Oscillating, with this period and time constant in steps; stationary after ten time constants."""
    size, before = np.exp(-1.0 / decay), int(10 * decay)
    a, b = 2.0 * size * np.cos(2.0 * np.pi / period), -(size**2)
    variance = (1.0 - b) / ((1.0 + b) * ((1.0 - b) ** 2 - a**2))
    w = white(rng, (shape[0], before + shape[1], shape[2])) / np.sqrt(variance)
    return np.asarray(signal.lfilter([1.0], [1.0, -a, -b], w, axis=1)[:, before:])


@dataclass(frozen=True)
class World:
    """Whitened errors (runs, steps, 3) and how standard deviations grow."""

    about: str
    errors: Callable[[np.random.Generator, tuple[int, ...]], Array]
    grows: bool = False


WORLDS = {
    "white": World("errors of neighbouring steps are independent", white),
    "AR(.95)": World("errors of neighbouring steps correlate by 0.95", lambda r, s: first_order(r, s, 0.95)),
    "AR(.99)": World("errors of neighbouring steps correlate by 0.99", lambda r, s: first_order(r, s, 0.99)),
    "drift": World("odometry: errors are sums of independent ones, variances grow from step to step", drift, True),
    "constant": World("half of the variance is one error in all steps of a run, half is white", turn_on),
    "AR(-.5)": World("errors of neighbouring steps correlate by -0.5", lambda r, s: first_order(r, s, -0.5)),
    "differences": World("differences of independent errors", differences),
    "1 period": World("one period over the run", lambda r, s: periods(r, s, 1.0)),
    "1.5 periods": World("one and a half periods over the run", lambda r, s: periods(r, s, 1.5)),
    "1 period of heading": World("white, heading one period over the run", lambda r, s: periods(r, s, 1.0, (2,))),
    "2 periods of heading": World("white, heading two periods over the run", lambda r, s: periods(r, s, 2.0, (2,))),
    "AR(2)": World("oscillating, period 50, time constant 60 steps", lambda r, s: second_order(r, s, 50.0, 60.0)),
}


@dataclass(frozen=True)
class Case:
    """A kind of draw, and the ways in which it is read."""

    world: str
    ratio: float
    modes: tuple[str, ...]  # of --align; "offset": none, with --time-offset estimate
    steps: int = STEPS
    runs: int = RUNS
    draws: int = DRAWS


ALIGNED = ("posyaw", "posyaw-all")
NULL = [Case(world, 1.0, ALIGNED) for world in ("AR(.95)", "drift", "white")]
POWER = [
    Case("AR(.95)", 1.08, ("none", *ALIGNED)),
    Case("AR(.95)", 1 / 1.08, ("none", *ALIGNED), draws=FEWER),
    Case("AR(.95)", 1.16, ("none", *ALIGNED), 100, draws=FEWER),
    Case("white", 1.016, ("none", *ALIGNED), draws=FEWER),
    Case("AR(.99)", 1.2, ("none", *ALIGNED), draws=FEWER),
    Case("drift", 1.3, ("none", *ALIGNED), draws=FEWER),
]
FURTHER = [Case(world, 1.0, ALIGNED, 100, draws=FEWER) for world in ("AR(.95)", "AR(.99)", "constant")]
OSCILLATING = [
    *(Case(world, 1.0, ALIGNED, 20, draws=OFTEN) for world in ("AR(-.5)", "differences", "1 period")),
    *(Case(world, 1.0, ALIGNED, 100, draws=OFTEN) for world in ("1.5 periods", "2 periods of heading", "AR(2)")),
    Case("1 period of heading", 1.0, ("posyaw-all",), 20, draws=OFTEN),
]
OFFSET = [
    *(Case(world, 1.0, ("offset",), 100, draws=FEWER) for world in ("white", "AR(.95)", "drift")),
    *(Case("AR(.99)", 1.0, ("offset",), 100, runs, FEWER) for runs in (1, 5, 20)),
]


# --- draws --------------------------------------------------------------------------------------------------


def drawn(rng: np.random.Generator, case: Case) -> list[Poses]:
    """Runs in the world of the truth; the truth is known at ``FINER`` times as many instants."""
    world, shape = WORLDS[case.world], (case.runs, case.steps, 3)
    grown = np.sqrt(np.arange(1.0, case.steps + 1.0) / case.steps) if world.grows else np.ones(case.steps)
    sigma = SIGMA * grown[:, None]
    errors = np.sqrt(case.ratio) * sigma * world.errors(rng, shape)
    covariance = sigma[:, :, None] ** 2 * np.eye(3)
    finer = FINER if "offset" in case.modes else 1
    fine, extra = DT / finer, 2 * FINER
    count = finer * (case.steps + 1) + 2 * extra
    true_t = fine * (np.arange(count) - extra)
    runs = []
    for error in errors:
        heading = rng.uniform(-3, 3) + np.cumsum(rng.normal(0.0, SPIN / np.sqrt(finer), count))
        at = np.cumsum(fine * SPEED * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
        truth = np.column_stack([at, wrap(heading)])
        rows = extra + finer * np.arange(case.steps)
        estimate = truth[rows] - error
        estimate[:, 2] = wrap(estimate[:, 2])
        place = Places("row {}".format, np.arange(case.steps))
        stated = np.ones(case.steps, bool)
        runs.append(make_poses(place, true_t[rows], estimate, covariance, stated, true_t, truth, "planar", "so2", 0.01))
    return runs


def displaced(rng: np.random.Generator, runs: Sequence[Poses], mode: str) -> list[Poses]:
    """Runs in worlds of their own, or all in one."""
    if mode in ("none", "offset"):
        return list(runs)

    def frame() -> WorldTransform:
        return WorldTransform.about_z(rng.uniform(-np.pi, np.pi), rng.uniform(-50.0, 50.0, 2))

    one = frame()
    return [moved(p, one if mode.endswith("-all") else frame()) for p in runs]


def verdict(runs: Sequence[Poses], mode: str) -> Verdict:
    if mode in ("offset", "none"):
        shift, _ = clock_shift("bench", runs, "estimate" if mode == "offset" else 0.0)
        return judge(evidence(Aligned(runs, TruthFit()), shift), Settings(FALSE_ALARM))
    shift, _, found = clocks_and_frames("bench", runs, 0.0, mode, range(3))  # a number keeps the clocks out of it
    return judge(evidence(found, shift), Settings(FALSE_ALARM))


def evidence(found: Aligned, shift: float) -> Record:
    error = np.stack([p.errors(shift) for p in found.runs])
    record = make_record("bench", error, np.stack([p.own.covariance for p in found.runs]))
    return replace(record, fit=replace(found.fit, align="none", caption="", unseen=0.0))


def batch(case: Case, numbers: Sequence[int], seed: int) -> dict[str, Counter[str]]:
    """Verdicts of some draws by mode: statuses, and "fault" where any was found."""
    found: dict[str, Counter[str]] = {mode: Counter() for mode in case.modes}
    key = zlib.crc32(f"{case.world} {case.ratio} {case.steps} {case.runs}".encode())
    for number in numbers:
        rng = np.random.default_rng((seed, key, number))
        runs = drawn(rng, case)
        for mode in case.modes:
            v = verdict(displaced(rng, runs, mode), mode)
            found[mode].update([v.status, *(["fault"] if v.faults else [])])
    return found


# --- rows ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """What became of the draws of one case in one mode."""

    world: str
    ratio: float
    mode: str
    runs: int
    steps: int
    draws: int
    counts: dict[str, int]

    def share(self, status: str) -> tuple[float, float, float]:
        """Percent of a status, with Clopper and Pearson's 95 % interval."""
        k = self.counts.get(status, 0)
        interval = stats.binomtest(k, self.draws).proportion_ci(0.95)
        return 100.0 * k / self.draws, 100.0 * interval.low, 100.0 * interval.high


def measure(cases: Sequence[Case], seed: int, workers: int) -> Iterator[Row]:
    with ProcessPoolExecutor(workers) as pool:
        every = [
            [pool.submit(batch, case, range(k, min(k + 10, case.draws)), seed) for k in range(0, case.draws, 10)]
            for case in cases
        ]
        for case, futures in zip(cases, every, strict=True):
            parts = [future.result() for future in futures]
            for mode in case.modes:
                total = sum((part[mode] for part in parts), Counter())
                yield Row(case.world, case.ratio, mode, case.runs, case.steps, case.draws, dict(total))


def kept(row: Row, confidence: float) -> bool:
    """Is what was counted compatible with the promises, at this confidence?"""
    faults = row.counts.get("fault", 0)
    if row.ratio == 1.0:
        return bool(stats.binomtest(faults, row.draws, FALSE_ALARM, "greater").pvalue >= 1.0 - confidence)
    return True


def said(row: Row) -> str:
    statuses = ", ".join(f"{status} {row.counts[status]}" for status in FAULTS if row.counts.get(status))
    fault, low, high = row.share("fault")
    return (
        f"{row.world:<9} x{row.ratio:<6.4g} {row.mode:<11} {row.runs} runs of {row.steps}: found at fault "
        f"{fault:.1f} % [{low:.1f}, {high:.1f}] of {row.draws} draws ({statuses or 'none'}); "
        f"consistent {row.share('consistent')[0]:.1f} %"
    )


def write_docs(rows: Sequence[Row], path: Path) -> None:
    lines = ["| errors | covariance ratio | runs x steps | mode | found at fault | of these | consistent | draws |"]
    lines.append("| --- " * 8 + "|")
    for row in rows:
        fault, low, high = row.share("fault")
        of_these = ", ".join(f"{status} {row.counts[status]}" for status in FAULTS if row.counts.get(status)) or "–"
        lines.append(
            f"| {row.world} | {row.ratio:.4g} | {row.runs} x {row.steps} | {MODES[row.mode]} | "
            f"{fault:.1f} % [{low:.1f}, {high:.1f}] | {of_these} | {row.share('consistent')[0]:.1f} % | {row.draws} |"
        )
    text = path.read_text(encoding="utf-8")
    head, rest = text.split(BEGIN)
    path.write_text(f"{head}{BEGIN}\n\n" + "\n".join(lines) + f"\n\n{END}{rest.split(END)[1]}", encoding="utf-8")


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, write what is asked for, and say whether the promises are kept."""
    options = _options(arguments)
    fresh = int(np.random.SeedSequence().generate_state(1)[0])
    seed = options.seed if options.seed is not None else fresh if options.quick else SEED
    print(f"seed {seed}", flush=True)
    cases = [*NULL, *POWER, *FURTHER, *OSCILLATING, *OFFSET]
    cases = [case for case in cases if options.only in f"{case.world} {case.modes}"]
    if options.draws is not None:
        cases = [replace(case, draws=min(case.draws, options.draws)) for case in cases]
    if options.quick:
        right = [case for case in cases if case.ratio == 1.0 and case.runs >= RUNS]
        cases = list(dict.fromkeys(replace(case, draws=QUICK, steps=min(case.steps, 100)) for case in right))
    started, rows = time.monotonic(), []
    for row in measure(cases, seed, options.workers):
        rows.append(row)
        print(said(row), flush=True)
    table = {"seed": seed, "wall_time_s": round(time.monotonic() - started, 1), "rows": [asdict(row) for row in rows]}
    if options.out is not None:
        options.out.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
    if options.docs is not None:
        write_docs(rows, options.docs)
    confidence = 1.0 - QUICK_FAILURE / max(len(rows), 1) if options.quick else 0.99
    broken = [row for row in rows if not kept(row, confidence)]
    print(f"{table['wall_time_s']} s, {len(rows)} rows, promises broken: {len(broken)}", *map(said, broken), sep="\n")
    return int(bool(broken))


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    return options_of(
        "Measure verdicts on aligned files.",
        arguments,
        quick=(False, "few draws of right runs, with fresh random numbers"),
        out=(Path, "JSON file to write"),
        docs=(Path, "document whose table to replace"),
        only=("", "cases whose world or modes contain this text"),
        draws=(int, "of each case at most"),
        seed=(int, None),
        workers=(2, None),
    )


if __name__ == "__main__":
    sys.exit(main())
