"""Estimates beside their truth: the one form in which poses are judged."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from consistency.referee.errors import InputError
from consistency.referee.readers.mix_ups.reading_fit import is_plausible
from consistency.referee.readers.options import Reading
from consistency.referee.readers.pipeline.by_column import _columns_of
from consistency.referee.readers.pipeline.records import records_of
from consistency.referee.readers.places import Places
from consistency.referee.readers.truth_matching import Estimator, Poses, submatrices

SIGMA = np.array([0.1, 0.1, 0.02])


def run_of(rng, rows=40, run=0, error=SIGMA):
    """Poses every 0.1 s beside a truth of 20 Hz, whose covariance tells its sample; the last three have none.

    The second moments of the errors over all rows are exactly those of ``error``, so that nothing is left to chance.
    """
    z = rng.normal(size=(rows, 3))
    z = z @ np.linalg.inv(np.linalg.cholesky(z.T @ z / rows)).T
    true_t = np.arange(2 * (rows - 3)) * 0.05
    t = np.arange(rows) * 0.1
    truth = np.column_stack([np.sin(true_t), true_t, 0.2 * true_t])
    path = np.column_stack([np.sin(t), t, 0.2 * t])
    return Poses(
        Places(lambda row: f"line {row}", np.arange(rows)), t, path - error * z,
        np.tile(np.diag(SIGMA**2), (rows, 1, 1)), np.ones(rows, bool), true_t, truth, "planar", "so2", 0.01,
        true_covariance=np.arange(len(true_t))[:, None, None] * np.eye(3), run=run,
    )  # fmt: skip


def estimator_of(*runs):
    return Estimator("est", "est.csv", runs, ("x", "y", "heading"), "so2", "in words")


def test_matched_estimates_stand_beside_their_truth(rng):
    p = run_of(rng)
    found = p.matched()
    assert_array_equal(found.t, p.t[:37])
    assert found.true_t is found.t
    assert_allclose(found.truth, p.truth[::2][:37], atol=1e-12)
    assert_array_equal(found.true_covariance[:, 0, 0], np.arange(0, 74, 2))
    assert_allclose(found.errors(), p.errors()[:37], rtol=0, atol=1e-15)
    assert found.place[5] == "line 5"
    later = p.matched(0.05)
    assert_allclose(later.truth, p.truth[1::2], atol=1e-12)
    assert_array_equal(later.true_covariance[:, 0, 0], np.arange(1, 74, 2))
    assert_allclose(later.errors(), p.errors(0.05)[:37], rtol=0, atol=1e-15)
    between = replace(p, max_dt=0.03).matched(0.02)
    assert_allclose(between.apart[:-1], 0.02, atol=1e-12)
    assert (between.bend[1:-1] > 0).any()


def test_pairs_keep_each_truth_with_its_estimate(rng):
    found = replace(run_of(rng), by=np.arange(40.0), true_clock=np.arange(74.0)).matched(0.02)
    for kept in (np.array([3, 4, 9]), np.isin(np.arange(37), (3, 4, 9))):
        some = found.pairs(kept)
        assert_array_equal(some.by, [3, 4, 9])
        assert_array_equal(some.truth, found.truth[[3, 4, 9]])
        assert_array_equal(some.true_covariance, found.true_covariance[[3, 4, 9]])
        for name in ("apart", "bend", "true_clock"):
            assert_array_equal(getattr(some, name), getattr(found, name)[[3, 4, 9]])
        assert_array_equal(some.errors(), found.errors()[[3, 4, 9]])
    assert found.pairs(found.stated) is found


def test_only_what_is_matched_and_stated_is_judged(rng):
    p = run_of(rng)
    p = replace(
        p, stated=np.arange(40) != 7, covariance=np.where((np.arange(40) != 7)[:, None, None], p.covariance, 1e9)
    )
    (record,) = records_of(estimator_of(p), Reading())
    assert record.errors.error.shape == (1, 36, 3)
    assert np.nanmax(record.errors.covariance) < 1.0
    assert (
        "est: 4 of 40 estimates have no truth or no covariance within 0.01 s (--max-dt) and are left out"
        in record.origin.notes
    )
    with pytest.raises(InputError, match="no estimate has both a truth and a covariance"):
        records_of(estimator_of(replace(p, stated=np.zeros(40, bool))), Reading())


def test_errors_that_fit_are_plausible_and_others_are_not(rng):
    right = [run_of(rng, 200, run) for run in range(10)]
    assert is_plausible(right, 0.0, range(3))
    assert not is_plausible([run_of(rng, 200, error=4.0 * SIGMA)], 0.0, range(3))
    assert not is_plausible([replace(p, covariance=np.sqrt(p.covariance)) for p in right], 0.0, range(3))
    assert not is_plausible([run_of(rng, error=0.0 * SIGMA)], 0.0, range(3))
    half = [replace(p, estimate=p.estimate * [1.0, 1.0, 57.3]) for p in right]
    assert is_plausible(half, 0.0, [0, 1])
    assert not is_plausible(half, 0.0, range(3))


def test_a_start_that_is_known_exactly_is_no_estimate(rng):
    p = run_of(rng, 4)
    t = np.array([0.0])
    start = replace(p.of_rows(np.array([0])), t=t, true_t=t, numbered=True, covariance=np.zeros((1, 3, 3)))
    with pytest.raises(InputError, match=r"est.csv: holds the start alone, step 0, .* add steps from 1 on"):
        records_of(estimator_of(replace(start, truth=p.truth[:1], true_covariance=None)), Reading())


def test_some_components_of_matrices(rng):
    P = rng.normal(size=(4, 3, 3))
    assert_array_equal(submatrices(P, [0, 2]), P[np.ix_(range(4), [0, 2], [0, 2])])
    assert_array_equal(submatrices(P, range(1, 3)), P[:, 1:, 1:])


def test_columns_of_a_state_pass_over_the_four_numbers_of_a_rotation(rng):
    """Components 3 to 5 are the rotation, whose columns 3 to 6 are a quaternion."""
    planar = estimator_of(run_of(rng))
    assert_array_equal(_columns_of(planar, [0, 2]), [0, 2])
    assert_array_equal(_columns_of(replace(planar, in_space=True), [0, 2, 3, 5, 6, 8]), [0, 2, 7, 9])
    assert len(_columns_of(replace(planar, convention=""), [0, 2])) == 0
