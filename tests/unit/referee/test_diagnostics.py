"""NEES, intervals, coverage, normality and distribution functions against scipy and formulas by hand."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

import consistency as cs
from consistency.diagnostics import chi2_mean_interval, detectable_ratio, normality, rmse
from consistency.referee.diagnostics import distributions as laws
from consistency.referee.diagnostics import tails
from consistency.referee.diagnostics.nees import coverage
from consistency.referee.diagnostics.whitening import (
    DEFICIENT,
    EXACT,
    NEGATIVE,
    ROUNDED,
    Validity,
    asymmetric,
    classify,
    negative,
)
from consistency.referee.diagnostics.whitening import FEWER as ROWS


def covariances(rng, shape, n):
    A = rng.normal(size=(*shape, n, n + 2))
    return A @ np.swapaxes(A, -1, -2)


# --- NEES --------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2, 3, 6])
@pytest.mark.parametrize("batch", [(), (2,), (3,), (3, 3), (2, 3, 3)])
def test_a_batch_gives_what_single_ones_give(rng, n, batch):
    """Also where N = n, which ``solve(P, e)`` with (N, n) silently takes for one matrix of right-hand sides."""
    e, P = rng.normal(size=(*batch, n)), covariances(rng, batch, n)  # off-diagonal terms count
    values = np.asarray(cs.nees(e, P))
    assert values.shape == batch
    for index in np.ndindex(*batch):
        assert values[index] == pytest.approx(float(e[index] @ np.linalg.inv(P[index]) @ e[index]), rel=1e-9)


def test_one_covariance_serves_many_errors(rng):
    e, P = rng.normal(size=(3, 3)), covariances(rng, (), 3)
    assert np.allclose(cs.nees(e, P), [x @ np.linalg.inv(P) @ x for x in e])


NOT_DEFINITE = [np.diag([1.0, -1.0, 1.0]), np.diag([1.0, 0.0, 1.0]), np.ones((3, 3)), np.zeros((3, 3)), -np.eye(3)]


@pytest.mark.parametrize("P", NOT_DEFINITE, ids=["negative", "zero", "rank one", "nothing", "all negative"])
def test_nees_refuses_a_covariance_that_is_not_positive_definite(P):
    with pytest.raises(ValueError, match="not positive definite"):
        cs.nees(np.ones(3), P)
    stack = np.array([np.eye(3), np.eye(3), P, np.eye(3)])
    with pytest.raises(ValueError, match=r"not positive definite at index \(2,\)"):
        cs.nees(np.ones((4, 3)), stack)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_nees_refuses_what_is_not_finite(value):
    e, P = np.ones((2, 2, 3)), np.broadcast_to(np.eye(3), (2, 2, 3, 3)).copy()
    bad_e, bad_P = e.copy(), P.copy()
    bad_e[1, 0, 2], bad_P[0, 1, 2, 2] = value, value
    with pytest.raises(ValueError, match=r"the error is not finite at index \(1, 0\)"):
        cs.nees(bad_e, P)
    with pytest.raises(ValueError, match=r"the covariance is not finite at index \(0, 1\)"):
        cs.nees(e, bad_P)


@pytest.mark.parametrize(
    "e, P",
    [((3,), (2, 2)), ((3,), (3,)), ((), (1, 1)), ((4, 3), (4, 3, 2)), ((3,), (3, 4)), ((4, 3), (5, 3, 3))],
)
def test_nees_refuses_shapes_that_do_not_fit(e, P):
    with pytest.raises(ValueError, match="must be"):
        cs.nees(np.ones(e), np.ones(P))


def test_anees_averages_over_the_runs_that_have_a_value():
    values = np.array([[np.nan, 1.0, 2.0, 3.0], [np.nan, 3.0, np.nan, 5.0]])
    assert np.array_equal(cs.anees(values), [np.nan, 2.0, 2.0, 4.0], equal_nan=True)


# --- intervals -----------------------------------------------------------------------------------


@given(st.integers(1, 9), st.integers(1, 500), st.floats(0.5, 0.9999))
def test_anees_interval_leaves_equal_tails(dof, runs, confidence):
    low, high = cs.anees_interval(dof, runs, confidence)
    chi2 = stats.chi2(dof * runs)
    assert chi2.cdf(low * runs) == pytest.approx((1 - confidence) / 2, rel=1e-6)
    assert chi2.sf(high * runs) == pytest.approx((1 - confidence) / 2, rel=1e-6)
    assert low < dof < high or runs * dof < 3  # the mean of few degrees of freedom may lie aside the median


def test_interval_stays_exact_far_in_the_tail():
    """As the band over all steps needs it: 1 - 1e-13 is close to one."""
    low, high = chi2_mean_interval(150, 1 - 1e-12)
    tail = (1 - (1 - 1e-12)) / 2
    assert stats.chi2.sf(150 * high, 150) == pytest.approx(tail, rel=1e-6)
    assert stats.chi2.cdf(150 * low, 150) == pytest.approx(tail, rel=1e-6)


@pytest.mark.parametrize(
    "arguments, why",
    [((0, 50), "at least 1"), ((3, 0), "at least 1"), ((-1, 50), "at least 1")]
    + [((3, 50, confidence), "between 0 and 1") for confidence in (0.0, 1.0, -0.5, 95.0, np.nan)],
)
def test_anees_interval_refuses_what_has_none(arguments, why):
    with pytest.raises(ValueError, match=why):
        cs.anees_interval(*arguments)


def test_detectable_ratio_is_detected_with_its_power():
    """The NEES of a covariance that is too small by the ratio is the ratio times chi-square."""
    for runs, power in ((50, 0.95), (400, 0.9)):
        ratio = detectable_ratio(3, runs, 0.01, power)
        _, high = cs.anees_interval(3, runs, 0.99)
        assert stats.chi2.sf(high * runs / ratio, 3 * runs) == pytest.approx(power)
        assert ratio > 1
        one_sided = detectable_ratio(3, runs, 0.01, power, two_sided=False)
        assert stats.chi2.sf(stats.chi2.isf(0.01, 3 * runs) / one_sided, 3 * runs) == pytest.approx(power)
        assert one_sided < ratio


# --- coverage and error ----------------------------------------------------------------------------


def test_coverage_counts_by_axis():
    error = np.array([[1.9, 2.1], [-2.0, 0.0], [0.0, -3.0], [5.0, 1.0]])
    P = np.broadcast_to(np.eye(2), (4, 2, 2))
    assert np.array_equal(coverage(error, P), [0.75, 0.5])
    assert np.array_equal(coverage(error, 9.0 * P), [1.0, 1.0])
    assert np.array_equal(coverage(error, P, bound=1.0), [0.25, 0.5])


def test_coverage_leaves_out_what_has_no_value():
    error = np.array([[1.0, np.nan], [9.0, np.nan], [np.nan, np.nan]])
    P = np.broadcast_to(np.eye(2), (3, 2, 2)).copy()
    assert np.array_equal(coverage(error, P), [0.5, np.nan], equal_nan=True)
    P[0] = np.nan
    assert coverage(error, P)[0] == 0.0


def test_rmse_by_hand():
    error = np.array([[[3.0, 4.0], [0.0, 0.0]], [[np.nan, 1.0], [0.0, 5.0]]])
    assert rmse(error) == pytest.approx(np.sqrt((25 + 0 + 25) / 3))
    assert np.isnan(rmse(np.full((2, 2, 3), np.nan)))


# --- normality ---------------------------------------------------------------------------------------


def test_normality_of_a_gaussian_sample(rng):
    """K-squared is asymptotically chi-square(2); accepted unless p < 1e-5."""
    sample = rng.normal(2.0, 3.0, 4000)
    result = normality(sample)
    assert result.p_value > 1e-5
    assert result.p_value == pytest.approx(stats.chi2.sf(result.statistic, 2))
    assert result.mean == pytest.approx(sample.mean())
    assert result.std == pytest.approx(np.sqrt(np.sum((sample - sample.mean()) ** 2) / 3999))
    centred = sample - sample.mean()
    assert result.skewness == pytest.approx(np.mean(centred**3) / np.mean(centred**2) ** 1.5)
    assert result.excess_kurtosis == pytest.approx(np.mean(centred**4) / np.mean(centred**2) ** 2 - 3)


def test_normality_refuses_other_distributions(rng):
    """Negative controls: skewed, heavy-tailed and light-tailed samples."""
    for sample in (rng.exponential(size=2000), rng.standard_t(3, 2000), rng.uniform(size=2000)):
        assert normality(sample).p_value < 1e-5


@pytest.mark.parametrize("sample", [np.ones(19), np.ones((20, 2)), np.array([*range(30), np.nan])])
def test_normality_refuses_what_it_cannot_judge(sample):
    with pytest.raises(ValueError, match="at least 20 finite values"):
        normality(sample)


# --- distribution functions -----------------------------------------------------------------------------------


DOF = np.array([1.0, 2.0, 2.5, 3.0, 6.0, 15.0, 1e3, 1e5])[:, None]
TAILS = np.concatenate([10.0 ** np.linspace(-14, 0, 60), 1.0 - 10.0 ** np.linspace(-14, -1, 30), [0.0, 0.5, np.nan]])
VALUES = np.concatenate([np.geomspace(1e-6, 1e4, 80), np.linspace(-9.0, 0.0, 30), [-np.inf, np.inf, np.nan]])


@pytest.mark.parametrize("name, points", [("cdf", VALUES), ("sf", VALUES), ("ppf", TAILS), ("isf", TAILS)])
def test_chi_square_and_student(name, points):
    for ours, theirs in ((laws.chi2, stats.chi2), (laws.t, stats.t)):
        assert_array_equal(getattr(ours, name)(points, DOF), getattr(theirs, name)(points, DOF))


def test_no_degrees_of_freedom():
    assert np.isnan([laws.chi2.sf(1.0, 0.0), laws.chi2.isf(0.5, -1.0), laws.t.sf(1.0, 0.0)]).all()


def test_beta(monkeypatch):
    x = np.linspace(0.0, 1.0, 50)
    right = stats.beta.sf(x, 1.5, DOF / 2)
    assert_allclose(laws.beta.sf(x, 1.5, DOF / 2), right, rtol=1e-12)
    monkeypatch.delattr("scipy.special.betaincc", raising=False)  # as before SciPy 1.11
    assert_allclose(laws.beta.sf(x, 1.5, DOF / 2), right, rtol=1e-9, atol=1e-300)


@pytest.mark.parametrize("N", [1, 2, 3, 7, 20, 59, 100, 140, 141, 5000])
def test_kolmogorov(N):
    for distance in (0.5 / N, *np.linspace(0.25, 3.0, 23) / np.sqrt(N), 1.0):
        assert laws.kolmogorov.sf(distance, N) == pytest.approx(stats.kstwo.sf(distance, N), rel=1e-9, abs=1e-13)
    for p in (1e-5, 1e-3, 0.05, 0.3, 0.9):
        assert laws.kolmogorov.isf(p, N) == pytest.approx(stats.kstwo.isf(p, N), rel=1e-9)
    assert np.isnan(laws.kolmogorov.sf(float("nan"), N))


def test_a_gate_does_not_load_scipy_stats():
    gate = (
        "import sys, numpy as np; from consistency.testing import assert_consistent; "
        "rng = np.random.default_rng(1); e = rng.standard_normal((50, 20, 3)); "
        "assert_consistent(e, np.broadcast_to(np.eye(3), (50, 20, 3, 3)), false_alarm=1e-9); "
        "assert 'scipy.stats' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", gate], check=True)


def test_ranks_share_the_mean_of_equal_values():
    values = np.random.default_rng(2).integers(0, 9, 40).astype(float)
    assert_array_equal(tails._ranks(values), stats.rankdata(values))


# --- what can be judged as a covariance -----------------------------------------------------------------------


FULL = np.array([[2.0, 0.9, 0.1], [0.9, 1.0, 0.2], [0.1, 0.2, 0.5]])
NAN, INF = np.diag([1.0, np.nan, 1.0]), np.diag([1.0, np.inf, 1.0])


def correlated(rho, twist=0.0):
    """Two components; the smallest eigenvalue of the correlation matrix is 1 - rho."""
    return np.array([[1.0, rho + twist, 0.0], [rho, 1.0, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("units", [(1.0, 1.0, 1.0), (1e-9, 1.0, 1e6)])
@pytest.mark.parametrize(
    "matrix, tolerance, kind",
    [
        (FULL, EXACT, Validity.VALID),
        (np.diag([1.0, 0.0, 1.0]), EXACT, Validity.DEFICIENT),
        (np.zeros((3, 3)), EXACT, Validity.DEFICIENT),
        (correlated(1.0), EXACT, Validity.DEFICIENT),
        (correlated(1.0 - 2.0 * DEFICIENT), EXACT, Validity.VALID),
        (correlated(1.0 - 0.5 * DEFICIENT), EXACT, Validity.DEFICIENT),
        (correlated(1.0 + 0.5 * DEFICIENT), EXACT, Validity.DEFICIENT),
        (correlated(1.0 + 2.0 * DEFICIENT), EXACT, Validity.INDEFINITE),
        (correlated(1.0 + 9e-5), ROUNDED, Validity.DEFICIENT),
        (correlated(1.0 + 1.1e-4), ROUNDED, Validity.INDEFINITE),
        (correlated(2.0), ROUNDED, Validity.INDEFINITE),
        (np.diag([1.0, -1.0, 1.0]), ROUNDED, Validity.INDEFINITE),
        (NAN, EXACT, Validity.NOT_FINITE),
        (INF, ROUNDED, Validity.NOT_FINITE),
    ],
)  # fmt: skip
def test_kinds_in_any_unit(units, matrix, tolerance, kind):
    assert classify(matrix * np.outer(units, units), tolerance) == kind


def test_a_variance_of_zero_with_a_covariance_is_indefinite():
    P = np.diag([1.0, 0.0, 1.0])
    P[0, 1] = P[1, 0] = 0.1
    assert classify(P) == Validity.INDEFINITE


def test_nees_refuses_what_is_not_symmetric_but_for_rounding():
    with pytest.raises(ValueError, match="not symmetric"):
        cs.nees(np.ones(3), correlated(0.0, 1e-4))
    assert cs.nees(np.ones(3), correlated(0.0, 1e-12)) == pytest.approx(3.0)


@pytest.mark.parametrize("tolerance, within", [(EXACT, 1e-8), (ROUNDED, 1e-6)])
def test_asymmetry_is_relative_to_the_largest_entry(tolerance, within):
    both = 1e6 * np.stack([correlated(0.5, 0.9 * within), correlated(0.5, 1.1 * within)])
    assert asymmetric(both, tolerance).tolist() == [False, True]
    assert classify(both, tolerance).tolist() == [Validity.VALID, Validity.ASYMMETRIC]
    assert asymmetric(np.stack([NAN, INF])).tolist() == [False, False]


def test_a_stack_keeps_its_shape_and_is_worked_on_in_pieces():
    stack = np.broadcast_to(FULL, (2, ROWS, 3, 3)).copy()
    stack[1, 7] = NAN
    kinds = classify(stack)
    assert kinds.shape == (2, ROWS)
    assert np.argwhere(kinds != Validity.VALID).tolist() == [[1, 7]]
    assert classify(stack[:0]).shape == (0, ROWS)


def test_negative_is_more_lenient_than_indefinite():
    lost, wrong = np.diag([1.0, -0.5 * NEGATIVE, 1.0]), np.diag([1.0, -2.0 * NEGATIVE, 1.0])
    assert negative(np.stack([FULL, lost, wrong])).tolist() == [False, False, True]
    assert classify(lost) == Validity.INDEFINITE
    assert negative(np.empty((0, 3, 3))).shape == (0,)


def test_only_files_have_a_variance_below_which_there_is_none():
    """A clock error in seconds has such variances; arrays state them to all digits."""
    small = 1e-13**2 * FULL
    assert classify(small, EXACT) == Validity.VALID
    assert classify(small, ROUNDED) == Validity.DEFICIENT
