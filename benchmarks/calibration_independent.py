"""Rows that are runs, covariances found where none is stated, and gates judged by what they reject.

- ``--independent``: rows of a file, each with a covariance of its own, as of calibrations; the covariance is right, or
  wrong by a factor.
- ``correct`` of rows without a covariance: the verdict on each row by the variances of the others. Errors are Gaussian
  with one diagonal covariance, or with two, one for each half of the rows, which no single one is right for.
- ``monitor --gate``: right Kalman filters behind a gate, whose rejections are counted as the monitor counts them.

``calibration.py`` puts the rows into its table.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from calibration_gates import row
from calibration_monitor import Position, Velocity

import consistency as cs
from consistency.referee.diagnostics.monitor import gate_limit, gate_share, rest_after_rejection
from consistency.referee.fit_covariance.correct import Correction
from consistency.referee.types import Array

GATES, QUICK_GATES = 2000, 60
DRAWS, QUICK_DRAWS = 200, 10
SIZES = (30, 200)  # rows of a file
RATES = (0.05, 1e-3)
DETECT = 1.5
SIGMAS = (0.02, 0.02, 0.05, 0.01, 0.01, 0.03)
MIXED = 3.0  # sigmas of one half of the rows over those of the other
STEPS = (400, 2000)  # of a mission behind a gate
MISSIONS, QUICK_MISSIONS = 10_000, 1000
LEVELS = (0.99, 0.95)
FOUND, CLEARED = "rows, false alarm", "rows, wrong all-clear"
SHOWN, MISSED, AT_FAULT = "found, consistent", "found, wrong all-clear", "found, false alarm"
REJECTS = "gate, false alarm"
ABOUT = {
    "independent rows": "rows of 3 components with unlike covariances, judged with `--independent`; runs are rows",
    "no covariance": "rows of 6 components without a covariance, corrected with `--independent`; runs are rows",
    "no covariance, two kinds": f"the same, of which every second has {MIXED:g} times the errors",
    FOUND: "rows with a right covariance are found at fault",
    CLEARED: "rows whose covariance is wrong by exactly `detect` are called consistent",
    SHOWN: "the covariance that `correct` finds is called consistent on held-out rows",
    AT_FAULT: "it is found at fault, though it is right",
    MISSED: "it is called consistent, though no single one is right",
    REJECTS: "the gate of a right filter is said to reject too few or too many; runs are steps",
    **{
        f"gate {level:g} of {name}": f"the Kalman filter `{name}` behind a gate of {level:g}; runs are steps"
        for name in ("position", "velocity")
        for level in LEVELS
    },
}


def judged_rows(rng: np.random.Generator, rows: int, ratio: float, rate: float) -> cs.Verdict:
    """The verdict on rows of 3 components, whose true covariances are ``ratio`` times the stated ones."""
    A = rng.standard_normal((rows, 3, 3))
    P = A @ np.swapaxes(A, 1, 2) + 0.1 * np.eye(3)
    w = rng.standard_normal((rows, 3))
    errors = np.sqrt(ratio) * (np.linalg.cholesky(P) @ w[..., None])[..., 0]
    return cs.judge(errors, P, independent=True, false_alarm=rate, detect=DETECT)


def found_status(rng: np.random.Generator, rows: int, mixed: bool) -> tuple[str, bool]:
    """Status of what ``correct`` finds for rows without a covariance, and whether a fault was found."""
    errors = np.array(SIGMAS) * rng.standard_normal((rows, len(SIGMAS)))
    if mixed:
        errors[1::2] *= MIXED
    found = cs.correct(errors, independent=True)
    assert isinstance(found, Correction)
    return found.status, bool(found.verdict.faults)


def gate_findings(kind: type, rng: np.random.Generator, steps: int, missions: int, level: float) -> int:
    """Missions of right filters behind a gate that is said to reject too few or too many."""
    world = kind(rng, missions)
    limit, rest = gate_limit(level, world.dof), rest_after_rejection(level)
    tried, refused, untried = (np.zeros(missions, int) for _ in range(3))
    for _ in range(steps):
        rejected: Array = world.nis() > limit
        counted = untried == 0
        tried += counted
        refused += counted & rejected
        untried = np.where(rejected, rest, np.maximum(untried - 1, 0))
        world.move(~rejected)
    return sum(bool(gate_share(int(k), int(n), level).finding) for k, n in zip(refused, tried, strict=True))


def rows(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Rows of the calibration table."""
    table = []
    gates = QUICK_GATES if quick else GATES
    for size in SIZES:
        for rate in RATES:
            rng = np.random.default_rng((seed, size, round(1e4 * rate)))
            found = sum(bool(judged_rows(rng, size, 1.0, rate).faults) for _ in range(gates))
            table.append(row("independent rows", FOUND, 1.0, size, rate, "<=", gates, found))
    size, some = SIZES[-1], gates // 5
    for ratio in (DETECT, 1.0 / DETECT):
        rng = np.random.default_rng((seed, size, round(1e4 * ratio)))
        cleared = sum(judged_rows(rng, size, ratio, 0.05).status == "consistent" for _ in range(some))
        table.append(row("independent rows", CLEARED, ratio, size, 0.05, "<=", some, cleared))
    draws = QUICK_DRAWS if quick else DRAWS
    rng = np.random.default_rng((seed, 1))
    said = [found_status(rng, SIZES[-1], False) for _ in range(draws)]
    right = sum(status == "consistent" for status, _ in said)
    table.append(row("no covariance", SHOWN, 1.0, SIZES[-1], 0.9, ">=", draws, right))
    table.append(row("no covariance", AT_FAULT, 1.0, SIZES[-1], 0.05, "<=", draws, sum(fault for _, fault in said)))
    mixed = sum(found_status(rng, SIZES[-1], True)[0] == "consistent" for _ in range(draws))
    table.append(row("no covariance, two kinds", MISSED, 1.0, SIZES[-1], 0.05, "<=", draws, mixed))
    for kind, name in ((Position, "position"), (Velocity, "velocity")):
        for level in LEVELS:
            missions = QUICK_MISSIONS if quick else MISSIONS
            for steps in STEPS[:1] if quick else STEPS:
                rng = np.random.default_rng((seed, steps, round(100 * level)))
                found = gate_findings(kind, rng, steps, missions, level)
                table.append(row(f"gate {level:g} of {name}", REJECTS, 1.0, steps, 0.05, "<=", missions, found))
    return table
