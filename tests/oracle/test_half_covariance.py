"""Whole trials where a kernel could go wrong and small worlds would not tell: many landmarks, singular starts."""

import numpy as np
import pytest

import consistency as cs
from consistency.bench.filters.kernel.linalg import ROUNDING
from consistency.bench.filters.run_filter import step_through

MANY = {"truth__landmarks__count": 600, "truth__steps": 25}


def gap(a, b):
    """Largest difference of poses, of covariances relative to a step's largest entry, and of NIS relative to it.

    What is less than ``ROUNDING`` counts as no variance.
    """
    assert a.failure is None
    assert b.failure is None
    assert np.array_equal(a.nis_dof, b.nis_dof)
    largest = np.maximum(b.covariance.max(axis=(1, 2), keepdims=True), 1e-30)
    covariance = np.maximum(np.abs(a.covariance - b.covariance) - ROUNDING, 0.0)
    nis = np.nanmax(np.abs(a.nis - b.nis) / np.maximum(b.nis, 1.0))
    return float(max(np.abs(a.pose - b.pose).max(), (covariance / largest).max(), nis))


def both(name, scenario):
    trial, filter_ = cs.simulate(scenario, run=3), cs.get_filter(name)
    return filter_.run(trial, scenario.belief), step_through(filter_.textbook, trial, scenario.belief)


@pytest.mark.parametrize(
    "name, world",
    [
        ("kf", "linear-gaussian"),
        ("ekf-xyz", "herath2007-xyz"),
        ("ekf-uvd", "herath2007-stereo"),
        ("ukf-xyz", "herath2007-xyz"),
        ("ukf-uvd", "herath2007-stereo"),
    ],
)
def test_many_landmarks(small, name, world):
    ours, twin = both(name, small(world, **MANY))
    assert twin.nis_dof.max() >= 36  # a dozen landmarks in a step
    assert gap(ours, twin) < 1e-9


@pytest.mark.parametrize("name", ["ukf-xyz", "ukf-uvd", "ekf-uvd"])
@pytest.mark.parametrize("still", [("sigma_v",), ("sigma_omega",), ("sigma_v", "sigma_omega")], ids="-".join)
def test_a_covariance_that_stays_singular(small, name, still):
    """Without noise on v, on omega or on both, pivots stay zero and LAPACK's Cholesky has to be replaced."""
    changes = {f"{table}__motion__{key}": 0.0 for table in ("truth", "belief") for key in still}
    ours, twin = both(name, small("herath2007-stereo", truth__steps=40, **changes))
    assert gap(ours, twin) < 1e-9
