"""Factors that differ between blocks or axes, and correlations that are named beside them.

Chance fails a test here less often than once in 100,000 times: faults are so large, and bounds so wide.
"""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from draws import independent
from numpy.testing import assert_allclose
from records import changed
from scipy import stats

from consistency.diagnostics import Settings, judge, make_record
from consistency.referee.diagnostics import error_parts
from consistency.referee.diagnostics.bias_and_shape import pair_p_values
from consistency.referee.diagnostics.fault_words import factors_text, unlike_text
from consistency.referee.diagnostics.sentences import reasons
from consistency.referee.diagnostics.verdict_parts import ComponentRatios, Interval

SURE = 1e-5
INERTIAL = ("x", "y", "z", "roll", "pitch", "yaw", "vx", "vy", "vz")
NUMBER = r"\d+\.\d+"
WITH_INTERVAL = rf"x{NUMBER} \[{NUMBER}, {NUMBER}\]"


def correlations(n, r=0.5):
    """Every pair has the correlation r, of either sign."""
    signs = np.where(np.arange(n) % 2, -1.0, 1.0)
    return r * np.outer(signs, signs) + (1.0 - r) * np.eye(n)


def inertial(rng, factors, true=None, runs=40, steps=20):
    """Errors of position, attitude and velocity, and a covariance whose variances are too small by ``factors``."""
    C = correlations(9)
    if true is None:
        true = C
    scale = np.sqrt(np.repeat(factors, 3))
    P = C / np.outer(scale, scale)
    error = independent(rng, runs, steps, 9) @ np.linalg.cholesky(true).T
    return make_record("f", error, np.broadcast_to(P, (runs, steps, 9, 9)), axes=INERTIAL)


def p_of_pairs(error, stated):
    return pair_p_values(error, np.broadcast_to(stated, (*error.shape, 2)), np.ones(error.shape[:2], bool))


# --- the test of a pair --------------------------------------------------------------------------------------


def test_a_pair_in_one_step_without_a_stated_correlation_is_that_of_pearson(rng):
    error = independent(rng, 12, 1, 2) @ np.array([[1.0, 0.7], [0.0, 2.0]])
    p = p_of_pairs(error, np.diag([1.0, 9.0]))
    assert_allclose(p[0, 1], stats.pearsonr(*error[:, 0].T)[1], rtol=1e-9)
    assert p[1, 0] == p[0, 1]
    assert np.isnan(np.diag(p)).all()


def test_a_pair_in_one_step_is_whitened_by_its_stated_correlation(rng):
    S = np.array([[1.0, 0.6], [0.6, 1.0]])
    error = independent(rng, 30, 1, 2) @ np.linalg.cholesky(S).T
    w, V = np.linalg.eigh(S)
    u = error[:, 0] - error[:, 0].mean(axis=0)
    white = u / u.std(axis=0, ddof=1) @ (V / np.sqrt(w)) @ V.T
    r = (white[:, 0] @ white[:, 1] + 0.6 * 30 / 58) / np.sqrt(np.square(white).sum(axis=0).prod())
    assert_allclose(p_of_pairs(error, S)[0, 1], 2.0 * stats.t.sf(abs(r) * np.sqrt(28 / (1 - r * r)), 28), rtol=1e-9)


def test_a_run_is_one_observation_over_several_steps(rng):
    error = independent(rng, 15, 4, 2)
    u = (error - error.mean(axis=0)) / error.std(axis=0, ddof=1)
    expected = stats.ttest_1samp(u.prod(axis=-1).mean(axis=1), 0.0).pvalue
    assert_allclose(p_of_pairs(error, np.eye(2))[0, 1], expected, rtol=1e-9)


def test_factors_on_the_axes_do_not_matter_in_any_step(rng):
    error = independent(rng, 20, 6, 3) @ np.linalg.cholesky(correlations(3)).T
    P = np.broadcast_to(correlations(3), (20, 6, 3, 3))
    known = np.ones((20, 6), bool)
    factors = rng.uniform(0.1, 10.0, (6, 3))
    assert_allclose(pair_p_values(error * factors, P, known), pair_p_values(error, P, known), rtol=1e-9)


def test_a_large_stated_correlation_is_not_wrong_because_sizes_are_estimated(rng):
    """20 runs of 12,000 steps: without its correction the mean product would be 12 standard errors from 0."""
    S = np.array([[1.0, 0.95], [0.95, 1.0]])
    error = independent(rng, 20, 12_000, 2) @ np.linalg.cholesky(S).T
    assert p_of_pairs(error, S)[0, 1] > 1e-6
    assert p_of_pairs(error, np.array([[1.0, 0.9], [0.9, 1.0]]))[0, 1] < 1e-6


def test_steps_of_few_runs_are_left_out(rng):
    error = independent(rng, 8, 3, 2)
    known = np.ones((8, 3), bool)
    P = np.broadcast_to(np.eye(2), (8, 3, 2, 2))
    whole = pair_p_values(error[:, :2], P[:, :2], known[:, :2])
    known[:3, 2] = False
    error[:3, 2] = np.nan
    assert_allclose(pair_p_values(error, P, known), whole)
    assert np.isnan(pair_p_values(error[:5], P[:5], known[:5])).all()


@pytest.mark.parametrize("here, steps, looks", [(slice(None), 10, 6), (slice(4, 5), 10, 12), (slice(4, 5), 1, 120)])
def test_pairs_are_corrected_for_their_number_and_that_of_steps(monkeypatch, here, steps, looks):
    """Of 4 axes and 10 steps; a single step, chosen among all, shares the rate with whole runs."""
    sample = SimpleNamespace(
        dof=4, error=np.zeros((9, 10, 4)), covariance=np.zeros((9, 10, 4, 4)), counted=np.ones((9, 10), bool)
    )
    for p, shown in ((0.0099 / looks, True), (0.0101 / looks, False)):
        of_steps = {10: np.ones((4, 4)), 1: np.ones((4, 4)), steps: np.full((4, 4), p)}
        monkeypatch.setattr(error_parts, "pair_p_values", lambda error, *_, known=of_steps: known[error.shape[1]])
        assert (error_parts._shown_pairs(sample, here, 0.01) == shown).all()


# --- sentences -----------------------------------------------------------------------------------------------


def test_a_block_that_is_too_small_is_named_with_its_own_factor(rng):
    verdict = judge(inertial(rng, [4.0, 1.0, 1.0]), Settings(SURE))
    assert {"shape", "shape in some step"} & set(verdict.faults)
    found = re.fullmatch(
        rf"overconfident: covariance too small by x({NUMBER}) \[.*?\]; position too small by x({NUMBER}) "
        rf"\[({NUMBER}), ({NUMBER})\], attitude and velocity right; no bias found",
        verdict.reasons[0].split("; without")[0],
    )
    assert found, verdict.reasons[0]
    value, low, high = verdict.statistics["of_axes"]["position"]
    assert [float(text) for text in found.groups()[1:]] == pytest.approx([value, low, high], abs=0.006)
    assert float(found[1]) == pytest.approx(2.0, rel=0.15)


def test_a_wrong_correlation_is_named_beside_a_wrong_block(rng):
    true = correlations(9)
    true[0, 8] = true[8, 0] = 0.1
    verdict = judge(inertial(rng, [4.0, 1.0, 1.0], true, steps=60), Settings(SURE))
    assert verdict.shape.shown
    assert verdict.shape.pair == (0, 8)
    assert re.search(r"wrong (shape: correlation|sign:) .*\d, stated \+0.50, of x and vz", verdict.reasons[0])


def test_axes_of_unlike_factors_are_named_where_the_whole_is_right(rng):
    """Each of x and y is off by 2, to either side, so that the mean over both is about right."""
    S = np.array([[1.0, 0.5], [0.5, 1.0]])
    scale = np.sqrt([2.0, 0.5])
    error = independent(rng, 100, 40, 2) @ np.linalg.cholesky(S).T
    P = np.broadcast_to(S / np.outer(scale, scale), (100, 40, 2, 2))
    sentence = judge(make_record("f", error, P, axes=("x", "y")), Settings(SURE)).reasons[0]
    assert re.search(rf"too small by {WITH_INTERVAL} in x", sentence), sentence
    assert "correlation" not in sentence
    assert "unlike factors" not in sentence  # the sentence on the scale has them


def opposite_signs(rng):
    """Errors of x and y that are correlated by -0.6, with 0.6 stated."""
    true, stated = np.eye(3), np.eye(3)
    true[0, 1] = true[1, 0] = -0.6
    stated[0, 1] = stated[1, 0] = 0.6
    error = independent(rng, 100, 30, 3) @ np.linalg.cholesky(true).T
    return make_record("f", error, np.broadcast_to(stated, (100, 30, 3, 3)), axes=("x", "y", "heading"))


def test_a_correlation_is_named_only_if_it_is_shown_to_be_wrong(rng):
    verdict = judge(opposite_signs(rng), Settings(SURE))
    assert "correlation of the wrong sign: -0.6" in reasons(verdict)[0]
    unshown = reasons(replace(verdict, shape=replace(verdict.shape, shown=False)))[0]
    assert "correlation" not in unshown
    assert unshown.startswith("inconsistent: covariance of the wrong shape")


@pytest.mark.parametrize(
    "shown, pair, status",
    [([], (0, 1), "overconfident"), ([(0, 2)], (0, 2), "overconfident"), ([(0, 1), (0, 2)], (0, 1), "inconsistent")],
)
def test_the_status_depends_on_pairs_that_are_shown(rng, monkeypatch, shown, pair, status):
    """The sign of x and y alone is wrong: a pair that is shown is named before it, unless it is shown, too."""
    are_shown = np.zeros((3, 3), bool)
    for i, j in shown:
        are_shown[i, j] = are_shown[j, i] = True
    monkeypatch.setattr(error_parts, "_shown_pairs", lambda *_: are_shown)
    verdict = judge(opposite_signs(rng), Settings(SURE))
    assert (verdict.shape.pair, verdict.shape.shown) == (pair, bool(shown))
    assert verdict.shape.alone == verdict.shape.wrong_sign == (status == "inconsistent")
    assert verdict.status == status


def test_a_wrong_sign_is_named_before_a_correlation_that_is_farther_off(rng):
    true = np.array([[1.0, -0.3, 0.8], [-0.3, 1.0, 0.0], [0.8, 0.0, 1.0]])
    stated = np.array([[1.0, 0.3, 0.0], [0.3, 1.0, 0.0], [0.0, 0.0, 1.0]])
    error = independent(rng, 200, 30, 3) @ np.linalg.cholesky(true).T
    verdict = judge(make_record("f", error, np.broadcast_to(stated, (200, 30, 3, 3))), Settings(SURE))
    assert verdict.shape.pair == (0, 1)
    assert verdict.shape.alone
    assert verdict.status == "inconsistent"


def of(ratios, status="overconfident", subset=None, allow=None):
    """Findings with these ratios of axes, and blocks of them where they are given."""
    names = tuple(name for name in ratios if name not in ("position", "attitude", "velocity"))
    groups = {name: [i] for i, name in enumerate(names)}
    for block, members in (("position", "xyz"), ("attitude", ("roll", "pitch", "yaw"))):
        if block in ratios:
            groups[block] = [i for i, name in enumerate(names) if name in members]
    axes = ComponentRatios(names, groups, {name: Interval(*ratio) for name, ratio in ratios.items()})
    return SimpleNamespace(
        axes=axes, status=status, settings=Settings(allow=allow), location=SimpleNamespace(subset=subset)
    )


RIGHT = (1.0, 0.9, 1.1)
FAR = (2.0, 1.8, 2.2)


def test_a_block_is_named_only_if_its_axes_are_alike():
    alike = {"x": FAR, "y": (1.9, 1.6, 2.3), "position": FAR, "heading": RIGHT}
    text = "position too small by x2.00 [1.80, 2.20], heading right"
    assert factors_text(of(alike)) == text
    assert factors_text(of(alike, subset="x")) == factors_text(of(alike, subset="x, y")) == text
    assert factors_text(of(alike, subset="heading")) == ""
    of_correlation = {"x": RIGHT, "y": RIGHT, "position": (3.0, 2.5, 3.5), "heading": RIGHT}
    assert factors_text(of(of_correlation)) == ""
    single = alike | {"y": RIGHT}
    assert (
        factors_text(of(single, subset="x"))
        == unlike_text(of(single))
        == "x too small by x2.00 [1.80, 2.20], y and heading right"
    )


def test_factors_that_may_be_the_same_are_not_named():
    assert unlike_text(of({"x": FAR, "y": (1.5, 1.2, 1.9)})) == ""
    assert unlike_text(of({"x": FAR, "y": (1.4, 1.2, 1.7)})).startswith("x too small by")


def test_an_axis_is_right_if_it_is_shown_to_be():
    assert unlike_text(of({"x": FAR, "y": RIGHT, "z": (1.0, 0.6, 1.7)})) == "x too small by x2.00 [1.80, 2.20], y right"
    many = {"x": FAR} | dict.fromkeys(("a", "b", "c", "d"), RIGHT)
    assert unlike_text(of(many)).endswith(", the others right")
    assert unlike_text(of(many | {"e": (1.0, 0.5, 2.0)})) == "x too small by x2.00 [1.80, 2.20]"


@pytest.mark.parametrize(
    "yaw, right",
    [
        (RIGHT, True),
        ((1.29, 0.9, 1.9), True),
        ((1.31, 0.9, 1.9), False),
        ((1 / 1.29, 0.5, 1.1), True),
        ((1 / 1.31, 0.5, 1.1), False),
        ((1.2, 1.01, 1.4), False),
        ((0.85, 0.7, 0.99), False),
    ],
)
def test_a_block_is_right_if_each_of_its_axes_may_be_and_is_near_one(yaw, right):
    ratios = {"x": FAR, "y": FAR, "z": FAR, "position": FAR, "roll": RIGHT, "pitch": RIGHT, "yaw": yaw}
    text = unlike_text(of(ratios | {"attitude": (1.05, 0.85, 1.25)}))
    assert text == "position too small by x2.00 [1.80, 2.20]" + ", attitude right" * right


def test_nothing_in_a_conservative_covariance_has_to_grow():
    ratios = {"x": (0.4, 0.35, 0.45), "y": FAR}
    assert unlike_text(of(ratios, "conservative")) == "x too large by x2.50 [2.22, 2.86] (ratio 0.40)"
    assert "y too small" in unlike_text(of(ratios, "inconsistent"))
    assert unlike_text(of(ratios, allow="conservative")) == "y too small by x2.00 [1.80, 2.20]"


def test_a_side_is_said_once_and_both_sides_are():
    small, large = (1.6, 1.5, 1.7), (0.8, 0.7, 0.9)
    assert unlike_text(of({"x": FAR, "y": small})) == ("x too small by x2.00 [1.80, 2.20], y by x1.60 [1.50, 1.70]")
    many = {"x": FAR, "y": FAR, "z": FAR, "vx": FAR, "vy": large}
    assert re.sub(r" by x[^]]*]", "", unlike_text(of(many))) == "x too small, y, vy too large (ratio 0.80)"


# --- velocity ------------------------------------------------------------------------------------------------


def test_velocity_is_reported_and_not_tested(rng):
    record = inertial(rng, [1.0, 1.0, 2.0])
    verdict = judge(record, Settings(SURE))
    block = record.errors.error[..., 6:]
    nees = np.einsum("rki,ij,rkj->rk", block, np.linalg.inv(record.errors.covariance[0, 0, 6:, 6:]), block)
    assert verdict.statistics["of_axes"]["velocity"][0] == pytest.approx(nees.mean() / 3.0)
    assert verdict.statistics["groups"]["velocity"] == [6, 7, 8]
    other = judge(changed(record, axes=(*INERTIAL[:6], "a", "b", "c")), Settings(SURE))
    assert "velocity" not in other.statistics["of_axes"]
    assert [a.p_value for a in other.answers] == [a.p_value for a in verdict.answers]
    assert other.axes.inflation["x"] == verdict.axes.inflation["x"]


def test_velocity_of_the_estimate_alone_where_the_truth_is_uncertain(rng):
    record = inertial(rng, [1.0, 1.0, 4.0])
    truth = np.broadcast_to(0.01 * np.eye(9), record.errors.covariance.shape)
    verdict = judge(changed(record, truth_covariance=truth, truth_errors="independent"), Settings(SURE))
    plain = judge(record, Settings(SURE)).statistics["of_axes"]["velocity"][0]
    assert verdict.statistics["of_axes"]["velocity"][0] == pytest.approx(plain, rel=0.1)
    assert set(verdict.statistics["truth_share_of_axes"]) == {*INERTIAL, "position", "attitude"}
