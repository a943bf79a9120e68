"""Number of runs that a verdict needs, and the smallest fault that a number of runs can find."""

from __future__ import annotations

from bisect import bisect_left

from scipy import special

from consistency.referee.defaults import CONFIDENCE, FALSE_ALARM, POWER
from consistency.referee.diagnostics import distributions
from consistency.referee.diagnostics.verdict_parts import GROUP, JOINT, JOINT_DISTRIBUTION, MAIN, SHARES, shares_of

LARGEST = 10**7  # runs; more is refused as a mistake
FEWEST_PLANNED = 30  # runs; a fault of 5 % of the runs is missing from fewer with more than .95^30 = 21 % probability


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
    power : probability that the fault is found
    two_sided : False spends all of ``false_alarm`` on the side of ``ratio``

    Raises
    ------
    ValueError
        An argument out of its range, or a ratio so near 1 that over 10 million runs are needed.
    """
    require_rates(dof, false_alarm, power)
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
    require_rates(dof, false_alarm, power)
    runs = required_runs(dof, detect, SHARES[MAIN] * false_alarm, power, two_sided=allow is None)
    if lost is None:
        return runs
    return max(runs, lost_runs(lost, power))


def group_runs(
    dof: int,
    detect: float,
    groups: int,
    false_alarm: float = FALSE_ALARM,
    power: float = POWER,
    allow: str | None = None,
) -> int:
    """Runs in each of so many ``groups`` with which a verdict finds a covariance wrong by ``detect`` in one of them.

    This is :func:`required_runs` at the share of ``false_alarm`` that a verdict gives to groups, divided by their
    number. Raises the same exceptions, and ValueError with fewer than two groups.
    """
    if groups < 2:
        raise ValueError(f"groups must be at least 2, got {groups}")
    share = shares_of([question for question in SHARES if question not in (JOINT, JOINT_DISTRIBUTION)])[GROUP]
    return required_runs(dof, detect, share * false_alarm / groups, power, two_sided=allow is None)


def share_limit(lost: int, runs: int, confidence: float = CONFIDENCE) -> float:
    """Upper limit of the share of lost runs, where ``lost`` of ``runs`` are (Clopper & Pearson 1934)."""
    if lost >= runs:
        return 1.0
    return float(special.betaincinv(lost + 1, runs - lost, confidence))


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


def power_of(dof: float, runs: int, ratio: float, false_alarm: float = FALSE_ALARM, two_sided: bool = True) -> float:
    """Probability that ``runs`` runs find a covariance wrong by ``ratio``; the complement of :func:`required_runs`."""
    tail = _one_tail(false_alarm, two_sided)
    k = dof * runs
    if ratio > 1.0:
        return float(distributions.chi2.sf(distributions.chi2.isf(tail, k) / ratio, k))
    return float(distributions.chi2.cdf(distributions.chi2.ppf(tail, k) / ratio, k))


def detectable_ratio(
    dof: int, runs: int, false_alarm: float = FALSE_ALARM, power: float = POWER, two_sided: bool = True
) -> float:
    """Smallest ratio of true to stated covariance that ``runs`` runs find with ``power``."""
    require_rates(dof, false_alarm, power)
    tail = _one_tail(false_alarm, two_sided)
    return float(distributions.chi2.isf(tail, dof * runs) / distributions.chi2.ppf(1.0 - power, dof * runs))


def require_rates(dof: float, false_alarm: float, power: float) -> None:
    """Refuse numbers out of their range.

    Raises
    ------
    ValueError
        Degrees of freedom below 1, or a rate or power outside (0, 1).
    """
    if not dof >= 1:
        raise ValueError(f"dof must be at least 1, got {dof}")
    for name, value in (("false_alarm", false_alarm), ("power", power)):
        if not 0.0 < value < 1.0:
            raise ValueError(f"{name} must lie between 0 and 1, got {value}")


def _one_tail(false_alarm: float, two_sided: bool) -> float:
    if two_sided:
        return false_alarm / 2
    return false_alarm
