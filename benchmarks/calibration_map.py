"""Does the verdict on a map keep its rates? Landmarks that share the error of a pose, by a known joint covariance.

The landmarks of a run move with its pose and have errors of their own that are correlated at random. Each gate has a
covariance of its own. ``calibration.py`` puts the rows into its table.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from calibration_gates import row

from consistency.diagnostics import JointNees, Map, Verdict, judge, make_record
from consistency.referee.types import Array

LANDMARKS, POSE = 12, 3
NUMBER = POSE + 3 * LANDMARKS
SIGMA = (0.3, 0.2, 0.1)  # of the pose
RUNS = (12, 30, 100)
GATES, QUICK_GATES = {0.05: 1000, 0.01: 2000}, {0.05: 200, 0.01: 200}  # by the stated rate
POWER_GATES, RATIO, POWER_RUNS = 300, 1.25, 30
WORLD, RELATIVE = "map", "map given the pose"
ALARM, POWER = "map, false alarm", "map, power"
ABOUT = {
    WORLD: f"pose and {LANDMARKS} landmarks of one Gaussian; landmarks share the error of the pose",
    RELATIVE: "the same, wrong only in what the pose does not explain",
    ALARM: "a right map is found at fault",
    POWER: "a wrong map is found at fault",
}


def rows(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Rows of the calibration table: false alarms by number of runs and rate, and power."""
    gates = QUICK_GATES if quick else GATES
    table = []
    for runs in RUNS:
        rng = np.random.default_rng((seed, 77, runs))
        p = np.array([verdict(rng, runs).p_value for _ in range(max(gates.values()))])
        found = {rate: int((p[:count] <= rate).sum()) for rate, count in gates.items()}
        table += [row(WORLD, ALARM, 1.0, runs, rate, "<=", gates[rate], found[rate]) for rate in gates]
    for world, whole in ((WORLD, True), (RELATIVE, False)):
        rng, count = np.random.default_rng((seed, 78, int(whole))), POWER_GATES // (5 if quick else 1)
        wrong = sum(bool(verdict(rng, POWER_RUNS, RATIO, whole).faults) for _ in range(count))
        table.append(row(world, POWER, RATIO, POWER_RUNS, 0.95, ">=", count, wrong))
    return table


def verdict(rng: np.random.Generator, runs: int, ratio: float = 1.0, whole: bool = True) -> Verdict:
    """On maps whose true covariance is ``ratio`` times the stated one, of pose and map or of the map given the pose."""
    L = np.linalg.cholesky(_covariance(rng))
    w = rng.standard_normal((runs, NUMBER))
    w[:, 0 if whole else POSE :] *= np.sqrt(ratio)
    error = (w @ L.T)[:, POSE:].reshape(runs, LANDMARKS, 3)
    P = np.stack([L[i : i + 3] @ L[i : i + 3].T for i in range(POSE, NUMBER, 3)])
    parts = np.square(w).reshape(runs, -1, 3).sum(axis=-1)
    joint = JointNees(parts[:, 0], parts[:, 1:].sum(axis=1), np.full(runs, 3 * LANDMARKS), parts[:, 1:])
    covariance = np.broadcast_to(P, (*error.shape, 3)).copy()
    record = make_record("map", error, covariance)
    return judge(replace(record, map=Map(landmarks=np.arange(LANDMARKS), joint=joint)))


def _covariance(rng: np.random.Generator) -> Array:
    moved = np.vstack([np.eye(POSE), *(np.eye(3) + 0.3 * rng.standard_normal((3, 3)) for _ in range(LANDMARKS))])
    own = rng.standard_normal((NUMBER, NUMBER)) / np.sqrt(NUMBER)
    return np.asarray(moved @ np.diag(np.square(SIGMA)) @ moved.T + 0.05 * (own @ own.T + 0.1 * np.eye(NUMBER)))
