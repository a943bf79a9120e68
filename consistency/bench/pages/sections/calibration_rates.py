"""How often the referee itself is right: the measured table that is shipped with the package."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from consistency.bench.scenario import data_folder
from consistency.referee.diagnostics.nees import binomial_interval
from consistency.referee.show.blocks import Block, Cell, Column, Details, Facts, Table, Text

NAME = "calibration.json"
CONFIDENCE = 0.99  # of the interval of a measured share
HEADS = ("World", "What it is")
COLUMNS = (
    Column("True / stated covariance", "True / stated\ncovariance", number=True),
    Column("Runs", number=True),
    Column("Promised", number=True),
    Column("Gates", number=True),
    Column("Measured", number=True),
    Column("Worst world", width="1fr"),
    Column("99 % interval there", "99 % interval\nthere", number=True),
)


@dataclass(frozen=True)
class Rate:
    """Share of gates of one world that answered a question as is counted."""

    world: str
    question: str
    ratio: float  # of true to stated covariance; 1: nothing is wrong
    runs: int  # of a gate, at most
    looks: int  # 1, or 0 where a gate ends when it is decided
    mean_runs: float  # that a gate took
    promised: float
    at_most: bool  # the share is promised to be at most, else at least, that
    gates: int
    measured: float
    interval: tuple[float, float]  # exact binomial, Clopper & Pearson (1934)


@dataclass(frozen=True)
class Promise:
    """One promise in all worlds in which it was measured."""

    question: str
    rates: tuple[Rate, ...]  # alike in ratio, runs and promise

    @property
    def worst(self) -> Rate:
        """The world that is nearest to breaking the promise, or breaks it most."""
        return max(self.rates, key=lambda rate: rate.measured if rate.at_most else -rate.measured)

    @property
    def best(self) -> Rate:
        return min(self.rates, key=lambda rate: rate.measured if rate.at_most else -rate.measured)


@dataclass(frozen=True)
class Calibration:
    """Measured false alarms, power and wrong all-clears."""

    steps: int
    dof: int
    seed: int
    questions: dict[str, str]  # name -> what is counted
    worlds: dict[str, str]  # name -> what it is
    rates: tuple[Rate, ...]

    @property
    def gates(self) -> int:
        return sum(rate.gates for rate in self.rates)

    @property
    def promises(self) -> list[Promise]:
        """Rates by promise; questions in the order of ``questions``."""
        found: dict[tuple[Any, ...], list[Rate]] = {}
        for rate in sorted(self.rates, key=lambda rate: list(self.questions).index(rate.question)):
            key = rate.question, rate.ratio, rate.runs, rate.looks, rate.promised, rate.at_most
            found.setdefault(key, []).append(rate)
        return [Promise(str(key[0]), tuple(rates)) for key, rates in found.items()]


def calibration(path: Path | None = None) -> Calibration | None:
    """The table of ``path``, or the shipped one; None where there is none."""
    path = path or shipped()
    if path is None or not path.is_file():
        return None
    data = json.loads(path.read_text(encoding="utf-8"))
    rows, rates = data["rows"], list[Rate]()
    found = np.array([row["found"] for row in rows], float)
    gates = np.array([row["gates"] for row in rows], float)
    intervals = zip(*binomial_interval(found, gates, CONFIDENCE), strict=True)
    for row, (low, high) in zip(rows, intervals, strict=True):
        rates.append(Rate(
            row["world"], row["question"], row["ratio"], row["runs"], row["looks"], row.get("mean_runs", row["runs"]),
            row["stated"], row["bound"] == "<=", row["gates"], row["found"] / row["gates"], (float(low), float(high)),
        ))  # fmt: skip
    return Calibration(data["steps"], data["dof"], data["seed"], data["questions"], data["worlds"], tuple(rates))


def shipped() -> Path | None:
    """The file inside the wheel, else in the checkout."""
    places = (data_folder("reference"), data_folder("reports") / "reference")
    return next((place / NAME for place in places if (place / NAME).is_file()), None)


def calibration_rates() -> tuple[Block, ...]:
    """The promises of the referee, and how often they were kept; nothing where no table is shipped."""
    c = calibration()
    if c is None:
        return ()
    promises = Table(
        COLUMNS, promise_groups(c), "Promises of the referee, and how often they were kept", style="grouped"
    )
    worlds = Facts(tuple((name, about.replace("`", "")) for name, about in c.worlds.items()), HEADS, "4cm")
    return Text(text(c)), Details("Measured rates", (promises,)), Details("Worlds", (worlds,))


def promise_groups(c: Calibration) -> tuple[tuple[str, tuple[tuple[Cell, ...], ...]], ...]:
    """What is counted, and for each promise about it, in all its worlds, cells as COLUMNS."""
    promises = []
    for name, about in c.questions.items():
        rows = tuple(_row(promise) for promise in c.promises if promise.question == name)
        promises.append((f"{name}: {about.replace('`', '')}", rows))
    return tuple(promises)


def _row(promise: Promise) -> tuple[Cell, ...]:
    worst, best = promise.worst, promise.best
    low, high = worst.interval
    several = len(promise.rates) > 1
    ends = [f"{100 * rate.measured:.1f}" for rate in (best, worst)]
    gates = {rate.gates for rate in promise.rates}
    each = f"{min(gates)}" if len(gates) == 1 else f"{min(gates)} to {max(gates)}"
    return (
        "1, right" if worst.ratio == 1.0 else f"{worst.ratio:.3g}",
        str(worst.runs) if worst.looks else f"{worst.mean_runs:.0f}, {worst.runs} at most",
        f"{'≤' if worst.at_most else '≥'} {100 * worst.promised:g} %",
        f"{each} in {len(promise.rates)} worlds" if several else each,
        f"{' to '.join(dict.fromkeys(ends))} %",
        worst.world,
        f"{100 * low:.1f} to {100 * high:.1f} %",
    )


def text(c: Calibration) -> str:
    return (
        "A gate is one verdict on one group of runs. Each line is a promise of the referee: which share of gates is "
        "counted at most, or at least, and the shares measured, from the world where the promise is kept best to the "
        "one where it is kept worst. Where the true over the stated covariance is 1 the filter is right, however its "
        "errors depend on each other. Of gates that end when they are decided, the mean number of runs in the worst "
        "world stands first. "
        f"Measured over {c.gates} gates ({c.steps} steps, {c.dof} degrees of freedom where not said otherwise, seed "
        f"{c.seed}), with exact binomial intervals. A promise is broken where the whole interval is on its wrong side."
    )
