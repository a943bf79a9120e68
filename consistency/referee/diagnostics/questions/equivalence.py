"""Tests that show the scale to be right; the absence of a fault does not show it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from consistency.referee.diagnostics.questions.scale import FEW, MeanTest, scale_test
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.diagnostics.statistics.nees import EarlyMeans, e_processes, ever
from consistency.referee.diagnostics.statistics.number_of_runs import LARGEST
from consistency.referee.diagnostics.verdict.answers import MAIN, SHARES, Settings
from consistency.referee.diagnostics.verdict.parts import Equivalence
from consistency.referee.types import Array

FARTHEST = 15.0  # log of a ratio, beyond which an interval has no end
HALVINGS = 16  # of an interval in which an end is looked for


def equivalence(
    means: Array,
    dof: int,
    steps: int,
    settings: Settings,
    factor: float | None = None,
    low_is_fault: bool = True,
    unseen: float = 0.0,
    share: float = 0.0,
    weights: Array | None = None,
    is_whole: bool = False,
    test: Callable[[float], MeanTest] | None = None,
) -> Equivalence:
    """Two one-sided tests that the ratio of true to stated covariance lies in [1 / factor, factor].

    The ratio is below ``factor`` if the test of run means Y / factor finds them too small, and above its inverse if
    that of Y factor finds them too large; both at ``1 - power`` (Schuirmann 1987). A ratio at either end, or beyond,
    is called equivalent with that probability at most.

    The covariance may be right in some runs and wrong in others, which then differ more than Gaussian errors of one
    covariance: the effective degrees of freedom of a run may be fewer than ``dof``.

    Parameters
    ----------
    means : (runs,), mean NEES of each run over ``dof``
    steps : of the longest run
    factor : ``settings.factor`` where it is not given
    low_is_fault : whether a ratio below 1 is a fault, which more runs may find
    unseen : share of the NEES that ``means`` may lack; the ratio is then as much larger on its upper side
    share : of errors of the truth in the covariances of ``means``; the ratio is of the others
    weights : (runs,), of the runs in the mean; None where they are equal
    is_whole : the interval of the two tests is worked out, too
    test : that of the means over a number, in place of :func:`scale_test`
    """
    factor = settings.factor if factor is None else factor
    top = (share + (1.0 - share) * factor) * (1.0 - unseen)
    bottom = share + (1.0 - share) / factor

    def scaled(size: float) -> MeanTest:
        if test is not None:
            return test(size)
        return scale_test(means / size, dof, steps, False, weights)

    def p_below(ratio: float) -> float:
        size = (share + (1.0 - share) * ratio) * (1.0 - unseen)
        return scaled(size).below if size > 0 else 1.0

    def p_above(ratio: float) -> float:
        return scaled(share + (1.0 - share) * ratio).above

    ratio = float("nan")
    if is_whole and len(means):
        ratio = (float(np.average(means, weights=weights)) - share) / (1.0 - share)
    runs = None
    if top > 1.0:
        nearer = min(top, 1.0 / bottom) if share and not settings.one_sided else top
        runs = deciding_runs(scale_test(means, dof, steps, False, weights), nearer, settings, low_is_fault)
    return equivalent(p_below, p_above, ratio, factor, settings, runs)


def equivalent(
    below: Callable[[float], float],
    above: Callable[[float], float],
    ratio: float,
    factor: float,
    settings: Settings,
    runs: int | None = None,
) -> Equivalence:
    """Equivalence by two one-sided tests, with the interval of the ratios that neither excludes.

    The interval lies inside [1 / factor, factor] where equivalence is shown.

    Parameters
    ----------
    below, above : p values of the ratio being as large as a number, or as small
    ratio : the estimated one; the interval needs one above 0
    """
    p_value = below(factor)
    if not settings.one_sided:
        p_value = max(p_value, above(1.0 / factor))
    level = 1.0 - settings.power
    interval = None
    if ratio > 0 and np.isfinite(ratio):
        interval = _end(above, ratio, -1.0, level), _end(below, ratio, 1.0, level)
    return Equivalence(factor, float(p_value), level, runs, settings.one_sided, interval)


def _end(p_value: Callable[[float], float], ratio: float, sign: float, level: float) -> float:
    """The ratio from which on, upwards or downwards, a test excludes all."""
    inside = 0.0
    step = 0.1
    while p_value(ratio * float(np.exp(sign * step))) > level:
        inside = step
        step = 2.0 * step
        if step > FARTHEST:
            return float("inf") if sign > 0 else 0.0
    outside = step
    for _ in range(HALVINGS):
        middle = 0.5 * (inside + outside)
        if p_value(ratio * float(np.exp(sign * middle))) > level:
            inside = middle
        else:
            outside = middle
    return ratio * float(np.exp(sign * outside))


def equivalence_by_betting(means: Array, dof: int, settings: Settings, early: EarlyMeans | None = None) -> Equivalence:
    """Equivalence of the scale from the inverted e-process: valid at any look, and under any dependence.

    Parameters
    ----------
    means : (runs,), mean over its steps of each run's NEES over ``dof``
    dof : components of the error
    early : see :func:`e_processes`; None where runs have equally many steps
    """

    def below(ratio: float) -> float:
        return max(ever(bets.down) for bets in e_processes(means, dof, early, ratio))

    def above(ratio: float) -> float:
        return max(ever(bets.up) for bets in e_processes(means, dof, early, ratio))

    mean = float("nan")
    if len(means):
        mean = float(means.mean())
    return equivalent(below, above, mean, settings.factor, settings)


def equivalence_of_total(total: float, dof: int, settings: Settings, factor: float) -> Equivalence:
    """Equivalence of the scale from a total that is chi-square with ``dof`` degrees of freedom if the ratio is 1.

    The total NIS is, as innovations are independent over steps too, and so is the joint NEES of pose and map.
    """
    if not dof:
        return Equivalence(factor, float("nan"), 1.0 - settings.power, None)

    def below(ratio: float) -> float:
        return float(distributions.chi2.cdf(total / ratio, dof))

    def above(ratio: float) -> float:
        return float(distributions.chi2.sf(total / ratio, dof))

    return equivalent(below, above, total / dof, factor, settings)


def is_tolerated(total: float, dof: int, settings: Settings) -> bool:
    """Whether the ratio is shown to lie within the tolerance, see :func:`equivalence_of_total`."""
    return settings.tolerance is not None and equivalence_of_total(total, dof, settings, settings.tolerated).shown


def worst(parts: Sequence[Equivalence]) -> Equivalence:
    """Equivalence of all parts: shown where each of them is, by the runs that decide for each."""
    last = max(parts, key=lambda e: np.nan_to_num(e.p_value, nan=np.inf))
    runs = [e.runs for e in parts if not e.shown]
    return replace(last, runs=None if None in runs else max((r for r in runs if r is not None), default=last.runs))


def deciding_runs(test: MeanTest, factor: float, settings: Settings, low_is_fault: bool = True) -> int | None:
    """Number of runs that would probably show the ratio inside, or find it at fault, at its present estimate.

    From fewer than 20 runs the ratio is not known and is assumed to be right. Chi-square of k degrees of freedom
    is judged by its logarithm, of variance 2 / k; each with probability ``power``.
    """
    if not test.runs or not test.ratio > 0:
        return None
    off = float(np.log(test.ratio)) if test.runs >= FEW else 0.0
    gap = off if settings.one_sided else abs(off)  # one-sided, a ratio below 1 is not a fault and farther from the end
    tail = SHARES[MAIN] * settings.false_alarm / (1 if settings.one_sided else 2)
    power = float(special.ndtri(settings.power))
    room = float(np.log(factor)) - gap
    fault = gap if low_is_fault or off > 0 else 0.0

    def runs(quantile: float, distance: float) -> float:
        return 2.0 / test.effective_dof * ((quantile + power) / distance) ** 2 if distance > 0 else float("inf")

    least = min(runs(power, room), runs(float(special.ndtri(1.0 - tail)), fault))
    return None if least > LARGEST else max(int(np.ceil(least)), FEW)
