"""How often the referee itself is right: the measured table that is shipped with the package."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scipy import stats

from consistency.scenario import data_folder

NAME = "calibration.json"
CONFIDENCE = 0.99  # of the interval of a measured share


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

    @property
    def broken(self) -> bool:
        """The whole interval lies on the wrong side of the promise."""
        low, high = self.interval
        return low > self.promised if self.at_most else high < self.promised


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
        """Verdicts in all rows together."""
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
    return Calibration(
        data["steps"], data["dof"], data["seed"], data["questions"], data["worlds"], tuple(_rates(data["rows"]))
    )


def shipped() -> Path | None:
    """The file inside the wheel, else in the checkout."""
    places = (data_folder("reference"), data_folder("reports") / "reference")
    return next((place / NAME for place in places if (place / NAME).is_file()), None)


def _rates(rows: Iterable[dict[str, Any]]) -> Iterable[Rate]:
    for row in rows:
        gates, found = int(row["gates"]), int(row["found"])
        ends = stats.binomtest(found, gates).proportion_ci(CONFIDENCE, "exact")
        yield Rate(
            row["world"], row["question"], row["ratio"], row["runs"], row["looks"], row.get("mean_runs", row["runs"]),
            row["stated"], row["bound"] == "<=", gates, found / gates, (float(ends.low), float(ends.high)),
        )  # fmt: skip
