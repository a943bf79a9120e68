"""``cs.judge`` of arrays and files: failed runs are counted, misuse is refused."""

import numpy as np
import pytest
from draws import identities, independent
from numpy.testing import assert_allclose, assert_array_equal

import consistency as cs

RUNS, STEPS = 60, 20
SURE = 1e-6  # false-alarm rate of a verdict


@pytest.fixture
def error(rng):
    return independent(rng, RUNS, STEPS, 2)


def test_arrays_are_judged(error, tmp_path):
    verdict = cs.judge(error, identities(error), axes=["x", "y"], name="my.filter", false_alarm=SURE)
    assert (verdict.status, verdict.filter, verdict.runs, verdict.steps) == ("consistent", "my.filter", RUNS, STEPS)
    assert verdict.axes.names == ("x", "y")
    assert cs.judge(2.0 * error, identities(error), false_alarm=SURE).status == "overconfident"
    assert_array_equal(verdict.record.errors.error, error)
    np.savez(tmp_path / "mine.npz", errors=error, covariances=identities(error), axes=["x", "y"])
    read = cs.judge(str(tmp_path / "mine.npz"), false_alarm=SURE)
    assert read.reasons == verdict.reasons
    assert cs.judge(tmp_path / "mine.npz").filter == "mine"


def test_failed_runs_are_counted_and_the_others_judged(error):
    P = identities(error).copy()
    error[3, 12:] = np.nan
    P[7, 4] = -np.eye(2)
    P[9, 0, 0, 0] = np.inf
    verdict = cs.judge(error, P, name="mine", false_alarm=SURE)
    assert verdict.status == "failed"
    assert [(f.filter, f.run, f.step) for f in verdict.failures] == [("mine", 3, 13), ("mine", 7, 5), ("mine", 9, 1)]
    assert [f.reason.partition(" (")[0] for f in verdict.failures] == [
        "estimate is not finite", "covariance is not positive definite", "covariance is not finite",
    ]  # fmt: skip
    assert verdict.reasons[0].startswith("failed: 3 of 60 runs failed, first run 3 in step 13")
    assert verdict.scale.alive.tolist() == [59] * 4 + [58] * 8 + [57] * 8
    fault = cs.judge(3.0 * error, P, false_alarm=SURE)
    assert fault.status == "overconfident"
    assert "; 3 of 60 runs failed, first run 3 in step 13: " in fault.reasons[0]


def test_a_known_start_is_left_out_by_name(error):
    P = identities(error).copy()
    P[:, 0], P[:, 1, 1] = 0.0, 0.0
    verdict = cs.judge(error, P, false_alarm=SURE)
    assert verdict.left_out_steps == (1, 2)
    assert not verdict.failures


def test_a_masked_step_has_no_truth(error, tmp_path):
    """It is no failure, in arrays and files of errors, of estimates and of NEES; what stands there does not count."""
    mask = np.zeros((RUNS, STEPS), bool)
    mask[3, 12:15] = mask[:, 4] = mask[5, -1] = True
    spoilt = np.where(mask[..., None], np.nan, error)
    P, nees = np.where(mask[..., None, None], np.nan, identities(error)), np.square(error).sum(axis=-1)
    verdict = cs.judge(np.ma.masked_invalid(spoilt), P, false_alarm=SURE)
    assert verdict.status == "consistent"
    alive = (~mask).sum(axis=0)
    assert verdict.scale.alive.tolist() == alive.tolist()
    assert_allclose(verdict.scale.mean_anees, np.ma.array(nees, mask=mask).mean(axis=1).mean(), rtol=1e-12)
    assert not verdict.failures
    assert verdict.left_out_steps == ()
    estimates = np.where(mask[..., None], 1.0, -error)
    truth = np.where(mask[..., None], np.nan, 0.0 * error)
    for arrays in (
        {"errors": spoilt, "covariances": P},
        {"estimates": estimates, "truth": truth, "covariances": identities(error)},
        {"nees": np.where(mask, np.nan, nees), "dof": np.array(2)},
    ):
        np.savez(tmp_path / "mine.npz", mask=mask, **arrays)
        read = cs.judge(tmp_path / "mine.npz", false_alarm=SURE)
        assert (read.status, read.failures) == ("consistent", ())
        assert read.scale.alive.tolist() == alive.tolist()
    np.savez(tmp_path / "mine.npz", estimates=estimates, truth=truth, covariances=identities(error))
    with pytest.raises(cs.InputError, match="run 0, step 5: not finite; 'mask' is true where there is none"):
        cs.judge(tmp_path / "mine.npz")
    np.savez(tmp_path / "mine.npz", errors=spoilt, covariances=P, mask=mask[:2])
    with pytest.raises(cs.InputError, match=r"key 'mask' must be truth values of shape \(60, 20\)"):
        cs.judge(tmp_path / "mine.npz")


def test_rows_are_runs_only_where_that_is_said(rng):
    error = independent(rng, 300, 1, 2)[:, 0]
    P = identities(error)
    verdict = cs.judge(error, P, independent=True, false_alarm=SURE)
    assert (verdict.status, verdict.runs, verdict.steps) == ("consistent", 300, 1)
    with pytest.raises(cs.InputError, match=r"errors\[None\] and covariances\[None\] are one run of many"):
        cs.judge(error, P)
    assert cs.judge(error[None], P[None]).runs == 1


def test_a_covariance_of_zero_is_a_known_start_only_where_all_runs_begin_so(rng):
    error = independent(rng, 300, 1, 2)[:, 0]
    P = np.array(identities(error))
    P[:20] = 0.0
    verdict = cs.judge(error, P, independent=True, false_alarm=SURE)
    assert (verdict.status, len(verdict.failures)) == ("failed", 20)
    P[:20] = np.diag([1.0, 0.0])
    assert cs.judge(error, P, independent=True, false_alarm=SURE).status == "failed"
    sigma = np.ones(error.shape)
    sigma[7, 1] = 0.0
    assert cs.judge(error, deviations=sigma, independent=True, false_alarm=SURE).status == "failed"


@pytest.mark.parametrize("first, failed", [([0, 1, 2], [1]), ([1, 1, 2], []), ([2, 1, STEPS], [3])])
def test_how_long_a_known_start_may_be(error, first, failed):
    """``first``: steps of singular covariances at the beginning of runs 1, 2 and 3; of all others one, if any has."""
    P = np.array(identities(error))
    P[:, : min(first)] = 0.0
    for run, steps in enumerate(first, start=1):
        P[run, :steps] = 0.0
    verdict = cs.judge(error, P, false_alarm=SURE)
    expected = [run for run, steps in enumerate(first, start=1) if steps > 0] if min(first) == 0 else failed
    assert [failure.run for failure in verdict.failures] == expected


@pytest.mark.parametrize(
    "change, why",
    [
        (lambda e, P: (e[:, 0], P[:, 0, 0]), r"errors has shape \(300,\), needs \(N, n\).*errors\[:, None\]"),
        (lambda e, P: (e, P[0]), r"covariances has shape \(2, 2\), needs \(300, 2, 2\).*np.broadcast_to"),
        (lambda e, P: (e, P[:, 0]), r"covariances has shape \(300, 2\), needs .* deviations="),
        (lambda e, P: (e, P[1:]), r"covariances has shape \(299, 2, 2\), needs \(300, 2, 2\) beside errors"),
    ],
)
def test_rows_that_do_not_fit_are_told_as_they_were_given(change, why, rng):
    error = independent(rng, 300, 1, 2)[:, 0]
    errors, P = change(error, identities(error))
    with pytest.raises(cs.InputError, match=why):
        cs.judge(errors, P, independent=True)


@pytest.mark.parametrize(
    "change, why",
    [
        (lambda e, P: (e, P[:, :, :1]), "covariances has shape"),
        (lambda e, P: (e, P + np.array([[0.0, 0.1], [0.0, 0.0]])), "not symmetric"),
        (lambda e, P: (e, 0.0 * P), "zero in every step"),
        (lambda e, P: ([[1.0, 2.0], [3.0]], P), "^errors: not an array of numbers"),
        (lambda e, P: (e, [["a"]]), "^covariances: not an array of numbers"),
        (lambda e, P: (np.where(np.arange(STEPS)[:, None] >= 11, np.nan, e), P), "^errors, step 12: not finite in any"),
        (
            lambda e, P: (e, np.where(np.arange(STEPS)[:, None, None] == 4, np.inf, P)),
            "^covariances, step 5: not finite",
        ),
        (lambda e, P: (e, None), "^covariances: needed beside errors"),
    ],
)
def test_misuse_is_refused(error, change, why):
    with pytest.raises(cs.InputError, match=why):
        cs.judge(*change(error, identities(error)))


def test_names_are_checked(error):
    with pytest.raises(cs.InputError, match="axes names 1 components, the error has 2"):
        cs.judge(error, identities(error), axes=["x"])
    with pytest.raises(cs.InputError, match=r"^name"):
        cs.judge(error, identities(error), name="a\nb")
