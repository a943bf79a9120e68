"""Rates of words and of bets that a fast test cannot state: up to 500 draws a row, as many as the promise speaks of.

Random numbers are fresh in every run (the seed is printed when a test fails). Limits are binomial at 1e-5: 50
assertions, together under 1 false failure in 2,000 runs of this file.
"""

import numpy as np
import pytest
from draws import autoregression, errs_at_most, fully_dependent, independent, slow_axis

from consistency.diagnostics import e_process, largest_direction

pytestmark = pytest.mark.slow

DRAWS, STEPS = 500, 100


# --- heavy tails -------------------------------------------------------------------------------------------


# --- where and since when ----------------------------------------------------------------------------------


# --- directions and bets -----------------------------------------------------------------------------------


@pytest.mark.parametrize("runs", [21, 50, 100])
@pytest.mark.parametrize("n", [2, 6])
@pytest.mark.parametrize("world", [fully_dependent, autoregression, slow_axis, independent])
def test_no_direction_is_found_in_a_right_filter(fresh, world, n, runs):
    """2,000 draws at 5 %; Student's t leaves up to a tenth more (5.5 %)."""
    assert errs_at_most(0.055, 2000, lambda: largest_direction(world(fresh, runs, 20, n)).p_value <= 0.05)


@pytest.mark.parametrize("n", [1, 3])
def test_ville(fresh, n):
    """Of 20,000 sequences of 200 fully dependent runs at most 5 % ever reach 20; each side too."""
    reached = []

    def reaches():
        bet = e_process(fresh.chisquare(n, 200) / n, n)
        reached.append(np.array([bet.up.max(), bet.down.max(), bet.both.max()]) >= 20.0)
        return reached[-1]

    assert errs_at_most(0.05, 20_000, reaches)
    assert np.mean(reached, axis=0).min() >= 0.005  # a game that nobody ever wins finds nothing
