"""One long log in pieces that stand as runs, and errors whose convention nobody declared.

Errors of a log are AR(.95) beside a part of their variance that is the same in all steps. ``calibration.py`` puts the
rows into its table.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from calibration_gates import row, stationary
from scipy.spatial.transform import Rotation

from consistency.diagnostics import Record, judge, make_record
from consistency.referee.diagnostics.nees import nees
from consistency.referee.diagnostics.planning import in_pieces
from consistency.referee.geometry import SPATIAL, spatial_error
from consistency.referee.types import Array

STEPS, DOF, RHO = 20_000, 3, 0.95
CONSTANT = (0.0, 0.003, 0.01, 0.03, 0.1, 0.9)  # shares of the variance
GATES, QUICK_GATES = 1000, 20
RUNS, POSES = 50, 4  # of a study whose error is guessed
SIGMA = np.array([0.002, 0.02, 0.006, 0.001, 0.01, 0.003])  # m and rad
FALSE, POWER, LEFT = "--split, false alarm", "--split, power", "--error guess, the right one rejected"
ABOUT = {
    **{
        f"one log, {100 * share:g} % constant": f"{STEPS} steps of AR({RHO}), {100 * share:g} % of the variance the "
        f"same in all, n = {DOF}; runs are steps"
        for share in CONSTANT
    },
    **{f"poses, error {kind}": f"{POSES} steps of errors that are Gaussian in '{kind}', n = 6" for kind in SPATIAL},
    FALSE: "a log of a right filter, cut into the advised pieces, is found at fault",
    POWER: "a covariance wrong in all steps of a log is called as it is",
    LEFT: "the convention that the errors are of is not among those that `--error guess` lists",
}


def log_of(rng: np.random.Generator, constant: float, ratio: float) -> Record:
    e = np.sqrt(1.0 - constant) * stationary(rng.standard_normal((STEPS, DOF)), RHO)
    e = np.sqrt(ratio) * (e + np.sqrt(constant) * rng.standard_normal((1, DOF)))
    return make_record("log", e[None], np.broadcast_to(np.eye(DOF), (1, STEPS, DOF, DOF)))


def study_of(rng: np.random.Generator, convention: str) -> Record:
    """Errors of one study under every convention, of which one is right; the first is the default of files."""
    e = SIGMA * rng.standard_normal((RUNS * POSES, 6))
    estimate = np.column_stack([rng.normal(0, 20, (len(e), 3)), Rotation.random(len(e), random_state=rng).as_quat()])
    true = applied(estimate, e, convention)
    P = np.broadcast_to(np.diag(SIGMA**2), (RUNS, POSES, 6, 6))
    records = {}
    for kind in SPATIAL:
        error = spatial_error(true, estimate, kind).reshape(RUNS, POSES, 6)
        records[kind] = make_record("est", error, P, nees(error, P), 6, convention=kind)
    return replace(records["so3"], guesses=records)


def applied(poses: Array, e: Array, convention: str) -> Array:
    """The true poses (N, 7) whose errors are e (N, 6), to first order."""
    R, turn = Rotation.from_quat(poses[:, 3:]), Rotation.from_rotvec(e[:, 3:])
    true = turn * R if convention in ("so3", "right") else R * turn
    if convention == "rvec":
        true = Rotation.from_rotvec(R.as_rotvec() + e[:, 3:])
    elif convention == "euler":
        true = Rotation.from_euler("ZYX", R.as_euler("ZYX") + e[:, :2:-1])
    position, shift = poses[:, :3], e[:, :3]
    at = {"left": position + R.apply(shift), "right": turn.apply(position) + shift}.get(convention, position + shift)
    return np.column_stack([at, true.as_quat()])


def rows(quick: bool, seed: int) -> list[dict[str, Any]]:
    table, gates = [], QUICK_GATES if quick else GATES
    for k, constant in enumerate(CONSTANT[:1] if quick else CONSTANT):
        world = f"one log, {100 * constant:g} % constant"
        for ratio in (1.0,) if constant else (1.0, 1.5, 1.0 / 1.5):
            rng = np.random.default_rng((seed, k, round(100 * ratio)))
            found = [judge(in_pieces(log_of(rng, constant, ratio))) for _ in range(gates)]
            if ratio == 1.0:
                table.append(row(world, FALSE, 1.0, STEPS, 0.05, "<=", gates, sum(bool(v.faults) for v in found)))
            else:
                side = "overconfident" if ratio > 1.0 else "conservative"
                called = sum(v.status == side for v in found)
                table.append(row(world, POWER, ratio, STEPS, 0.95, ">=", gates, called))
    for k, kind in enumerate(SPATIAL):
        rng = np.random.default_rng((seed, 100, k))
        gone = sum(not judge(study_of(rng, kind)).guesses[kind].possible for _ in range(gates))
        table.append(row(f"poses, error {kind}", LEFT, 1.0, RUNS, 0.05, "<=", gates, gone))
    return table
