"""Sensors of landmarks in the plane: models, scenarios, logs, maps."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import consistency as cs
from consistency.bench.filters import PLANAR
from consistency.bench.filters.kernel.part_functions import (
    locate,
    locate_jacobian,
    measure,
    measure_jacobian,
    wrap_residual,
)
from consistency.bench.filters.methods.ekf import sensor_of
from consistency.bench.filters.run_filter import step_through
from consistency.bench.runs.reproduce_findings import sibling
from consistency.bench.runs.run_outcome import is_flat
from consistency.bench.scenario import models
from consistency.bench.simulation import draw_landmarks
from consistency.bench.store.recorded_log import read_log, write_log
from consistency.diagnostics import map_score
from consistency.referee.system import manifest_of

STEP = 1e-6
POINTS = np.array([[2.0, 0.5], [-1.5, 0.8], [-1.2, -2.0], [0.3, -0.4]])


def slope(function, at):
    """Jacobian by central differences."""
    steps = STEP * np.eye(len(at))
    return np.column_stack([(function(at + d) - function(at - d)) / (2.0 * STEP) for d in steps])


@pytest.mark.parametrize("point", POINTS)
def test_range_and_bearing_have_these_jacobians(point):
    there = np.array(models.range_bearing(*point))
    assert np.allclose(models.at_range_bearing(*there), point, rtol=0, atol=1e-15)
    J = np.reshape(models.range_bearing_jacobian(*point), (2, 2))
    back = np.reshape(models.at_range_bearing_jacobian(*there), (2, 2))
    assert np.allclose(J, slope(lambda p: np.array(models.range_bearing(*p)), point), rtol=0, atol=1e-8)
    assert np.allclose(back, np.linalg.inv(J), rtol=0, atol=1e-14)
    assert there[1] == pytest.approx(np.angle(complex(*point)))  # counter-clockwise from x


@pytest.mark.parametrize("world", ["esde-xy", "range-bearing"])
def test_a_sensor_locates_what_it_measures(world):
    sensor = sensor_of(cs.load_scenario(world).belief, uvd=False)
    for x, y in POINTS:
        z = np.array(measure(sensor, x, y, 7.0))
        assert len(z) == 2
        assert np.allclose(locate(sensor, z), [x, y, 0.0], rtol=0, atol=1e-15)
        J, back = (
            np.reshape(measure_jacobian(sensor, x, y, 7.0), (2, 3)),
            np.reshape(locate_jacobian(sensor, z), (3, 2)),
        )
        assert np.allclose(J @ back, np.eye(2), rtol=0, atol=1e-14)
        assert not J[:, 2].any()


def test_a_bearing_is_taken_by_the_shorter_way_round():
    sensor = sensor_of(cs.load_scenario("range-bearing").belief, uvd=False)
    z = np.array([2.0, 3.1])
    wrap_residual(sensor, z, np.array([5.0, -3.1]))
    assert np.allclose(z, [2.0, 3.1 - 2.0 * np.pi], rtol=0, atol=1e-15)
    lengths = np.array([2.0, 3.1])
    wrap_residual(sensor_of(cs.load_scenario("esde-xy").belief, uvd=False), lengths, np.array([5.0, -3.1]))
    assert lengths.tolist() == [2.0, 3.1]


@pytest.mark.parametrize("method", PLANAR)
def test_full_turns_of_a_bearing_change_nothing(small, method):
    """The twin, step by step; its kernel has the same numbers (tests/oracle/test_combinations.py)."""
    scenario = small("range-bearing", truth__steps=40)
    trial, twin = cs.simulate(scenario), cs.get_filter(f"{method}-rb").textbook
    rng = np.random.default_rng(1)
    turned = trial.z + np.column_stack([np.zeros(len(trial.z)), 2.0 * np.pi * rng.integers(-1, 2, len(trial.z))])
    others = [step_through(twin, each, scenario.belief) for each in (trial, replace(trial, z=turned))]
    assert others[0].failure is None
    assert np.allclose(others[0].pose, others[1].pose, rtol=0, atol=1e-12)
    assert np.allclose(others[0].nis, others[1].nis, rtol=1e-9, equal_nan=True)


# --- scenarios -------------------------------------------------------------------------------------


def test_landmarks_on_a_circle_and_in_rings(small):
    circle = draw_landmarks(cs.load_scenario("esde-xy").truth)
    assert circle.shape == (15, 3)
    assert np.allclose(np.hypot(*(circle[:, :2] - [0.1251, 3.3318]).T), 4.3333)
    assert np.allclose(np.linalg.norm(np.diff(circle, axis=0), axis=1), 2 * 4.3333 * np.sin(np.pi / 15))
    rings = draw_landmarks(cs.load_scenario("ocekf-slam-xy").truth)
    far = np.hypot(*(rings[:, :2] - [0.0, 10.0]).T)
    assert ((far[:10] >= 10.5) & (far[:10] <= 15.0)).all()
    assert ((far[10:] >= 5.0) & (far[10:] <= 9.5)).all()
    assert not rings[:, 2].any()
    other = draw_landmarks(small("ocekf-slam-xy", truth__landmarks__seed=43).truth)
    assert not np.allclose(rings, other)


def test_range_and_bearing_of_the_truth_without_noise(small):
    scenario = small("range-bearing", truth__sensor__sigma=(1e-12, 1e-12))
    trial = cs.simulate(scenario)
    pose = trial.truth[trial.step]
    offset = (trial.landmarks[trial.landmark, :2] - pose[:, :2]) @ [1.0, 1j]
    assert np.allclose(trial.z[:, 0], np.abs(offset))
    assert np.allclose(np.exp(1j * trial.z[:, 1]), offset / np.abs(offset) * np.exp(-1j * pose[:, 2]))
    assert trial.z[:, 0].min() >= 0.5
    assert trial.z[:, 0].max() <= 5.0
    assert trial.z[:, 1].min() < -2.0  # it looks all round
    assert trial.z[:, 1].max() > 2.0


BAD = {
    "three sigmas": ({"truth__sensor__sigma": (0.1, 0.1, 0.1)}, "sigma must have 2 numbers for a sensor 'relative-xy'"),
    "tilted": ({"belief__sensor__mount": {"rotation": [0.1, 0.0, 0.0]}}, "level in the plane of the robot"),
    "raised": ({"truth__sensor__mount": {"position": [0.0, 0.0, 0.2]}}, "level in the plane of the robot"),
    "heights": ({"truth__landmarks": {"layout": "listed", "points": [(1.0, 0.0, 0.1)]}}, "measures no heights"),
    "a ring inside out": (
        {
            "truth__landmarks": {
                "layout": "annular", "count": 3, "seed": 0, "centre": (0.0, 0.0), "rings": [(2.0, 1.0)],
            }
        },
        "0 <= low <= high",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_what_a_planar_sensor_cannot_have(small, case):
    changes, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        small("esde-xy", **changes)


# --- logs and maps ---------------------------------------------------------------------------------


@pytest.mark.parametrize("world", ["esde-xy", "range-bearing"])
def test_a_log_keeps_two_values_of_each_observation(tmp_path, small, world):
    scenario = small(world)
    trial = cs.simulate(scenario)
    write_log(tmp_path / "log", [trial], scenario.belief, None, manifest_of(kind="log"))
    assert "z2" not in pd.read_parquet(tmp_path / "log" / "observations.parquet")
    log = read_log(tmp_path / "log")
    assert log.belief == scenario.belief
    assert np.array_equal(log.trials[0].z, trial.z)
    rows = pd.read_parquet(tmp_path / "log" / "observations.parquet").drop(columns="z1")
    rows.to_parquet(tmp_path / "log" / "observations.parquet")
    with pytest.raises(cs.InputError, match="column 'z1' is missing"):
        read_log(tmp_path / "log")


def test_a_landmark_of_the_plane_has_two_degrees_of_freedom():
    run = np.arange(4)
    assert map_score(run, np.full(4, 2.0), 2).ratio.value == pytest.approx(1.0)
    assert map_score(run, np.full(4, 3.0)).ratio.value == pytest.approx(1.0)
    P = np.zeros((2, 3, 3))
    P[:, :2, :2] = np.eye(2)
    assert is_flat(P)
    P[1, 2, 2] = 1e-9
    assert not is_flat(P)


# --- peers -----------------------------------------------------------------------------------------

PEERS = sibling(str(Path(__file__).parents[3] / "experiments" / "e13_consistent.py"), "e14_planar_peers")


@pytest.mark.parametrize("s", [0.01, 0.02, 0.03])
def test_the_worlds_of_esde_have_its_noise(s):
    (world,) = PEERS.worlds(f"esde-xy-{s}")
    for table in (world.truth.motion, world.belief.motion):
        assert table.sigma_v == pytest.approx(s / np.sqrt(2.0))
        assert table.sigma_omega == pytest.approx(2.0 * np.sqrt(2.0) * s)
    shipped = cs.load_scenario("esde-xy").truth.motion
    assert (world.truth.motion.sigma_v == pytest.approx(shipped.sigma_v)) == (s == 0.02)


def test_a_number_between_those_of_maps_is_no_distance_away():
    assert PEERS.distance(pd.Series([-2.0, 0.5, 3.0])) == 0.0
    assert PEERS.distance(pd.Series([2.0, 0.5, 3.0])) == 0.5
    assert PEERS.distance(pd.Series([-4.0])) == -4.0
