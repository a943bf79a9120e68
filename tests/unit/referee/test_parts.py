"""Components whose cross terms are not stated are judged each by itself, with one false-alarm rate.

Verdicts on right estimators are at a rate of 1e-6 each, or are counted against a binomial limit whose rate is stated.
"""

from dataclasses import replace

import numpy as np
import pytest
from draws import independent
from numpy.testing import assert_allclose
from records import changed
from scipy import stats

import consistency as cs
from consistency.diagnostics import Settings, gate_runs, judge, make_record, ratio_interval
from consistency.referee.diagnostics.record import each_alone
from consistency.referee.diagnostics.whitening import diagonal
from consistency.referee.gating.session import RunningTest, needed_at, watching
from consistency.testing import ConsistencyError, InsufficientTrials, assert_consistent, assert_not_worse

SURE = 1e-6
RATE = 0.2  # high, so that few draws show a rate that is too high
DRAWS = 100
BIAS = np.array([2.0, 0.0, 0.0])
MIX = np.linalg.cholesky(np.array([[1.0, 0.5, 0.5], [0.5, 1.0, 0.5], [0.5, 0.5, 1.0]]))


def correlated(rng, runs=60, steps=12):
    """Errors with variances of 1 and correlations of 0.5, which deviations do not tell."""
    return independent(rng, runs, steps, 3) @ MIX.T


def of_deviations(error, rate=SURE, **settings):
    return cs.judge(error, deviations=np.ones(error.shape), axes=["x", "y", "z"], false_alarm=rate, **settings)


def test_right_marginals_are_consistent_whatever_the_correlation(rng):
    error = correlated(rng)
    verdict = of_deviations(error)
    assert verdict.status == "consistent"
    assert [*verdict.parts] == ["x", "y", "z"]
    parts = verdict.parts.values()
    assert verdict.p_value == pytest.approx(min(1.0, 3.0 * min(part.p_value for part in parts)))
    shown = [part.equivalence.p_value for part in parts if part.equivalence is not None]
    assert verdict.equivalence.p_value == max(shown) > min(shown)
    assert_allclose(verdict.scale.mean_anees, 3.0 * np.square(error).mean(), rtol=1e-12)
    assert "(1 expected under any correlation), is not judged" in verdict.reasons[1]
    whole = cs.judge(error, diagonal(np.ones(error.shape)), false_alarm=SURE)
    assert whole.status != "consistent"  # the cross terms taken as 0 are a fault of the shape


def test_rate_of_false_alarms(rng):
    """A right referee exceeds the binomial limit with probability 1e-5; three axes at the whole rate each reach it."""
    faults = sum(bool(of_deviations(correlated(rng, 20, 1), RATE).faults) for _ in range(DRAWS))
    assert faults <= stats.binom.isf(1e-5, DRAWS, RATE)


@pytest.mark.parametrize(
    "factor, status",
    [
        ((1.0, 2.0, 1.0), "overconfident"),
        ((0.4, 0.4, 1.0), "conservative"),
        ((0.4, 1.0, 2.5), "inconsistent"),
    ],
)
def test_an_axis_is_found_by_itself(rng, factor, status):
    """Ratios of 4 or 1/6 in 60 runs of 12 steps are found with a probability of 1 - 1e-6."""
    verdict = of_deviations(correlated(rng) * factor)
    assert verdict.status == status
    wrong = [name for name, f in zip("xyz", factor, strict=True) if f != 1.0]
    assert {name for name, part in verdict.parts.items() if part.faults} == set(wrong)
    sides = {name: "small" if f > 1.0 else "large" for name, f in zip("xyz", factor, strict=True)}
    for name in wrong:
        assert f"{name}: covariance too {sides[name]} by x" in verdict.reasons[0]


def test_a_small_fault_is_found_at_the_rate_that_others_leave(rng):
    """Holm: y alone is at fault at the whole rate over one part, not at that over three."""
    parts = of_deviations(correlated(rng) * (9.0, 9.0, 1.0), RATE).parts
    assert [round(RATE / part.settings.false_alarm) for part in parts.values()] == [3, 3, 1]


def test_a_bias_is_named_beside_a_wrong_size(rng):
    error = correlated(rng)
    assert of_deviations(error + BIAS).status == "biased"
    verdict = of_deviations(error * (1.0, 3.0, 1.0) + BIAS)
    assert verdict.status == "overconfident"
    assert "x: mean error" in verdict.reasons[0]


def test_failed_runs_and_a_known_start(rng):
    error, sigma = correlated(rng), np.ones((60, 12, 3))
    sigma[:, 0, 1] = 0.0
    error[5, 7:] = np.nan
    sigma[6, 3, 2] *= -1.0
    verdict = cs.judge(error, deviations=sigma, false_alarm=SURE)
    assert verdict.status == "failed"
    assert [(f.run, f.step) for f in verdict.failures] == [(5, 8), (6, 4)]
    assert verdict.left_out_steps == (1,)
    assert (verdict.lost.count, verdict.lost.runs) == (2, 60)


def test_failed_runs_are_told_once_beside_the_faults_of_parts(rng):
    error = 3.0 * correlated(rng)
    error[4, 5] = np.nan
    sentence = of_deviations(error).reasons[0]
    assert sentence.count("x: covariance too small") == sentence.count("y: covariance too small") == 1
    assert sentence.count("1 of 60 runs failed") == 1


def test_parts_of_several_components_use_their_cross_terms(rng):
    """x and y with their correlation, z by itself."""
    error = correlated(rng)
    P = np.broadcast_to(np.array([[1.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 1.0]]), (60, 12, 3, 3))
    record = make_record("f", error, P, axes=("x", "y", "z"), parts=((0, 1), (2,)))
    verdict = judge(record, Settings(SURE))
    assert verdict.status == "consistent"
    assert [*verdict.parts] == ["x, y", "z"]
    P = np.where(np.eye(3, dtype=bool), P, -P)
    assert "x, y: correlation of the wrong sign" in judge(changed(record, covariance=P), Settings(SURE)).reasons[0]


def test_innovations_share_the_rate(rng):
    nis = rng.chisquare(2, (60, 12))
    record = each_alone(
        make_record("f", correlated(rng), diagonal(np.ones((60, 12, 3))), nis=nis, nis_dof=np.full((60, 12), 2))
    )
    assert [*judge(record, Settings(SURE)).parts] == ["axis 0", "axis 1", "axis 2"]
    judged = changed(record, optimal_gain=True)
    assert [*judge(judged, Settings(SURE)).parts][-1] == "innovations"
    verdict = judge(changed(judged, nis=3.0 * nis), Settings(SURE))
    assert verdict.status == "overconfident"
    assert verdict.faults == ("innovation scale of innovations",)


def test_one_component_has_no_cross_terms(rng):
    error = independent(rng, 60, 12, 1)
    one, same = cs.judge(error, deviations=2.0 + 0.0 * error), cs.judge(error, 4.0 + 0.0 * error[..., None])
    assert one.reasons == same.reasons
    assert not one.parts


def test_misuse_is_refused(rng):
    error = correlated(rng)
    with pytest.raises(cs.InputError, match="give one of them"):
        cs.judge(error, diagonal(error), deviations=error)
    with pytest.raises(cs.InputError, match=r"deviations has shape \(60, 12, 2\)"):
        cs.judge(error, deviations=error[..., :2])
    with pytest.raises(cs.InputError, match="truth_covariance needs covariances"):
        cs.judge(error, deviations=np.ones(error.shape), truth_covariances=diagonal(np.ones(error.shape)))
    with pytest.raises(ValueError, match="has no errors"):
        each_alone(make_record("f", nees=np.ones((3, 2)), dof=2))


# --- gates -----------------------------------------------------------------------------------------


def test_a_gate_judges_deviations_as_files_and_arrays_are(rng):
    error = correlated(rng)
    verdict = assert_consistent(error, deviations=np.ones(error.shape), axes=["x", "y", "z"], false_alarm=SURE)
    assert verdict.reasons == replace(of_deviations(error), filter=verdict.filter).reasons
    stated = np.ones(error.shape) * [1.0, 0.5, 1.0]
    with pytest.raises(ConsistencyError, match="overconfident: y: covariance too small by x") as caught:
        assert_consistent(error, deviations=stated, axes=["x", "y", "z"], false_alarm=SURE)
    assert [name for name, part in caught.value.verdict.parts.items() if part.faults] == ["y"]
    error[4, 5:] = np.nan
    with pytest.raises(ConsistencyError, match="1 of 60 runs failed, first run 4 in step 6"):
        assert_consistent(error, deviations=np.ones(error.shape), false_alarm=SURE)


@pytest.mark.parametrize("innovations", [False, True])
def test_a_gate_plans_for_parts_that_share_the_rate(innovations, rng):
    error = correlated(rng, 9, 3)
    kept = []
    more = {"nis": rng.chisquare(2, (9, 3)), "nis_dof": 2, "optimal_gain": True} if innovations else {}
    needed = gate_runs(1, 1.5, SURE / (3 + innovations), 0.95)
    with (
        watching(RunningTest(keep=kept.append)),
        pytest.raises(InsufficientTrials, match=f"Simulate {needed} ") as caught,
    ):
        assert_consistent(error, deviations=np.ones(error.shape), false_alarm=SURE, **more)
    assert caught.value.needed == needed
    assert f"consistency plan --dof 1 --detect 1.5 --false-alarm {SURE / (3 + innovations)!r}" in str(caught.value)
    assert needed_at(kept[0], 0.1 * SURE) == gate_runs(1, 1.5, 0.1 * SURE / (3 + innovations), 0.95)


def test_two_estimators_that_state_deviations(rng):
    error = correlated(rng)
    right, small = np.ones(error.shape), np.full(error.shape, 0.5)
    assert not assert_not_worse(error, None, error, deviations_a=right, deviations_b=small, detect=9.0).worse
    with pytest.raises(ConsistencyError, match="worse than the reference"):
        assert_not_worse(error, None, error, deviations_a=small, deviations_b=right, false_alarm=SURE)
    whole = {"covariances_b": diagonal(right), "deviations_a": right, "false_alarm": SURE}
    assert not assert_not_worse(error, None, error, **whole).worse  # the same matrices: no chance in it
    with pytest.raises(ValueError, match="the errors have 2 and 3 components"):
        assert_not_worse(error[..., :2], None, error, deviations_a=right[..., :2], deviations_b=right)


@pytest.mark.parametrize("parts, least", [(((0,), (1,), (2,), (3,)), 1), (((0, 1), (2, 3)), 2), (((0,), (1, 2, 3)), 1)])
def test_the_interval_of_the_whole_allows_for_parts_whose_errors_are_the_same(rng, parts, least):
    """With fewer than 20 runs: the mean NEES then has the degrees of freedom of the smallest part."""
    error = independent(rng, 8, 5, 4)
    verdict = judge(make_record("f", error, diagonal(np.ones(error.shape)), dof=4, axes=tuple("wxyz"), parts=parts))
    expected = ratio_interval(np.square(error).mean(axis=(1, 2)), least)
    assert_allclose(verdict.scale.inflation, expected)
