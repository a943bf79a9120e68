"""How often the referee itself is right: the measured table that is shipped with the package."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scipy import stats

from consistency.scenario import data_folder

NAME = "calibration.json"
CONFIDENCE = 0.99  # of the interval of a measured share


@dataclass(frozen=True)
class Rate:
    """Share of gates in which a fault was found, for one world and one ratio of true to stated covariance."""

    world: str
    ratio: float  # 1: nothing is wrong
    runs: int  # of a gate, at most
    looks: int  # at which a gate may end early
    mean_runs: float  # that a gate took
    promised: float  # at most this false-alarm rate, or at least this power
    gates: int
    measured: float
    interval: tuple[float, float]  # exact binomial, Clopper & Pearson (1934)


@dataclass(frozen=True)
class Calibration:
    """Measured false-alarm rates and power."""

    steps: int
    dof: int
    seed: int
    false_alarms: tuple[Rate, ...]
    power: tuple[Rate, ...]

    @property
    def gates(self) -> int:
        """Verdicts in all rows together."""
        return sum(rate.gates for rate in self.false_alarms + self.power)


def calibration(path: Path | None = None) -> Calibration | None:
    """The table of ``path``, or the shipped one; None where there is none."""
    path = path or shipped()
    if path is None or not path.is_file():
        return None
    data = json.loads(path.read_text(encoding="utf-8"))
    rates = [_rate(row) for row in data["rows"]]
    right, wrong = (tuple(r for r in rates if (r.ratio == 1.0) == same) for same in (True, False))
    return Calibration(data["steps"], data["dof"], data["seed"], right, wrong)


def shipped() -> Path | None:
    """The file inside the wheel, else in the checkout."""
    places = (data_folder("reference"), data_folder("reports") / "reference")
    return next((place / NAME for place in places if (place / NAME).is_file()), None)


def _rate(row: dict[str, Any]) -> Rate:
    gates, found = int(row["gates"]), int(row["found"])
    ends = stats.binomtest(found, gates).proportion_ci(CONFIDENCE, "exact")
    promised = row["false_alarm"] if row["ratio"] == 1.0 else row["power"]
    return Rate(
        row["world"], row["ratio"], row["runs"], row.get("looks", 1), row.get("mean_runs", row["runs"]), promised,
        gates, found / gates, (float(ends.low), float(ends.high)),
    )  # fmt: skip
