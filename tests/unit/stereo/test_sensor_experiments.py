"""The worlds and statistics of the experiments on a sensor's biases and on the issues of section 4."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scripts import experiment

import consistency as cs


@pytest.fixture(scope="module")
def bias():
    return experiment("e20_bias_or_noise")


@pytest.fixture(scope="module")
def issues():
    return experiment("e21_sensor_issues")


def test_the_bias_has_the_pooled_spread_of_the_chapter(bias):
    """By two trials with the same noise, which drops out of their difference."""
    k = bias.brentq(bias.excess_sd, 1e-4, 2e-2)
    world = bias.variants(k)["as noise"]
    quiet = {"truth__sensor__sigma": (1e-9, 1e-9, bias.SIGMA_D)}
    ideal = cs.simulate(world.variant("ideal", summary="", truth__sensor__effects=(), **quiet))
    biased = cs.simulate(world.variant("biased", summary="", **quiet))
    rows = {(step, label): z for step, label, z in steps_of(ideal)}
    errors = np.array([z[2] - rows[step, label][2] for step, label, z in steps_of(biased) if (step, label) in rows])
    noise = bias.SIGMA_D * np.interp([z[2] for *_, z in steps_of(ideal)], *bias.GROWTH.values())
    spread = np.sqrt(errors.var() + np.square(noise).mean())
    assert spread == pytest.approx(bias.POOLED, rel=4e-3)


def steps_of(trial):
    step = trial.step - 1
    return [(int(k), int(label), z) for k, label, z in zip(step, trial.landmark, trial.z, strict=True)]


def test_beliefs_differ_in_what_their_names_say(bias):
    worlds = bias.variants(0.005)
    noise = worlds["noise"].belief.sensor
    for name, has_map, has_noise in [("as noise", 0, 0), ("mapped", 1, 0), ("known", 1, 1), ("ignored", 0, 1)]:
        sensor = worlds[name].belief.sensor
        assert worlds[name].truth == worlds["mapped"].truth
        assert (sensor.bias is not None) == bool(has_map)
        assert (sensor.disparity_growth is not None) == bool(has_noise)
        assert sensor.sigma == ((*noise.sigma[:2], bias.SIGMA_D) if has_noise else noise.sigma)


def test_the_map_is_that_of_the_distortion(bias):
    k, f, d = 0.005, 150.0, bias.NOMINAL
    found = bias.variants(k)["mapped"].belief.sensor.bias.at(np.array([80.0]), np.array([40.0]))[0]
    left, right = (80.0**2 + 40.0**2) / f**2, ((80.0 - d) ** 2 + 40.0**2) / f**2
    assert found == pytest.approx([80.0 * k * left, 40.0 * k * left, k * left * 80.0 + k * right * (80.0 - d)])


def test_the_share_of_an_excess(bias, rng):
    before = 3.0 + 8.0 * rng.uniform(0.5, 1.5, 50)
    share, low, high = bias.interval_of_share(before, 3.0 + 0.25 * (before - 3.0), 0)
    assert (share, low, high) == pytest.approx((0.75, 0.75, 0.75))
    share, low, high = bias.interval_of_share(before, 3.0 + rng.uniform(0.0, 4.0, 50), 0)
    assert low < share < high < 0.9


@pytest.mark.parametrize("degrees, f", [(90.0, 160.0), (20.0, 907.405), (120.0, 92.376)])
def test_a_lens_of_so_many_degrees(issues, degrees, f):
    plain, distorted = issues.lens(degrees, 0.0), issues.lens(degrees, 0.002)
    for world in (plain, distorted):
        assert world.truth.sensor.f == world.belief.sensor.f == pytest.approx(f, rel=1e-5)
        nearest = f * 0.09 / world.truth.sensor.disparity[1]
        assert nearest <= 150.0 * 0.09 / 32.0 * (1.0 + 1e-9)
    assert plain.truth.sensor.effects == ()
    assert distorted.truth.sensor.effects[0].left == (0.002, 0.0)
    assert distorted.truth.sensor.effects[0].right == (-0.002, 0.0)


def test_so_many_features_from_here_to_there(issues):
    world = issues.selected(3, (0.5, 2.0))
    trial = cs.simulate(world)
    assert np.diff(trial.first).max() <= 3
    assert trial.z[:, 2].min() > 13.5 / 2.0 - 5.0 * 0.65 - 2.0  # nearer than 2 m: 6.75 px and more
    assert world.truth.sensor.range == (0.5, 2.0)


def test_statistics_of_runs(issues):
    error = np.zeros((2, 4, 3))
    error[0, :, :2], error[0, :, 2], error[1, :, :2], error[1, :, 2] = [3.0, 4.0], 1.0, 1.0, 0.5
    record = cs.make_record("f", error, nees=np.array([[2.0, np.nan], [4.0, 6.0]]))
    assert issues.log_rmse(record, (0, 1))[0] == pytest.approx(np.log(5.0))
    assert issues.log_rmse(record, (2,))[1] == pytest.approx(np.log(0.5))
    assert issues.log_nees(record) == pytest.approx(np.log([2.0, 5.0]))
    low, high = np.array([0.0, 0.1, 0.2, np.nan]), np.array([1.0, 1.2, 1.1, -9.0])
    assert issues.greater(high, low) < 0.01 < 0.99 < issues.greater(low, high)


def test_errors_of_the_first_run(issues):
    covariance = np.zeros((2, 2, 3, 3))
    covariance[0] = np.diag([4.0, 9.0, np.radians(5.0) ** 2])
    covariance[0, 1, 0, 0] = np.nan
    error = np.zeros((2, 2, 3))
    error[0, 1] = 1.0, 2.0, np.radians(3.0)
    table = issues.first_run(cs.make_record("f", error, covariance))
    expected = [[1, 0, 0, 0, 2, 3, 5], [2, 1, 2, 3, np.nan, 3, 5]]
    assert_allclose(table.to_numpy(float), expected)
    assert table.columns.tolist() == ["step", "x", "y", "heading", "sigma_x", "sigma_y", "sigma_heading"]


def test_tables_of_the_findings_on_a_bias(bias, monkeypatch):
    """Three runs of one filter in short worlds."""
    monkeypatch.setattr(bias, "FILTERS", ("ekf-uvd",))
    worlds = {name: world.variant(world.name, truth__steps=60) for name, world in bias.variants(0.005).items()}
    study = cs.Study(3, 1, 1)
    bias.share(study, worlds)
    bias.survivors(study, worlds)
    table = study.tables["bias_or_noise"]
    assert table["share"].isna().tolist() == [True, True, False, False, True]
    anees = [study.judged(world, "ekf-uvd")[0].statistic for world in worlds.values()]
    assert_allclose(table["anees"], anees, rtol=1e-9)
    assert (table["low"] <= table["share"])[2:4].all()
    (row,) = study.tables["bias_survivors"].to_dict("records")
    assert (row["anees_noise"], row["anees_bias"]) == pytest.approx((anees[0], anees[1]))
    assert set(study.tables["bias_or_noise_nees"]["belief"]) == set(table["belief"])
