"""A constant error of a sensor."""

import numpy as np

import consistency as cs


def test_a_bias_shifts_every_disparity() -> None:
    exact = cs.load_scenario("herath2007-stereo").variant("exact", truth__sensor__disparity=(1e-6, 1e6))
    biased = exact.variant("biased", truth__sensor__effects=[{"kind": "bias", "bias": (0.0, 0.0, 1.0)}])
    a, b = cs.simulate(exact), cs.simulate(biased)
    assert np.array_equal(b.landmark, a.landmark)
    assert np.allclose(b.z, a.z + np.array([0.0, 0.0, 1.0]), rtol=0, atol=1e-12)
