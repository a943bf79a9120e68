"""Gates for a filter of one's own, and for two of the bench: copy this file and put your filter in place of ``kf``.

    pytest docs/examples/test_my_filter.py

The guide is docs/gates.md. Each gate fails a right filter with probability 1e-6 at most. Filters of the bench need the
extra of that name.
"""

from __future__ import annotations

import numpy as np
import pytest

import consistency as cs
from consistency.testing import ConsistencyError, assert_consistent, assert_not_worse

pytestmark = pytest.mark.consistency(false_alarm=1e-6)  # of every gate below; plans consistency_runs too

DT, ACCELERATION, SIGMA = 0.1, 0.5, 0.2  # s, m/s^2, m
F = np.array([[1.0, DT], [0.0, 1.0]])
G = np.array([DT**2 / 2, DT])
P0 = np.diag([0.5**2, 0.3**2])


# --- a filter of your own: position and velocity from noisy positions --------------------------------


def kf(z, sigma_a):
    """Linear Kalman filter: measurements (steps,) -> estimates (steps, 2) and covariances (steps, 2, 2)."""
    x, P, estimates, covariances = np.zeros(2), P0, [], []
    for value in z:
        x, P = F @ x, F @ P @ F.T + np.outer(G, G) * sigma_a**2
        K = P[:, 0] / (P[0, 0] + SIGMA**2)
        x, P = x + K * (value - x[0]), P - np.outer(K, P[0])
        P = (P + P.T) / 2
        estimates.append(x)
        covariances.append(P)
    return np.array(estimates), np.array(covariances)


def trials(runs, steps=60, sigma_a=ACCELERATION, seed=0):
    """Errors (runs, steps, 2) and covariances (runs, steps, 2, 2) of the filter, each run a new world."""
    errors, covariances = [], []
    for rng in np.random.default_rng(seed).spawn(runs):
        state, truth = rng.multivariate_normal(np.zeros(2), P0), []
        for noise in rng.normal(0.0, ACCELERATION, steps):
            state = F @ state + G * noise
            truth.append(state)
        x, P = kf(np.array(truth)[:, 0] + rng.normal(0.0, SIGMA, steps), sigma_a)
        errors.append(np.array(truth) - x)
        covariances.append(P)
    return np.array(errors), np.array(covariances)


@pytest.mark.consistency(dof=2)
def test_my_filter_is_consistent(consistency_runs):
    assert_consistent(*trials(consistency_runs), axes=["position", "velocity"])


@pytest.mark.consistency(dof=2)
def test_the_gate_would_find_too_little_process_noise(consistency_runs):
    """The negative control: a gate that cannot fail says nothing."""
    with pytest.raises(ConsistencyError) as caught:
        assert_consistent(*trials(consistency_runs, sigma_a=0.5 * ACCELERATION), axes=["position", "velocity"])
    verdict = caught.value.verdict
    assert verdict.status == "overconfident"
    assert verdict.subset == "velocity"


@pytest.mark.consistency(dof=2)
def test_my_filter_is_no_worse_than_before(consistency_runs):
    """Against a reference on the same trials: here the filter with a little too much process noise."""
    now, before = trials(consistency_runs), trials(consistency_runs, sigma_a=1.5 * ACCELERATION)
    assert_not_worse(*now, *before)


# --- filters of the bench ------------------------------------------------------------------------------


def test_kf_is_consistent_in_the_linear_world(consistency_runs):
    results = cs.run_trials(cs.load_scenario("linear-gaussian"), filters=["kf"], runs=consistency_runs)
    assert_consistent(results, filter="kf")


def test_ekf_xyz_is_overconfident_with_a_short_baseline():
    """Herath, Kodagoda & Dissanayake (2007). A fault is found with few runs, if it is large."""
    results = cs.run_trials(cs.load_scenario("herath2007-stereo"), filters=["ekf-xyz"], runs=20)
    with pytest.raises(ConsistencyError) as caught:
        assert_consistent(results, filter="ekf-xyz")
    verdict = caught.value.verdict
    assert verdict.status == "overconfident"
    assert "too small by x" in verdict.reasons[0]
    low, _ = verdict.inflation_interval
    assert low > 5.0  # the stated covariance is too small by at least this factor
    assert verdict.first_step is not None
    assert verdict.first_step < 100
