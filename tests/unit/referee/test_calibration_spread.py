"""The question of the scale of many draws at once, as the calibration counts it, is the one that a verdict asks."""

from dataclasses import replace

import calibration
import calibration_spread as spread
import numpy as np
import pytest
from numpy.testing import assert_allclose

from consistency.referee.diagnostics.scale import scale_test


@pytest.mark.parametrize("dof, n, group, share, runs", [(1, 2, 1, 0.5, 24), (2, 2, 1, 1.0, 20), (6, 6, 2, 0.5, 50)])
@pytest.mark.parametrize("steps", [2, 2000])
@pytest.mark.parametrize("ratio", [0.8, 1.0, 1.3])
def test_many_draws_at_once_are_judged_as_one(dof, n, group, share, runs, steps, ratio):
    means = ratio * spread.run_means(np.random.default_rng(5), n, group, share, (40, runs))
    above, below = spread.tails(means, dof, steps)
    tests = [scale_test(one, dof, steps) for one in means]
    assert_allclose(above, [test.above for test in tests], rtol=1e-9)
    assert_allclose(below, [test.below for test in tests], rtol=1e-9)
    assert_allclose(spread.p_values(means, dof, steps), [test.p_value for test in tests], rtol=1e-9)


def test_run_means_are_those_of_a_right_filter():
    """Mean 1; the variance of a constant group is 2 group / n^2 in so many runs. Six standard errors."""
    n, group, share, count = 6, 2, 0.3, 40_000
    means = spread.run_means(np.random.default_rng(6), n, group, share, (count,))
    variance = share * 2 * group / n**2 + 2 * (n - share * group) / n**2 / spread.STEPS
    assert abs(means.mean() - 1.0) < 6 * np.sqrt(variance / count)
    squares = np.square(means - 1.0)
    assert abs(squares.mean() - variance) < 6 * squares.std() / np.sqrt(count)


def test_errors_of_gates_have_the_same_run_means():
    evidence = spread._evidence(np.random.default_rng(7), 6, 2, 0.5, 200)
    constant = np.ptp(evidence.errors.error, axis=1) == 0
    assert (constant[:, 0] == constant[:, 1]).all()
    assert not constant[:, 2:].any()
    assert 60 < constant[:, 0].sum() < 140  # 5.6 standard errors


def test_small_rates_are_shown_with_their_digits():
    row = calibration.Row("w", spread.QUESTION, 1.0, 50, 1, 5e-4, "<=", 100_000, 21)
    assert calibration.said(row).endswith("<= 0.05 %: 0.0210 % of 100000")
    assert calibration.said(replace(row, stated=0.05)).endswith("<= 5 %: 0.0 % of 100000")


def test_every_row_is_explained(monkeypatch):
    monkeypatch.setattr(spread, "QUICK", spread.WORLDS)
    monkeypatch.setattr(spread, "QUICK_DRAWS", spread.BATCH // 500)
    monkeypatch.setattr(spread, "BATCH", spread.BATCH // 500)
    monkeypatch.setattr(spread, "QUICK_COUNT", 2)
    rows = [calibration.Row(**row) for row in spread.rows(True, 1)]
    assert {row.world for row in rows} | {row.question for row in rows} == set(spread.ABOUT)
    assert {row.stated for row in rows if row.question == spread.QUESTION} == {5e-4, 5e-5}
