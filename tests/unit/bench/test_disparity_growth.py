"""Noise of a disparity that grows with it: the curve, what the world does, what a file may say, and old hashes."""

import numpy as np
import pytest
from scenario_files import load, put

import consistency as cs
from consistency.bench.scenario import DisparityGrowth
from consistency.bench.simulation import World
from consistency.scenario import scenario_text

GROWTH = {"disparity": [3.0, 5.0, 12.0], "ratio": [0.5, 1.0, 2.4]}
WIDE = {"truth__sensor__disparity": (1e-6, 1e6)}
HASHES = {
    "esde-xy": "076d5dac7e525347",
    "herath2007-optimistic": "a47902c80790442f",
    "herath2007-stereo": "58509e972cc57274",
    "herath2007-wide-baseline": "edd0f1746567bcd5",
    "herath2007-xyz": "183c88bfc020d12e",
    "iekf-slam-xy": "f6a0448f3099d0ee",
    "linear-gaussian": "8e46c345ca849ece",
    "long-loop": "f7e7ba2fd02ffb6f",
    "ocekf-slam-xy": "aca0b7a3bb28773b",
    "range-bearing": "971f4a2a8dddd169",
}  # of results folders that were written before sensors had optional keys


@pytest.mark.parametrize("name", HASHES)
def test_a_scenario_without_the_new_keys_keeps_its_hash(name):
    scenario = cs.load_scenario(name)
    assert scenario.hash == HASHES[name]
    content = scenario.model_dump(mode="json")
    for half in ("truth", "belief"):
        assert not {"disparity_growth", "bias", "effects"} & set(content[half]["sensor"])


@pytest.mark.parametrize("half", ["truth", "belief"])
def test_a_growth_changes_the_hash_and_survives_a_file(small, tmp_path, half):
    base = cs.load_scenario("herath2007-stereo")
    grown = base.variant("grown", **{f"{half}__sensor__disparity_growth": GROWTH})
    assert grown.hash != base.hash
    assert grown.variant("back", **{f"{half}__sensor__disparity_growth": None}).hash == base.hash
    (tmp_path / "grown.toml").write_text(scenario_text(grown), encoding="utf-8")
    assert cs.load_scenario(tmp_path / "grown.toml").hash == grown.hash


def test_the_curve_is_linear_between_its_nodes_and_constant_beyond():
    growth = DisparityGrowth.model_validate({"disparity_px": [3.0, 5.0, 12.0], "ratio": [0.5, 1.0, 2.4]})
    d = np.array([[0.1, 3.0, 4.0], [5.0, 8.5, 40.0]])
    assert np.allclose(growth.ratio_at(d), [[0.5, 0.5, 0.75], [1.0, 1.7, 2.4]], rtol=0, atol=1e-15)
    assert np.all(DisparityGrowth(disparity=(4.0,), ratio=(2.0,)).ratio_at(d) == 2.0)


@pytest.mark.parametrize("noise_on", ["odometry", "motion"])
def test_the_noise_has_the_same_random_numbers_scaled_at_the_true_disparity(small, noise_on):
    plain = small("herath2007-stereo", truth__motion__noise_on=noise_on, **WIDE)
    grown = plain.variant("grown", truth__sensor__disparity_growth=GROWTH)
    a, b, world = cs.simulate(plain, 1, 2), cs.simulate(grown, 1, 2), World(plain.truth)
    step = a.step
    ideal = world.context(a.truth).measure(step, a.landmark)
    ratio = np.interp(ideal[:, 2], GROWTH["disparity"], GROWTH["ratio"])
    assert np.ptp(ratio) > 1.0
    assert np.array_equal(b.z[:, :2], a.z[:, :2])
    assert np.allclose(b.z[:, 2] - ideal[:, 2], ratio * (a.z[:, 2] - ideal[:, 2]), rtol=0, atol=1e-12)


MISTAKES = {
    "not as many": ({"disparity_px": [1.0, 2.0], "ratio": [1.0]}, r"ratio must have a number for each .*got 1 for 2$"),
    "not increasing": ({"disparity_px": [2.0, 2.0], "ratio": [1.0, 2.0]}, r"disparity must increase .*\[2\.0, 2\.0\]$"),
    "negative": ({"disparity_px": [1.0, 2.0], "ratio": [1.0, -0.1]}, r"\.ratio\.1': .*greater than 0 \(got -0\.1\)$"),
    "empty": ({"disparity_px": [], "ratio": []}, r"\.disparity': .*at least 1 item"),
    "infinite": ({"disparity_px": [1.0, float("inf")], "ratio": [1.0, 2.0]}, r"\.disparity\.1': .*finite"),
    "unit": ({"disparity_m": [1.0], "ratio": [1.0]}, r"\.disparity_m': unknown key; allowed here: disparity, ratio"),
    "missing": ({"ratio": [1.0]}, r"\.disparity': missing; it must be given"),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_a_mistake_is_answered_with_file_and_key(tmp_path, case):
    growth, complaint = MISTAKES[case]
    with pytest.raises(cs.InputError, match=r"mine\.toml: key 'truth\.sensor\.disparity_growth.*" + complaint) as e:
        load(tmp_path, put("truth.sensor.disparity_growth", growth))
    assert "\n" not in str(e.value)


def test_points_in_metres_have_no_disparity(tmp_path):
    good = {"disparity_px": [1.0], "ratio": [1.0]}
    with pytest.raises(cs.InputError, match=r"'belief\.sensor': disparity_growth is of a sensor 'uvd', not 'xyz'"):
        load(tmp_path, put("belief.sensor.disparity_growth", good), name="herath2007-xyz")
    with pytest.raises(cs.InputError, match=r"'truth\.sensor\.disparity_growth': unknown key"):
        load(tmp_path, put("truth.sensor.disparity_growth", good), name="herath2007-xyz")
