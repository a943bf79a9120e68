"""Starts that are known exactly, one path in all runs, and heavy tails in a few steps."""

import numpy as np
import pytest
from draws import independent, verdict_on
from records import changed

from consistency.diagnostics import Settings, judge, make_record

SURE = 1e-5
AXES = ("x", "y", "vx", "vy")
STEP, Q, R = 0.2, 0.5, 1.0  # s, m^2/s^3, m^2


def tracking(rng, runs=46, steps=40, start=(4.0, 4.0, 0.25, 0.25)):
    """Errors and covariances of a Kalman filter with constant velocity: its start is known exactly, its P_0 large."""
    F = np.eye(4) + STEP * np.eye(4, k=2)
    G = np.array([[STEP**3 / 3, STEP**2 / 2], [STEP**2 / 2, STEP]])
    noise = Q * np.kron(G, np.eye(2))
    H = np.eye(2, 4)
    P = np.diag(start)
    e = np.zeros((runs, 4))
    errors, covariances = [], []
    for k in range(1, steps + 1):
        e = e @ F.T + rng.multivariate_normal(np.zeros(4), noise, size=runs)
        P = F @ P @ F.T + noise
        if k % 5 == 0:
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R * np.eye(2))
            e = e @ (np.eye(4) - K @ H).T - rng.normal(size=(runs, 2)) @ K.T
            P = (np.eye(4) - K @ H) @ P
        P = (P + P.T) / 2
        errors.append(e)
        covariances.append(P)
    return np.stack(errors, 1), np.tile(covariances, (runs, 1, 1, 1))


def recorded(error, P, true):
    """A record with true positions (runs, steps, 2)."""
    path = np.stack([true, true - error[..., :2]], axis=2)
    return changed(
        make_record("kf", error, P, np.einsum("rki,rkij,rkj->rk", error, np.linalg.inv(P), error), axes=AXES), path=path
    )


def said(verdict):
    return [reason for reason in verdict.reasons if "all runs have the same true" in reason]


@pytest.mark.parametrize("start", [(4.0, 4.0, 0.25, 0.25), (1.0, 1.0, 1.0, 1.0), (25.0, 1.0, 0.1, 4.0)])
def test_an_exact_start_is_conservative_and_not_heavy_tailed(rng, start):
    """Errors of the first steps lie in fewer directions than axes, and so differ more than those of one scale."""
    for _ in range(8):
        error, P = tracking(rng, start=start)
        verdict = judge(make_record("kf", error, P, axes=AXES), Settings())
        assert "scale in some step" in verdict.faults
        assert verdict.status in ("conservative", "inconsistent")


@pytest.mark.parametrize("shift", [0.0, -3.0, 500.0])
def test_a_truth_that_all_runs_share_is_named(rng, shift):
    error, P = tracking(rng)
    paths = shift + np.cumsum(0.05 * rng.normal(size=(*error.shape[:2], 2)), axis=1)
    (one,) = said(judge(recorded(error, P, np.tile(paths[:1], (len(error), 1, 1)))))
    assert one.startswith("all runs have the same true path")
    assert "draw its start from the first covariance" in one
    (one,) = said(judge(recorded(error, P, paths)))
    assert one.startswith("all runs have the same true start")
    assert "draw it from the first covariance" in one
    drawn = paths + rng.normal(size=(len(error), 1, 2)) * 2.0
    assert not said(judge(recorded(error, P, drawn)))


def test_a_shared_path_is_no_cause_of_errors_of_one_size(rng):
    P = np.tile(np.eye(4), (40, 20, 1, 1))
    true = np.tile(np.cumsum(rng.normal(size=(1, 20, 2)), axis=1), (40, 1, 1))
    for scale in (0.5, 1.0, 2.0):
        assert not said(judge(recorded(scale * independent(rng, 40, 20, 4), P, true), Settings(SURE)))


@pytest.mark.parametrize("small", [0, 3, 8])
def test_heavy_tails_in_a_few_steps_keep_their_name_beside_steps_below_the_band(rng, small):
    """One error in 20 of steps 31 to 36 is 12 times as large: the mean of all is right within 40 %."""
    error = independent(rng, 60, 120, 3)
    error[:, 30:36] *= np.where(np.arange(60) % 20 == 0, 12.0, 1.0)[:, None, None]
    error[:, :small] *= 0.3
    verdict = verdict_on(error)
    assert verdict.location.steps_below >= small
    assert verdict.status == "heavy-tailed"


def test_heavy_tails_in_a_step_below_the_band_keep_their_name(rng):
    """Errors of step 31 are a tenth as large, but in one run of 5."""
    error = independent(rng, 60, 120, 3)
    error[:, 30] *= np.where(np.arange(60) % 5 == 0, 1.0, 0.1)[:, None]
    verdict = verdict_on(error, false_alarm=SURE)
    assert (verdict.location.steps_above, verdict.location.steps_below) == (0, 1)
    assert verdict.faults == ("scale in some step",)
    assert verdict.status == "heavy-tailed"


@pytest.mark.parametrize("ratio", [9.0, 25.0, 100.0])
def test_one_axis_in_a_few_steps_is_not_heavy_tailed(rng, ratio):
    """Its NEES spreads as that of one degree of freedom, which is no heavy tail."""
    error = independent(rng, 60, 60, 3)
    error[:, 20:24, 0] *= np.sqrt(ratio)
    assert verdict_on(error, false_alarm=SURE).status == "overconfident"
