"""The closed forms of e18_static_limit.py: against figures from elsewhere, and against the filters."""

import numpy as np
import pytest
from scripts import experiment

import consistency as cs

# Worked out elsewhere, from the same model: depth in m, limit / depth, growth of the NEES by an observation, and
# 1 + rho^2 + 3 rho^4; noise in the disparity alone, B = 0.09 m, f = 150 px, sigma_d = 0.65 px.
FIGURES = np.array([
    [1, 0.993125, 0.0206732, 1.00233],
    [2, 0.973409, 0.0805115, 1.00953],
    [3, 0.943276, 0.173721, 1.02217],
    [4, 0.905922, 0.292702, 1.04122],
    [5, 0.864528, 0.429969, 1.06803],
    [6, 0.821728, 0.579451, 1.10435],
    [8, 0.738713, 0.900161, 1.21441],
    [10, 0.664325, 1.24048, 1.39305],
])  # fmt: skip
PIXELS = np.array([1.34, 1.53, 0.65])  # px, of herath2007-stereo


@pytest.fixture(scope="module")
def script():
    return experiment("e18_static_limit")


def test_closed_forms_are_the_figures_from_elsewhere(script):
    depth, ratio, growth, fourth = FIGURES.T
    rho = 0.65 * depth / 13.5
    assert script.limit_ratio(rho, lateral=False) == pytest.approx(ratio, abs=1e-6)
    assert script.growth(rho, lateral=False) == pytest.approx(growth, rel=1e-5)
    assert script.limit_ratio(rho, lateral=True) != pytest.approx(ratio, abs=1e-3)
    small = rho[:2]
    assert script.mean_ratio(small) == pytest.approx(fourth[:2], abs=2e-5)  # the next term, 15 rho^6, is 1e-5
    q = script.debiased_ratio(rho[:4])
    assert q * (1.0 + (q * rho[:4]) ** 2) == pytest.approx(script.mean_ratio(rho[:4]), rel=1e-12)
    assert q[:2] - 1.0 == pytest.approx(3.0 * small**4, rel=0.05)


@pytest.mark.parametrize("lateral", [False, True])
def test_ekf_xyz_is_the_weighted_mean_of_the_points(script, lateral, rng):
    """W_i = D_i' R^-1 D_i at the measured point, from which the closed forms follow."""
    still = {f"belief__motion__{key}": 0.0 for key in ("sigma_v", "sigma_omega")}
    belief = cs.load_scenario("herath2007-stereo").variant("still", **still).belief
    u, v, d = (z := [0.0, 0.0, 13.5 / 4.0] + rng.normal(size=(50, 3)) * PIXELS * (lateral, lateral, 1.0)).T
    zero, f = np.zeros(50), np.full(50, 150.0)
    D = np.moveaxis(d / 13.5 * np.array([[-u, -f, zero], [-v, zero, -f], [-d, zero, zero]]), 2, 0)
    W = np.swapaxes(D, 1, 2) / PIXELS**2 @ D
    points = np.column_stack([13.5 / d, -0.09 * u / d, -0.09 * v / d])
    expected = np.linalg.solve(W.sum(axis=0), (W @ points[..., None]).sum(axis=0))[:, 0]
    said = cs.get_filter("ekf-xyz").run(script.still(0, 4.0, z), belief).map
    assert said.mean[0] == pytest.approx(expected, rel=1e-9)
    assert said.covariance[0] @ W.sum(axis=0) == pytest.approx(np.eye(3), abs=1e-7)


def test_findings_hold_and_their_rule_can_fail(script, monkeypatch):
    """With a false-failure rate of 1e-3 for each of six comparisons."""
    monkeypatch.setattr(script, "OBSERVATIONS", 400)
    findings = script.main(cs.Study(runs=12))
    assert [finding.id for finding in findings] == list(script.FINDINGS)
    assert {finding.verdict for finding in findings} == {"reproduced"}
    monkeypatch.setattr(script, "limit_ratio", lambda rho, lateral: np.ones_like(rho))  # that of a right filter
    monkeypatch.setattr(script, "growth", lambda rho, lateral: np.zeros_like(rho))
    monkeypatch.setattr(script, "mean_ratio", np.ones_like)
    assert {finding.verdict for finding in script.main(cs.Study(runs=12))} == {"not reproduced"}
