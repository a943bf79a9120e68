"""Does the monitor keep its promise? Alarms of right Kalman filters, and how long a fault goes unseen.

``calibration.py`` takes its rows from here; run alone, this script prints its tables. Two linear
filters, each exactly right for what it filters:

- ``position``: three random walks with gains of 0.2, 0.5 and 0.8, all measured in every step (3 degrees of freedom,
  one gate for all three);
- ``velocity``: a point at nearly constant velocity, its position measured (1 degree of freedom).

A fault of ratio r is a stated covariance, of everything the filter believes, that is r times smaller than the right
one: the gain is still the optimal one, and a gate rejects more or less. All missions of a world are filtered at once,
and monitored at once: :class:`Monitors` has the arithmetic of ``cs.Monitor``, and a test compares the two.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
from calibration_gates import row
from numpy.typing import NDArray

from consistency.referee.diagnostics.monitor import EXPONENT, LARGEST, bet_on, rest_after_rejection, start_share

Array = NDArray[Any]

STEPS, LATE = 10_000, 5_000  # of a mission; step after which a late fault begins
MISSIONS = {0.05: 1_000, 0.01: 2_000}  # by the stated false-alarm rate
QUICK_MISSIONS = {0.05: 200, 0.01: 200}
DELAYS, QUICK_DELAYS, PATIENCE = 500, 100, 5_000  # missions with a fault; steps that they are watched for
TOLERANCES = (1.0, 1.2)
GATES = (None, 0.99)
RATIOS = (1.5, 2.0, 0.5)
DELAY_RATE = 0.05  # stated false-alarm rate of the missions with a fault
SEED = 20240401

# half of the missions with a fault that begins in step 1, or after LATE, are found within so many steps:
# the exact test on the filter "position" without a gate
FOUND_WITHIN = {
    (1.5, 1): 45,
    (1.5, LATE + 1): 150,
    (2.0, 1): 16,
    (2.0, LATE + 1): 48,
    (0.5, 1): 25,
    (0.5, LATE + 1): 82,
}
ALARM = {tolerance: f"monitor, false alarm, tolerance {tolerance:g}" for tolerance in TOLERANCES}
FOUND = {1: "monitor, fault from step 1", LATE + 1: f"monitor, fault from step {LATE + 1:,}"}
ABOUT = {
    "position": "innovations of a Kalman filter of three random walks, gains 0.2, 0.5 and 0.8; runs are steps here",
    "position, gate 0.99": "the same with a gate that rejects 1 % of right innovations",
    "velocity": "innovations of a Kalman filter of position and velocity, position measured; runs are steps here",
    "velocity, gate 0.99": "the same with a gate that rejects 1 % of right innovations",
    **dict.fromkeys(ALARM.values(), "the monitor ever alarms on a right filter"),
    **dict.fromkeys(FOUND.values(), "the exact monitor at 5 % finds a stated covariance that is wrong from there on"),
}

Row = dict[str, Any]


class Position:
    """Three random walks, measured with a variance of 1; state and covariance are (3, missions)."""

    dof = 3
    gains = np.array([[0.2], [0.5], [0.8]])

    def __init__(self, rng: np.random.Generator, missions: int) -> None:
        self.rng = rng
        steady = self.gains / (1.0 - self.gains)  # predicted variance whose gain is that one
        self.noise = steady * self.gains
        self.P = np.tile(steady, missions)
        self.error = np.sqrt(steady) * rng.standard_normal((3, missions))

    def nis(self) -> Array:
        """The NIS (missions,) of the next measurement."""
        self.innovation = self.error + self.rng.standard_normal(self.error.shape)
        nis: Array = (np.square(self.innovation) / (self.P + 1.0)).sum(axis=0)
        return nis

    def move(self, accepted: Array) -> None:
        """Take the measurement where ``accepted`` (missions,), and predict the next step."""
        gain = np.where(accepted, self.P / (self.P + 1.0), 0.0)
        self.error -= gain * self.innovation
        self.error += np.sqrt(self.noise) * self.rng.standard_normal(self.error.shape)
        self.P += self.noise - gain * self.P


class Velocity:
    """Position and velocity with white acceleration; the position is measured with a variance of 1."""

    dof = 1
    F = np.array([[1.0, 1.0], [0.0, 1.0]])
    Q = 0.01 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])

    def __init__(self, rng: np.random.Generator, missions: int) -> None:
        self.rng = rng
        P = np.eye(2)
        for _ in range(1000):
            P = self.F @ (P - np.outer(P[0], P[0]) / (P[0, 0] + 1.0)) @ self.F.T + self.Q
        self.P = np.tile([P[0, 0], P[0, 1], P[1, 1]], (missions, 1)).T
        self.error = np.linalg.cholesky(P) @ rng.standard_normal((2, missions))
        self.root = np.linalg.cholesky(self.Q)

    def nis(self) -> Array:
        """The NIS (missions,) of the next measurement."""
        self.innovation = self.error[0] + self.rng.standard_normal(self.error.shape[1])
        nis: Array = np.square(self.innovation) / (self.P[0] + 1.0)
        return nis

    def move(self, accepted: Array) -> None:
        """Take the measurement where ``accepted`` (missions,), and predict the next step."""
        xx, xv, vv = self.P
        gain = np.where(accepted, self.P[:2] / (xx + 1.0), 0.0)
        error = self.F @ (self.error - gain * self.innovation)
        self.error = error + self.root @ self.rng.standard_normal(self.error.shape)
        xx, xv, vv = xx - gain[0] * xx, xv - gain[0] * xv, vv - gain[1] * xv
        self.P = np.stack([xx + 2.0 * xv + vv + self.Q[0, 0], xv + vv + self.Q[0, 1], vv + self.Q[1, 1]])


WORLDS: dict[str, type[Position] | type[Velocity]] = {"position": Position, "velocity": Velocity}


class Monitors:
    """``cs.Monitor`` for many missions at once, all innovations with the same degrees of freedom."""

    def __init__(self, missions: int, dof: int, tolerance: float, gate: float | None) -> None:
        bet = bet_on(dof, tolerance, gate)
        self.constant, self.slope = (np.array(values)[:, None] for values in zip(*bet.terms, strict=True))
        self.tolerance, self.limit, self.rest = tolerance, bet.limit, rest_after_rejection(gate)
        self.R = np.zeros((len(bet.terms), missions))
        self.judged, self.skip = np.zeros(missions, int), np.zeros(missions, int)
        self.share = np.array([start_share(k) for k in range(1, max(STEPS, LATE + PATIENCE) + 1)])
        self.unspent = 1.0 - np.concatenate([[0.0], np.cumsum(self.share)])

    def update(self, nis: Array) -> Array:
        """E-values (missions,) after this step's NIS (missions,)."""
        accepted = nis <= self.limit
        judged = accepted & (self.skip == 0)
        self.skip = np.where(accepted, np.maximum(self.skip - 1, 0), self.rest)
        ratio = np.exp(np.minimum(self.constant + self.slope * nis, EXPONENT))
        with np.errstate(over="ignore"):
            grown = np.minimum(ratio * (self.R + self.share[self.judged]), LARGEST)
        self.R = np.where(judged, grown, self.R)
        self.judged += judged
        evidence: Array = self.R.mean(axis=0) + self.unspent[self.judged]
        return evidence


def first_alarms(
    world: Position | Velocity, monitors: Sequence[Monitors], steps: int, ratio: float, rates: Sequence[float]
) -> Array:
    """Steps (monitors, rates, missions), counted from 1, of the first alarms; infinite where there is none.

    Stops as soon as every mission has alarmed at every rate.
    """
    missions = world.error.shape[1]
    first = np.full((len(monitors), len(rates), missions), np.inf)
    thresholds = 1.0 / np.array(rates)[:, None]
    for step in range(1, steps + 1):
        nis = ratio * world.nis()
        for i, monitor in enumerate(monitors):
            found = (monitor.update(nis) >= thresholds) & np.isinf(first[i])
            first[i][found] = step
        world.move(nis <= monitors[0].limit)
        if step % 50 == 0 and np.isfinite(first).all():
            break
    return first


def rows(quick: bool, seed: int) -> list[Row]:
    """Rows of the calibration table; ``runs`` are steps, and ``gates`` are missions."""
    missions, faults = (QUICK_MISSIONS, QUICK_DELAYS) if quick else (MISSIONS, DELAYS)
    made = [row for name in WORLDS for gate in GATES for row in false_alarms(name, gate, missions, seed)]
    for (tolerance, ratio, since), steps in delays("position", None, faults, seed).items():
        if tolerance == 1.0:
            within = FOUND_WITHIN[ratio, since]
            made.append({
                "world": "position", "question": FOUND[since], "ratio": ratio, "runs": within, "looks": 0,
                "stated": 0.5, "bound": ">=", "gates": len(steps), "found": int((steps <= within).sum()),
                "mean_runs": float(steps.mean()), "late_runs": quantile(steps, 0.95),
            })  # fmt: skip
    return made


def false_alarms(name: str, gate: float | None, missions: dict[float, int], seed: int = SEED) -> list[Row]:
    """Right filters over ``STEPS`` steps: how many of the ``missions`` of each stated rate alarm."""
    count = max(missions.values())
    filters, monitors = _start(name, gate, count, np.random.default_rng((seed, 1, *map(ord, name), gate is None)))
    first = first_alarms(filters, monitors, STEPS, 1.0, list(missions))
    return [
        row(
            name if gate is None else f"{name}, gate {gate:g}", ALARM[monitor.tolerance], 1.0, STEPS, rate, "<=", of,
            int(np.isfinite(steps[:of]).sum()),
        )
        for monitor, by_rate in zip(monitors, first, strict=True)
        for (rate, of), steps in zip(missions.items(), by_rate, strict=True)
    ]  # fmt: skip


def delays(
    name: str, gate: float | None, missions: int = DELAYS, seed: int = SEED
) -> dict[tuple[float, float, int], Array]:
    """Steps from a fault to its alarm, by tolerance, ratio and first faulty step.

    Of the missions without an alarm before the fault; infinite where there is none within ``PATIENCE`` steps.
    """
    start = _start(name, gate, missions, np.random.default_rng((seed, 2, *map(ord, name), gate is None)))
    late = copy.deepcopy(start)
    early = first_alarms(*late, LATE, 1.0, [DELAY_RATE])[:, 0]
    found = {}
    for since, begun in ((1, start), (LATE + 1, late)):
        for ratio in RATIOS:
            filters, monitors = copy.deepcopy(begun)
            first = first_alarms(filters, monitors, PATIENCE, ratio, [DELAY_RATE])[:, 0]
            for monitor, steps, before in zip(monitors, first, early, strict=True):
                found[monitor.tolerance, ratio, since] = steps[np.isinf(before)] if since > 1 else steps
    return found


def quantile(steps: Array, share: float) -> float:
    """The step by which this share of the missions has alarmed."""
    return float(np.quantile(steps, share, method="higher"))


def _start(
    name: str, gate: float | None, missions: int, rng: np.random.Generator
) -> tuple[Position | Velocity, list[Monitors]]:
    world = WORLDS[name]
    return world(rng, missions), [Monitors(missions, world.dof, tolerance, gate) for tolerance in TOLERANCES]


def main() -> None:
    """Print false alarms, and median and 95 % quantile of the delays."""
    for one in rows(quick=False, seed=SEED):
        share = 100 * one["found"] / one["gates"]
        print(f"{one['question']}, {one['world']}, x{one['ratio']:.3g}: {share:.2f} % ({one['bound']} {one['stated']})")
    for name in WORLDS:
        for gate in GATES:
            for (tolerance, ratio, since), steps in delays(name, gate).items():
                took = f"{quantile(steps, 0.5):g} ({quantile(steps, 0.95):g})"
                print(f"{name}, gate {gate}, tolerance {tolerance:g}, x{ratio:g} from step {since}: {took}", flush=True)


if __name__ == "__main__":
    main()
