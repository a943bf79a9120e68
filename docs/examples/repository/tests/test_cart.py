"""The EKF is honest about its uncertainty, and the gate would see if it were not."""

import pytest

import cart.ekf
from cart.world import errors, trials
from consistency.testing import ConsistencyError, assert_consistent

AXES = ["x", "y", "heading"]
pytestmark = pytest.mark.consistency(dof=3, false_alarm=1e-6)


def test_the_ekf_is_consistent(consistency_runs):
    truth, estimates, covariances = trials(consistency_runs)
    assert_consistent(errors(truth, estimates), covariances, axes=AXES, name="cart EKF")


def test_too_much_trust_in_the_fixes_is_found(consistency_runs, monkeypatch):
    """The negative control."""
    monkeypatch.setattr(cart.ekf, "SIGMA_FIX", 0.5 * cart.ekf.SIGMA_FIX)
    truth, estimates, covariances = trials(consistency_runs)
    with pytest.raises(ConsistencyError, match="overconfident"):
        assert_consistent(errors(truth, estimates), covariances, axes=AXES, name="cart EKF")
