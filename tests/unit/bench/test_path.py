"""Named trajectories: what they are called for is what is driven."""

import numpy as np
import pytest

import consistency as cs
from consistency.bench.simulation import planned_controls, planned_path

V, DT = 0.7, 0.1  # no lap below is a whole number of steps of 0.1 s
START = {"start": (1.0, -2.0), "heading": 0.6, "speed": V}
POINTS = [(5.0, 0.0), (5.0, 4.0), (-1.0, 3.0)]
SHAPES = {
    "circle": {"radius": 3.0},
    "figure-of-eight": {"radius": 2.0},
    "rounded-rectangle": {"length": 9.0, "width": 5.0, "corner_radius": 1.0},
    "corridor": {"length": 8.0, "turn_radius": 0.5},
    "waypoints": {"points": POINTS, "turn_rate": 0.8},
}
CORNERS = np.array([START["start"], *POINTS, START["start"]])
LENGTH = {
    "circle": 2 * np.pi * 3.0,
    "figure-of-eight": 4 * np.pi * 2.0,
    "rounded-rectangle": 2 * (7.0 + 3.0) + 2 * np.pi * 1.0,
    "corridor": 16.0 + 2 * np.pi * 0.5,
    "waypoints": float(np.hypot(*np.diff(CORNERS, axis=0).T).sum()),
}
TURNED = {"circle": 1, "figure-of-eight": 0, "rounded-rectangle": 1, "corridor": 1, "waypoints": 1}  # turns a lap


@pytest.fixture(scope="session")
def drive():
    base = cs.load_scenario("herath2007-xyz")

    def make(shape, steps, **changes):
        path = {"shape": shape, **START, **SHAPES[shape], **changes}
        return base.variant(shape, truth__path=path, truth__steps=steps, truth__dt=DT).truth

    return make


def lap_time(shape):
    """Seconds of one lap; on the spot the robot turns without getting further."""
    if shape != "waypoints":
        return LENGTH[shape] / V
    legs = np.diff(CORNERS, axis=0)
    headings = np.concatenate([[START["heading"]], np.arctan2(legs[:, 1], legs[:, 0]), [START["heading"]]])
    turns = (np.diff(headings) + np.pi) % (2 * np.pi) - np.pi
    return LENGTH[shape] / V + np.abs(turns).sum() / SHAPES[shape]["turn_rate"]


def lap(drive, shape):
    return planned_path(drive(shape, round(lap_time(shape) / DT)))


@pytest.mark.parametrize("shape", SHAPES)
def test_a_lap_closes_within_one_step(drive, shape):
    path = lap(drive, shape)
    assert np.hypot(*(path[-1, :2] - path[0, :2])) <= V * DT
    # negative control: a tenth of a lap earlier the robot is somewhere else
    assert np.hypot(*(path[int(0.9 * len(path)), :2] - path[0, :2])) > V * DT


@pytest.mark.parametrize("shape", SHAPES)
def test_length_and_turns_of_many_laps_are_made_in_full(drive, shape):
    """Steps that a corner begins or ends in the middle of must not lose a part of it."""
    laps = 7
    steps = round(laps * lap_time(shape) / DT)
    dt, v, omega = planned_controls(drive(shape, steps)).T
    rest = steps * DT - laps * lap_time(shape)  # at most half a step
    assert np.sum(dt * v) == pytest.approx(laps * LENGTH[shape], abs=V * abs(rest) + 1e-9)
    rate = np.abs(omega).max()
    assert np.sum(dt * omega) == pytest.approx(2 * np.pi * laps * TURNED[shape], abs=rate * abs(rest) + 1e-9)


@pytest.mark.parametrize("shape", SHAPES)
def test_steps_and_speed(drive, shape):
    controls, path = planned_controls(drive(shape, 333)), planned_path(drive(shape, 333))
    assert controls.shape == (333, 3)
    assert path.shape == (334, 3)
    assert np.array_equal(path[0], [*START["start"], START["heading"]])
    assert np.all(controls[:, 0] == DT)
    assert controls[:, 1].max() == pytest.approx(V)
    assert controls[:, 1].min() >= 0.0


def test_rectangle_has_its_size_and_begins_in_the_middle_of_a_long_side(drive):
    truth = drive("rounded-rectangle", round(lap_time("rounded-rectangle") / DT), heading=0.0)
    path = planned_path(truth)
    assert np.allclose(np.ptp(path[:, :2], axis=0), (9.0, 5.0), rtol=0, atol=V * DT)
    assert START["start"][0] == pytest.approx((path[:, 0].min() + path[:, 0].max()) / 2, abs=V * DT)
    assert START["start"][1] == pytest.approx(path[:, 1].min(), abs=V * DT)


def test_rectangle_of_four_quarter_circles_is_a_circle(drive):
    """Straight pieces of length zero must not stand in the way."""
    size = {"length": 4.0, "width": 4.0, "corner_radius": 2.0}
    square = planned_path(drive("rounded-rectangle", 100, **size))
    assert np.allclose(square, planned_path(drive("circle", 100, radius=2.0)), rtol=0, atol=1e-12)


def test_figure_of_eight_crosses_its_start_in_the_middle(drive):
    truth = drive("figure-of-eight", round(lap_time("figure-of-eight") / DT), heading=0.0)
    path = planned_path(truth)
    half = len(path) // 2
    assert np.hypot(*(path[half, :2] - path[0, :2])) <= V * DT
    assert path[half, 2] == pytest.approx(2 * np.pi, abs=V / 2.0 * DT)
    # one loop to the left of the start, one to the right
    assert np.allclose([path[:, 1].min(), path[:, 1].max()], [-2.0 - 4.0, -2.0 + 4.0], rtol=0, atol=V * DT)


def test_circle_turns_left_around_its_centre(drive):
    path = lap(drive, "circle")
    centre = np.array(START["start"]) + 3.0 * np.array([-np.sin(0.6), np.cos(0.6)])
    assert np.allclose(np.hypot(*(path[:, :2] - centre).T), 3.0, rtol=0, atol=V * DT)


def test_corridor_comes_back_beside_itself(drive):
    path = planned_path(drive("corridor", round(lap_time("corridor") / DT), heading=0.0))
    assert np.ptp(path[:, 0]) == pytest.approx(8.0 + 2 * 0.5, abs=V * DT)
    assert np.ptp(path[:, 1]) == pytest.approx(2 * 0.5, abs=V * DT)


def test_waypoints_are_visited_in_order_and_the_heading_is_that_of_the_start(drive):
    path = lap(drive, "waypoints")
    distance = np.hypot(*(path[:, None, :2] - np.array(POINTS)).transpose(2, 0, 1))
    assert np.all(distance.min(axis=0) <= V * DT)
    assert np.all(np.diff(distance.argmin(axis=0)) > 0)
    turn = (path[-1, 2] - START["heading"] + np.pi) % (2 * np.pi) - np.pi
    assert abs(turn) <= SHAPES["waypoints"]["turn_rate"] * DT


def test_waypoint_where_the_robot_stands_already(drive):
    path = planned_path(drive("waypoints", 40, points=[START["start"], (3.0, -2.0)], heading=0.0))
    assert path[-1, 0] > 1.0
    assert np.isfinite(path).all()
