"""How often the monitor alarms on right Kalman filters, and that it finds what is wrong.

Random numbers are fresh in every run (the seed is printed when a test fails). Binomial limits at 1e-5: about 30 of
them, together under 1 false failure in 3,000 runs of this file.
"""

import calibration_monitor as calibration
import numpy as np
import pytest
from scipy import stats

pytestmark = pytest.mark.slow

SURE = 1 - 1e-5
RATES = (0.05, 0.01)
MISSIONS, STEPS = 1000, 5000


@pytest.mark.parametrize("gate", [None, 0.99, 0.95])
@pytest.mark.parametrize("name", list(calibration.WORLDS))
def test_right_filters_alarm_no_more_often_than_stated(name, gate, fresh):
    """1,000 missions of 5,000 steps at 5 % and 1 %, with tolerance 1 and at either edge of tolerance 1.2.

    Seen with 9 in 10: a rate of 5 % that is really 9 %, a rate of 1 % that is really 3 %.
    """
    limits = [stats.binom.ppf(SURE, MISSIONS, rate) for rate in RATES]
    for tolerance, ratio in ((1.0, 1.0), (1.2, 1.2), (1.2, 1 / 1.2)):
        world = calibration.WORLDS[name](fresh, MISSIONS)
        monitors = [calibration.Monitors(MISSIONS, world.dof, tolerance, gate)]
        alarms = np.isfinite(calibration.first_alarms(world, monitors, STEPS, ratio, RATES)[0]).sum(axis=1)
        assert (alarms <= limits).all(), (tolerance, ratio, alarms)


def test_without_the_rest_after_a_rejection_they_do(fresh):
    """Negative control: what the rest is for."""
    world = calibration.Position(fresh, MISSIONS)
    monitor = calibration.Monitors(MISSIONS, world.dof, 1.0, 0.95)
    monitor.rest = 0
    alarms = np.isfinite(calibration.first_alarms(world, [monitor], STEPS, 1.0, RATES)[0]).sum(axis=1)
    assert (alarms > [stats.binom.ppf(SURE, MISSIONS, rate) for rate in RATES]).all()


def test_faults_are_found_as_soon_as_the_manual_says(fresh):
    """The exact test at 5 %: medians are below the limit unless more than half of 300 missions are late (1e-5)."""
    most = stats.binom.ppf(SURE, 300, 0.5)
    for since, limit in ((0, 45), (5000, 150)):
        world = calibration.Position(fresh, 300)
        monitors = [calibration.Monitors(300, world.dof, 1.0, None)]
        if since:
            calibration.first_alarms(world, monitors, since, 1.0, RATES[:1])
        late = calibration.first_alarms(world, monitors, limit, 1.5, RATES[:1])[0, 0] > limit
        assert late.sum() <= most
