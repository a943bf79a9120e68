"""A challenge finds a right filter overconfident at the stated rate at most."""

import pytest
from scipy import stats

from consistency.bench.challenging.challenge import Plan, challenge

SEARCHES, STATED = 20, 0.05
SHORT = ("steps=50:100",)


@pytest.mark.slow
def test_a_right_filter_is_rarely_found():
    """Fails by chance in 3 of 10,000 runs where the rate is as large as stated."""
    found = sum(
        challenge("kf", None, Plan(minutes=None, trials=60, seed=seed, false_alarm=STATED), SHORT).found
        for seed in range(SEARCHES)
    )
    assert stats.binom.sf(found - 1, SEARCHES, STATED) > 1e-3
