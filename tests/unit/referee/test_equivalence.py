"""Is a right scale shown, and only a right one? Two one-sided tests by hand, and the runs that would decide.

Seeds are fixed and were not chosen; counts have limits at 1e-5.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from draws import independent, verdict_on
from scipy import stats

from consistency.referee.diagnostics import Evidence, Settings, e_process, ever, judge, nis_test
from consistency.referee.diagnostics.questions import equivalence
from consistency.referee.diagnostics.questions.equivalence import equivalence_by_betting, equivalence_of_innovations
from consistency.referee.diagnostics.questions.scale import scale_test
from consistency.referee.types import Array

SURE = 1e-5


def means_of(rng: np.random.Generator, runs: int, nu: float = 3.0, ratio: float = 1.0) -> Array:
    return ratio * rng.chisquare(nu, runs) / nu


# --- two one-sided tests --------------------------------------------------------------------------------


@pytest.mark.parametrize("detect", [1.5, 2.0, 0.5, 1.25])
@pytest.mark.parametrize("ratio", [0.6, 1.0, 1.4])
def test_by_hand_below_twenty_runs(detect: float, ratio: float) -> None:
    """Chi-square of N n degrees of freedom at both ends of the interval."""
    n, means = 3, means_of(np.random.default_rng(21), 19, ratio=ratio)
    k, total, d = 19 * n, n * means.sum(), max(detect, 1 / detect)
    too_large, too_small = stats.chi2.cdf(total / d, k), stats.chi2.sf(total * d, k)
    both = equivalence(means, n, 50, Settings(detect=detect))
    assert both.p_value == pytest.approx(max(too_large, too_small), rel=1e-9)
    assert both.factor == pytest.approx(d)
    assert both.level == pytest.approx(0.05)
    one = equivalence(means, n, 50, Settings(detect=detect, allow="conservative"))
    assert one.p_value == pytest.approx(too_large, rel=1e-9)


@pytest.mark.parametrize("allow", [None, "conservative"])
@pytest.mark.parametrize("ratio", [0.72, 1.0, 1.35])
def test_by_the_test_of_means_from_twenty_runs_on(ratio: float, allow: str | None) -> None:
    means = means_of(np.random.default_rng(22), 40, 8.0, ratio)
    result = equivalence(means, 2, 50, Settings(detect=1.4, allow=allow))
    below, above = scale_test(means / 1.4, 2, 50).below, scale_test(means * 1.4, 2, 50).above
    assert result.p_value == pytest.approx(below if allow else max(below, above))
    assert below != pytest.approx(above, rel=0.01)


def test_level_is_one_less_the_power() -> None:
    means = np.full(19, 1.0) + 1e-9
    for power in (0.8, 0.95, 0.999):
        result = equivalence(means, 3, 50, Settings(power=power))
        assert result.level == pytest.approx(1 - power)
        assert result.shown == (result.p_value <= 1 - power)
    at_stake = equivalence(means, 3, 50, Settings()).p_value
    assert equivalence(means, 3, 50, Settings(power=1 - 1.01 * at_stake)).shown
    assert not equivalence(means, 3, 50, Settings(power=1 - 0.99 * at_stake)).shown


def test_another_factor_than_that_of_the_settings() -> None:
    means = means_of(np.random.default_rng(23), 15)
    result = equivalence(means, 3, 50, Settings(detect=1.5), 3.0)
    assert result.factor == 3.0
    assert result.p_value == pytest.approx(equivalence(means, 3, 50, Settings(detect=3.0)).p_value)


@pytest.mark.parametrize("ratio", [1.5, 1 / 1.5])
@pytest.mark.parametrize("runs", [12, 40])
def test_a_ratio_at_the_end_is_seldom_called_equivalent(ratio: float, runs: int) -> None:
    """Fully dependent, 500 draws at 5 % (Student's t leaves up to .7 % more from 20 runs on)."""
    rng = np.random.default_rng(24)
    shown = sum(equivalence(means_of(rng, runs, 3.0, ratio), 3, 50, Settings()).shown for _ in range(500))
    assert shown <= stats.binom.isf(SURE, 500, 0.057)


def test_nothing_is_shown_of_nothing() -> None:
    result = equivalence(np.empty(0), 3, 0, Settings())
    assert np.isnan(result.p_value)
    assert not result.shown
    assert result.runs is None


# --- runs that would decide ----------------------------------------------------------------------------


def test_runs_that_would_decide_by_hand() -> None:
    """2 / nu ((z + z') / distance)^2, to the nearer of 'shown' and 'at fault'."""
    z = stats.norm.ppf
    means = means_of(np.random.default_rng(27), 40)
    for ratio, allow, expected in (
        (1.0, None, 2 / 3 * (2 * z(0.9) / np.log(1.5)) ** 2),
        (1.2, None, 2 / 3 * (2 * z(0.9) / np.log(1.5 / 1.2)) ** 2),
        (1.4, None, 2 / 3 * ((z(0.9) + z(1 - 0.02 / 4)) / np.log(1.4)) ** 2),
        (1.4, "conservative", 2 / 3 * ((z(0.9) + z(1 - 0.02 / 2)) / np.log(1.4)) ** 2),
        (0.7, None, 2 / 3 * ((z(0.9) + z(1 - 0.02 / 4)) / np.log(1 / 0.7)) ** 2),
    ):
        settings = Settings(false_alarm=0.02, power=0.9, allow=allow)
        result = equivalence(means / means.mean() * ratio, 3, 1, settings)
        assert result.runs == max(int(np.ceil(expected)), 20)


def test_few_runs_are_taken_for_right() -> None:
    """19 runs do not know their ratio; what would decide is worked out at 1 and the worst case."""
    z = stats.norm.ppf
    result = equivalence(np.full(19, 3.0), 2, 50, Settings())
    assert result.runs == int(np.ceil((2 * z(0.95) / np.log(1.5)) ** 2))


def test_no_advice_where_there_is_none() -> None:
    assert equivalence(np.zeros(30), 3, 1, Settings()).runs is None
    near = equivalence(np.full(5, 1.0), 1, 1, Settings(detect=1.0001))
    assert near.runs is None


def test_what_may_be_conservative_is_far_from_the_end() -> None:
    """One-sided, a ratio of .7 is farther from 1.5 than one of 1; it is no fault, and takes fewer runs to show."""
    z, means = stats.norm.ppf, means_of(np.random.default_rng(28), 40)
    result = equivalence(0.7 * means / means.mean(), 3, 1, Settings(allow="conservative", power=0.999))
    assert result.runs == int(np.ceil(2 / 3 * (2 * z(0.999) / np.log(1.5 / 0.7)) ** 2))


# --- by betting, and of innovations -----------------------------------------------------------------------


@pytest.mark.parametrize("ratio", [0.85, 1.1])
@pytest.mark.parametrize("allow", [None, "conservative"])
def test_by_betting(allow: str | None, ratio: float) -> None:
    """The e-process of Y / d against 'none is too large', that of Y d against 'none is too small'."""
    means, d = means_of(np.random.default_rng(29), 60, 20.0, ratio), 1.6
    result = equivalence_by_betting(means, 3, Settings(detect=d, allow=allow))
    too_large, too_small = ever(e_process(means / d, 3).down), ever(e_process(means * d, 3).up)
    assert (too_large < too_small) == (ratio < 1)
    assert result.p_value == pytest.approx(too_large if allow else max(too_large, too_small))
    assert (result.factor, result.level, result.runs) == (d, pytest.approx(0.05), None)


def test_of_innovations() -> None:
    rng = np.random.default_rng(31)
    nis, dof = 1.05 * rng.chisquare(2, (10, 20)), np.full((10, 20), 2)
    test = nis_test(nis, dof)
    d, total = 1.2, nis.sum()
    expected = stats.chi2.cdf(total / d, 400), stats.chi2.sf(total * d, 400)
    both = equivalence_of_innovations(test, Settings(detect=d))
    assert both.p_value == pytest.approx(max(expected), rel=1e-9)
    one = equivalence_of_innovations(test, Settings(detect=d, allow="conservative", power=0.9))
    assert one.p_value == pytest.approx(expected[0], rel=1e-9)
    assert one.level == pytest.approx(0.1)
    nothing = equivalence_of_innovations(nis_test(nis * np.nan, dof), Settings())
    assert np.isnan(nothing.p_value)
    assert not nothing.shown


# --- in a verdict ---------------------------------------------------------------------------------------


def test_consistent_is_shown_and_nothing_else() -> None:
    rng = np.random.default_rng(32)
    many = verdict_on(independent(rng, 60, 10, 3), false_alarm=SURE)
    assert many.status == "consistent"
    assert many.equivalence.shown
    narrow = verdict_on(independent(rng, 60, 10, 3), false_alarm=SURE, detect=1.001)
    assert narrow.status == "undecided"
    assert not narrow.equivalence.shown
    assert narrow.faults == ()


def test_a_single_honest_log_is_undecided() -> None:
    rng = np.random.default_rng(33)
    verdict = verdict_on(independent(rng, 1, 300, 3), false_alarm=SURE)
    assert verdict.status == "undecided"
    assert verdict.faults == ()
    assert "1 run does not show" in verdict.reasons[0]


def test_nothing_is_shown_by_innovations_that_are_not_judged() -> None:
    rng = np.random.default_rng(34)
    nis, dof = rng.chisquare(2, (40, 50)), np.full((40, 50), 2)
    assert judge(Evidence("f", nis=nis, nis_dof=dof), Settings(SURE)).status == "undecided"
    optimal = judge(Evidence("f", nis=nis, nis_dof=dof, optimal_gain=True), Settings(SURE))
    assert optimal.status == "consistent"
    assert judge(Evidence("f", nis=nis, nis_dof=dof, optimal_gain=True), Settings(SURE, 1.0001)).status == "undecided"


def test_innovations_of_nearly_the_stated_size_are_tolerated() -> None:
    """4 % too small in 40,000 innovations is found, shown to lie within 1.1 and not within 1.02; no chance in it."""
    nis = 1.04 * stats.chi2.ppf((np.random.default_rng(0).permutation(40_000) + 0.5) / 40_000, 2).reshape(400, 100)
    evidence = Evidence("f", nis=nis, nis_dof=np.full(nis.shape, 2), optimal_gain=True)
    assert judge(evidence).status == "overconfident"
    verdict = judge(evidence, Settings(tolerance=1.1))
    assert (verdict.status, verdict.faults) == ("consistent", ())
    assert [a.question for a in verdict.answers if a.tolerated] == ["innovation scale"]
    assert judge(evidence, Settings(tolerance=1.02)).status == "overconfident"
    assert not judge(replace(evidence, optimal_gain=False), Settings(tolerance=1.1)).answers
