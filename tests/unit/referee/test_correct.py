"""Factors and floors for a stated covariance: the fit, runs as the unit, what is held out, and the verdict."""

from dataclasses import replace

import calibration_lengths as lengths
import numpy as np
import pytest
from records import changed
from scipy import optimize, stats

import consistency as cs
from consistency.referee.diagnostics.groups import Groups
from consistency.referee.diagnostics.nees import nees
from consistency.referee.diagnostics.record import make_record
from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.correct import (
    are_needed,
    correct,
    correction_lines,
    fit_groups,
    held_out_by,
    with_uncertainty,
)
from consistency.referee.fit_covariance.estimation import (
    Score,
    chance_of_one,
    floor_interval,
    interval_of_ratio,
    maximise,
)
from consistency.referee.fit_covariance.factors import (
    FactorBlock,
    Factors,
    blocks_of,
    fit_alone,
    fit_factors,
    fit_runs,
    likeness,
    relative_sizes,
    run_moments,
    scores,
)
from consistency.referee.types import Failure

POSE = ("x", "y", "z", "roll", "pitch", "yaw")
BLOCKS, PLACE = blocks_of(POSE, 6, False), blocks_of(POSE[:3], 3, False)


def covariances(rng, runs, steps, n, spread=1.0):
    """One shape of a covariance whose size varies from step to step, (runs, steps, n, n)."""
    A = rng.normal(size=(n, n))
    return np.asarray(np.exp(spread * rng.normal(size=(runs, steps, 1, 1))) * (A @ A.T + np.eye(n)))


def drawn(rng, C, rho=0.0):
    """Errors with covariances C (runs, steps, n, n), whose whitened values depend on those of the step before."""
    runs, steps, n, _ = C.shape
    w = rng.normal(size=(runs, steps, n))
    for k in range(1, steps):
        w[:, k] = rho * w[:, k - 1] + np.sqrt(1.0 - rho**2) * w[:, k]
    return np.asarray((np.linalg.cholesky(C) @ w[..., None])[..., 0])


def record_of(error, P, axes=()):
    n = error.shape[-1]
    return make_record("est", error, P, nees(error, P), n, axes=axes or POSE[:n], runs=np.arange(len(error)))


def wrong(rng, runs=24, steps=40, factor=9.0, turn=0.5, rho=0.5):
    """A pose in space whose position is off by one factor and its rotation by another."""
    P = covariances(rng, runs, steps, 6)
    return record_of(drawn(rng, Factors(BLOCKS, np.array([factor, turn]), np.zeros(2)).applied(P), rho), P)


# --- blocks and factors -----------------------------------------------------------------------------------------------


def test_blocks_go_by_names():
    names = (*POSE, "vx", "vy", "vz")
    assert [(b.name, b.places) for b in blocks_of(names, 9, False)] == [
        ("position", (0, 1, 2)),
        ("attitude", (3, 4, 5)),
        ("velocity", (6, 7, 8)),
    ]
    assert [b.name for b in blocks_of(("x", "y", "heading"), 3, True)] == ["x", "y", "heading"]
    assert [b.name for b in blocks_of(("tank", "x", "pump"), 3, False)] == ["tank", "position", "pump"]
    assert [b.places for b in blocks_of((), 3, False)] == [(0, 1, 2)]


def test_factors_are_the_most_likely_ones(rng):
    record = wrong(rng, runs=4)
    P, e = record.errors.covariance, record.errors.error

    def loss(logs):
        C = Factors(BLOCKS, np.exp(logs), np.zeros(2)).applied(P)
        return float(nees(e, C).mean() + np.linalg.slogdet(C)[1].mean())

    found = optimize.minimize(loss, np.zeros(2), tol=1e-12).x
    Q = run_moments(record, BLOCKS)
    assert np.log(fit_factors(Q.mean(axis=0), np.array([3.0, 3.0]))) == pytest.approx(found, abs=1e-4)


def test_factors_of_any_size_are_found(rng):
    A = rng.normal(size=(50, 4, 4)) * 10.0 ** rng.uniform(-6, 6, (50, 4, 1))
    Q, sizes = A @ np.swapaxes(A, 1, 2), np.array([3.0, 3.0, 3.0, 1.0])
    x = fit_factors(Q, sizes) ** -0.5
    assert (Q @ x[..., None])[..., 0] * x == pytest.approx(np.broadcast_to(sizes, x.shape), abs=1e-6)


def test_runs_are_the_unit(rng):
    record = wrong(rng, runs=6, steps=10)
    twice = record_of(np.repeat(record.errors.error, 3, axis=1), np.repeat(record.errors.covariance, 3, axis=1))
    once, again = (fit_runs(each, BLOCKS) for each in (record, twice))
    for one, other in zip(once.factor, again.factor, strict=True):
        assert tuple(one) == pytest.approx(tuple(other), rel=1e-6)


def test_a_covariance_is_scaled_by_blocks():
    P = np.array([[4.0, 1.0, 0.2], [1.0, 5.0, 0.3], [0.2, 0.3, 0.1]])
    factors = Factors(
        (FactorBlock("position", (0, 1)), FactorBlock("attitude", (2,))), np.array([9.0, 4.0]), np.array([0.5, 0.0])
    )
    expected = [[36.5, 9.0, 1.2], [9.0, 45.5, 1.8], [1.2, 1.8, 0.4]]
    assert factors.applied(P) == pytest.approx(np.array(expected))


# --- what is held out -------------------------------------------------------------------------------------------------


def test_a_run_has_no_say_in_its_own_factors(rng):
    record = wrong(rng, runs=6)
    error = record.errors.error.copy()
    error[3] *= 20.0
    one, other = (correct(each) for each in (record, record_of(error, record.errors.covariance)))
    assert other.used[3][0].factor == pytest.approx(one.used[3][0].factor, rel=1e-9)
    assert (other.used[2][0].factor > 2 * one.used[2][0].factor).all()


def test_known_factors_are_found_and_judged_right():
    """Fails by chance in fewer than 1 in 1e5: bounds are 5 standard errors or more of some 960 steps x 3."""
    found = correct(wrong(np.random.default_rng(), rho=0.0))
    position, attitude = found.fit.factor
    assert position.value == pytest.approx(9.0, rel=0.15)
    assert attitude.value == pytest.approx(0.5, rel=0.15)
    assert found.before.ratio.low > 2.0
    assert found.after.ratio.value == pytest.approx(1.0, abs=0.02)
    assert found.after.covered((0.68, 0.95, 0.99)) == pytest.approx((0.68, 0.95, 0.99), abs=0.08)
    assert found.gain.low > 0.0
    assert not found.after.ratio.holds(1.2)


def test_the_gain_is_of_log_densities(rng):
    record = wrong(rng, runs=3, steps=5)
    scores_of = held_out_by(record).scores
    for run in range(3):
        density = [
            stats.multivariate_normal.logpdf(e, np.zeros(6), P)
            for e, P in zip(record.errors.error[run], record.errors.covariance[run], strict=True)
        ]
        assert scores_of[run] == pytest.approx(np.mean(density))


def test_named_runs_and_half_are_judged_by_the_others(rng):
    record = wrong(rng, runs=6)
    by_name = correct(record, held_out="1, 4", names=["0", "1", "2", "3", "4", "5"])
    assert by_name.judged == ("1", "4")
    assert by_name.fitted == ("0", "2", "3", "5")
    rest = fit_runs(record.of_runs(np.array([0, 2, 3, 5])), by_name.blocks)
    assert by_name.used[0][0].factor == pytest.approx(rest.factors.factor)
    assert correct(record, held_out="half").judged == ("3", "4", "5")


def test_uncertain_factors_lengthen_no_tails():
    """A block whose NEES is a quantile of n F(n, nu) has that of the chi-square afterwards."""
    p = np.array([0.01, 0.5, 0.99, 0.9999])
    squares = 3 * stats.f.ppf(p, 3, 8.0)
    error = np.zeros((1, 4, 3))
    error[0, :, 1] = np.sqrt(squares)
    record = record_of(error, np.broadcast_to(np.eye(3), (1, 4, 3, 3)).copy())
    found = with_uncertainty(record, PLACE, np.array([[8.0]]))
    assert found.errors.nees[0] == pytest.approx(stats.chi2.ppf(p, 3), rel=1e-6)


def test_what_few_runs_add_is_what_a_ratio_has_more():
    rng = np.random.default_rng(0)
    constant = np.repeat(rng.normal(size=(10, 1, 3)), 5, axis=1)
    P = np.broadcast_to(np.eye(3), (10, 5, 3, 3)).copy()
    found = correct(constant, P, axes=("x", "y", "z"))
    nu = found.fit.dof[0]
    assert nu >= 27.0
    assert found.excess == pytest.approx(nu / (nu - 2.0))
    assert any(f"which adds x{found.excess:.3g} to a" in line for line in correction_lines(found))
    assert not any("are uncertain" in line for line in correction_lines(replace(found, excess=1.004)))


# --- the three ends ---------------------------------------------------------------------------------------------------


def test_many_runs_off_by_a_factor_are_consistent_after():
    """Fails by chance where the referee finds a fault in a right covariance, 5 %; so the best of five tries counts."""
    tries = (correct(wrong(np.random.default_rng(), runs=40, rho=0.3)).status for _ in range(5))
    assert "consistent" in tries


def test_few_runs_are_undecided_after_and_say_how_many_would_decide():
    found = correct(wrong(np.random.default_rng(3), runs=6))
    assert found.status == "undecided"
    assert found.needed > 6
    assert f"about {found.needed} runs would decide" in repr(found)


def test_what_no_factor_mends_is_named(rng):
    record = wrong(rng, runs=40, rho=0.0)
    heavy = record.errors.error * np.sqrt(2.0 / rng.chisquare(2.0, (40, 40, 1)))
    biased = record.errors.error + 3.0 * np.sqrt(np.diagonal(record.errors.covariance, axis1=2, axis2=3))
    for error, word in ((heavy, "heavy"), (biased, "mean error")):
        found = correct(record_of(error, record.errors.covariance))
        assert found.status == "inconsistent"
        assert word in found.verdict.reasons[0]
        assert "no factor mends this" in repr(found)


def test_a_run_that_failed_from_the_start_counts(rng):
    record = wrong(rng, runs=8)
    error, values = record.errors.error.copy(), record.errors.nees.copy()
    error[2], values[2] = np.nan, np.nan
    broken = changed(record, error=error, nees=values, failures=(Failure("est", 2, 1, "estimate is not finite"),))
    found = correct(broken)
    assert found.status == "inconsistent"
    assert found.verdict.status == "failed"
    assert found.after.verdict.runs == 8
    assert found.fitted == ("0", "1", "3", "4", "5", "6", "7")
    assert found.used[2][0] == found.fit.factors
    assert found.used[3][0] == found.fit.left_out[2]
    assert np.isfinite(found.after.covered((0.5,))).all()
    assert np.isfinite(found.gain).all()


def test_a_correlation_of_the_wrong_sign_is_not_mended(rng):
    right = np.array([[1.0, 0.9], [0.9, 1.0]])
    C = np.broadcast_to(right, (40, 30, 2, 2)).copy()
    P = C * np.array([[1.0, -1.0], [-1.0, 1.0]])
    assert correct(record_of(drawn(rng, C), P)).status == "inconsistent"


def test_one_run_is_refused_with_what_it_takes(rng):
    with pytest.raises(InputError, match="--split auto, which takes 20 pieces"):
        correct(wrong(rng, runs=1))
    with pytest.raises(InputError, match="no run '9'; there are 0, 1, 2"):
        correct(wrong(rng, runs=3), held_out="9")
    with pytest.raises(InputError, match="leaves 1 runs to fit"):
        correct(wrong(rng, runs=3), held_out="0,1")
    P = np.broadcast_to(np.eye(2), (3, 4, 2, 2)).copy()
    with pytest.raises(InputError, match="no error in any step"):
        correct(record_of(np.zeros((3, 4, 2)), P))


# --- floors -----------------------------------------------------------------------------------------------------------


def with_floor(rng, factor, floor, spread=1.0, runs=24):
    P = covariances(rng, runs, 40, 3, spread)
    return record_of(drawn(rng, factor * P + floor * np.eye(3)), P)


def test_a_floor_is_found_where_it_is():
    """Both of two draws are off by 5 standard errors in fewer than 1 in 1e7: one is in 0 of 4,400."""
    fits = []
    for _ in range(2):
        record = with_floor(np.random.default_rng(), 2.0, 20.0)
        fits.append(fit_runs(record, PLACE))
    assert any(
        all(
            abs(value - true) < 1.25 * (interval.high - interval.low) + 0.02 * true
            for value, interval, true in (
                (fit.factors.factor[0], fit.factor[0], 2.0),
                (fit.factors.floor[0], fit.floor[0], 20.0),
            )
        )
        for fit in fits
    )
    assert any("gains" in fit.notes[0] for fit in fits)


def test_no_floor_is_kept_that_data_do_not_ask_for():
    rng = np.random.default_rng(5)
    record = with_floor(rng, 2.0, 0.0)
    fit = fit_runs(record, PLACE)
    assert fit.factors.floor.tolist() == [0.0]
    assert fit.floor[0].low == 0.0
    assert fit.floor[0].high > 0.0
    assert "floors are 0" in fit.notes[0]


def test_a_factor_of_0_beside_a_floor_has_a_one_sided_interval():
    rng = np.random.default_rng(2)
    P = covariances(rng, 20, 40, 3)
    record = record_of(drawn(rng, np.broadcast_to(50.0 * np.eye(3), P.shape).copy()), P)
    fit = fit_runs(record, PLACE)
    assert fit.factors.floor[0] == pytest.approx(50.0, rel=0.2)
    assert fit.factor[0].low == 0.0
    assert 0.0 < fit.factor[0].high < 2.0


def test_a_floor_is_not_told_from_a_covariance_of_its_shape(rng):
    P = np.broadcast_to(2.0 * np.eye(3), (6, 20, 3, 3)).copy()
    record = record_of(drawn(rng, 3.0 * P), P)
    assert likeness(record, PLACE[0]) == pytest.approx(1.0)
    fit = fit_runs(record, PLACE)
    assert fit.factors.floor.tolist() == [0.0]
    assert "cannot be told apart" in fit.notes[0]


def test_gradients_and_information_are_those_of_the_likelihood(rng):
    record = wrong(rng, runs=3, steps=30)
    blocks, free = BLOCKS, np.array([0, 1])
    theta = np.array([4.0, 0.7, 0.8, 0.3])
    _, gradient, information = scores(record, blocks, free, theta)
    h = 1e-5
    for i in range(4):
        step = h * np.eye(4)[i]
        above, below = (scores(record, blocks, free, theta + sign * step) for sign in (1.0, -1.0))
        assert (above[0] - below[0]) / (2 * h) == pytest.approx(gradient[:, i], rel=1e-4, abs=1e-6)
    assert (np.linalg.eigvalsh(information) > 0).all()


def test_sizes_by_other_factors_are_those_of_the_covariances(rng):
    """In the mean over steps, by the trace of the inverse of one times the other."""
    record = wrong(rng, runs=2, steps=5)
    whole = Factors(BLOCKS, np.array([4.0, 0.7]), np.array([0.8, 0.3]))
    other = Factors(BLOCKS, np.array([3.0, 0.9]), np.array([0.5, 0.6]))
    expected = np.zeros(2)
    for b, block in enumerate(BLOCKS):
        ratios = np.linalg.inv(block.of(whole.applied(record.errors.covariance))) @ block.of(
            other.applied(record.errors.covariance)
        )
        expected[b] = np.trace(ratios, axis1=-2, axis2=-1).mean() / 3
    assert relative_sizes(record, whole, [other])[0] == pytest.approx(expected)


def test_the_ends_of_the_interval_of_a_factor():
    """By the variance of its logarithm over runs: the lower one by Student's t, the upper one by chi-square."""
    left_out = np.array([8.0, 9.0, 9.5, 10.0])
    variance = 3 / 4 * np.square(np.log(left_out) - np.log(left_out).mean()).sum()
    reach, nu = stats.t.ppf(0.975, 3), 2.0 / variance
    high = 9.0 * nu / stats.chi2.ppf(stats.norm.sf(reach), nu)
    assert tuple(interval_of_ratio(9.0, left_out)) == pytest.approx((9.0, 9.0 * np.exp(-reach * variance**0.5), high))


def test_the_chance_of_1_is_5_percent_at_the_end_of_an_interval():
    spread = np.array([0.9, 1.1, 0.95, 1.05, 1.02])
    for end in tuple(interval_of_ratio(1.0, spread))[1:]:
        assert chance_of_one(1.0 / end, spread / end) == pytest.approx(0.05)
    assert chance_of_one(1.0, spread) > 0.9


def test_factors_are_needed_all_together(rng):
    """One of two at a chance of 3 % is no more than chance has, where two are asked."""
    fit = fit_alone(wrong(rng), BLOCKS)
    assert are_needed([replace(fit, chance=(0.03,))])
    assert not are_needed([replace(fit, chance=(0.03, 0.5))])
    assert not are_needed([replace(fit, chance=(0.03,)), replace(fit, chance=(0.5,))])
    floors = replace(fit.factors, floor=np.array([0.0, 0.1]))
    assert are_needed([replace(fit, chance=(0.5, 0.5), factors=floors)])


def test_the_first_line_says_that_no_factor_is_needed():
    """One of five tries with a right covariance at least, each 90 %: fails by chance in fewer than 1 in 50,000."""
    rng = np.random.default_rng()
    words = "no factor is shown to be needed, at 95% for all of them together"
    right = (covariances(rng, 12, 10, 6) for _ in range(5))
    assert any(words in repr(correct(record_of(drawn(rng, P), P))) for P in right)
    assert words not in repr(correct(wrong(rng)))


def test_no_factor_is_invented_where_the_covariance_is_right():
    """Two blocks at 5 % together in 200 draws of 6 runs, measured 5.9 %: fails by chance in fewer than 1 in 1e5."""
    rng = np.random.default_rng()
    invented = 0
    for _ in range(200):
        P = covariances(rng, 6, 10, 6)
        invented += are_needed([fit_alone(record_of(drawn(rng, P), P), BLOCKS)])
    assert invented < 32
    assert are_needed([fit_alone(wrong(rng), BLOCKS)])


def test_a_floor_at_zero_has_a_one_sided_interval():
    left_out = np.array([-0.3, -0.2, 0.1, 0.05, -0.1])
    error = 2.0 * left_out.std()
    found = floor_interval(0.0, -0.1, left_out)
    assert tuple(found) == pytest.approx((0.0, 0.0, stats.t.isf(0.05, 4) * error))
    inside = floor_interval(0.1, 0.1, left_out)
    assert inside.high == pytest.approx(0.1 + stats.t.isf(0.025, 4) * error)
    away = np.array([0.9, 1.1, 0.95, 1.05])
    assert floor_interval(1.0, 1.0, away) == interval_of_ratio(1.0, away)


def ragged(rng, runs=20, steps=30):
    """A right estimator whose runs have unlike numbers of steps, none of which depends on the errors."""
    P = covariances(rng, runs, steps, 3)
    record = record_of(drawn(rng, P), P)
    counted = np.arange(steps) < rng.integers(2, steps + 1, runs)[:, None]
    return changed(record, nees=np.where(counted, record.errors.nees, np.nan))


def test_runs_count_by_their_steps(rng):
    record = ragged(rng)
    counts = np.isfinite(record.errors.nees).sum(axis=1)
    fit = fit_alone(record, PLACE)
    assert fit.factors.factor == pytest.approx(np.nansum(record.errors.nees) / (3 * counts.sum()))
    others = np.delete(record.errors.nees, 4, axis=0)
    assert fit.left_out[4].factor == pytest.approx(np.nansum(others) / (3 * np.delete(counts, 4).sum()))
    left_out = np.array([each.factor[0] for each in fit.left_out])
    runs = counts.sum() ** 2 / np.square(counts).sum()
    assert tuple(fit.factor[0]) == pytest.approx(tuple(interval_of_ratio(fit.factors.factor[0], left_out, runs)))
    assert fit.factor[0].low < interval_of_ratio(fit.factors.factor[0], left_out).low
    assert fit.chance[0] == pytest.approx(chance_of_one(fit.factors.factor[0], left_out, runs))
    nu = 2.0 / (19 * np.log(left_out).var())
    assert fit.dof[0] == pytest.approx(max(nu, 3 * (runs - 1)))


def test_scores_count_by_steps(rng):
    record = ragged(rng, runs=4)
    value, gradient, information = scores(record, PLACE, np.array([0]), np.array([1.2, 0.1]))
    counts = np.isfinite(record.errors.nees).sum(axis=1)
    for run in range(4):
        alone = scores(record.of_runs(np.array([run])), PLACE, np.array([0]), np.array([1.2, 0.1]))
        assert value[run] == pytest.approx(alone[0][0] * counts[run] / counts.mean())
        assert gradient[run] == pytest.approx(alone[1][0] * counts[run] / counts.mean())
        assert information[run] == pytest.approx(alone[2][0] * counts[run] / counts.mean())


@pytest.mark.parametrize("seed", [7, 8])
def test_a_right_filter_needs_no_factor_by_how_its_runs_end(seed):
    """Fails by chance once in 10,000; with equal weights the chance of 1 is below 1e-8."""
    record = lengths.measured(np.random.default_rng(seed), lengths.WORLDS["aligned"], 6000)
    fit = fit_alone(record, blocks_of(("x",), 1, False))
    assert fit.chance[0] > 1e-4
    means = np.nanmean(record.errors.nees, axis=1)
    assert chance_of_one(means.mean(), (means.sum() - means) / (len(means) - 1)) < 1e-8


def test_several_fits_ask_more_of_a_floor():
    record = with_floor(np.random.default_rng(6), 2.0, 20.0)
    assert fit_runs(record, PLACE, 20).factors.floor[0] > 0.0
    assert fit_runs(record, PLACE, 10**30).factors.floor[0] == 0.0


def test_groups_have_factors_of_their_own_runs(rng):
    record = wrong(rng, runs=6)
    index = rng.integers(-1, 2, (6, 40))
    index[:5][index[:5] == 1] = 0
    groups = Groups("speed", ("slow", "fast"), index, (1.0,))
    fits = fit_groups(replace(record, groups=groups), BLOCKS)
    assert list(fits) == ["slow", "fast", ""]
    slow = changed(record, nees=np.where(index == 0, record.errors.nees, np.nan))
    assert fits["slow"].factors.factor == pytest.approx(fit_runs(slow, fits[""].factors.blocks).factors.factor)
    assert fits["fast"].factors == fits[""].factors
    assert "fewer than two runs" in fits["fast"].notes[0]
    found = correct(replace(record, groups=groups))
    run, step = (int(each[0]) for each in np.nonzero(index == -1))
    expected = fits[""].left_out[run].applied(record.errors.covariance[run, step])
    assert found.after.record.errors.covariance[run, step] == pytest.approx(expected)


def test_arrays_are_corrected_in_python(rng):
    P = covariances(rng, 8, 20, 3)
    found = cs.correct(drawn(rng, 4.0 * P), P, axes=("x", "y", "heading"), per_axis=True)
    assert [block.name for block in found.blocks] == ["x", "y", "heading"]
    d = np.sqrt(found.fit.factors.factor)
    assert found.covariance(P[0, 0]) == pytest.approx(P[0, 0] * np.outer(d, d) + np.diag(found.fit.factors.floor))


def test_pictures_are_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    found = correct(wrong(np.random.default_rng(1), runs=5))
    figure = found.plot(tmp_path / "c.png")
    assert (tmp_path / "c.png").stat().st_size > 1000
    runs, factors, coverage = figure.axes
    assert [len(line.get_xdata()) for line in runs.lines if line.get_marker() == "s"] == [5]
    assert factors.get_xlabel() == "factor on variances"
    assert {line.get_label() for line in coverage.lines} >= {"stated", "corrected"}


def test_more_runs_than_those_judged_would_decide():
    """One run that differs keeps the others from showing anything."""
    rng = np.random.default_rng(8)
    errors = rng.normal(size=(40, 100, 3))
    errors[17] *= 1.45
    found = cs.correct(errors, np.broadcast_to(np.eye(3), (40, 100, 3, 3)))
    assert found.status == "undecided"
    assert found.needed > 40


# --- scoring ---------------------------------------------------------------------------------------


def test_steps_that_lead_beyond_the_top_are_halved():
    """Newton's method from 0 diverges on -sqrt(1 + (x - 3)^2): its first step ends at 30."""

    def score(theta):
        away = theta[0] - 3.0
        root = np.sqrt(1.0 + away**2)
        return Score(-root, np.array([-away / root]), np.array([[root**-3]]))

    assert maximise(score, np.zeros(1), 0.0, 1e-12) == pytest.approx(3.0, abs=1e-4)
