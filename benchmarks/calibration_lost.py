"""Rare lost runs: is *consistent* said of a filter that loses 5 % of its runs, where ``lost=0.05`` is asked?

A run is lost with probability 0.05; its errors make the covariance ratio 1.5 in the mean, which must not be called
consistent. The NEES alone is judged, without axes, so that only the scale and what is asked of lost runs can object.
``calibration.py`` puts the rows into its table.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
from calibration_gates import row

from consistency.diagnostics import Settings, Verdict, follow, gate_runs, judge, make_record, sequential_design
from consistency.referee.types import Array

STEPS, DOF, SHARE, DETECT = 20, 3, 0.05, 1.5
SIZE = 1.0 + (DETECT - 1.0) / SHARE  # ratio of a lost run
GATES, QUICK_GATES = 2000, 40
DECIDED_GATES, QUICK_DECIDED = 400, 10
FEW, MORE, MOST = 21, 96, 500  # runs: few, so many that one may be lost, and most of --until-decided
LOST, RIGHT, DECIDED, FREE = (
    "lost runs, wrong all-clear", "lost runs, all-clear", "until decided, lost runs, wrong all-clear",
    "lost runs, not asked for",
)  # fmt: skip
ABOUT = {
    "5 % lost, independent": "5 % of the runs have errors of 11 times the variance; steps are independent",
    "5 % lost, AR(.8)": "5 % of the runs have errors of 11 times the variance; neighbours correlate by 0.8",
    "5 % lost, offset": "5 % of the runs have a NEES of 33 in all steps, the others one error in all steps",
    "0 % lost, AR(.8)": "a right filter, neighbours correlate by 0.8",
    "0 % lost, offset": "a right filter with one error in all steps of a run",
    LOST: "a filter that loses 5 % of its runs is called consistent, `lost=0.05`",
    RIGHT: "with the planned runs a right filter is called consistent, `lost=0.05`",
    DECIDED: "`--until-decided --lost 0.05` calls a filter that loses 5 % of its runs consistent",
    FREE: "a filter that loses 5 % of its runs is called consistent where nothing is asked of lost runs; a limit",
}


def rows(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Rows of the calibration table: wrong all-clears with lost runs, and all-clears of right filters."""
    gates, decided = (QUICK_GATES, QUICK_DECIDED) if quick else (GATES, DECIDED_GATES)
    planned = gate_runs(DOF, DETECT, lost=SHARE)
    asked, free = Settings(detect=DETECT, lost=SHARE), Settings(detect=DETECT)
    table = []

    def add(question: str, world: str, runs: int, share: float, settings: Settings, stated: float, bound: str) -> None:
        rng = np.random.default_rng((seed, zlib.crc32(f"{question} {world}".encode()), runs))
        draws = (WORLDS[world](rng, runs, share) for _ in range(gates))
        said = [judge(make_record("gate", nees=nees, dof=DOF), settings).consistent for nees in draws]
        ratio, name = DETECT if share else 1.0, f"{100 * share:g} % lost, {world}"
        table.append(row(name, question, ratio, runs, stated, bound, len(said), sum(said)))

    for world in WORLDS:
        for runs in (planned, MORE):
            add(LOST, world, runs, SHARE, asked, 0.05, "<=")
        add(FREE, world, FEW, SHARE, free, 1.0, "<=")
    for world, least in (("AR(.8)", 0.93), ("offset", 0.85)):
        add(RIGHT, world, planned, 0.0, asked, least, ">=")
    rng = np.random.default_rng((seed, 83))
    late = [until_decided(_autoregressive(rng, MOST, SHARE)).consistent for _ in range(decided)]
    return [*table, row("5 % lost, AR(.8)", DECIDED, DETECT, MOST, 0.05, "<=", len(late), sum(late))]


def until_decided(nees: Array) -> Verdict:
    """The verdict of ``--until-decided --lost 0.05`` on the NEES (runs, T), runs as they come."""
    design = sequential_design(DOF, DETECT, max_runs=len(nees), lost=SHARE)
    return follow(design, lambda runs: make_record("gate", nees=nees[:runs], dof=DOF))[0]


def _independent(rng: np.random.Generator, runs: int, share: float) -> Array:
    return rng.chisquare(DOF, (runs, STEPS)) * np.where(_lost(rng, runs, share), SIZE, 1.0)


def _autoregressive(rng: np.random.Generator, runs: int, share: float) -> Array:
    w = rng.standard_normal((runs, STEPS, DOF))
    for k in range(1, STEPS):
        w[:, k] = 0.8 * w[:, k - 1] + 0.6 * w[:, k]
    return np.asarray(np.square(w).sum(axis=-1) * np.where(_lost(rng, runs, share), SIZE, 1.0))


def _offset(rng: np.random.Generator, runs: int, share: float) -> Array:
    one = np.where(_lost(rng, runs, share), SIZE * DOF, rng.chisquare(DOF, (runs, 1)))
    return np.repeat(one, STEPS, axis=1)


def _lost(rng: np.random.Generator, runs: int, share: float) -> Array:
    return rng.random((runs, 1)) < share


WORLDS: dict[str, Callable[[np.random.Generator, int, float], Array]] = {
    "independent": _independent, "AR(.8)": _autoregressive, "offset": _offset,
}  # fmt: skip
