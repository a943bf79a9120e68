"""Does the monitor keep its promise? Alarms of right Kalman filters, and how long a fault goes unseen.

``calibration_monitor.py`` prints all rows. Two linear filters, each exactly right for what it filters:

- ``position``: three random walks with gains of 0.2, 0.5 and 0.8, all measured in every step (3 degrees of freedom,
  one gate for all three);
- ``velocity``: a point at nearly constant velocity, its position measured (1 degree of freedom).

A fault of ratio r is a stated covariance, of everything the filter believes, that is r times smaller than the right
one: the gain is still the optimal one, and a gate rejects more or less. All missions of a world are filtered at once,
and monitored at once: :class:`Monitors` has the arithmetic of ``cs.Monitor``, and a test compares the two.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from consistency.diagnostics.monitor import bet_on, rest_after_rejection, start_share

Array = NDArray[Any]

STEPS, LATE = 10_000, 5_000  # of a mission; step after which a late fault begins
MISSIONS = {0.05: 1_000, 0.01: 2_000}  # by the stated false-alarm rate
DELAYS, PATIENCE = 500, 5_000  # missions with a fault; steps that they are watched for
TOLERANCES = (1.0, 1.2)
GATES = (None, 0.99)
RATIOS = (1.5, 2.0, 0.5)
DELAY_RATE = 0.05  # stated false-alarm rate of the rows with a fault
SEED = 20240401

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
        self.share = np.array([start_share(k) for k in range(1, STEPS + PATIENCE + 1)])
        self.unspent = 1.0 - np.concatenate([[0.0], np.cumsum(self.share)])

    def update(self, nis: Array) -> Array:
        """E-values (missions,) after this step's NIS (missions,)."""
        accepted = nis <= self.limit
        judged = accepted & (self.skip == 0)
        self.skip = np.where(accepted, np.maximum(self.skip - 1, 0), self.rest)
        ratio = np.exp(self.constant + self.slope * nis)
        self.R = np.where(judged, ratio * (self.R + self.share[self.judged]), self.R)
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
        for row, monitor in enumerate(monitors):
            found = (monitor.update(nis) >= thresholds) & np.isinf(first[row])
            first[row][found] = step
        world.move(nis <= monitors[0].limit)
        if step % 50 == 0 and np.isfinite(first).all():
            break
    return first


def false_alarms(name: str, gate: float | None, missions: dict[float, int], seed: int = SEED) -> list[Row]:
    """Right filters over ``STEPS`` steps: how many of the ``missions`` of each stated rate alarm."""
    count = max(missions.values())
    filters, monitors = _start(name, gate, count, np.random.default_rng((seed, 1, *map(ord, name), gate is None)))
    first = first_alarms(filters, monitors, STEPS, 1.0, list(missions))
    return [
        _row(name, 1.0, monitor.tolerance, gate, rate) | {"missions": of, "found": int(np.isfinite(steps[:of]).sum())}
        for monitor, by_rate in zip(monitors, first, strict=True)
        for (rate, of), steps in zip(missions.items(), by_rate, strict=True)
    ]


def delays(name: str, gate: float | None, missions: int = DELAYS, seed: int = SEED) -> list[Row]:
    """Steps from a fault to its alarm: median and 95 % quantile of the missions without an alarm before it."""
    rows = []
    start = _start(name, gate, missions, np.random.default_rng((seed, 2, *map(ord, name), gate is None)))
    late = copy.deepcopy(start)
    early = first_alarms(*late, LATE, 1.0, [DELAY_RATE])[:, 0]
    for since, begun in ((1, start), (LATE + 1, late)):
        for ratio in RATIOS:
            filters, monitors = copy.deepcopy(begun)
            first = first_alarms(filters, monitors, PATIENCE, ratio, [DELAY_RATE])[:, 0]
            for monitor, steps, before in zip(monitors, first, early, strict=True):
                judged = steps[np.isinf(before)] if since > 1 else steps
                row = _row(name, ratio, monitor.tolerance, gate, DELAY_RATE) | {"since": since, "missions": len(judged)}
                quantiles = np.quantile(judged, [0.5, 0.95], method="higher")
                rows.append(row | dict(zip(("median_delay", "p95_delay"), quantiles.tolist(), strict=True)))
    return rows


def measure(missions: dict[float, int] | None = None, faults: int = DELAYS, seed: int = SEED) -> list[Row]:
    """All rows, false alarms (``ratio`` 1) before delays; ``missions`` by stated rate, ``faults`` missions a delay."""
    pairs = [(name, gate) for name in WORLDS for gate in GATES]
    alarms = [row for pair in pairs for row in false_alarms(*pair, missions or MISSIONS, seed)]
    return alarms + [row for pair in pairs for row in delays(*pair, faults, seed)]


def _start(
    name: str, gate: float | None, missions: int, rng: np.random.Generator
) -> tuple[Position | Velocity, list[Monitors]]:
    world = WORLDS[name]
    return world(rng, missions), [Monitors(missions, world.dof, tolerance, gate) for tolerance in TOLERANCES]


def _row(name: str, ratio: float, tolerance: float, gate: float | None, rate: float) -> Row:
    return {
        "world": f"monitor, {name}", "ratio": ratio, "steps": STEPS, "tolerance": tolerance, "gate": gate,
        "false_alarm": rate,
    }  # fmt: skip


if __name__ == "__main__":
    started = time.monotonic()
    for row in measure():
        print(row, flush=True)
    print(f"{time.monotonic() - started:.1f} s")
