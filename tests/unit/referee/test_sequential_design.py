"""Looks while runs come, whose decisions stand, and bets on run means, each fair by integration.

Seeds are fixed and were not chosen; counts have limits at 1e-5.
"""

import functools
import itertools

import numpy as np
import pytest
from draws import identities, independent
from scipy import integrate, stats

from consistency.diagnostics import (
    Design,
    e_process,
    ever,
    follow,
    judge,
    look,
    make_record,
    sequential_design,
)
from consistency.referee.diagnostics import judge_record
from consistency.referee.diagnostics import nees as betting
from consistency.referee.diagnostics.record_findings import InterimLook, findings_of
from consistency.referee.diagnostics.scale import equivalence, equivalence_by_betting
from consistency.referee.diagnostics.verdict import Findings
from consistency.referee.types import Failure

SURE = 1e-5


def inspections(design, count):
    return list(itertools.islice(design.inspections(), count))


def evidence_from(error, **more):
    """The first runs of a filter, as many as asked for."""
    P = identities(error)
    return lambda runs: make_record("f", error[:runs], P[:runs], **more)


# --- the grid -----------------------------------------------------------------------------------------


def test_looks_double_and_the_scale_is_looked_at_in_between():
    found = inspections(Design(3), 13)
    assert [runs for runs, _ in found] == [12, 15, 18, 21, 24, 30, 36, 42, 48, 60, 72, 84, 96]
    spent = dict(found)
    assert [runs for runs, s in found if s is not None] == [12, 24, 48, 96]
    assert [spent[n] for n in (12, 24, 48, 96)] == pytest.approx([1 / 2, 1 / 6, 1 / 12, 1 / 20])


def test_all_looks_cost_the_rate_once():
    costs = [s for _, s in inspections(Design(3), 400) if s is not None]
    assert len(costs) == 100
    assert 0.98 < sum(costs) < 1.0


@pytest.mark.parametrize("max_runs", [1, 12, 13, 16, 24, 25, 47, 1000])
def test_a_limit_on_runs_ends_with_a_look(max_runs):
    found = list(Design(3, max_runs=max_runs).inspections())
    runs = [n for n, _ in found]
    assert runs[-1] == max_runs
    assert found[-1][1] is not None
    assert all(a < b for a, b in itertools.pairwise(runs))
    assert sum(s for _, s in found if s is not None) <= 1.0
    free = inspections(Design(3), len(found))
    assert found[:-1] == free[: len(found) - 1]


@pytest.mark.parametrize(
    "options",
    [
        {"max_runs": 0},
        {"dof": 0},
        {"detect": 1.0},
        {"false_alarm": 0.0},
        {"power": 1.0},
    ],
)
def test_what_cannot_be_is_refused(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        sequential_design(**{"dof": 3, **options})


def test_settings_are_those_of_the_plan():
    settings = sequential_design(2, 0.5, 0.01, 0.9, 40).settings
    assert (settings.detect, settings.false_alarm, settings.power, settings.allow) == (0.5, 0.01, 0.9, None)


# --- one look ------------------------------------------------------------------------------------------


def test_the_scale_is_that_of_the_e_process_and_the_rest_pays_for_the_look():
    rng = np.random.default_rng(71)
    error = 1.1 * independent(rng, 24, 6, 3)
    error[:20] *= 1.3  # earlier evidence counts though it has faded
    evidence = evidence_from(error)(24)
    means = np.square(error).sum(axis=-1).mean(axis=1) / 3
    expected = ever(e_process(means, 3).both)
    plain = {a.question: a.p_value for a in judge(evidence).answers}
    at = {a.question: a.p_value for a in look(Design(3), evidence, 1 / 6).answers}
    assert set(at) == set(plain)
    assert at.pop("scale") == pytest.approx(expected)
    assert at == pytest.approx({q: min(1.0, 6 * p) for q, p in plain.items() if q != "scale"})
    between = {a.question: a.p_value for a in look(Design(3), evidence, None).answers}
    assert between.pop("scale") == pytest.approx(expected)
    assert set(between.values()) == {1.0}


def test_what_is_shown_is_shown_by_betting():
    error = independent(np.random.default_rng(73), 96, 6, 3)
    verdict = look(Design(3, detect=1.7), evidence_from(error)(96), 0.05)
    means = np.square(error).sum(axis=-1).mean(axis=1) / 3
    expected = equivalence_by_betting(means, 3, Design(3, detect=1.7).settings)
    assert verdict.equivalence == expected


def test_consistent_is_said_at_looks_only():
    evidence = evidence_from(independent(np.random.default_rng(74), 200, 20, 3))(200)
    design = Design(3, false_alarm=SURE)
    assert look(design, evidence, 0.05).status == "consistent"
    between = look(design, evidence, None)
    assert (between.status, between.later) == ("undecided", True)
    assert between.reasons[0].startswith("undecided: no fault found; an all-clear takes a look at all questions")
    assert between.faults == ()


def test_an_all_clear_takes_thirty_runs():
    """15 errors show their scale with 24 runs, but too few runs to show that hardly any has a wrong covariance."""
    evidence_of = evidence_from(independent(np.random.default_rng(74), 48, 20, 15))
    design = Design(15, false_alarm=SURE)
    early = look(design, evidence_of(24), 1 / 6)
    assert (early.status, early.later, early.faults) == ("undecided", True, ())
    assert early.scale.equivalence.shown
    assert "with 30 runs or more" in early.reasons[0]
    assert look(design, evidence_of(30), 1 / 6).status == "consistent"
    verdict, runs = follow(design, evidence_of, 48)
    assert (verdict.status, runs) == ("consistent", 48)


def test_an_all_clear_at_a_look_takes_the_test_of_its_runs_too():
    """Two of 48 runs are wrong by x4: bets on the mean show it to be near 1, the test of unlike runs does not."""
    means = np.where(np.arange(48) < 2, 4.0, 0.97)
    evidence = make_record("f", nees=np.broadcast_to(3.0 * means[:, None], (48, 20)), dof=3)
    settings = Design(3).settings
    assert equivalence_by_betting(means, 3, settings).shown
    of_runs = equivalence(means, 3, 20, settings, is_whole=True)
    assert not of_runs.shown
    shown = findings_of(evidence, settings, InterimLook(1 / 12, 1.0)).scale.equivalence
    assert [shown.p_value, *shown.interval] == pytest.approx([of_runs.p_value, *of_runs.interval])


def test_a_gross_fault_is_found_between_looks_too():
    error = np.sqrt(20.0) * independent(np.random.default_rng(75), 15, 6, 3)
    assert look(Design(3), evidence_from(error)(15), None).status == "overconfident"
    assert look(Design(3), evidence_from(error / 40.0)(15), None).status == "conservative"


def test_a_correlation_is_found_at_looks_only():
    error = independent(np.random.default_rng(76), 48, 20, 2)
    error[..., 1] = 0.9 * error[..., 0] + np.sqrt(0.19) * error[..., 1]
    design, evidence = Design(2, false_alarm=1e-3), evidence_from(error)(48)
    assert "shape" in look(design, evidence, 1 / 12).faults
    assert look(design, evidence, None).faults == ()


def test_failed_runs_decide_at_once():
    error = independent(np.random.default_rng(77), 15, 6, 3)
    failures = (Failure("f", 2, 1, "diverged"),)
    assert look(Design(3, false_alarm=SURE), evidence_from(error, failures=failures)(15), None).status == "failed"


def test_without_truth_looks_are_at_the_innovations():
    rng = np.random.default_rng(78)
    nis, dof = 2.0 * rng.chisquare(2, (48, 30)), np.full((48, 30), 2)
    evidence = make_record("f", nis=nis, nis_dof=dof, optimal_gain=True)
    design = Design(3, false_alarm=1e-3)
    assert look(design, evidence, None).status == "undecided"
    at_look = look(design, evidence, 1 / 12)
    assert at_look.status == "overconfident"
    scale = next(a for a in at_look.answers if a.question == "innovation scale")
    plain = next(a for a in judge(evidence).answers if a.question == "innovation scale")
    assert scale.p_value == pytest.approx(12 * plain.p_value)


def test_a_look_inside_judge():
    """A scale just below and just above its half of the rate."""
    evidence = evidence_from(independent(np.random.default_rng(79), 24, 6, 3))(24)
    design = Design(3, false_alarm=0.01)
    found = findings_of(evidence, design.settings, InterimLook(None, 0.00499))
    assert found.faults == ("scale",)
    assert findings_of(evidence, design.settings, InterimLook(None, 0.00501)).faults == ()


# --- until decided -------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_a_decision_stands_however_many_runs_follow(seed):
    rng = np.random.default_rng(seed)
    ratio = [1.0, 1.0, 1.6, 1.6, 0.5, 4.0][seed]
    error = np.sqrt(ratio) * independent(rng, 400, 5, 3)
    verdict, used = follow(Design(3), evidence_from(error), 400)
    assert verdict.status != "undecided"
    for limit in (used, used + 1, 2 * used, None):
        assert follow(Design(3), evidence_from(error), limit)[0].answers == verdict.answers
    spoiled = error.copy()
    spoiled[used:] *= 100.0  # what comes later is not looked at
    later, again = follow(Design(3), evidence_from(spoiled), 400)
    assert (later.status, later.reasons, again) == (verdict.status, verdict.reasons, used)


def test_a_limit_is_not_exceeded():
    error = independent(np.random.default_rng(82), 400, 2, 3)
    asked = []

    def evidence(runs):
        asked.append(runs)
        return evidence_from(error)(runs)

    design = Design(3, detect=1.0001)  # never shown
    for limit, expected in (
        (5, [5]),
        (12, [12]),
        (16, [12, 15]),
        (24, [12, 15, 18, 21, 24]),
        (29, [12, 15, 18, 21, 24]),
    ):
        asked.clear()
        verdict, used = follow(design, evidence, limit)
        assert asked == expected
        assert used == expected[-1]
        assert verdict.runs == used
    asked.clear()
    verdict, used = follow(Design(3, detect=1.0001, max_runs=20), evidence)
    assert asked == [12, 15, 18, 20]
    assert (verdict.status, used) == ("undecided", 20)


# --- the same for several filters at a time -----------------------------------------------------------------


def test_a_later_look_does_not_overwrite_a_decision(monkeypatch):
    """'early' is decided at the first look, and would be found consistent later; 'late' keeps the runs coming."""
    calls = []
    script = {("early", 12): "overconfident", ("late", 24): "conservative"}

    def findings_at(evidence, settings, inspection):
        runs = len(evidence.run_numbers)
        calls.append((evidence.name, runs))
        status = script.get((evidence.name, runs), "consistent" if evidence.name == "early" else "undecided")
        return Findings(evidence.name, status, runs, 1, settings)

    monkeypatch.setattr(judge_record, "findings_of", findings_at)
    monkeypatch.setattr(judge_record, "speaks", lambda design, evidence, spent: spent is not None)
    verdicts = {}

    def read(runs, name):
        return make_record(name, runs=np.arange(runs))

    counts = list(judge_record.looks(sequential_design(3), ["early", "late"], read, verdicts))
    assert counts == [12, 15, 18, 21, 24]
    assert {name: v.status for name, v in verdicts.items()} == {"early": "overconfident", "late": "conservative"}
    assert [call for call in calls if call[0] == "early"] == [("early", 12)]
    assert [runs for name, runs in calls if name == "late"] == [12, 24]
    assert list(verdicts) == ["early", "late"]


# --- betting on run means -------------------------------------------------------------------------------------


STAKES = [("up", stake) for stake in (0.1, 0.25, 0.5, 1.0)] + [("down", stake) for stake in (0.25, 0.5, 1.0, 2.0, 4.0)]


def only(monkeypatch, side, stake):
    """One stake in place of the mixture."""
    monkeypatch.setattr(betting, side.upper(), np.array([stake]))


NODES, WEIGHTS = np.polynomial.legendre.leggauss(60)


def mean_of_a_bet(side, n, ratio=1.0, kink=1.0):
    """Expected value after one run of one step, by Gauss-Legendre over the chi distribution of the error's length."""
    ends = [0.0, float(np.sqrt(n * kink / ratio)), float(np.sqrt(n * kink / ratio)) + 9.0]
    mean = 0.0
    for a, b in itertools.pairwise(ends):
        length = 0.5 * (a + b) + 0.5 * (b - a) * NODES
        value = np.array([getattr(e_process(np.array([y]), n), side)[0] for y in ratio * length**2 / n])
        mean += 0.5 * (b - a) * float((WEIGHTS * value * stats.chi(n).pdf(length)).sum())
    return mean


@pytest.mark.parametrize("n", [1, 2, 3, 6])
@pytest.mark.parametrize("side, stake", STAKES)
def test_every_bet_is_fair(monkeypatch, side, stake, n):
    """Mean 1 exactly if the covariance is right and the steps of a run are one; below 1 if it errs the other way."""
    only(monkeypatch, side, stake)
    kink = 1.0 + 1.0 / stake
    assert mean_of_a_bet(side, n, kink=kink) == pytest.approx(1.0, abs=1e-8)
    right, wrong = (1.3, 0.7) if side == "up" else (0.7, 1.3)
    assert mean_of_a_bet(side, n, right, kink) > 1.01
    assert mean_of_a_bet(side, n, wrong, kink) < 0.995


@functools.cache
def mean_pay(stake, n):
    """Of max(0, 1 - stake (Y - 1)) for Y = chi-square(n) / n."""

    def paid(length):
        return max(0.0, 1.0 - stake * (length**2 / n - 1.0)) * float(stats.chi.pdf(length, n))

    return float(integrate.quad(paid, 0.0, np.sqrt(n * (1.0 + 1.0 / stake)), epsabs=1e-12)[0])


def by_hand(means, dof):
    """Products and their means in plain numbers."""
    up, down = [1.0] * 4, [1.0] * 5
    all_up, all_down = [], []
    for y, n in zip(means, dof, strict=True):
        for i, stake in enumerate((0.1, 0.25, 0.5, 1.0)):
            up[i] *= 1.0 + stake * (y - 1.0)
        for i, stake in enumerate((0.25, 0.5, 1.0, 2.0, 4.0)):
            down[i] *= 0.98 * max(0.0, 1.0 - stake * (y - 1.0)) / mean_pay(stake, int(n)) + 0.02
        all_up.append(sum(up) / 4)
        all_down.append(sum(down) / 5)
    return all_up, all_down


def test_against_plain_products():
    """Over runs of unlike dimension, some far from 1."""
    rng = np.random.default_rng(11)
    dof = np.array([1, 3, 2, 3, 6, 1, 1, 2])
    means = np.append(rng.chisquare(dof) / dof, [0.0, 0.3, 7.0])
    dof = np.append(dof, [2, 1, 3])
    bet = e_process(means, dof)
    up, down = by_hand(means, dof)
    assert bet.up == pytest.approx(up, rel=1e-7)
    assert bet.down == pytest.approx(down, rel=1e-7)
    assert bet.both == pytest.approx([(a + b) / 2 for a, b in zip(up, down, strict=True)], rel=1e-7)


def test_ever_is_the_inverse_of_the_largest_value():
    assert ever(np.array([0.5, 40.0, 0.1])) == pytest.approx(1 / 40)
    assert ever(np.array([0.5, 0.9])) == 1.0
    assert ever(np.empty(0)) == 1.0


def test_what_was_seen_is_not_forgotten():
    """Record against a fault that comes later does not take an earlier finding back."""
    bet = e_process(np.concatenate([np.full(20, 2.0), np.full(200, 0.9)]), 3)
    assert ever(bet.up) < 1e-4
    assert bet.up[-1] < 1.0
    assert len(bet.up) == len(bet.down) == len(bet.both) == 220
    assert np.array_equal(e_process(np.full(20, 2.0), 3).both, bet.both[:20])  # an early value needs no later run


@pytest.mark.parametrize("n", [1, 3])
def test_extreme_runs(n):
    """No error at all, and an error beyond all bounds: no warning, nothing but finite numbers."""
    for means in ([0.0], [0.0] * 400, [1e300], [1e300] * 5, [0.0, 1e300, 1.0], [1e-300] * 50):
        bet = e_process(np.array(means), n)
        for values in (bet.up, bet.down, bet.both):
            assert np.isfinite(values).all()
            assert (values >= 0.0).all()
    assert ever(e_process(np.array([1e300]), n).up) < 1e-290
    assert ever(e_process(np.zeros(40), n).down) < 1e-6


def test_one_run_does_not_end_the_game():
    """A wild run costs a bet downwards all but a fiftieth of what it had."""
    before, after = e_process(np.append(np.full(30, 0.5), 1e6), 3).down[-2:]
    assert after == pytest.approx(0.02 * before)
    assert e_process(np.concatenate([[1e6], np.full(60, 0.5)]), 3).down[-1] > 20.0


def test_no_run_no_evidence():
    bet = e_process(np.empty(0), 3)
    assert len(bet.both) == 0
    assert ever(bet.both) == 1.0
