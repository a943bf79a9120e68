"""filterpy's filters, put behind the same interface, say what ours say."""

import numpy as np
import pandas as pd
import pytest
from estimates import apart

import consistency as cs
from consistency.bench.filters.run_filter import run_filter

MERWE = {"belief__sigma_points": {"alpha": 0.5, "beta": 2.0, "kappa": 1.0}}
CASES = [
    ("ekf-xyz", "herath2007-xyz", {}),
    ("ekf-xyz", "herath2007-stereo", {}),
    ("ekf-uvd", "herath2007-stereo", {"truth__steps": 120}),
    ("ukf-xyz", "herath2007-xyz", {}),
    ("ukf-xyz", "herath2007-stereo", {}),
    ("ukf-uvd", "herath2007-stereo", {}),
    ("ukf-uvd", "herath2007-wide-baseline", MERWE),
]


@pytest.mark.parametrize("name, world, changes", CASES)
def test_filterpy_agrees(small, name, world, changes):
    scenario = small(world, **changes)
    trial = cs.simulate(scenario, run=2)
    peer, ours = (run_filter(cs.get_filter(n), trial, scenario.belief) for n in (f"filterpy-{name}", name))
    assert peer.failure is None
    assert np.array_equal(peer.nis_dof, ours.nis_dof)
    assert apart(peer, ours) < 1e-9


def test_the_comparison_sees_another_filter(uvd):
    """Negative control."""
    trial = cs.simulate(uvd, run=2)
    peer, ours = (run_filter(cs.get_filter(n), trial, uvd.belief) for n in ("filterpy-ukf-uvd", "ekf-uvd"))
    assert apart(peer, ours) > 1e-6


@pytest.mark.parametrize("name", ["filterpy-ekf-xyz", "filterpy-ekf-uvd", "filterpy-ukf-xyz", "filterpy-ukf-uvd"])
def test_a_peer_runs_beside_ours_in_processes(small, name):
    scenario = small("herath2007-stereo", truth__steps=20)
    alone = cs.run_trials(scenario, [name], runs=2, jobs=1)
    among = cs.run_trials(scenario, [name, "ekf-uvd"], runs=2, jobs=2).estimates
    among = among[among["filter"] == name].reset_index(drop=True)
    assert len(alone.failures) == 0
    pd.testing.assert_frame_equal(among, alone.estimates, check_exact=True)
