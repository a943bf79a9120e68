"""Lost runs: the bound beyond which a run is lost, the share that stays open, and gates that ask for one.

Draws have a fixed seed that was not chosen; statistical limits are at 1e-5 or further out.
"""

import numpy as np
import pytest
from draws import identities, independent
from scipy import integrate, stats

from consistency.diagnostics import (
    Design,
    Settings,
    follow,
    gate_runs,
    judge,
    look,
    lost_bound,
    lost_runs,
    make_record,
    pilot_plan,
)
from consistency.referee.diagnostics.number_of_runs import share_limit
from consistency.referee.diagnostics.tails import lost_evidence, lost_of
from consistency.referee.gating.session import RunningTest, watching
from consistency.referee.types import Failure
from consistency.referee.verdicts.judge_sources import plan_runs
from consistency.testing import InsufficientTrials, assert_consistent

SURE = 1e-5


def verdict_on(nees, failures=(), **settings):
    return judge(make_record("f", nees=nees, dof=3, failures=failures), Settings(**settings))


def right(runs, steps=4):
    """NEES whose mean is 3 and whose distribution is chi-square's in every step: quantiles, no chance in it."""
    levels = (np.arange(runs) + 0.5) / runs
    order = np.random.default_rng(3)
    return np.stack([order.permutation(stats.chi2.ppf(levels, 3)) for _ in range(steps)], axis=1)


# --- the bound -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dof", [1, 3, 6])
@pytest.mark.parametrize("rate", [0.05, 1e-3, 1e-6])
def test_the_bound_is_the_mean_beyond_the_quantile(dof, rate):
    q = stats.chi2.isf(rate, dof)
    mean, _ = integrate.quad(lambda x: x * stats.chi2.pdf(x, dof), q, np.inf, epsabs=1e-14)
    assert float(lost_bound(dof, rate)) == pytest.approx(mean / rate, rel=1e-6)
    assert float(lost_bound(dof, rate)) > q


# --- the share -------------------------------------------------------------------------------------------


def test_none_lost_leaves_a_share_open():
    assert share_limit(0, 50) == pytest.approx(1.0 - 0.05 ** (1 / 50))
    assert share_limit(2, 40) == pytest.approx(stats.beta.ppf(0.95, 3, 38))
    assert share_limit(7, 7) == 1.0
    assert stats.binom.cdf(3, 90, share_limit(3, 90, 0.99)) == pytest.approx(0.01)


@pytest.mark.parametrize("lost, runs", [(0, 59), (1, 93), (2, 124)])
def test_runs_that_exclude_five_percent(lost, runs):
    assert lost_runs(0.05, lost=lost) == runs
    assert share_limit(lost, runs) <= 0.05 < share_limit(lost, runs - 1)


def test_plans_have_at_least_these_runs():
    assert gate_runs(3, 2.0) == 21
    assert gate_runs(3, 2.0, lost=0.05) == 59
    assert gate_runs(3, 2.0, power=0.9, lost=0.05) == lost_runs(0.05, 0.9) == 45
    assert gate_runs(3, 1.2, lost=0.05) == gate_runs(3, 1.2)
    means = np.linspace(0.9, 1.1, 40)
    assert pilot_plan(means, 3, 100, 2.0, lost=0.05).runs == 59 > pilot_plan(means, 3, 100, 2.0).runs


def test_a_plan_has_thirty_runs_and_a_gate_what_its_scale_takes():
    assert plan_runs(15, 1.5, 0.05, 0.95)["runs"] == 30 > gate_runs(15, 1.5) == 13
    assert plan_runs(3, 1.5, 0.05, 0.95)["runs"] == gate_runs(3, 1.5) == 61
    assert pilot_plan(np.linspace(0.99, 1.01, 40), 15, 100, 2.0).runs == 30


def test_a_share_out_of_range_is_refused():
    for share in (0.0, 1.0, -0.1):
        with pytest.raises(ValueError, match="lost must lie between 0 and 1"):
            lost_runs(share)
        with pytest.raises(ValueError, match="lost must lie between 0 and 1"):
            Settings(lost=share)
        with pytest.raises(ValueError, match="lost must lie between 0 and 1"):
            assert_consistent(nees=right(60), dof=3, lost=share)
    with pytest.raises(ValueError, match="needs more than 10000000 runs"):
        lost_runs(1e-8)


# --- verdicts --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("runs, status", [(58, "undecided"), (59, "consistent")])
def test_a_share_that_is_asked_for_takes_its_runs(runs, status):
    verdict = verdict_on(right(runs), lost=0.05)
    assert verdict_on(right(runs)).status == "consistent"
    assert verdict.status == status
    if status == "undecided":
        assert "but up to 5.03 % of runs may still be lost, and 5 % is asked for" in verdict.reasons[0]
        assert "59 runs would show it, if no further one is lost" in verdict.reasons[0]
    else:
        assert "lost runs are shown to be at most 5 % of all (none of 59 is)" in verdict.reasons[0]
    assert verdict.answers == verdict_on(right(runs)).answers


def test_a_run_beyond_the_bound_is_lost():
    """The bound is that of the rate over the number of runs; one run just beyond it is lost, one just below is not."""
    bound = float(lost_bound(3, 0.05 / 60))
    for factor, count in ((0.999, 0), (1.001, 1)):
        nees = right(60)
        nees[7] = factor * bound
        lost = verdict_on(nees).lost
        assert (lost.count, lost.runs) == (count, 60)
        assert lost.bound == pytest.approx(bound)
        assert lost.upper == pytest.approx(share_limit(count, 60))


def test_a_lost_run_takes_more_runs():
    nees = right(500)
    nees[7] = 1.5 * float(lost_bound(3, 0.05 / 500))
    free, asked = verdict_on(nees, false_alarm=0.05), verdict_on(nees, lost=0.05)
    assert free.faults == ()
    assert "; 1 run of 500 is lost, and up to 0.95 % of runs may still be lost" in free.reasons[0]
    assert asked.status == "consistent"
    assert "(1 run of 500 is lost)" in asked.reasons[0]
    fewer = verdict_on(nees[:92], lost=0.05)
    assert fewer.status == "undecided"
    assert fewer.lost.needed == 93


def test_failed_runs_are_lost_and_runs_without_a_value_are_none(rng):
    nees = right(60)
    nees[3], nees[5] = np.nan, np.nan
    evidence = make_record("f", nees=nees, dof=3, failures=(Failure("f", 13, 2, "broke"),), runs=np.arange(60) + 10)
    lost = lost_of(evidence, nees, 3, Settings())
    assert (lost.count, lost.runs) == (1, 59)
    assert (
        lost_of(make_record("f", nees=np.full((2, 3), np.nan), dof=3), np.full((2, 3), np.nan), 3, Settings()) is None
    )


def test_innovations_alone_show_no_share(rng):
    nis = {"nis": rng.chisquare(2, (200, 30)), "nis_dof": np.full((200, 30), 2)}
    verdict = judge(make_record("f", **nis, optimal_gain=True), Settings(SURE, lost=0.05))
    assert verdict.status == "undecided"
    assert "cannot show" in verdict.reasons[0]


# --- until decided -----------------------------------------------------------------------------------------


def test_the_bet_against_a_share():
    none = np.zeros(100, bool)
    evidence = lost_evidence(none, 0.05)
    by_hand = np.mean([((1.0 - q) / 0.95) ** 100 for q in (0.0, 0.00625, 0.0125, 0.025)])
    assert evidence[-1] == pytest.approx(by_hand)
    first = int(np.flatnonzero(evidence >= 20.0)[0]) + 1
    assert 59 < first < 90  # a little more than a single look takes
    one = none.copy()
    one[0] = True
    assert lost_evidence(one, 0.05)[-1] == pytest.approx(
        np.mean([q / 0.05 * ((1.0 - q) / 0.95) ** 99 for q in (0.0, 0.00625, 0.0125, 0.025)])
    )


def test_until_decided_goes_on_until_the_share_is_excluded():
    nees = right(400)
    free, runs = follow(Design(3, max_runs=400), lambda n: make_record("f", nees=nees[:n], dof=3))
    asked, more = follow(Design(3, max_runs=400, lost=0.05), lambda n: make_record("f", nees=nees[:n], dof=3))
    assert (free.status, asked.status) == ("consistent", "consistent")
    assert runs < more == 96
    assert asked.lost.upper <= 0.05
    assert asked.reasons[0].count("lost runs") == 1
    early = look(Design(3, lost=0.05), make_record("f", nees=nees[:48], dof=3), 0.1)
    assert early.lost.upper > 0.05
    assert early.lost.bound == pytest.approx(float(lost_bound(3, 0.05 / (48 * 49))))
    needed = early.lost.needed
    assert lost_evidence(np.zeros(needed, bool), 0.05)[-1] >= 20.0 > lost_evidence(np.zeros(needed - 1, bool), 0.05)[-1]


# --- gates -------------------------------------------------------------------------------------------------


def test_a_gate_asks_for_runs_that_exclude_the_share(rng):
    error = independent(rng, 110, 6, 3)
    assert_consistent(error, identities(error), false_alarm=SURE)
    with pytest.raises(InsufficientTrials, match=r"up to 2\.69 % of runs may still be lost.*--lost 0\.01") as few:
        assert_consistent(error, identities(error), false_alarm=SURE, lost=0.01)
    assert few.value.needed == lost_runs(0.01) == 299
    assert "or ask for a larger detect and a larger lost" in str(few.value)
    assert_consistent(error, identities(error), false_alarm=SURE, lost=0.05)


def test_a_marker_may_ask(rng):
    error = independent(rng, 110, 6, 3)
    entries = []
    with watching(RunningTest({"lost": 0.01}, keep=entries.append)), pytest.raises(InsufficientTrials):
        assert_consistent(error, identities(error), false_alarm=SURE)
    assert entries[0].lost == 0.01
    with watching(RunningTest({"lost": 0.01}, budget=1e-3, keep=entries.append)), pytest.raises(InsufficientTrials):
        assert_consistent(error, identities(error))
    assert entries[1].lost == 0.01
    assert entries[1].needed == 299
