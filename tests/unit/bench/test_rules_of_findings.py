"""Rules of findings decide by intervals: held, not held, and not shown."""

import math

import numpy as np
import pytest
from scipy import stats
from scripts import experiment

import consistency as cs

OVER = "overconfident"


@pytest.fixture(scope="module")
def stereo():
    return experiment("e04_stereo")


@pytest.fixture(scope="module")
def projection():
    return experiment("e05_projection")


@pytest.mark.parametrize(
    "status, low, high, holds",
    [
        (OVER, -0.1, 0.4, True),
        (OVER, -0.4, 0.1, True),
        (OVER, -0.1, 0.6, None),
        (OVER, -0.6, 0.1, None),
        (OVER, 0.6, 0.8, False),
        (OVER, -0.8, -0.6, False),
        ("undecided", -0.1, 0.1, None),
        ("consistent", -0.1, 0.1, False),
    ],
)
def test_improvement_is_minimal(stereo, status, low, high, holds):
    assert stereo.is_minimal(status, low, high) is holds


@pytest.mark.parametrize(
    "status, share, p_value, holds",
    [
        (OVER, 0.97, 1e-9, True),
        (OVER, 0.03, 1e-9, False),
        (OVER, 0.60, 0.01, None),
        ("undecided", 0.97, 1e-9, None),
        ("consistent", 0.97, 1e-9, False),
    ],
)
def test_observing_pixels_improves(stereo, status, share, p_value, holds):
    assert stereo.is_improved(status, share, p_value) is holds


def test_share_of_the_excess_that_is_removed(stereo):
    """Halfway from 13 to 3 in every run, so that the interval has no width but that of the runs."""
    ekf = 13.0 + np.linspace(-1, 1, 300)
    gain, low, high = stereo.removed(ekf, 3.0 + (ekf - 3.0) / 2, seed=0)
    assert (gain, low, high) == pytest.approx((0.5, 0.5, 0.5))
    rng = np.random.default_rng(0)
    few, many = ([3.0 + rng.chisquare(3, size=runs) for _ in range(2)] for runs in (20, 500))
    widths = [np.diff(stereo.removed(*pair, seed=0)[1:]).item() for pair in (few, many)]
    assert widths[1] < widths[0] / 2  # 25 times more runs: about a fifth of the width


def test_studies_stand_beside_each_other(stereo):
    nees = np.repeat([1.0, 2.0, 3.0, 4.0, 5.0, 6.0], 50)
    nees[0] = 101.0  # one diverged run decides the mean of its study alone
    table = stereo.table_of({"ekf": stereo.Studies(OVER, nees, None)})
    assert table["anees"].tolist() == [3.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert table["median_run"].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert table["worst_run"].tolist() == [101.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    words = stereo.Studies(OVER, nees, None).words("ekf")
    assert words == (
        "ekf overconfident, median run 4.0, worst run 101, mean ANEES of the 6 studies 3.0, 2.0, 3.0, 4.0, 5.0, 6.0"
    )


def test_errors_are_bounded_or_not():
    module = experiment("e02_tuning")
    rule = [
        module.is_bounded(np.full(3, low), np.array([high, 0.99, 0.99])) for low, high in ((0.9, 0.99), (0.8, 0.89))
    ]
    assert rule == [True, False]
    assert module.is_bounded(np.array([0.8, 0.9, 0.9]), np.full(3, 0.9)) is None
    assert module.is_bounded(np.full(3, np.nan), np.full(3, np.nan)) is None
    upper = np.array([0.95, 0.99, 0.99])
    assert [module.is_optimistic(upper, word) for word in (OVER, "undecided", "consistent")] == [True, None, False]
    assert module.is_optimistic(np.full(3, 0.96), OVER) is None
    bounded = experiment("e03_direct_points").is_well_bounded
    assert [bounded(*values) for values in ((False, 2.0), (False, 2.1), (True, 1.5))] == [True, None, False]


@pytest.mark.parametrize(
    "tests, holds",
    [
        ([(True, 1e-9), (True, 1e-9)], True),
        ([(True, 1e-9), (True, 0.01)], None),
        ([(True, 1e-9), (False, 0.01)], None),
        ([(True, 1e-9), (False, 1e-9)], False),
    ],
)
def test_direction_of_sign_tests(tests, holds):
    assert experiment("e06_baseline").direction(tests) is holds


def test_cost_and_rate_of_the_front_end(monkeypatch):
    module = experiment("e10_front_end_synthetic")
    assert [module.is_cheaper(*ends) for ends in ((1.2, 3.0), (0.8, 1.2), (0.2, 0.8))] == [True, None, False]
    rules = [module.accepts_as_often(*values) for values in ((0.91, 0.96), (0.89, 0.96), (0.83, 0.949), (0.91, 0.949))]
    assert rules == [True, None, False, False]
    seconds = iter([1.0, 8.0] * module.PAIRS)
    monkeypatch.setattr(module, "cpu_seconds", lambda _: next(seconds))
    finding = module.cost(cs.Study(seed=3))
    assert finding.verdict == "reproduced"
    assert finding.measured.startswith("x8.0 (8.0 to 8.0): the closed form takes as long as 125 samples")


def test_motions_of_the_simulation_scatter_as_the_closed_form_says():
    """Between 1/1.3 and 1.3 in each variance of 2,000 samples: 8 of their standard deviations and the second order."""
    module = experiment("e10_front_end_synthetic")
    rng, rig = np.random.default_rng(5), module.rigs.published_rig()
    p1 = module.rigs.common_points(rng, rig, module.rigs.MOTION, 100, 1.5, 3.0)
    clouds = p1, module.rigs.MOTION.inverse().apply(p1)
    true = [rig.project(p) for p in clouds]
    samples = module.motions(rig, true, 0.5, 2000, rng)
    assert samples.shape == (2000, 6)
    S1, S2 = (module.triangulation_covariance(rig, uv, 0.25 * np.eye(4)) for uv in true)
    stated = np.diag(module.registration_covariance(*clouds, S1, S2, module.register_svd(*clouds)))
    ratio = samples.var(axis=0) / stated
    assert ((ratio > 1 / 1.3) & (ratio < 1.3)).all()
    np.testing.assert_allclose(samples.mean(axis=0), module.rigs.MOTION.vector, atol=6 * np.sqrt(stated.max() / 2000))


# --- (x, y) of fig. 12 -------------------------------------------------------------------------------


def test_skewness_in_the_plane(projection):
    """p of Gaussian points is uniform: the share below 5 % of 500 batches is within 5 sigma (1 in a million)."""
    rng = np.random.default_rng(2)
    batches = rng.normal(size=(500, 100, 2)) @ np.array([[2.0, 0.0], [1.5, 0.3]])
    share = np.mean([projection.skewness_p(batch) < 0.05 for batch in batches])
    assert abs(share - 0.05) < 5 * math.sqrt(0.05 * 0.95 / 500) + 0.005  # the approximation at n = 100
    skew = rng.exponential(size=(50, 100, 2))
    assert np.mean([projection.skewness_p(batch) < 0.05 for batch in skew]) > 0.9


def test_skewness_on_a_line(projection):
    """With one component Mardia's statistic is n / 6 times the squared skewness, corrected for n."""
    x = np.random.default_rng(1).gamma(9.0, size=40)
    corrected = 40 * (2 * 41 * 43) / (40 * (41 * 2 - 6)) * stats.skew(x) ** 2 / 6
    assert projection.skewness_p(x[:, None]) == pytest.approx(stats.chi2.sf(corrected, 1), rel=1e-9)


def test_skewness_does_not_depend_on_the_axes(projection):
    points = np.random.default_rng(1).gamma(2.0, size=(80, 2))
    turned = 3.0 + points @ np.array([[2.0, -1.0], [0.5, 4.0]])
    assert projection.skewness_p(turned) == pytest.approx(projection.skewness_p(points), rel=1e-9)


def test_volume_that_two_gaussians_share(projection):
    """2 Phi(-d / 2) for equal covariances at a Mahalanobis distance d; two chi-squares where densities cross."""
    covariance = np.array([[4.0, 1.2], [1.2, 1.0]])
    away = np.array([1.0, -0.5])
    d = math.sqrt(away @ np.linalg.solve(covariance, away))
    shared = projection.shared_volume((np.zeros(2), covariance), (away, covariance))
    assert shared == pytest.approx(2 * stats.norm.cdf(-d / 2), abs=1e-4)
    k2 = 4.0
    crossing = math.log(k2) / (0.5 - 0.5 / k2)
    expected = stats.chi2.sf(crossing, 2) + stats.chi2.cdf(crossing / k2, 2)
    assert projection.shared_volume((np.zeros(2), covariance), (np.zeros(2), k2 * covariance)) == pytest.approx(
        expected, abs=1e-4
    )


def test_the_plane_of_a_wide_baseline_is_linear_and_of_a_narrow_one_is_not(projection):
    findings = {finding.id: finding for finding in projection.main(cs.Study(seed=3))}
    assert {findings[name].verdict for name in ("fig12a-xy", "fig12b-xy")} == {"reproduced"}
    rng = np.random.default_rng(1)
    sample = projection.transformed(5.0, rng)  # m: nothing is left of the curvature
    flat = projection.plane(sample, sample, 5.0)
    assert flat.rejecting < 0.2
    assert flat.shared > 0.97
    np.testing.assert_allclose(flat.measured[1], flat.linear, rtol=0.1, atol=1e-4)


@pytest.mark.parametrize(
    ("pairs", "alike"),
    [
        ([("overconfident", "overconfident"), ("consistent", "consistent")], True),
        ([("overconfident", "overconfident"), ("consistent", "undecided")], None),
        ([("undecided", "consistent"), ("overconfident", "consistent")], False),
    ],
)
def test_worlds_that_differ_where_one_is_undecided_show_nothing(pairs, alike):
    assert experiment("e07_other_worlds").are_alike(pairs) is alike
