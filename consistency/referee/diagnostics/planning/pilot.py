"""Number of runs that a verdict needs, from a few runs that show how much they differ."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from consistency.referee.defaults import FALSE_ALARM, POWER
from consistency.referee.diagnostics.questions.scale import FEW, scale_test
from consistency.referee.diagnostics.statistics.number_of_runs import (
    FEWEST_PLANNED,
    gate_runs,
    lost_runs,
    require_rates,
    required_runs,
)
from consistency.referee.diagnostics.verdict.answers import MAIN, SHARES
from consistency.referee.types import Array

MARGIN = 1.15  # on the runs of a pilot's plan, measured: it then keeps its power


@dataclass(frozen=True)
class PilotPlan:
    """Number of runs that a verdict needs, according to a pilot."""

    pilot_runs: int
    effective_dof: float  # of one run, one standard error to the safe side
    standard_error: float  # of its logarithm
    runs: int


def pilot_plan(
    means: Array,
    dof: int,
    steps: int,
    detect: float,
    false_alarm: float = FALSE_ALARM,
    power: float = POWER,
    allow: str | None = None,
    lost: float | None = None,
) -> PilotPlan:
    """Runs that :func:`judge` needs if steps depend on each other as in a pilot, and not completely.

    :func:`gate_runs` at the pilot's effective degrees of freedom, one standard error to the safe side, times 1.15: a
    verdict estimates them again from its own runs. At least 30 runs, since fewer miss too easily that the covariance
    is wrong in a few of them. Scale and bias of the pilot do not matter, only the spread of its run means.

    Parameters
    ----------
    means : (runs,), mean NEES of each run over ``dof``; at least 20
    steps : of a run
    lost : share of lost runs that is to be excluded

    Raises
    ------
    ValueError
        Fewer than 20 runs, or an argument that :func:`required_runs` or :func:`lost_runs` refuses.
    """
    require_rates(dof, false_alarm, power)
    if len(means) < FEW:
        raise ValueError(f"a pilot needs at least {FEW} runs, got {len(means)}")
    test = scale_test(means / means.mean(), dof, steps)
    share = SHARES[MAIN] * false_alarm
    least = required_runs(test.effective_dof, detect, share, power, two_sided=allow is None)
    runs = max(FEWEST_PLANNED, min(int(np.ceil(MARGIN * least)), gate_runs(dof, detect, false_alarm, power, allow)))
    if lost is not None:
        runs = max(runs, lost_runs(lost, power))
    return PilotPlan(len(means), test.effective_dof, float(np.sqrt(2.0 / test.spread)), runs)
