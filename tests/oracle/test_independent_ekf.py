"""Our EKF against one that was written from the contract alone and reads nothing but a log folder."""

import independent_ekf
import numpy as np
import pytest

import consistency as cs
from consistency.bench.runs.montecarlo import simulate_log

RUNS, SEED = 2, 5
# filter, its observation model, scenario, steps
CASES = [
    ("ekf-uvd", "uvd", "herath2007-stereo", 500),
    ("ekf-xyz", "xyz", "herath2007-stereo", 500),
    ("ekf-uvd", "uvd", "herath2007-wide-baseline", 150),
    ("ekf-xyz", "xyz", "herath2007-xyz", 500),
    ("ekf-xyz", "xyz", "herath2007-optimistic", 150),
]
POSE = ["x", "y", "heading"]
VARIANCE = {"P_xx": ("P_xx", "P_xx"), "P_yy": ("P_yy", "P_yy"), "P_hh": ("P_hh", "P_hh")}
COVARIANCE = {"P_xy": ("P_xx", "P_yy"), "P_xh": ("P_xx", "P_hh"), "P_yh": ("P_yy", "P_hh")}


def relative_covariance(ours, theirs):
    """Largest difference of the six entries in units of the standard deviations that they belong to."""
    later = theirs["step"] > 1  # in step 1 some variances are zero
    worst = 0.0
    for name, (a, b) in (VARIANCE | COVARIANCE).items():
        scale = np.sqrt(theirs[a] * theirs[b])
        worst = max(worst, float((np.abs(ours[name] - theirs[name]) / scale)[later].max()))
    return worst


@pytest.mark.parametrize("name, model, scenario, steps", CASES)
def test_two_authors_agree(name, model, scenario, steps, tmp_path):
    world = cs.load_scenario(scenario).variant("two-authors", truth__steps=steps)
    simulate_log(world, RUNS, SEED, tmp_path / "log")
    results = cs.run_trials(world, [name], RUNS, SEED, jobs=1)
    assert len(results.failures) == 0
    for run, part in results.estimates.groupby("run"):
        ours, theirs = part.reset_index(drop=True), independent_ekf.run(tmp_path / "log", int(str(run)), model)
        assert np.array_equal(ours["step"], theirs["step"])
        assert np.allclose(ours[POSE], theirs[POSE], rtol=0, atol=1e-6)
        assert relative_covariance(ours, theirs) < 1e-6
        for name_, value in (("nees", 1e-6), ("nis", 1e-6)):
            assert np.allclose(ours[name_], theirs[name_], rtol=value, atol=1e-9, equal_nan=True)
        assert np.array_equal(ours["nis_dof"], theirs["nis_dof"])


def test_the_comparison_sees_a_small_difference(small, tmp_path):
    """Negative control: a belief that is 0.1 % off is not the same filter."""
    simulate_log(small("herath2007-stereo"), 1, SEED, tmp_path / "log")
    off = small("herath2007-stereo", belief__motion__sigma_v=0.05005)
    ours = cs.run_trials(off, ["ekf-uvd"], 1, SEED, jobs=1).estimates
    theirs = independent_ekf.run(tmp_path / "log", 0, "uvd")
    assert not np.allclose(ours[POSE], theirs[POSE], rtol=0, atol=1e-6)
    assert relative_covariance(ours, theirs) > 1e-6
