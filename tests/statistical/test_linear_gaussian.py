"""The Kalman filter in a linear-Gaussian world is exactly consistent: every statistic has a known distribution.

400 runs of 500 steps with the default seed. Ten two-sided tests share a false-alarm rate of 1e-4, 1e-5
each (Bonferroni): the ANEES at seven steps that were fixed beforehand, the sum of all NIS, the NIS of
single runs and the NEES of single runs in the last step. ANEES(k) is chi-square(1200) / 400: its test sees
a ratio of 1.19 (covariance too small) with even odds and one of 1.26 with 9 in 10.
"""

import numpy as np
import pandas as pd
import pytest
from scipy import stats

import consistency as cs
from consistency.bench.runs.results_to_records import record_of

pytestmark = pytest.mark.slow

RUNS, STEPS = 400, 500
CHECKPOINTS = (2, 25, 50, 100, 200, 350, 500)
ALPHA = 1e-4 / 10


def scenario(factor=1.0):
    """The built-in world; the belief has all its standard deviations times ``factor``."""
    base = cs.load_scenario("linear-gaussian")
    motion, sensor = base.truth.motion, base.truth.sensor
    return base.variant(
        f"linear-gaussian-{factor}",
        truth__steps=STEPS,
        belief__motion__sigma_v=factor * motion.sigma_v,
        belief__motion__sigma_omega=factor * motion.sigma_omega,
        belief__sensor__sigma=tuple(factor * s for s in sensor.sigma),
    )


def run(factor):
    return cs.run_trials(scenario(factor), ["kf"], runs=RUNS)


@pytest.fixture(scope="module")
def results():
    return run(1.0)


@pytest.fixture(scope="module")
def kf(results):
    return record_of(results, "kf")


@pytest.fixture(scope="module", params=[1 / 1.5, 1.5], ids=["overconfident", "conservative"])
def off(request):
    return request.param, run(request.param)


def anees_holds(c, step):
    low, high = cs.anees_interval(3, RUNS, 1 - ALPHA)
    return bool(low <= c.errors.nees[:, step - 1].mean() <= high)


def nis_sum_holds(c):
    low, high = stats.chi2.interval(1 - ALPHA, c.innovations.nis_dof.sum())
    return bool(low <= np.nansum(c.innovations.nis) <= high)


def nis_of_runs_holds(c):
    """The NIS of a run is chi-square with its degrees of freedom, independently of other runs."""
    p = stats.chi2.cdf(np.nansum(c.innovations.nis, axis=1), c.innovations.nis_dof.sum(axis=1))
    return bool(stats.kstest(p, "uniform").pvalue > ALPHA)


def nees_of_runs_holds(c):
    return bool(stats.kstest(c.errors.nees[:, -1], stats.chi2(3).cdf).pvalue > ALPHA)


def test_no_run_fails_and_only_the_first_step_is_left_out(results, kf):
    assert len(results.failures) == 0
    assert kf.errors.nees.shape == (RUNS, STEPS)
    assert np.isnan(kf.errors.nees[:, 0]).all()
    assert np.isfinite(kf.errors.nees[:, 1:]).all()


@pytest.mark.parametrize("step", CHECKPOINTS)
def test_anees_is_three(kf, step):
    assert anees_holds(kf, step)


def test_sum_of_nis_is_its_degrees_of_freedom(kf):
    assert nis_sum_holds(kf)


def test_nis_of_single_runs_is_chi_square(kf):
    assert nis_of_runs_holds(kf)


def test_nees_of_single_runs_is_chi_square(kf):
    assert nees_of_runs_holds(kf)


def test_the_verdict_is_consistent(results):
    """A further false-alarm rate of 1e-5, by the verdict's own bound."""
    assert cs.analyse(results, confidence=1 - ALPHA)["kf"].status == "consistent"


def test_a_belief_off_by_half_is_caught_everywhere(off):
    """Negative control of all ten tests: ANEES becomes 6.75 or 1.33."""
    factor, wrong = off
    c = record_of(wrong, "kf")
    assert not any(anees_holds(c, step) for step in CHECKPOINTS)
    assert not nis_sum_holds(c)
    assert not nis_of_runs_holds(c)
    assert not nees_of_runs_holds(c)
    status = "overconfident" if factor < 1 else "conservative"
    assert cs.analyse(wrong, confidence=1 - ALPHA)["kf"].status == status


def test_scaled_beliefs_give_the_same_estimates(results, off):
    """The gain depends on ratios of covariances alone, so NEES scales exactly by the factor squared."""
    factor, wrong = off
    pd.testing.assert_series_equal(wrong.estimates["x"], results.estimates["x"], rtol=0, atol=1e-9)
    scaled = wrong.estimates["nees"] * factor**2
    pd.testing.assert_series_equal(scaled, results.estimates["nees"], rtol=1e-6)
