"""Do single questions keep their rates where that is hardest? Whiteness of the NIS, band with gaps, shape.

The NIS alone is judged with 1 to 6 degrees of freedom over 20 to 5,000 steps, at 5 % and at the default rate of a gate;
the band, where runs miss steps of slow errors. The shape is asked at its share of 2 to 9 components, and of three that
are seen from a body which turns in space alike in all runs. ``calibration.py`` puts the rows into its table.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from calibration_gates import row
from scipy.spatial.transform import Rotation

from consistency.diagnostics import Verdict, judge, make_record, mean_shape
from consistency.referee.diagnostics.verdict_parts import SHARES, STEP
from consistency.referee.types import Array

RATES = (0.05, 1e-3)  # of commands and of gates
GATES, DRAWS = 2000, 40_000
LONG_GATES, CHEAP = 400, 10_000  # gates of more values of the NIS than that
QUICK_GATES, QUICK_DRAWS = 60, 500
ALARM, WHITENESS, IN_STEP, SHAPE = "false alarm", "innovation whiteness", STEP, "shape"
# degrees of freedom of the NIS: runs and steps
NIS = {
    (1,): ((20, 20), (50, 100), (50, 1000), (50, 5000)),
    (2,): ((20, 20), (50, 1000)),
    (6,): ((20, 20), (50, 1000)),
    (1, 6): ((20, 20), (50, 1000)),
    (1, 2, 3, 4, 5, 6): ((20, 20), (50, 1000), (50, 5000)),
}
QUICK_NIS = {(1,): ((20, 20), (50, 1000))}
GAP_STEPS, GAP_RUNS = 100, (21, 50)
GAPS = {
    "10 % missing": "one error in all steps of a run, 10 % of the NEES missing at random",
    "40 % missing": "one error in all steps of a run, 40 % of the NEES missing at random",
    "early ends": "one error in all steps of a run, which ends after 1 to 100 steps",
    "few go on": "one error in all steps of a run, 10 % missing at random; all but 10 runs end half-way",
}
COMPONENTS = {2: (21, 50, 100), 3: (21, 50, 100), 6: (50, 100), 9: (50, 100)}  # and runs
QUICK_GAPS = ("10 % missing",)
SHAPES = {
    "independent": "10 independent steps",
    "slow": "one error in all steps",
    "ragged": "1 to 10 independent steps",
    "turning": "one error in all steps, seen from a body that turns in space, alike in all runs",
}


def _nis_world(dof: tuple[int, ...], steps: int) -> str:
    return f"NIS of {' or '.join(map(str, dof))}, {steps} steps"


def _shape_world(name: str, n: int) -> str:
    return f"{name}, n = {n}"


ABOUT = {
    **{
        _nis_world(dof, steps): f"white innovations of so many degrees of freedom{', at random' * (len(dof) > 1)}"
        for dof, sizes in NIS.items() for _, steps in sizes
    },
    **GAPS,
    **{_shape_world(name, n): about for name, about in SHAPES.items() for n in COMPONENTS},
    WHITENESS: "a right filter's innovations are found correlated, at the share of this question",
    IN_STEP: "a right filter's ANEES leaves its band, at the share of this question",
    SHAPE: "a right filter's covariance is found to have a wrong shape, at the share of this question",
}  # fmt: skip


def rows(quick: bool, seed: int) -> list[dict[str, Any]]:
    return [*_nis_rows(quick, seed), *_gap_rows(quick, seed), *_shape_rows(quick, seed)]


def _nis_rows(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    for dof, sizes in (QUICK_NIS if quick else NIS).items():
        for runs, steps in sizes:
            rng = np.random.default_rng((seed, 91, *dof, runs, steps))
            gates = QUICK_GATES if quick else GATES if runs * steps <= CHEAP else LONG_GATES
            verdicts = [_of_innovations(rng, dof, runs, steps) for _ in range(gates)]
            yield from _of_gates(_nis_world(dof, steps), WHITENESS, runs, verdicts)


def _gap_rows(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    for k, world in enumerate(QUICK_GAPS if quick else GAPS):
        for runs in GAP_RUNS[-1:] if quick else GAP_RUNS:
            rng = np.random.default_rng((seed, 92, k, runs))
            verdicts = [_of_gaps(rng, world, runs) for _ in range(QUICK_GATES if quick else GATES)]
            yield from _of_gates(world, IN_STEP, runs, verdicts)


def _shape_rows(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    for k, name in enumerate(SHAPES):
        for n, numbers in COMPONENTS.items():
            if name == "turning" and n != 3:
                continue
            for runs in numbers[-1:] if quick else numbers:
                rng = np.random.default_rng((seed, 93, k, n, runs))
                draws = range(QUICK_DRAWS if quick else DRAWS)
                p = np.array([mean_shape(whitened(rng, name, runs, n))[1] for _ in draws])
                yield _of_p(_shape_world(name, n), SHAPE, runs, RATES[0] * SHARES[SHAPE], p)


def _of_gates(world: str, question: str, runs: int, verdicts: list[Verdict]) -> list[dict[str, Any]]:
    """Rows of whole gates at both rates, and of one question at its share."""
    p = np.array([verdict.p_value for verdict in verdicts])
    of_question = np.array([next(a.p_value for a in v.answers if a.question == question) for v in verdicts])
    share = RATES[0] * SHARES[question]
    return [*(_of_p(world, ALARM, runs, rate, p) for rate in RATES), _of_p(world, question, runs, share, of_question)]


def _of_p(world: str, question: str, runs: int, stated: float, p: Array) -> dict[str, Any]:
    return row(world, question, 1.0, runs, stated, "<=", len(p), int((p <= stated).sum()))


def _of_innovations(rng: np.random.Generator, dof: tuple[int, ...], runs: int, steps: int) -> Verdict:
    of_step = rng.choice(dof, (runs, steps)) if len(dof) > 1 else np.full((runs, steps), dof[0])
    return judge(make_record("nis", nis=rng.chisquare(of_step), nis_dof=of_step, optimal_gain=True))


def _of_gaps(rng: np.random.Generator, world: str, runs: int) -> Verdict:
    """On the NEES of runs that have one error in all steps, some of which are not there."""
    nees = np.repeat(rng.chisquare(3, (runs, 1)), GAP_STEPS, axis=1)
    step, order = np.arange(GAP_STEPS), np.arange(runs)[:, None]
    if world == "early ends":
        nees[step >= rng.integers(1, GAP_STEPS + 1, (runs, 1))] = np.nan
    else:
        nees[rng.random(nees.shape) < (0.4 if world == "40 % missing" else 0.1)] = np.nan
    if world == "few go on":
        nees[(order >= 10) & (step >= GAP_STEPS // 2)] = np.nan
    return judge(make_record("gaps", nees=nees, dof=3))


def whitened(rng: np.random.Generator, name: str, runs: int, n: int) -> Array:
    """Whitened errors (runs, steps, n) of a right filter; those of slow errors once instead of in all steps."""
    if name == "slow":
        return np.asarray(rng.standard_normal((runs, 1, n)))
    if name == "turning":
        turn = Rotation.from_rotvec(_wandering(10)).as_matrix()
        return np.asarray(np.einsum("kij,rj->rki", turn, rng.standard_normal((runs, n))))
    w = rng.standard_normal((runs, 10, n))
    if name == "ragged":
        w[np.arange(10) >= rng.integers(1, 11, (runs, 1))] = np.nan
    return w


def _wandering(steps: int) -> Array:
    """Rotation vectors (steps, 3) of a body that turns about an axis which moves, the same at every call."""
    k = np.arange(steps)[:, None]
    axis = np.stack([np.cos(0.2 * k[:, 0]), np.sin(0.2 * k[:, 0]), 0.5 * np.ones(steps)], axis=-1)
    return np.asarray(0.4 * k * axis)
