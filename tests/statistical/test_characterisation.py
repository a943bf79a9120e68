"""Characterisation over many repetitions: how often all intervals hold together."""

import characterisation as benchmark
import numpy as np
import pytest
from scipy import stats

pytestmark = pytest.mark.slow
REPETITIONS, RUNS, MISSES = 20, 3, 5


@pytest.mark.parametrize("truth", [benchmark.Real(None, None), benchmark.real()], ids=["plain", "real"])
def test_all_intervals_hold_together(truth):
    """Of 20 repetitions, each missed with 1 % at most, more than 5 are missed once in 10^7."""
    assert stats.binom.sf(MISSES, REPETITIONS, 0.01) < 1e-6
    outcome = benchmark.repeat(truth, REPETITIONS, RUNS, seed=4000)
    assert sum(bool(names) for names in outcome.missed) <= MISSES
    assert outcome.width.mean() < 0.08  # sqrt(10 / 3) of the width of ten runs
    assert np.sqrt(np.mean(outcome.rms**2)) < 0.1
