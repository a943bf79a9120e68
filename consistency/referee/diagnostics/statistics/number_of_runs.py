"""Number of runs that a verdict needs, and the smallest fault that a number of runs can find."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

import numpy as np
from scipy import special

from consistency.referee.defaults import CONFIDENCE, FALSE_ALARM, POWER
from consistency.referee.diagnostics.questions.scale import FEW, scale_test
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.diagnostics.verdict.answers import MAIN, SHARES
from consistency.referee.types import Array

LARGEST = 10**7  # runs; more is refused as a mistake
MARGIN = 1.15  # on the runs of a pilot's plan, measured: it then keeps its power


def required_runs(
    dof: float, ratio: float, false_alarm: float = FALSE_ALARM, power: float = POWER, two_sided: bool = True
) -> int:
    """Runs that find a covariance wrong by ``ratio`` with ``power`` in the average NEES of one step.

    N times the average is ``ratio`` times chi-square with N ``dof`` degrees of freedom, and is compared with
    the quantiles of that chi-square (Bar-Shalom, Li & Kirubarajan 2001, sec. 5.4). The mean of a whole
    trajectory spreads no more than that of one step, so the number suffices there too.

    Parameters
    ----------
    dof : dimension of the error, or the effective degrees of freedom of a run
    ratio : true over stated covariance; above 1 overconfident, below 1 conservative
    false_alarm : of the test on a consistent filter
    power : chance that the fault is found
    two_sided : False spends all of ``false_alarm`` on the side of ``ratio``

    Raises
    ------
    ValueError
        An argument out of its range, or a ratio so near 1 that over 10 million runs are needed.
    """
    _require(dof, false_alarm, power)
    if not 0.0 < ratio < float("inf") or ratio == 1.0:
        raise ValueError(f"ratio must be positive and not 1, got {ratio}")

    def enough(runs: int) -> bool:
        return power_of(dof, runs, ratio, false_alarm, two_sided) >= power

    if not enough(LARGEST):
        raise ValueError(f"ratio of {ratio} needs more than {LARGEST} runs; ask for one further from 1")
    return 1 + bisect_left(range(1, LARGEST), True, key=enough)


def gate_runs(
    dof: int,
    detect: float,
    false_alarm: float = FALSE_ALARM,
    power: float = POWER,
    allow: str | None = None,
    lost: float | None = None,
) -> int:
    """Runs with which a verdict (:func:`judge`) finds a covariance wrong by ``detect`` in all steps with ``power``.

    This is :func:`required_runs` at the half of ``false_alarm`` that a verdict gives to the mean NEES, and at least
    :func:`lost_runs` where a share ``lost`` of lost runs is to be excluded. Raises the same exceptions.
    """
    _require(dof, false_alarm, power)
    runs = required_runs(dof, detect, SHARES[MAIN] * false_alarm, power, two_sided=allow is None)
    return runs if lost is None else max(runs, lost_runs(lost, power))


def share_limit(lost: int, runs: int, confidence: float = CONFIDENCE) -> float:
    """Upper limit of the share of lost runs, where ``lost`` of ``runs`` are (Clopper & Pearson 1934)."""
    return float(special.betaincinv(lost + 1, runs - lost, confidence)) if lost < runs else 1.0


def lost_runs(share: float, power: float = POWER, lost: int = 0) -> int:
    """Runs with ``lost`` lost ones among them whose Clopper-Pearson limit is ``share`` at most: 59 for 0.05 and none.

    Raises
    ------
    ValueError
        A number outside (0, 1), or a share so small that over 10 million runs are needed.
    """
    for name, value in (("lost", share), ("power", power)):
        if not 0.0 < value < 1.0:
            raise ValueError(f"{name} must lie between 0 and 1, got {value}")
    if share_limit(lost, LARGEST, power) > share:
        raise ValueError(f"lost of {share} needs more than {LARGEST} runs; ask for a larger share")
    few = lost + 1
    return few + bisect_left(range(few, LARGEST), True, key=lambda runs: share_limit(lost, runs, power) <= share)


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
    verdict estimates them again from its own runs. At least 20 runs, as it needs for that. Scale and bias of the pilot
    do not matter, only the spread of its run means.

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
    _require(dof, false_alarm, power)
    if len(means) < FEW:
        raise ValueError(f"a pilot needs at least {FEW} runs, got {len(means)}")
    test = scale_test(means / means.mean(), dof, steps)
    share = SHARES[MAIN] * false_alarm
    least = required_runs(test.effective_dof, detect, share, power, two_sided=allow is None)
    runs = min(int(np.ceil(MARGIN * least)), gate_runs(dof, detect, false_alarm, power, allow))
    runs = max(runs, FEW) if lost is None else max(runs, FEW, lost_runs(lost, power))
    return PilotPlan(len(means), test.effective_dof, float(np.sqrt(2.0 / test.spread)), runs)


def power_of(dof: float, runs: int, ratio: float, false_alarm: float = FALSE_ALARM, two_sided: bool = True) -> float:
    """Chance that ``runs`` runs find a covariance wrong by ``ratio``; the complement of :func:`required_runs`."""
    tail, k = false_alarm / (2 if two_sided else 1), dof * runs
    if ratio > 1.0:
        return float(distributions.chi2.sf(distributions.chi2.isf(tail, k) / ratio, k))
    return float(distributions.chi2.cdf(distributions.chi2.ppf(tail, k) / ratio, k))


def detectable_ratio(
    dof: int, runs: int, false_alarm: float = FALSE_ALARM, power: float = POWER, two_sided: bool = True
) -> float:
    """Smallest ratio of true to stated covariance that ``runs`` runs find with ``power``."""
    _require(dof, false_alarm, power)
    tail = false_alarm / (2 if two_sided else 1)
    return float(distributions.chi2.isf(tail, dof * runs) / distributions.chi2.ppf(1.0 - power, dof * runs))


def _require(dof: float, false_alarm: float, power: float) -> None:
    if not dof >= 1:
        raise ValueError(f"dof must be at least 1, got {dof}")
    for name, value in (("false_alarm", false_alarm), ("power", power)):
        if not 0.0 < value < 1.0:
            raise ValueError(f"{name} must lie between 0 and 1, got {value}")
