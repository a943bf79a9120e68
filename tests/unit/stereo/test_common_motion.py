"""Landmarks that leave the motion that most share, for every sensor, and what becomes of their numbers."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import consistency as cs
from consistency.bench.scenario import Belief, BelievedMotion, BelievedSensor, Mount, models
from consistency.bench.store.recorded_log import Log
from consistency.bench.types import Trial
from consistency.referee.pages.write_pages import facts
from consistency.stereo.visual_odometry import tracks
from consistency.stereo.visual_odometry.tracks import screened, screened_log, screening_line

STEPS, COUNT = 12, 14
MOTION = BelievedMotion(sigma_v=0.1, sigma_omega=0.02)
MOUNT = Mount(position=(0.5, -0.2, 0.0), rotation=(0.0, 0.0, 0.1))
BACK = Mount(position=(0.5, -0.2, 0.0), rotation=(0.0, 0.0, 3.1))  # what is ahead lies at bearings of about half a turn
SENSORS = {
    "uvd": BelievedSensor(model="uvd", sigma=(0.3, 0.3, 0.2), f=400.0, B=0.4, mount=MOUNT),
    "xyz": BelievedSensor(model="xyz", sigma=(0.02, 0.02, 0.02), mount=MOUNT),
    "relative-xy": BelievedSensor(model="relative-xy", sigma=(0.02, 0.02), mount=MOUNT),
    "range-bearing": BelievedSensor(model="range-bearing", sigma=(0.02, 0.003), mount=BACK),
}


def seen_by(sensor, pose, places):
    """What a sensor of a robot at ``pose`` measures of points (n, 3), without noise."""
    x, y, z = models.to_sensor(*models.to_robot(*pose, *places.T), sensor.mount.packed())
    if sensor.model == "uvd":
        return np.column_stack(models.project(x, y, z, sensor.f, sensor.B))
    if sensor.model == "range-bearing":
        return np.column_stack(models.range_bearing(x, y))
    return np.column_stack([x, y, z])[:, : sensor.size]


def drive(sensor, rng, landmarks=False):
    """A turning robot; landmark 0 is a car that goes its own way from step 6 on, 1 slips to another point in step 9."""
    places = np.column_stack([rng.uniform(6, 14, COUNT), rng.uniform(-4, 4, COUNT), rng.uniform(-1, 1, COUNT)])
    places[:, 2] *= not sensor.planar
    t = np.arange(STEPS + 1)
    truth = np.column_stack([0.1 * t, 0.002 * t**2, 0.02 * t])
    rows = []
    for step in range(1, STEPS + 1):
        now = places.copy()
        now[0, :2] += max(step - 5, 0) * np.array([0.0, 1.2])
        now[1, :2] += (step >= 9) * np.array([1.5, 1.0])
        rows.append(seen_by(sensor, truth[step], now) + rng.normal(size=(COUNT, sensor.size)) * sensor.sigma)
    controls = np.column_stack([np.full(STEPS, 0.1), np.full(STEPS, 1.0), np.full(STEPS, 0.2)])
    return Trial(
        3, np.zeros(3), controls, COUNT * np.arange(STEPS + 1), np.tile(np.arange(COUNT), STEPS), np.concatenate(rows),
        COUNT, truth, places if landmarks else None,
    )  # fmt: skip


def gate_of(sensor):
    """Seven standard deviations of a difference of two observations: a right one is beyond by chance in 1e-11."""
    return 7.0 * np.sqrt(2.0) * np.array(sensor.sigma)


def pieces(trial):
    """Steps of each id, in order of the ids."""
    step = trial.step
    return [step[trial.landmark == i].tolist() for i in range(trial.n_landmarks)]


@pytest.mark.parametrize("model", SENSORS)
def test_a_car_and_a_slip_begin_anew_and_nothing_else(model):
    sensor = SENSORS[model]
    trial = drive(sensor, np.random.default_rng(71))
    found = screened([trial], Belief(motion=MOTION, sensor=sensor), gate_of(sensor))
    [after] = found.trials
    steps = pieces(after)
    assert steps[0] == [1, 2, 3, 4, 5]  # the car, then each of its sights is another landmark
    assert steps[1] == [*range(1, 9)]
    assert all(each == [*range(1, STEPS + 1)] for each in steps[2:COUNT])
    assert sorted(steps[COUNT:]) == sorted([*([k] for k in range(6, STEPS + 1)), [9, 10, 11, 12]])
    assert (found.offered, found.judged, found.broken) == (COUNT * STEPS, COUNT * (STEPS - 1), 8)
    assert_array_equal(after.z, trial.z)
    # of an estimate by the median of 154 misfits or more a seventh is 5 standard errors
    assert_allclose(found.scale, np.sqrt(2.0) * np.array(sensor.sigma), rtol=0.3)


def test_odometry_that_says_another_turn_is_not_believed_more_than_the_landmarks():
    sensor = SENSORS["uvd"]
    trial = drive(sensor, np.random.default_rng(72))
    wrong = trial.controls + np.array([0.0, 0.0, 0.06])  # 3 of its standard deviations of 0.002 rad a step
    found = screened([replace(trial, controls=wrong)], Belief(motion=MOTION, sensor=sensor), gate_of(sensor))
    assert found.broken == 8


@pytest.mark.parametrize("model", SENSORS)
def test_the_derivative_of_what_is_expected(model):
    sensor, rng = SENSORS[model], np.random.default_rng(77)
    points = np.column_stack([rng.uniform(6, 14, 5), rng.uniform(-4, 4, 5), rng.uniform(-1, 1, 5)])
    move = np.array([0.1, -0.05, 0.02, 0.0, 0.0, 0.0])
    seen, _ = tracks._expected(points, sensor)
    _, slope = tracks._error_and_slope(points, seen, move, sensor)
    for i, step in enumerate(1e-6 * np.eye(6)):
        ends = [tracks._error_and_slope(points, seen, move + s * step, sensor)[0] for s in (1, -1)]
        assert_allclose(slope[:, :, i], (ends[1] - ends[0]) / 2e-6, rtol=1e-5, atol=1e-5)


def test_a_bearing_may_cross_half_a_turn():
    sensor, points = SENSORS["range-bearing"], np.array([[8.0, 1.0, 0.0], [9.0, -1.0, 0.0]])
    seen, _ = tracks._expected(points, sensor)
    beyond = seen + np.array([0.0, 2.0 * np.pi])
    error, _ = tracks._error_and_slope(points, beyond, np.zeros(6), sensor)
    assert_allclose(error, 0.0, atol=1e-12)


def test_a_landmark_that_was_not_seen_a_step_before_is_not_judged():
    sensor = SENSORS["uvd"]
    trial = drive(sensor, np.random.default_rng(78))
    step = np.repeat(np.arange(1, STEPS + 1), COUNT)
    keep = (trial.landmark != 1) | (step < 7) | (step > 9)  # 1 slips while it is not seen
    gap = replace(
        trial,
        z=trial.z[keep],
        landmark=trial.landmark[keep],
        first=np.searchsorted(step[keep], np.arange(1, STEPS + 2)),
    )
    found = screened([gap], Belief(motion=MOTION, sensor=sensor), gate_of(sensor))
    assert (found.judged, found.broken) == (COUNT * (STEPS - 1) - 4, 7)


def test_what_few_landmarks_say_of_the_noise():
    """The fit takes after four landmarks: without their leverage misfits in v are 0.45 of the noise, with it 0.84."""
    sensor = SENSORS["uvd"]
    trials = []
    for number in range(40):
        trial = drive(sensor, np.random.default_rng(7900 + number))
        keep = (trial.landmark > 1) & (trial.landmark < 6)
        first = 4 * np.arange(STEPS + 1)
        trials.append(replace(trial, z=trial.z[keep], landmark=trial.landmark[keep], first=first))
    found = screened(trials, Belief(motion=MOTION, sensor=sensor), gate_of(sensor))
    ratio = found.scale[:2] / (np.sqrt(2.0) * np.array(sensor.sigma[:2]))  # standard error 0.03
    assert ((ratio > 0.73) & (ratio < 1.1)).all()


def test_roll_pitch_and_height_are_no_disagreement():
    """The robot rocks by a degree a step, which moves pixels by 7 px, and believes its odometry to be perfect."""
    sensor = SENSORS["uvd"]
    sure = BelievedMotion(sigma_v=1e-3, sigma_omega=1e-4)
    trial = drive(sensor, np.random.default_rng(73))
    rocking = np.repeat(3.5 * (-1.0) ** np.arange(STEPS), COUNT)
    shaken = replace(trial, z=trial.z + rocking[:, None] * [0.0, 1.0, 0.0])
    assert screened([shaken], Belief(motion=sure, sensor=sensor), gate_of(sensor)).broken == 8


def test_two_landmarks_tell_nothing():
    """Any motion fits them; the car is not found, and nothing else is lost."""
    sensor = SENSORS["uvd"]
    trial = drive(sensor, np.random.default_rng(74))
    keep = trial.landmark < 1
    alone = replace(trial, z=trial.z[keep], landmark=trial.landmark[keep], first=np.arange(STEPS + 1))
    assert screened([alone], Belief(motion=MOTION, sensor=sensor), gate_of(sensor)).judged == STEPS - 1


def test_numbers_of_landmarks_that_are_known_and_of_things():
    """Landmarks first, then their new numbers, then things: 14 is none, and begins anew like a landmark."""
    sensor = SENSORS["xyz"]
    trial = drive(sensor, np.random.default_rng(75), landmarks=True)
    thing = np.where(trial.landmark == 0, COUNT, trial.landmark)
    source = np.where(thing == COUNT, -1, thing)
    labels = np.append(100 + np.arange(COUNT), 7)
    known = replace(trial, landmark=thing, source=source, n_landmarks=COUNT + 1, labels=labels)
    other = replace(known, run=4, z=trial.z + 0.0)
    log = Log("log", [known, other], Belief(motion=MOTION, sensor=sensor), None)
    table = pd.DataFrame(trial.landmarks, columns=["x", "y", "z"]).assign(landmark=labels[:COUNT])
    log = replace(log, landmarks=table[["landmark", "x", "y", "z"]])
    after = screened_log(log, gate_of(sensor))
    first, second = after.trials
    assert_array_equal(first.landmark, second.landmark)
    assert len(first.landmarks) == COUNT + 1  # type: ignore[arg-type]
    assert_array_equal(first.landmarks[COUNT], trial.landmarks[1])  # type: ignore[index]
    assert first.labels.tolist() == [*range(100, 114), 114, 7, *range(115, 122)]  # type: ignore[union-attr]
    step = np.repeat(np.arange(1, STEPS + 1), COUNT)
    assert (first.landmark[(trial.landmark == 1) & (step >= 9)] == COUNT).all()
    assert (first.landmark[(trial.landmark == 0) & (step < 6)] == COUNT + 1).all()
    assert_array_equal(first.spurious, known.spurious)
    assert set(first.things) == {COUNT + 1, *range(COUNT + 2, COUNT + 9)}
    assert_array_equal(after.landmarks.set_index("landmark").loc[114], trial.landmarks[1])  # type: ignore[index]
    assert after.screening["broken"] == 16
    assert "screen: 16 of 308 observations" in screening_line(after)
    assert ("Screened", "16 of 308 observations leave the common motion") in facts({"screening": after.screening})
    assert "Screened" not in dict(facts({}))


@pytest.mark.parametrize("gate", ["2,2", "2,2,0", "2,2,nan", "a,b,c", ""])
def test_an_unusable_gate(gate):
    sensor = SENSORS["uvd"]
    log = Log("log", [drive(sensor, np.random.default_rng(76))], Belief(motion=MOTION, sensor=sensor), None)
    with pytest.raises(
        cs.InputError, match=f"--screen {gate}: must be 3 positive numbers for a sensor 'uvd', as 2,2,1"
    ):
        screened_log(log, gate)


def test_a_linear_world_is_not_screened():
    world = cs.load_scenario("linear-gaussian")
    trial, belief = cs.simulate(world, run=0, seed=5), world.belief
    with pytest.raises(cs.InputError, match="a sensor 'linear' cannot be screened"):
        screened_log(Log("log", [trial], belief, None), np.ones(3))
