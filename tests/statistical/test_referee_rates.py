"""Does the referee keep its promises? Cases that are hardest for single questions; see also `make calibrate-quick`.

Random numbers are fresh in every run (the seed is printed when a test fails). Every count has binomial
limits at 1e-5 or further out: under 40 of them, together under 1 false failure in 2,000 runs of this file.
"""

import numpy as np
import pytest
from draws import errs_at_most, identities
from referee import judge
from scipy import stats

from consistency.diagnostics import mean_shape, mean_test, nis_whiteness, simultaneous_band

pytestmark = pytest.mark.slow

DOF = 3


# --- single questions where they are hardest -------------------------------------------------------------

RUNS, STEPS = 20, 40


def constant_axis(rng):
    """Nine tenths of an axis are one and the same error in all steps: a mean of few, skewed squares."""
    w = rng.standard_normal((RUNS, STEPS, DOF))
    w[..., 0] = np.sqrt(0.9) * rng.standard_normal((RUNS, 1)) + np.sqrt(0.1) * w[..., 0]
    return w


def nearly_constant(rng):
    return np.sqrt(0.97) * rng.standard_normal((RUNS, 1, DOF)) + np.sqrt(0.03) * rng.standard_normal((RUNS, STEPS, DOF))


def independent(rng):
    return rng.standard_normal((RUNS, STEPS, DOF))


def few_runs(rng):
    return constant_axis(rng)[:10]


def one_run_of_one_step(rng):
    w = independent(rng)
    w[0, 1:] = np.nan
    return w


def ever_longer(rng):
    w = independent(rng)
    for run in range(RUNS):
        w[run, 1 + 2 * run :] = np.nan
    return w


def no_common_step(rng):
    w = np.full((RUNS, STEPS, DOF), np.nan)
    for run in range(RUNS):
        w[run, 2 * run : 2 * run + 2] = rng.standard_normal((2, DOF))
    return w


WORLDS = [constant_axis, nearly_constant, independent, few_runs, one_run_of_one_step, ever_longer, no_common_step]


@pytest.mark.parametrize("world", WORLDS)
def test_no_question_alarms_more_often_than_it_may(fresh, world):
    """1,000 draws at the level that a verdict at 5 % gives the mean, and at a tenth of it."""
    draws = 1000
    p = {"scale": [], "band": [], "shape": []}
    for _ in range(draws):
        w = world(fresh)
        nees = np.square(w).sum(axis=-1)
        p["scale"].append(mean_test(nees, DOF).p_value)
        p["band"].append(simultaneous_band(nees, DOF).p_value)
        p["shape"].append(mean_shape(w)[1])
    for level in (0.025, 0.0025):
        limit = stats.binom.ppf(1 - 1e-7, draws, level)
        counts = {question: int((np.array(values) <= level).sum()) for question, values in p.items()}
        assert max(counts.values()) <= limit, (level, limit, counts)


def test_the_nis_alone_is_white_far_out_in_the_tail(fresh):
    """Squares have long tails and their correlations too: 3,000 draws at 0.001."""
    dof = np.full((20, 30), 2)
    assert errs_at_most(1e-3, 3000, lambda: nis_whiteness(fresh.chisquare(2, (20, 30)), dof).p_value <= 1e-3)


@pytest.mark.parametrize("options", [{}, {"allow": "conservative"}, {"method": "bonferroni"}])
@pytest.mark.parametrize("world", [constant_axis, few_runs, ever_longer])
def test_whole_verdicts_alarm_no_more_than_stated(fresh, world, options):
    """200 verdicts at 10 %."""

    def alarms():
        w = world(fresh)
        return bool(judge("f", w, identities(w), false_alarm=0.1, **options).faults)

    assert errs_at_most(0.1, 200, alarms)
