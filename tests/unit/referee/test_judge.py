"""From results to run means and wins: failed runs are the worst there are."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy import stats

from consistency.bench.runs.results_to_records import mean_nees_of_runs, wins
from consistency.diagnostics import make_record
from consistency.referee.types import Failure


def record_of(nees, failed=(), first=0):
    """Runs ``first``, ``first`` + 1, ... in which the runs named ``failed`` broke down."""
    failures = tuple(Failure("f", run, 2, "NaN") for run in failed)
    return make_record("f", nees=nees, dof=3, failures=failures, runs=np.arange(first, first + len(nees)))


def test_run_means_by_hand():
    nan = np.nan
    nees = np.array([[1.0, 2.0, 6.0], [nan, 2.0, 4.0], [0.5, nan, nan], [nan, nan, nan]])
    assert_array_equal(mean_nees_of_runs(record_of(nees)), [3.0, 3.0, 0.5, np.inf])


def test_a_failed_run_is_infinite_whatever_it_had_before():
    nees = np.array([[1.0, np.nan], [1.0, 1.0], [0.1, np.nan]])
    assert_array_equal(mean_nees_of_runs(record_of(nees, failed=(5, 7), first=5)), [np.inf, 1.0, np.inf])


def test_a_failed_run_loses():
    """Run 1 of a has the lowest NEES until it fails; runs that fail in both are no win for either."""
    a = record_of(
        np.array([[1.0, 1.0], [0.1, np.nan], [2.0, 2.0], [0.1, np.nan], [3.0, 3.0], [1.0, 1.0]]), failed=(1, 3)
    )
    b = record_of(np.array([[2.0, 2.0], [5.0, 5.0], [1.0, 1.0], [0.2, np.nan], [3.0, 3.0], [9.0, 9.0]]), failed=(3,))
    assert wins(a, b) == (2, pytest.approx(stats.binomtest(2, 4).pvalue))
    assert wins(b, a) == (2, pytest.approx(1.0))
    whole = record_of(np.array([[2.0, 2.0]] * 6))
    assert wins(a, whole) == (2, pytest.approx(stats.binomtest(2, 5).pvalue))


def test_the_sign_test_of_wins():
    """All of eight: p = 2 / 2^8 on two sides."""
    low, high = record_of(np.ones((8, 2))), record_of(np.full((8, 2), 2.0))
    assert wins(low, high) == (8, pytest.approx(2.0 / 256.0))
    assert wins(high, low) == (0, pytest.approx(2.0 / 256.0))
    assert wins(record_of(np.ones((8, 2)), failed=tuple(range(8))), high) == (0, pytest.approx(2.0 / 256.0))


def test_nothing_but_ties():
    assert wins(record_of(np.ones((8, 2))), record_of(np.ones((8, 2)))) == (0, 1.0)
