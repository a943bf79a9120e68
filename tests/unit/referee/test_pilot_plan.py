"""Runs that a verdict takes, from a few runs: by hand, and against what verdicts with so many runs find."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from consistency.referee.diagnostics import gate_runs, pilot_plan, power_of, required_runs
from consistency.referee.diagnostics.questions.scale import scale_test
from consistency.referee.types import Array


def pilot(runs: int = 40, nu: float = 20.0, seed: int = 91) -> Array:
    return np.random.default_rng(seed).chisquare(nu, runs) / nu


def chi_square_power(k: float, ratio: float, tail: float) -> float:
    """Of a test of ratio times chi-square(k), at the side of ``ratio``."""
    if ratio > 1:
        return float(stats.chi2.sf(stats.chi2.ppf(1 - tail, k) / ratio, k))
    return float(stats.chi2.cdf(stats.chi2.ppf(tail, k) / ratio, k))


@pytest.mark.parametrize(
    ("detect", "allow"), [(1.2, None), (1.5, None), (0.67, None), (1.2, "conservative"), (1.5, "conservative")]
)
def test_by_hand(detect: float, allow: str | None) -> None:
    """The least N with the power, at half of the rate and the pilot's nu, times 1.15 and rounded up."""
    means, dof, false_alarm, power = pilot(), 3, 0.04, 0.9
    test = scale_test(means / means.mean(), dof, 60)
    tail = 0.02 if allow else 0.01
    runs = 1
    while chi_square_power(runs * test.effective_dof, detect, tail) < power:
        runs += 1
    plan = pilot_plan(means, dof, 60, detect, false_alarm, power, allow)
    assert plan.runs == max(20, int(np.ceil(1.15 * runs)))
    assert plan.pilot_runs == 40
    assert plan.effective_dof == pytest.approx(test.effective_dof)
    assert plan.standard_error == pytest.approx(np.sqrt(2.0 / test.spread))
    assert 0.0 < plan.standard_error < 1.0
    assert plan.effective_dof > dof


def test_never_more_than_without_a_pilot() -> None:
    """A pilot whose runs spread as one step does: the plan of the worst case, and no margin on it."""
    means = pilot(30, 3.0, 92)
    plan = pilot_plan(means, 3, 60, 1.5)
    assert plan.effective_dof == 3.0
    assert plan.standard_error == 0.0
    assert plan.runs == gate_runs(3, 1.5)
    assert pilot_plan(means, 3, 60, 1.5, allow="conservative").runs == gate_runs(3, 1.5, allow="conservative")
    assert gate_runs(3, 1.5, allow="conservative") < gate_runs(3, 1.5)


def test_the_scale_of_the_pilot_does_not_matter() -> None:
    """Many pilots: one that is overconfident by 4 is planned for as a right one is."""
    for seed in range(20):
        means = pilot(seed=seed)
        plans = {c: pilot_plan(c * means, 3, 60, 1.2).runs for c in (0.25, 1.0, 4.0)}
        assert len(set(plans.values())) == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"means": np.ones(19)}, "a pilot needs at least 20 runs, got 19"),
        ({"detect": 1.0}, "ratio must be positive and not 1"),
        ({"detect": -2.0}, "ratio must be positive"),
        ({"detect": 1.000001}, "more than"),
        ({"false_alarm": 0.0}, "false_alarm must lie between"),
        ({"power": 1.0}, "power must lie between"),
        ({"dof": 0}, "dof must be at least 1"),
    ],
)
def test_what_cannot_be_planned_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        pilot_plan(**{"means": pilot(), "dof": 3, "steps": 60, "detect": 1.5, **options})


def test_power_of_fractional_degrees_of_freedom() -> None:
    """nu is no whole number; between its neighbours."""
    low, middle, high = (power_of(nu, 50, 1.2, 0.05) for nu in (7.0, 7.5, 8.0))
    assert low < middle < high
    assert required_runs(8.0, 1.2) < required_runs(7.5, 1.2) < required_runs(7.0, 1.2)
    assert middle == pytest.approx(chi_square_power(50 * 7.5, 1.2, 0.025))
