"""A single log: does the interval of its covariance ratio hold 1, and does the length that it advises decide?

    python benchmarks/single_log.py                 # 2,000 logs a row, some three minutes
    python benchmarks/single_log.py --draws 300

Errors of logs are white, or AR(1) with a correlation of neighbouring steps; their covariance is right. The first table
has the share of logs that get an interval, the share of these intervals that hold 1, and their median width (upper
over lower end). The second has what becomes of logs of the length that a pilot advised, cut into the pieces that it
advised. Exit status 1 if an interval that belongs to a long log is wrong more often than 5 %, or a cut log raises more
false alarms (binomial, 1 % for all rows together).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np
from calibration_gates import stationary
from scipy import stats
from script_options import options_of

from consistency.diagnostics import Settings, judge, make_record
from consistency.referee.diagnostics.planning import within
from consistency.referee.types import Array

WORLDS = [
    (0.0, 100, 3), (0.0, 1000, 3), (0.0, 1000, 1), (0.9, 1000, 3), (0.95, 1000, 1), (0.95, 1000, 3), (0.95, 1000, 6),
    (0.95, 10_000, 3), (0.99, 10_000, 3), (0.98, 1000, 3), (0.99, 1000, 3), (0.999, 1000, 3),
]  # fmt: skip  # correlation, steps, components
PROMISED = 50.0  # correlation times of the NEES in a log from which on its interval is held to 95 %
PILOTS = [(0.0, 1000, 3), (0.95, 1000, 3), (0.95, 1000, 6)]
RATE, SURE = 0.05, 0.01  # of what is promised; probability that rates exactly as promised are called broken
ROWS = len(WORLDS) + len(PILOTS)
SETTINGS = Settings(RATE)


def errors(rng: np.random.Generator, rho: float, steps: int, n: int) -> Array:
    """Standard normal errors (steps, n), neighbours correlated by ``rho``."""
    return stationary(rng.normal(size=(steps, n)), rho)


def coverage(draws: int, seed: int) -> Iterator[tuple[str, bool]]:
    """Rows of the first table, and whether they keep what is promised."""
    for number, (rho, steps, n) in enumerate(WORLDS):
        told, held, widths = 0, 0, []
        for k in range(draws):
            rng = np.random.default_rng((seed, number, k))
            found = within(np.square(errors(rng, rho, steps, n)).sum(axis=1), n, SETTINGS, SETTINGS.factor)
            if found is not None:
                told += 1
                held += found.ratio.holds(1.0)
                widths.append(found.ratio.high / found.ratio.low)
        memory = (1.0 + rho**2) / (1.0 - rho**2)
        low, high = stats.binomtest(held, max(told, 1)).proportion_ci(0.95, "exact")
        kept = steps < PROMISED * memory or bool(stats.binom.cdf(held, told, 1.0 - RATE) > SURE / ROWS)
        share = f"{held / max(told, 1):.1%} [{low:.1%}, {high:.1%}]"
        width = f"x{np.median(widths):.2f}" if widths else ""
        yield (
            f"| {_name(rho)}, n = {n} | {steps} | {steps / memory:.0f} | {told / draws:.1%} | {share} | {width} |", kept
        )  # fmt: skip


def decided(draws: int, seed: int) -> Iterator[tuple[str, bool]]:
    """Rows of the second table, and whether they keep what is promised."""
    for number, (rho, steps, n) in enumerate(PILOTS):
        for ratio in (1.0, SETTINGS.detect):
            counts, lengths, faults = dict.fromkeys(("consistent", "overconfident"), 0), [], 0
            for k in range(draws):
                rng = np.random.default_rng((seed, 79, number, round(100 * ratio), k))
                pilot = within(np.square(errors(rng, rho, steps, n)).sum(axis=1), n, SETTINGS, SETTINGS.factor)
                if pilot is None or pilot.steps is None or pilot.pieces is None:
                    continue
                length = pilot.steps // pilot.pieces
                lengths.append(pilot.steps)
                log = np.sqrt(ratio) * errors(rng, rho, length * pilot.pieces, n)
                cut = log.reshape(pilot.pieces, length, n)
                P = np.broadcast_to(np.eye(n), (*cut.shape, n))
                verdict = judge(make_record("log", cut, P), SETTINGS)
                faults += bool(verdict.faults)
                if verdict.status in counts:
                    counts[verdict.status] += 1
            said = " | ".join(f"{count / len(lengths):.1%}" for count in counts.values())
            kept = ratio != 1.0 or bool(stats.binom.sf(faults - 1, len(lengths), RATE) > SURE / ROWS)
            share = f"{faults / len(lengths):.1%}"
            yield f"| {_name(rho)}, n = {n} | x{ratio:g} | {np.median(lengths):.0f} | {said} | {share} |", kept


def _name(rho: float) -> str:
    return "white" if not rho else f"AR({str(rho).lstrip('0')})"


def main() -> None:
    options = options_of(
        __doc__,
        draws=(2000, "logs a row"),
        seed=(80808, None),
    )
    broken = []
    print("| errors | steps | correlation times | told | holds 1 | width |\n| --- | --- | --- | --- | --- | --- |")
    for line, kept in coverage(options.draws, options.seed):
        print(line, flush=True)
        broken += [] if kept else [line]
    print("\n| errors | ratio | steps, median | consistent | overconfident | some fault |\n" + "| --- " * 6 + "|")
    for line, kept in decided(max(options.draws // 4, 1), options.seed):
        print(line, flush=True)
        broken += [] if kept else [line]
    print(f"\npromises broken: {len(broken)}", *broken, sep="\n")
    sys.exit(1 if broken else 0)


if __name__ == "__main__":
    main()
