"""Gates of ``consistency.testing`` without a session around them.

Right filters are judged at a false-alarm rate of 1e-6 each, 2e-5 in this file; faults are far beyond what is found
with a power of 1 - 1e-6.
"""

import pickle
import re
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest
from draws import autoregression, identities

import consistency as cs
from consistency.diagnostics import gate_runs
from consistency.referee.gating.checked_input import planned_dof, record_of_checked
from consistency.testing import ConsistencyError, InsufficientTrials, assert_consistent, assert_not_worse

RARE = 1e-6  # false-alarm rate of a gate here
RUNS = gate_runs(3, 1.5, RARE, 0.95)
OPTIMAL = {"optimal_gain": True}
gate, no_worse = (partial(function, false_alarm=RARE) for function in (assert_consistent, assert_not_worse))


def sample(rng, runs=RUNS, steps=12, n=3, true=1.0):
    """Errors that follow each other (AR(1), 0.8), and covariances that are theirs over ``true``; of mixed units."""
    A = rng.normal(size=(n, n)) + 2.0 * np.eye(n)
    A[0] *= 1e-3
    z = autoregression(rng, runs, steps, n, 0.8)
    P = np.broadcast_to(A @ A.T / true, (runs, steps, n, n))
    return z @ A.T, 0.5 * (P + np.swapaxes(P, -1, -2))


def innovations(rng, runs=40, steps=50):
    """Right innovations of two components, and their covariances."""
    v = rng.normal(size=(runs, steps, 2))
    return v, identities(v).copy()


def places(failures):
    return [(failure.run, failure.step) for failure in failures]


# --- what passes and what does not -----------------------------------------------------------------


@pytest.mark.parametrize("true, status", [(3.0, "overconfident"), (1 / 3, "conservative")])
def test_a_wrong_scale_does_not(rng, true, status):
    with pytest.raises(ConsistencyError) as caught:
        gate(*sample(rng, true=true), name="mine")
    verdict = caught.value.verdict
    assert (verdict.status, verdict.filter) == (status, "mine")
    assert verdict.p_value <= RARE
    assert "scale" in verdict.faults
    low, high = verdict.inflation_interval
    assert low < verdict.inflation < high
    assert abs(np.log(verdict.inflation / true)) < 0.5
    lines = str(caught.value).splitlines()
    assert lines[0] == f"assert_consistent: mine is {verdict.reasons[0]}"
    assert lines[1:] == [f"  - {reason}" for reason in verdict.reasons[1:]]


def test_a_subset_is_looked_at(rng):
    verdict = gate(*sample(rng), subsets={"first two": [0, 1]}, method="bonferroni")
    assert "first two" in verdict.statistics["groups"]


# --- innovations -----------------------------------------------------------------------------------


def test_innovations_alone(rng):
    S = np.broadcast_to(np.diag([4.0, 0.25]), (40, 50, 2, 2))
    v = rng.normal(size=(40, 50, 2)) * [2.0, 0.5]
    v[:, 7] = np.nan  # no measurement in step 8
    assert gate(innovations=v, innovation_covariances=S, **OPTIMAL).consistent
    nis, dof = np.where(np.isnan(v[..., 0]), np.nan, np.square(v / [2.0, 0.5]).sum(-1)), np.full((40, 50), 2)
    dof[:, 7] = 0
    assert gate(nis=nis, nis_dof=dof, **OPTIMAL).consistent
    with pytest.raises(ConsistencyError, match="larger than stated"):
        gate(innovations=v, innovation_covariances=S / 2.0, **OPTIMAL)
    slow = np.repeat(rng.normal(size=(40, 25, 2)), 2, axis=1) * [2.0, 0.5]
    with pytest.raises(ConsistencyError, match="correlated over steps"):
        gate(innovations=slow, innovation_covariances=S, **OPTIMAL)


def test_innovations_beside_errors(rng):
    """Right errors, innovations twice as wide as stated."""
    S, v = np.ones((RUNS, 12, 1, 1)), 2.0 * rng.normal(size=(RUNS, 12, 1))
    with pytest.raises(ConsistencyError) as caught:
        gate(*sample(rng), innovations=v, innovation_covariances=S, **OPTIMAL)
    assert caught.value.verdict.faults == ("innovation scale",)
    verdict = gate(*sample(rng), innovations=v, innovation_covariances=S)
    assert not verdict.innovations.judged
    assert verdict.innovations.ratio > 3.0


# --- enough runs -----------------------------------------------------------------------------------


def test_too_few_runs_do_not_pass(rng):
    """Five runs have 15 degrees of freedom: no ratio shows that 1.5 and 1 / 1.5 are both too far off."""
    errors, covariances = sample(rng, runs=5)
    with pytest.raises(InsufficientTrials) as caught:
        gate(errors, covariances)
    assert (caught.value.needed, caught.value.runs) == (RUNS, 5)
    assert caught.value.verdict.status == "undecided"
    assert f"consistency plan --dof 3 --detect 1.5 --false-alarm {RARE} --power 0.95" in str(caught.value)
    assert "5 runs do not show the covariance ratio" in str(caught.value)
    with pytest.raises(InsufficientTrials, match="--allow conservative"):
        gate(errors, covariances, detect=1.01, allow="conservative")


def test_a_small_fault_can_be_tolerated(rng):
    """x1.2 in 2,000 runs is found beyond all doubt, and shown to be below 1.5."""
    errors, covariances = sample(rng, runs=2000, true=1.2)
    with pytest.raises(ConsistencyError, match=r"covariance too small by x1\.2"):
        gate(errors, covariances)
    verdict = gate(errors, covariances, tolerance=1.4)
    assert "within the tolerance of x1.4" in "".join(verdict.reasons)
    with pytest.raises(ConsistencyError):
        gate(errors, covariances, tolerance=1.1)
    with pytest.raises(ValueError, match="tolerance must be"):
        assert_consistent(errors, covariances, tolerance=-1.0)


def test_the_defaults_are_those_of_the_documentation(rng):
    with pytest.raises(InsufficientTrials) as caught:  # fixed values: no chance in it
        assert_consistent(nees=[[3.0], [2.0]], dof=3)
    assert caught.value.needed == gate_runs(3, 1.5, 1e-3, 0.95)


@pytest.mark.parametrize("error", [ConsistencyError("text"), InsufficientTrials("text", 7, 3)])
def test_errors_travel_between_processes(error):
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), vars(again)) == (str(error), vars(error))


# --- failed runs, and input that cannot be judged -------------------------------------------------------


def spoilt(what, rng, runs=6):
    """Right errors; run 4 is broken in step 7."""
    errors = rng.normal(size=(runs, 8, 3))
    covariances = identities(errors).copy()
    bad = covariances[4, 6]
    if what == "error":
        errors[4, 6, 1] = np.nan
    elif what == "infinite":
        errors[4, 6, 1] = np.inf
    elif what == "covariance":
        bad[0, 0] = np.nan
    elif what == "negative":
        bad[2, 2] = -1.0
    elif what == "indefinite":
        bad[0, 1] = bad[1, 0] = 1.5
    elif what == "singular":
        bad[:2, :2] = 1.0
    return errors, covariances


FAILURES = {
    "error": "estimate is not finite", "infinite": "estimate is not finite", "covariance": "covariance is not finite",
    "negative": "covariance is not positive definite", "indefinite": "covariance is not positive definite",
    "singular": "covariance is not positive definite",
}  # fmt: skip


@pytest.mark.parametrize("what, reason", FAILURES.items())
def test_a_run_that_is_no_estimate_has_failed(what, reason, rng):
    """It is counted, fails the gate, and the others are judged beside it; no number of runs makes up for it."""
    errors, covariances = spoilt(what, rng, RUNS)
    match = rf"mine failed: 1 of {RUNS} runs failed, first run 4 in step 7: {reason}"
    with pytest.raises(ConsistencyError, match=match) as caught:
        gate(errors, covariances, name="mine")
    verdict = caught.value.verdict
    assert [(f.filter, f.run, f.step) for f in verdict.failures] == [("mine", 4, 7)]
    assert verdict.scale.alive.tolist() == [RUNS] * 6 + [RUNS - 1] * 2
    assert (verdict.lost.count, verdict.lost.runs) == (1, RUNS)
    with pytest.raises(ConsistencyError, match=r"1 runs failed, of the reference 0"):
        no_worse(errors, covariances, *spoilt("", rng, RUNS))
    right = spoilt("", rng, RUNS)
    assert not assert_not_worse(*right, *(part.copy() for part in spoilt(what, rng, RUNS)), detect=9.0).worse


def test_nees_of_a_failed_run(rng):
    nees = rng.chisquare(3, (RUNS, 8))
    nees[4, 6:] = np.nan
    with pytest.raises(ConsistencyError, match="first run 4 in step 7: NEES is not finite"):
        gate(nees=nees, dof=3)


def test_innovations_end_with_a_failed_run(rng):
    """Whatever a run says after its failure does not count, nor is it refused."""
    errors, covariances = spoilt("error", rng, RUNS)
    nis = rng.chisquare(2, (RUNS, 8))
    nis[4, 6:] = np.nan
    v, S = innovations(rng, RUNS, 8)
    S[4, 7], v[4, 7, 0] = -1.0, np.nan
    for step, arrays in ((7, {"nis": nis, "nis_dof": 2}), (8, {"innovations": v, "innovation_covariances": S})):
        record = record_of_checked("f", errors, covariances, **arrays)
        assert np.isnan(record.innovations.nis[4]).tolist() == [False] * 6 + [True] * 2
        assert record.innovations.nis_dof[4].tolist() == [2] * 6 + [0] * 2
        with pytest.raises(ConsistencyError, match="1 of"):
            gate(errors, covariances, **arrays)
        with pytest.raises(ConsistencyError, match=rf"first run 4 in step {step}: (NIS|innovation) is not finite"):
            gate(np.nan_to_num(errors), covariances, **arrays)


def test_innovations_of_a_start_without_rank(rng):
    """Left out where every run begins so; a run that alone does has failed."""
    v, S = innovations(rng, steps=8)
    S[:, 0] = 0.0
    record = record_of_checked("f", innovations=v, innovation_covariances=S, **OPTIMAL)
    assert record.failures == ()
    assert np.isnan(record.innovations.values[:, 0]).all()
    assert np.isfinite(record.innovations.values[:, 1:]).all()
    S[:, 0], S[6, 0] = np.eye(2), 0.0
    failures = record_of_checked("f", innovations=v, innovation_covariances=S, **OPTIMAL).failures
    assert places(failures) == [(6, 1)]


def broken_innovations(what, rng):
    """Right innovations but for runs 4 and 9, which break down in step 7."""
    v, S = innovations(rng)
    broken = np.isin(np.arange(40), (4, 9))[:, None] & (np.arange(50) >= 6)
    if what == "masked":
        v[broken] = np.nan
        v = np.ma.masked_array(v, np.broadcast_to((np.arange(50) == 3)[:, None], v.shape))  # not measured in step 4
    elif what == "innovation":
        v[broken] = [0.0, np.inf]
    else:
        S[broken] = {"indefinite": [[1, 0], [0, -0.1]], "singular": [[1, 1], [1, 1]], "NaN": np.nan}[what]
    return v, S


@pytest.mark.parametrize("what, reason", [
    ("indefinite", "innovation covariance is not positive definite"),
    ("singular", "innovation covariance is not positive definite"),
    ("NaN", "innovation covariance is not finite"),
    ("innovation", "innovation is not finite"),
    ("masked", "innovation is not finite"),
])  # fmt: skip
def test_runs_fail_by_their_innovations(what, reason, rng):
    v, S = broken_innovations(what, rng)
    with pytest.raises(ConsistencyError, match=f"2 of 40 runs failed, first run 4 in step 7: {reason}") as caught:
        gate(innovations=v, innovation_covariances=S, **OPTIMAL)
    verdict = caught.value.verdict
    assert verdict.status == "failed"
    assert verdict.innovations.dof == 2 * (40 * 50 - 2 * 44) - 80 * (what == "masked")
    assert verdict.innovations.ratio == pytest.approx(1.0, abs=0.2)  # of the rest; 6 standard errors
    errors, covariances = spoilt("", rng, 40)
    own = record_of_checked("f", errors, covariances, innovations=v[:, :8], innovation_covariances=S[:, :8])
    assert np.isnan(own.errors.nees).sum(axis=1).tolist() == [2 * (run in (4, 9)) for run in range(40)]
    assert places(own.failures) == [(4, 7), (9, 7)]


def test_nis_count_nothing_from_the_failure_of_their_run_on(rng):
    nis = rng.chisquare(2, (20, 8))
    nis[4, 6] = np.nan
    record = record_of_checked("f", nis=nis, nis_dof=2, optimal_gain=True)
    assert places(record.failures) == [(4, 7)]
    assert record.innovations.nis_dof[4].tolist() == [2] * 6 + [0] * 2
    assert (np.delete(record.innovations.nis_dof, 4, axis=0) == 2).all()


def test_a_run_fails_where_anything_of_it_failed_first(rng):
    errors, covariances = spoilt("error", rng, 20)  # run 4 in step 7
    v, S = rng.normal(size=(20, 8, 1)), np.ones((20, 8, 1, 1))
    S[4, 2], S[3, 7] = -1.0, np.nan
    record = record_of_checked("f", errors, covariances, innovations=v, innovation_covariances=S)
    assert [(each.run, each.step, "innovation" in each.reason) for each in record.failures] == [
        (3, 8, True),
        (4, 3, True),
    ]
    assert np.isfinite(record.errors.error[4]).all(axis=-1).tolist() == [True] * 2 + [False] * 6
    assert record.innovations.nis_dof[[3, 4]].tolist() == [[1] * 7 + [0], [1] * 2 + [0] * 6]


def test_misuse_of_innovations_is_no_failed_run(rng):
    v, S = innovations(rng, 6, 8)

    def refused(match, v, S):
        with pytest.raises(ValueError, match=match):
            assert_consistent(innovations=v, innovation_covariances=S, **OPTIMAL)

    turned, nowhere, never = S.copy(), S.copy(), v.copy()
    turned[2, 4, 0, 1], nowhere[:, 3], never[:, 5, 1] = 0.1, np.nan, np.nan
    refused("innovation_covariances, run 2, step 5: the covariance is not symmetric", v, turned)
    refused("innovation_covariances, step 4: not finite in any run", v, nowhere)
    refused("innovations, step 6: not finite in any run", never, S)
    known = S.copy()
    known[:, 0] = 0.0  # a start that is known exactly, and a measurement without noise
    record = record_of_checked("f", innovations=v, innovation_covariances=known, optimal_gain=True)
    assert record.failures == ()
    assert record.innovations.nis_dof[0].tolist() == [0] + [2] * 7


def test_misuse_is_no_failed_run(rng):
    errors, covariances = spoilt("", rng)
    P = covariances.copy()
    P[4, 6, 0, 1] = 1e-5
    with pytest.raises(ValueError, match=r"run 4, step 7: the covariance is not symmetric"):
        assert_consistent(errors, P)
    with pytest.raises(ValueError, match=r"reference b: .*run 4, step 7: the covariance is not symmetric"):
        assert_not_worse(errors, covariances, errors, P)
    for key, arrays in {"errors": (errors.copy(), covariances), "covariances": (errors, covariances.copy())}.items():
        arrays[key == "covariances"][:, 2] = np.nan
        with pytest.raises(ValueError, match=f"{key}, step 3: not finite in any run"):
            assert_consistent(*arrays)
    with pytest.raises(ValueError, match="are identical; remove the duplicate"):
        assert_consistent(errors[[0, 1, 1]], covariances[:3])
    with pytest.raises(ValueError, match="not positive definite"):
        cs.nees(errors[0, 0], -covariances[0, 0])


E = np.random.default_rng(0).normal(size=(4, 2, 3))
P = identities(E)
BOTH = {"errors": E, "covariances": P}


@pytest.mark.parametrize(
    "arguments, said",
    [
        ({}, "nothing to judge"),
        ({"errors": E}, "errors without covariances"),
        ({"covariances": P}, "covariances without errors"),
        ({"errors": E[0], "covariances": P[0]}, "errors has shape (2, 3), needs (runs, steps, n): errors[None]"),
        ({"errors": E, "covariances": P[..., :2]}, "covariances has shape (4, 2, 3, 2), needs (4, 2, 3, 3)"),
        ({"errors": E[:0], "covariances": P[:0]}, "errors has shape (0, 2, 3), needs (runs, steps, n)"),
        ({"errors": [[[1.0], [2.0]], [[1.0]]], "covariances": P}, "errors: not an array of numbers"),
        (BOTH | {"dof": 2}, "dof is 2, but the errors have 3 components"),
        (BOTH | {"nees": E[..., 0]}, "not both"),
        ({"nees": E[..., 0]}, "nees without dof"),
        ({"nees": E[..., 0], "dof": 0}, "dof must be one whole number of 1 or more"),
        ({"nees": E[0, :, 0], "dof": 3}, "nees has shape (2,), needs (runs, steps): nees[None] is one run"),
        ({"nees": np.abs(E[..., 0]) - 9.0, "dof": 3}, "nees, run 0, step 1: "),
        ({"nees": E[..., 0] * np.nan, "dof": 3}, "nees, step 1: not finite in any run"),
        ({"nees": E[..., 0] ** 2, "dof": 3, "axes": ["a", "b", "c"]}, "axes needs errors and covariances"),
        ({"nis": E[..., 0]}, "give nis and nis_dof together"),
        ({"nis": E[..., 0] ** 2, "nis_dof": 1}, "only with optimal_gain=True"),
        ({"nis": E[..., 0] ** 2, "nis_dof": 1.5}, "whole numbers"),
        ({"nis": E[..., 0] * np.nan, "nis_dof": 1}, "nis, step 1: not finite in any run"),
        ({"nis": -(E[..., 0] ** 2), "nis_dof": 1}, "nis: negative in run 0, step 1"),
        (BOTH | {"deviations": E}, "covariances or deviations, not both"),
        ({"deviations": E}, "deviations without errors"),
        ({"errors": E, "deviations": E[:2]}, "deviations has shape (2, 2, 3), needs that of errors"),
        ({"errors": E, "deviations": np.ones(E.shape), "subsets": {"a": [0]}}, "subsets needs covariances"),
        ({"innovations": E}, "give innovations and innovation_covariances together"),
        ({"innovations": E, "innovation_covariances": E}, "(runs, steps, m) and (runs, steps, m, m)"),
        (BOTH | {"nis": E[:2, :, 0] ** 2, "nis_dof": 1}, "nis has (2, 2) runs and steps"),
        (BOTH | {"allow": "optimistic"}, "allow must be 'conservative' or None"),
        (BOTH | {"method": "pointwise"}, "method must be 'max' or 'bonferroni'"),
        (BOTH | {"false_alarm": 0.0}, "false_alarm must lie between 0 and 1"),
        (BOTH | {"power": 1.0}, "power must lie between 0 and 1"),
        (BOTH | {"detect": 1.0}, "detect must be a positive ratio"),
        (BOTH | {"detect": 0.5, "allow": "conservative"}, "which allow='conservative' accepts"),
        (BOTH | {"axes": ["x"]}, "axes names 1 components, the error has 3"),
        (BOTH | {"filter": "kf"}, "results"),
    ],
)
def test_unusable_arguments_say_what_is_wrong(arguments, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        assert_consistent(**arguments)


# --- two filters -----------------------------------------------------------------------------------


@pytest.mark.parametrize("true", [2.0, 0.5])
def test_a_less_consistent_filter_is_worse(rng, true):
    errors, covariances = sample(rng)
    with pytest.raises(ConsistencyError, match="worse than the reference: mean NEES") as caught:
        no_worse(errors, covariances / true, errors, covariances, name="new")
    assert caught.value.comparison.worse
    assert caught.value.verdict.filter == "new"
    nees = cs.nees(errors, covariances)
    with pytest.raises(ConsistencyError):
        no_worse(nees_a=true * nees, nees_b=nees, dof=3)
    assert not no_worse(nees_a=nees, nees_b=true * nees, dof=3, detect=3.0).worse  # the better one


def test_a_comparison_needs_runs(rng):
    a, b = sample(rng, runs=9), sample(rng, runs=9)
    with pytest.raises(InsufficientTrials, match="at the spread between these runs") as caught:
        no_worse(*a, *b, detect=1.01)
    assert caught.value.needed > 9
    with pytest.raises(InsufficientTrials, match="4 runs are too few for a standard error"):
        assert_not_worse(a[0][:4], a[1][:4], b[0][:4], b[1][:4])


def test_rows_of_a_comparison_are_the_same_trials(rng):
    e, P = sample(rng, runs=20)
    with pytest.raises(ValueError, match="20 runs and the reference 19"):
        assert_not_worse(e, P, e[1:], P[1:])
    with pytest.raises(ValueError, match="3 and 2 components"):
        assert_not_worse(e, P, e[..., :2], P[..., :2, :2])
    with pytest.raises(ValueError, match="need results"):
        assert_not_worse(e, P, e, P, than="kf")
    with pytest.raises(ValueError, match="reference b: nothing to judge"):
        assert_not_worse(e, P)


# --- the bench's own results -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def stereo():
    scenario = cs.load_scenario("herath2007-stereo").variant("short", truth__steps=80)
    return cs.run_trials(scenario, filters=["ekf-xyz", "ekf-uvd"], runs=12, seed=0)


def test_results_are_judged_as_by_analyse(stereo):
    with pytest.raises(ConsistencyError) as caught:
        assert_consistent(stereo, filter="ekf-xyz", false_alarm=0.05)
    assert caught.value.verdict.reasons == cs.analyse(stereo)["ekf-xyz"].reasons
    assert caught.value.verdict.status == "overconfident"


def test_a_failed_run_is_a_fault(stereo):
    row = {"filter": ["ekf-uvd"], "run": [3], "step": [40], "reason": ["NaN"]}
    failures = pd.DataFrame(row).astype(stereo.failures.dtypes)
    broken = replace(stereo, failures=failures, estimates=stereo.estimates[stereo.estimates["run"] != 3])
    with pytest.raises(ConsistencyError, match="1 of 12 runs failed"):
        gate(broken, filter="ekf-uvd", detect=20.0)


def test_results_compared(stereo):
    with pytest.raises(ConsistencyError, match="worse than ekf-uvd"):
        assert_not_worse(stereo, filter="ekf-xyz", than="ekf-uvd", false_alarm=0.01)
    assert not no_worse(stereo, filter="ekf-xyz", reference=stereo).worse
    with pytest.raises(ValueError, match="name the filter to compare with"):
        assert_not_worse(stereo, filter="ekf-xyz")
    with pytest.raises(ValueError, match="'kf' is not in the reference"):
        assert_not_worse(stereo, filter="ekf-xyz", than="kf")


def test_results_need_a_filter_and_bring_the_rest(stereo):
    with pytest.raises(ValueError, match="filter: name one of ekf-xyz, ekf-uvd"):
        assert_consistent(stereo)
    with pytest.raises(ValueError, match="'kf' is not in these results"):
        assert_consistent(stereo, filter="kf")
    with pytest.raises(ValueError, match="dof: results bring their own"):
        assert_consistent(stereo, filter="ekf-xyz", dof=3)


def test_a_run_is_planned_for_the_fewest_degrees_of_freedom():
    nis_dof = np.array([[2, 2, 0], [2, 2, 2]])
    record = record_of_checked("f", nis=np.where(nis_dof, 2.0, np.nan), nis_dof=nis_dof, optimal_gain=True)
    assert planned_dof(record) == 4
    assert planned_dof(record_of_checked("f", nis=np.ones((2, 3)), nis_dof=2, nees=np.ones((2, 3)), dof=5)) == 5
