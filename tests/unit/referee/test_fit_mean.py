"""The mean of noise models: on whose side the noise is, instruments, intervals, and what is not corrected."""

from dataclasses import replace

import fit_sides as sides
import numpy as np
import pytest
from fit_covariance import World, drives
from fit_sides import Side
from numpy.testing import assert_allclose
from odometry import windows
from scipy import stats

import consistency as cs
from consistency.referee.fit_covariance import mean_and_noise as errors_
from consistency.referee.fit_covariance.mean_and_noise import (
    BACKWARD,
    FORWARD,
    GAP,
    NEIGHBOURS,
    Mean,
    MeanFit,
    WhiteNoise,
    choose_mean,
    constant_of,
    estimate,
    fit_noise,
    fitted_terms,
    jacobian_of_mean,
    jitter_of,
    no_mean,
    normal_equations,
    sum_of_neighbours,
    terms_of,
)
from consistency.referee.fit_covariance.noise_model import correction, data_of_model, noise_lines

FIT = MeanFit(
    Mean(1.0, 0.95, (0.0,)), Mean(1.01, 0.94, (0.001,)), np.array([0.98, 0.9, -0.01]), np.array([1.03, 0.98, 0.012]),
    np.array([False, True, False]), FORWARD, (0.8, 1.1), 4.0, False,
)  # fmt: skip


def cut(side, seed):
    return windows(sides.drives(np.random.default_rng(seed), side), "1m")


@pytest.mark.parametrize("in_space", [False, True])
@pytest.mark.parametrize("of_odometry", [True, False])
def test_the_scale_is_found_on_whichever_side_the_noise_is(of_odometry, in_space):
    """Turns with 3 times the variance of their noise, of which the estimates have 0.95: within 5 standard errors.

    Least squares finds 0.75 of it, or with the true motion as instruments 1.33 times as much where it is noisy.
    """
    fit = choose_mean(cut(Side(3, of_odometry, in_space, scale=0.95), 4))
    reach = 0.5 * (fit.high[1] - fit.low[1])
    assert fit.instruments == NEIGHBOURS
    assert abs(fit.whole.turn - 0.95) < 2.5 * reach < 0.3
    assert fit.strength > 100
    forward, backward = (0.95 * 0.75, 0.95) if of_odometry else (0.95, 0.95 / 0.75)
    assert fit.turns == pytest.approx((forward, backward), rel=0.15)
    assert not fit.is_open


def test_neighbours_are_those_of_the_same_drive_without_a_gap():
    w = cut(Side(3), 1).of(np.arange(5))
    first, last = np.array([0, 20, 40, 60, 81]), np.array([20, 40, 60, 80, 101])
    w = replace(w, drive=np.array([0, 0, 0, 1, 1]), first=first, last=last)
    out = sum_of_neighbours(w, np.arange(1.0, 6), 10 * np.arange(1.0, 6))
    assert out.tolist() == [20.0, 31.0, 2.0, 0.0, 0.0]


@pytest.mark.parametrize("in_space", [False, True])
def test_instruments_are_of_neighbouring_motion_apart_from_shared_ends(in_space):
    w = cut(Side(3, in_space=in_space), 2).of(np.arange(3))
    Z = normal_equations(w, no_mean(w), np.tile(np.eye(len(w.axes)), (3, 1, 1)), [NEIGHBOURS])[NEIGHBOURS].Z
    P, one = w.pieces.shape[1], 0.0
    early, late = np.array(w.pieces[:1]), np.array(w.pieces[2:])
    early[:, P - GAP :], late[:, :GAP] = one, one
    assert_allclose(Z[1], (jacobian_of_mean(early) + jacobian_of_mean(late))[0], atol=1e-12)
    # another motion of a window, or next to it, does not change its instruments
    w.pieces[1], w.pieces[0, P - GAP :], w.pieces[2, :GAP] = one, one, one
    again = normal_equations(w, no_mean(w), np.tile(np.eye(len(w.axes)), (3, 1, 1)), [NEIGHBOURS])[NEIGHBOURS].Z
    assert_allclose(again[1], Z[1], atol=1e-12)


def test_moments_are_weighted_by_the_covariance():
    w = cut(Side(3), 3).of(np.arange(4))
    root = np.random.default_rng(0).normal(size=(4, 3, 3))
    C = root @ np.swapaxes(root, 1, 2) + np.eye(3)
    forward, backward = normal_equations(w, no_mean(w), C, [FORWARD, BACKWARD]).values()
    X, Z = jacobian_of_mean(w.pieces), jacobian_of_mean(w.true_pieces)
    for k in range(4):
        for found, left in ((forward, X[k]), (backward, Z[k])):
            assert_allclose(found.A[k], left.T @ np.linalg.solve(C[k], X[k]), rtol=1e-9, atol=1e-12)
            assert_allclose(found.b[k], left.T @ np.linalg.solve(C[k], w.errors[k]), rtol=1e-9, atol=1e-12)


def test_an_interval_is_of_the_scatter_between_blocks():
    """Student's, of sums over 20 blocks that the solution leaves; a coefficient that is not fitted is that of none."""
    w = cut(Side(3, scale=0.9), 5)
    near = Mean(1.02, 0.9, (0.01,))
    m = normal_equations(w, near, None, [FORWARD])[FORWARD]
    mean, low, high = estimate(w, near, m)
    A = m.A.sum(axis=0)
    step = np.linalg.solve(A, m.b.sum(axis=0))
    left = m.b - m.A @ step
    sums = np.array([part.sum(axis=0) for part in np.array_split(left, 20)]) @ np.linalg.inv(A).T
    reach = stats.t.ppf(0.975, 19) * np.sqrt((sums**2).sum(axis=0) * 20 / 19)
    assert_allclose(mean.values, [1.02 * (1 + step[0]), 0.9 * (1 + step[1]), 0.01 * (1 + step[1]) + 1.02 * step[2]])
    assert_allclose(high - low, 2 * reach, rtol=1e-6)
    alone, _, _ = estimate(w, near, m, np.array([True, False, False]))
    assert alone.turn == 1.0
    assert alone.drift == (0.0,)
    fixed = np.array([0.0, 1 / 0.9 - 1, -0.01 / 1.02])
    rest = (m.b - m.A @ fixed).sum(axis=0)[0] / A[0, 0]
    assert alone.way == pytest.approx(1.02 * (1 + rest))


def test_what_is_none_is_not_corrected(rng):
    """White noise about a right scale: nothing is corrected unless an interval of 95 % misses."""
    found = choose_mean(cut(Side(3), 11))
    held = (found.low <= [1, 1, 0]) & (found.high >= [1, 1, 0])
    assert (found.free == ~held).all()
    assert held.sum() >= 2  # fails in 0.7 %
    for value, is_free, none in zip(found.mean.values, found.free, (1.0, 1.0, 0.0), strict=True):
        assert is_free or value == none
    assert np.abs(found.whole.values - [1, 1, 0]).min() > 0
    w = windows(drives(rng, 2))
    w = replace(w, true=Mean(1.0, 0.95, (0.0,)).applied(w).motions, true_pieces=Mean(1.0, 0.95).corrected(w.pieces))
    assert choose_mean(w).mean.turn == pytest.approx(0.95, abs=1e-3)


@pytest.mark.parametrize("of_odometry, snr", [(True, 10), (False, 1)])
def test_a_truth_that_drifts_leaves_the_scale_open(of_odometry, snr):
    """Its errors outlast a window; the interval holds both directions."""
    found = choose_mean(cut(Side(snr, of_odometry, drifts=True), 8))
    assert found.lasts
    assert found.is_open
    assert found.low[1] < min(found.turns) < max(found.turns) < found.high[1]
    assert found.low[1] < 1.0 < found.high[1]
    assert found.mean.turn == 1.0


def test_motion_that_lasts_for_less_than_a_window_is_a_weak_instrument():
    """White turns: F is that of a chance correlation, above the limit of 10 in 0.2 %."""
    rng, made = np.random.default_rng(3), []
    for i in range(6):
        turn = 0.05 * np.repeat(rng.normal(size=100), 1)
        steps = np.column_stack([np.ones(100), np.zeros(100), turn])
        noise = rng.normal(size=steps.shape) * [0.02, 0.01, 0.05]
        true, estimate = (cs.drive_of("", s, s, motions=True).estimate for s in (steps, steps + noise))
        made.append(cs.Drive(f"d{i}", np.arange(100.0), np.arange(100), estimate, true))
    found = choose_mean(windows(made, "3"))
    assert found.strength < 10
    assert found.instruments == FORWARD
    assert found.is_open
    assert found.turns == pytest.approx((0.5, 1.0), abs=0.25)


def test_weak_instruments_are_not_used(monkeypatch):
    w = cut(Side(3, in_space=False), 4)
    assert choose_mean(w).instruments == NEIGHBOURS
    monkeypatch.setattr(errors_, "STRONG", 1e9)
    assert choose_mean(w).instruments == FORWARD


def test_roads_without_turns_leave_turns_as_they_are():
    """Estimated turns are noise alone: least squares is near 0, and the range holds 1."""
    found = choose_mean(cut(Side(0.0), 10))
    assert found.mean.turn == 1.0
    assert abs(found.turns[0]) < 0.2
    assert found.low[1] < 1.0 < found.high[1]


def test_strength_is_the_first_stage_f():
    """Of the weakest coefficient, each beside the other; robust to unequal variances."""
    rng = np.random.default_rng(0)
    Z = rng.normal(size=(400, 2, 2))
    X = Z * [3.0, 0.2] + rng.normal(size=Z.shape)
    f = errors_._strength(errors_.NormalEquations(Z, Z[:, 0], Z, X))
    z, other, x = Z[..., 1].ravel(), Z[..., 0].ravel(), X[..., 1].ravel()
    z, x = (each - other * (other @ each) / (other @ other) for each in (z, x))
    slope = z @ x / (z @ z)
    variance = ((z * (x - slope * z)).reshape(400, 2).sum(axis=1) ** 2).sum() / (z @ z) ** 2
    assert f == pytest.approx(slope**2 / variance)


@pytest.mark.parametrize(
    "weights, expected", [((1.0,), False), ((1.0, 1.0), True), ((1.0, 0.0, 1.0), True), ((1.0, -1.0), False)]
)
def test_errors_that_outlast_a_window(weights, expected):
    """Independent errors; errors that share a part with the next window, or the one after; jitter of shared ends.

    Independent errors are called lasting in 0.3 %.
    """
    w = cut(Side(3), 6)
    white = 0.03 * np.random.default_rng(2).normal(size=len(w.drive) + 2)
    yaw = sum(weight * white[k : k + len(w.drive)] for k, weight in enumerate(weights))
    moved = np.zeros((len(w.drive), 3))
    moved[:, 2] = yaw
    true = w.motions @ sides.matrices_of(moved)
    assert errors_._lasts(replace(w, true=true)) == expected


# --- variances -----------------------------------------------------------------------------------------


def test_a_turn_of_its_own_does_not_stand_for_a_noisy_one():
    w = cut(Side(3), 7).of(np.arange(6))
    F, found = terms_of(w.pieces), fitted_terms(w, replace(FIT, instruments=NEIGHBOURS))
    assert_allclose(found[:, :3], F[:, :3])
    assert_allclose(found[2, 3:], 0.5 * (F[1, 3:] + F[3, 3:]))
    assert_allclose(found[0, 3:], F[1, 3:])
    for fit in (FIT, None):
        assert_allclose(fitted_terms(w, fit), F)
    lonely = replace(w, last=w.last - np.array([0, 0, 0, 0, 1, 0]))
    found = fitted_terms(lonely, replace(FIT, instruments=NEIGHBOURS))
    assert_allclose(found[5, 3:], found[:5, 3:].mean(axis=0))


def test_jitter_is_the_constant_of_mean_squares():
    stated, counts = np.array([1.0, 2.0, 4.0, 8.0]), np.array([800, 400, 200, 100])
    assert constant_of(2.0 * stated + 3.0, stated, counts) == pytest.approx(3.0)
    assert constant_of(stated, stated, counts) == 0.0
    assert constant_of(2.0 * stated + 3.0, stated, counts / 100) == 0.0  # not shown by 3 standard errors
    assert constant_of(20.0 - stated, stated, 1000 * counts) == 0.0  # errors do not grow


def test_the_floor_is_added():
    w = cut(Side(3), 9).of(np.arange(4))
    theta, floor = np.arange(1.0, 7.0), np.array([0.1, 0.2, 0.3])
    noise = WhiteNoise(w.axes, no_mean(w), theta[:3], theta[3:], floor, 2.0)
    F = terms_of(w.pieces)
    assert_allclose(noise.covariance(w.pieces), 2.0 * (np.tensordot(theta, F, (0, 1)) + np.diag(floor)))


@pytest.mark.parametrize("seed, side", [(2, Side(3, False, jitters=True)), (3, Side(1))], ids=["jitter", "odometry"])
def test_the_ratio_over_twenty_spans_is_right(seed, side):
    """1 but for 10 %; 0.6 if jitter is taken for noise of the way, 1.8 by least squares where the odometry errs."""
    _, ratio = sides.fitted(np.random.default_rng(seed), side)
    assert 0.75 < ratio < 1.3


def test_every_fit_that_is_judged_has_the_jitter(rng):
    made = drives(rng, 3, World(offset=0.1), 300.0)
    model = cs.fit_covariance(made, "10m")
    jitter = jitter_of(fit_noise(model.windows), model.windows)
    assert jitter[0] > 0.005  # of 0.02
    for noise in (model.noise, *(fold.noise for fold in model.folds)):
        assert (noise.floor >= jitter).all()


# --- sentences ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def model():
    return cs.fit_covariance(drives(np.random.default_rng(5), 3, length=300.0), "10m", name="wheels")


def said(model, **changes):
    fit = replace(FIT, **changes)
    noise = replace(model.noise, mean=fit.mean, mean_fit=fit)
    return "\n".join([correction(replace(model, noise=noise)), *noise_lines(replace(model, noise=noise))])


def test_sentences_of_the_mean(model):
    text = said(model)
    assert text.startswith("correct first: turn x0.95\n")
    assert "not corrected, as the interval holds none: way x[0.98, 1.03], heading [-0.01, 0.012]" in text
    assert "whose noise it is cannot be told: the scale of turns is x0.80 if the robot's motion errs" in text
    assert "x1.10 if the odometry errs" in text
    assert "weak instruments (F 4.00, below 10)" in text
    assert "errors outlast a window" in said(model, strength=50.0, lasts=True)
    assert "tell less than these" in said(model, strength=50.0)
    assert "cannot be told" not in said(model, turns=(0.95, 0.96))
    used = said(model, instruments=NEIGHBOURS, strength=50.0)
    assert "the scale of turns is that by the motion of neighbouring windows (F 50.0), not x0.80" in used
    assert "--second tells which" in used
    assert "--second" not in said(model, instruments=NEIGHBOURS, turns=(0.8, 0.97))
    slip = "correct first: -0.1 m of way a rad of turn"
    assert said(model, mean=Mean(1.0, 0.95, (0.0,), -0.1)).startswith(f"{slip}, then turn x0.95\n")
    assert said(model, mean=Mean(slip=-0.1), free=np.array([False] * 3)).startswith(f"{slip}\n")
    none = said(model, free=np.array([False] * 3), mean=no_mean(model.windows))
    assert none.startswith("\n")


def test_programs_have_the_evidence(model):
    fit, mean = model.noise.mean_fit, data_of_model(model)["mean"]
    assert mean["low"] == fit.low.tolist()
    assert mean["free"] == fit.free.tolist()
    assert mean["instruments"] == fit.instruments
    plain = cs.fit_covariance(model.drives, "10m", correct=False)
    assert plain.noise.mean_fit is None
    assert set(data_of_model(plain)["mean"]) == {"way", "turn", "drift_rad_per_m", "slip_m_per_rad"}
