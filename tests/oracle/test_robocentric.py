"""The robot-centred filter: geometry by finite differences, conversion by quadrature, kernel by its twin."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from scipy.stats import truncnorm

import consistency as cs
from consistency.bench.filters.filter_inputs import problem_of
from consistency.bench.filters.kernel.part_functions import Frame, State
from consistency.bench.filters.methods import robocentric as rc
from consistency.bench.filters.parts.converting import (
    Converting,
    _is_driven_through,
    aim_chained,
    cast_columns,
    converting_arrays,
    take_root,
    unchain,
)
from consistency.bench.filters.parts.invariant_pose import bend
from consistency.bench.filters.parts.inverse_range import Pixels, carried, second_order
from consistency.bench.filters.parts.parking import Parking, _is_worth_it, make_clones, unpark
from consistency.bench.filters.parts.reactivation import _stays
from consistency.bench.filters.parts.sensors import Growth
from consistency.bench.filters.run_filter import step_through
from consistency.bench.filters.textbook import inverse_range, robocentric_state
from consistency.bench.filters.textbook import robocentric as textbook
from consistency.bench.filters.textbook.basics import heading_matrix
from consistency.bench.runs.results_to_records import record_of
from consistency.bench.types import Control

Small = Callable[..., cs.Scenario]
Y = np.array([[0.3, -0.2, 0.4], [-0.6, 0.1, 0.15], [2.4, 0.3, 0.9]])  # the last one is behind the robot
STEP = 1e-6


def close(a, b, tolerance=1e-7):
    return bool(np.abs(a - b).max() <= tolerance)


def along(function, x):
    """Derivative of a function of x by central differences, its last axis that of x."""
    steps = STEP * np.eye(len(x))
    return np.stack([(function(x + d) - function(x - d)) / (2.0 * STEP) for d in steps], axis=-1)


@pytest.fixture
def sensor(small, tilted):
    return small("herath2007-stereo", belief__sensor__mount=tilted).belief.sensor


# --- geometry ------------------------------------------------------------------------------------


@pytest.mark.parametrize("i", range(len(Y)))
def test_carrying_a_landmark_has_the_derivatives_it_says(sensor, i):
    R, t = heading_matrix(-0.3), np.array([-0.4, 0.2, 0.0])
    _, J, _, _ = inverse_range.in_new_frame(Y, R, t, sensor)
    assert close(J[i], along(lambda y: inverse_range.in_new_frame(y[None], R, t, sensor)[0][0], Y[i]))
    assert not close(1.001 * J[i], along(lambda y: inverse_range.in_new_frame(y[None], R, t, sensor)[0][0], Y[i]))


def test_carrying_there_and_back_changes_nothing(sensor):
    R, t = heading_matrix(-0.3), np.array([-0.4, 0.2, 0.0])
    there = inverse_range.in_new_frame(Y, R, t, sensor)[0]
    assert close(inverse_range.in_new_frame(there, R.T, -R.T @ t, sensor)[0], Y, 1e-12)


DRIVE, TURN = 0.4, 0.3  # m, rad


def moved(errors, sensor):
    """A landmark (3,) after a motion, by errors (5,) of a, e, rho, drive and turn about ``errors[:3]``."""
    R = heading_matrix(-TURN - errors[4])
    return inverse_range.in_new_frame(errors[None, :3], R, -R[:, 0] * (DRIVE + errors[3]), sensor)[0][0]


def differences(y, sensor):
    """First (3, 5) and second derivatives (5, 5, 3) of :func:`moved` by central differences."""
    step, about = 1e-3 * np.eye(5), np.append(y, [0.0, 0.0])

    def at(d):
        return moved(about + d, sensor)

    first = np.stack([(at(d) - at(-d)) / 2e-3 for d in step], axis=1)
    second = [[at(d + e) - at(d - e) - at(e - d) + at(-d - e) for e in step] for d in step]
    return first, np.array(second) / 4e-6


def said_of(y, sensor):
    R = heading_matrix(-TURN)
    return inverse_range.second_derivatives(y, R, -R[:, 0] * DRIVE, sensor)


@pytest.mark.parametrize("i", range(len(Y)))
def test_a_motion_has_the_second_derivatives_it_says(sensor, i):
    exact = differences(Y[i], sensor)[1]
    assert np.abs(said_of(Y, sensor)[i] - exact).max() < 1e-5 * np.abs(exact).max()
    sizes = np.abs(exact).max(axis=2)
    sizes[3, 3] = sizes[3, 3] or 1.0
    assert (sizes > 1e-3).all(), "each pair of errors counts"


def random_covariance(rng):
    root = 0.02 * rng.normal(size=(3, 3))
    return root @ root.T


@pytest.mark.parametrize("i", range(len(Y)))
def test_the_errors_of_a_landmark_spread_it_to_second_order(small, tilted, rng, i):
    """By the fourth moments of a normal: the covariance of 1/2 x' G_i x and 1/2 x' G_j x is 1/2 tr(G_i S G_j S)."""
    scenario = small("herath2007-stereo", belief__sensor__mount=tilted)
    motion, trial, own, dt = scenario.belief.motion, cs.simulate(scenario), random_covariance(rng), 0.5
    P = np.zeros((6, 6))
    P[3:, 3:] = own
    x = np.append([1.0, 2.0, 0.5], Y[i])
    state = robocentric_state.CentredState(x, P, problem_of(trial, scenario.belief), places={0: 3}, seen={0: 0})
    first, plain = (
        textbook.RobotCentredKalman("trial", inverse_range.Corrections(spread=spread)).predict(
            state, Control(dt, DRIVE / dt, TURN / dt)
        )
        for spread in (True, False)
    )
    S = np.zeros((5, 5))
    S[:3, :3], S[3, 3], S[4, 4] = own, (dt * motion.sigma_v) ** 2, (dt * motion.sigma_omega) ** 2
    GS = np.moveaxis(differences(Y[i], scenario.belief.sensor)[1], -1, 0) @ S
    exact = np.zeros((6, 6))
    exact[3:, 3:] = 0.5 * np.einsum("ikl,jlk->ij", GS, GS)
    assert np.abs(first.P - plain.P - exact).max() < 1e-4 * exact.max()


@pytest.mark.parametrize("i", range(len(Y)))
def test_the_kernel_has_the_second_order_of_its_twin(sensor, rng, i):
    sigmas, own, R = (0.05, 0.2), random_covariance(rng), heading_matrix(-TURN)
    second = said_of(Y, sensor)[i : i + 1]
    frame, mount = Frame(*(-R[:2, 0] * DRIVE), R[0, 0], R[1, 0]), sensor.mount.packed()
    there, J, D, B, L, means, spread = np.zeros(3), *np.zeros((6, 3, 3))
    b = carried(Y[i], frame, mount, there, J, D, B)
    P = np.zeros((9, 9))
    P[4:7, 4:7] = np.triu(own)
    take_root(P, 4, L)
    assert close(L, np.linalg.cholesky(own), 1e-14)
    second_order(Y[i], L, b, D, B, frame, mount, *sigmas, 0, np.zeros((5, 9)), means, spread)
    mean = 0.5 * np.square(sigmas)[:, None] * second[0, [3, 4], [3, 4]]
    assert close(means[:2], mean, 1e-14)
    assert np.abs(mean).max(axis=1).min() > 1e-5
    twin = inverse_range.spread_by_pairs(second, own[None], sigmas)[0]
    assert np.abs(spread - np.triu(twin)).max() < 1e-12 * twin.max()
    take_root(np.zeros((9, 9)), 4, L)
    assert not L.any(), "an error that is known to be zero has no direction"


@pytest.mark.parametrize("curvature", [True, False])
def test_the_noise_of_a_motion_moves_the_mean_by_half_of_its_second_derivatives(small, tilted, curvature):
    scenario, dt = small("herath2007-stereo", belief__sensor__mount=tilted), 0.5
    motion, sensor = scenario.belief.motion, scenario.belief.sensor
    state = robocentric_state.CentredState(
        np.append([1.0, 2.0, 0.5], Y[0]), 1e-6 * np.eye(6), problem_of(cs.simulate(scenario), scenario.belief),
        places={0: 3}, seen={0: 0},
    )  # fmt: skip
    filter_ = textbook.RobotCentredKalman("trial", inverse_range.Corrections(curvature=curvature))
    after = filter_.predict(state, Control(dt, DRIVE / dt, TURN / dt)).x[3:]
    second = differences(Y[0], sensor)[1]
    shift = 0.5 * dt**2 * (motion.sigma_v**2 * second[3, 3] + motion.sigma_omega**2 * second[4, 4])
    assert close(after, moved(np.append(Y[0], [0.0, 0.0]), sensor) + curvature * shift, 1e-8)
    assert np.abs(shift).max() > 1e-5


@pytest.mark.parametrize("y", Y)
def test_a_parked_landmark_has_the_derivatives_it_says(small, tilted, y):
    scenario = small("herath2007-stereo", belief__sensor__mount=tilted)
    trial = cs.simulate(scenario)
    clone, pose = np.array([1.0, -0.5, 0.4]), np.array([1.6, 0.3, -0.7])

    def seen(y, clone, pose):
        state = robocentric_state.CentredState(pose, np.zeros((3, 3)), problem_of(trial, scenario.belief))
        return robocentric_state.seen_from(state, clone, y)

    _, J, by_shift = seen(y, clone, pose)
    assert close(J, along(lambda y: seen(y, clone, pose)[0], y))
    assert close(by_shift, along(lambda xi: seen(y, inverse_range.moved_pose(clone, xi), pose)[0], np.zeros(3)))
    assert close(-by_shift, along(lambda xi: seen(y, clone, inverse_range.moved_pose(pose, xi))[0], np.zeros(3)))
    assert not close(by_shift, 0.0 * by_shift, 1e-3)


def test_the_left_jacobian_is_that_of_exp_up_to_the_third_order():
    pose = np.array([1.0, -0.5, 0.4])
    gaps = []
    for size in (0.2, 0.1):
        xi = size * np.array([0.8, -0.6, 0.5])
        ahead = along(lambda error, xi=xi: inverse_range.moved_pose(pose, xi + error), np.zeros(3))
        left = along(
            lambda error, xi=xi: inverse_range.moved_pose(inverse_range.moved_pose(pose, xi), error), np.zeros(3)
        )
        gaps.append(np.abs(ahead - left @ inverse_range.pose_jacobian(xi)).max())
    assert gaps[0] < 1e-3
    assert gaps[1] < gaps[0] / 6.0
    assert close(
        along(lambda error: inverse_range.moved_pose(pose, error), np.zeros(3)),
        np.linalg.inv(inverse_range.shift_matrix(pose)),
        1e-7,
    )


# --- conversion ----------------------------------------------------------------------------------

Z = np.array([[20.0, -35.0, 4.0], [-110.0, 60.0, 1.7], [5.0, 90.0, 12.0]])


def test_the_conversion_is_the_inverse_of_the_image_and_has_the_derivatives_it_says(sensor):
    y, J = inverse_range.converted(Z, sensor)
    assert close(inverse_range.imaged(y, sensor), Z, 1e-9)
    for i in range(len(Z)):
        assert close(J[i], along(lambda z: inverse_range.converted(z[None], sensor)[0][0], Z[i]))
        x = np.array([sensor.f * sensor.B / Z[i, 2]])
        point = np.array([x[0], -x[0] * Z[i, 0] / sensor.f, -x[0] * Z[i, 1] / sensor.f])
        assert y[i, 2] == pytest.approx(1.0 / np.linalg.norm(point))


def test_the_bias_is_that_of_quadrature(sensor):
    nodes, weights = np.polynomial.hermite_e.hermegauss(15)
    u, v = np.meshgrid(nodes * sensor.sigma[0], nodes * sensor.sigma[1], indexing="ij")
    weight = np.outer(weights, weights).ravel() / (2.0 * np.pi)
    steps = np.stack([u.ravel(), v.ravel(), np.zeros(u.size)], axis=1)
    said = inverse_range.conversion_bias(Z, sensor)
    for i in range(len(Z)):
        values = inverse_range.converted(Z[i] + steps, sensor)[0]
        exact = weight @ values - inverse_range.converted(Z[i][None], sensor)[0][0]
        assert np.abs(said[i] - exact).max() < 0.01 * np.abs(exact).max()
        assert np.abs(exact).max() > 1e-6


@pytest.mark.parametrize("expected", [0.6, 1.0, 1.69, 5.0, 31.5])
def test_a_disparity_freed_of_its_range_has_the_expected_mean_and_the_variance_it_says(expected):
    low, high, sigma = 1.0, 32.0, 0.65
    inside = truncnorm((low - expected) / sigma, (high - expected) / sigma, loc=expected, scale=sigma)
    d = np.array([inside.mean()])
    mean, variance = inverse_range.untruncated_disparity(d, np.array([expected]), sigma, (low, high))
    assert mean[0] == pytest.approx(expected)
    slope = inverse_range.untruncated_disparity(d + 1.0, np.array([expected]), sigma, (low, high))[0] - mean
    assert variance[0] == pytest.approx(slope[0] ** 2 * inside.var())


# --- charts of poses ------------------------------------------------------------------------------


def charted(rng, size):
    return rng.normal(size=(5, 3)), size * rng.normal(size=(5, 3))


@pytest.mark.parametrize("on", [0, 2, 3])
@pytest.mark.parametrize("chart", ["apart", "chained"])
def test_a_chart_has_the_derivatives_it_says(rng, chart, on):
    """Errors about the moved poses are those on the left; J_l is that of SE(2) to second order."""
    poses, xi = charted(rng, 0.01)
    function = inverse_range.poses_moved if chart == "apart" else partial(inverse_range.chained, on=on)
    moved, C = function(poses, xi)

    def error(flat):
        there = function(poses, flat.reshape(-1, 3))[0]
        turn = there[:, 2] - moved[:, 2]
        c, s = np.cos(turn), np.sin(turn)
        x, y = moved[:, 0], moved[:, 1]
        return np.stack([there[:, 0] - c * x + s * y, there[:, 1] - s * x - c * y, turn], axis=1).ravel()

    slope = along(error, xi.ravel())
    assert close(C, slope, 1e-5)
    assert not close(np.eye(len(C)), slope, 1e-3)


def test_the_motion_between_two_poses_of_a_chain_hangs_on_its_own_error(rng):
    poses, xi = charted(rng, 0.3)
    other = xi + rng.normal(size=3)  # another error before the first pose; the same from each to the next

    def between(errors):
        moved, _ = inverse_range.chained(poses, errors, on=3)
        turn = heading_matrix(-moved[3, 2])[:2, :2]
        return np.append(turn @ (moved[4, :2] - moved[3, :2]), moved[4, 2] - moved[3, 2])

    assert close(between(xi), between(other), 1e-12)
    apart = [inverse_range.poses_moved(poses, errors)[0] for errors in (xi, other)]
    gaps = [np.hypot(*(moved[4, :2] - moved[3, :2])) for moved in apart]
    assert abs(gaps[0] - gaps[1]) > 1e-3


def test_a_robot_moved_by_the_noise_of_its_last_motion_keeps_its_older_error():
    """T_true = Exp(xi) Exp(nu) T: about Exp(nu) T the error is xi, and was xi + nu about T to first order."""
    xi, nu, pose = np.array([0.05, -0.08, 0.1]), np.array([0.1, 0.2, 0.3]), np.array([2.0, -1.0, 0.7])
    poses, C = inverse_range.poses_moved(np.array([pose, pose]), np.array([nu, nu]), recency=True)
    assert close(
        inverse_range.moved_pose(poses[-1], C[3:, 3:] @ xi),
        inverse_range.moved_pose(inverse_range.moved_pose(pose, nu), xi),
    )
    turned = inverse_range.moved_pose(poses[-1], C[:3, :3] @ xi)  # a clone has no motion of its own
    assert not close(turned, inverse_range.moved_pose(poses[-1], xi), 1e-3)


def test_the_covariance_of_a_pose_is_that_of_its_exponential():
    """By quadrature, with a heading known to 0.4 rad: that of a linear error is off by 0.09 of its deviations."""
    pose, root = np.array([3.0, -2.0, 0.7]), np.array([[0.5, 0.0, 0.0], [-0.2, 0.3, 0.0], [-0.15, 0.25, 0.27]])
    C = root @ root.T
    nodes, weights = np.polynomial.hermite_e.hermegauss(12)
    grid = np.stack(np.meshgrid(nodes, nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 3)
    weight = np.einsum("i,j,k", weights, weights, weights).ravel() / weights.sum() ** 3
    M = inverse_range.shift_matrix(pose)
    errors = np.array([inverse_range.moved_pose(pose, M @ root @ x) - pose for x in grid])
    exact = (weight[:, None] * errors).T @ errors
    said, size = inverse_range.pose_moments(C), np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
    assert np.abs((said - exact) / size).max() < 0.02 < 0.05 < np.abs((C - exact) / size).max()
    kernel = C.copy()
    bend(kernel)
    assert close(kernel, said, 1e-15)
    on_a_line = np.outer([1.0, 2.0, 0.0], [1.0, 2.0, 0.0]) + np.diag([0.0, 0.0, 0.1])
    bend(kernel := on_a_line.copy())
    assert np.array_equal(kernel, inverse_range.pose_moments(on_a_line))
    assert np.array_equal(kernel, on_a_line)  # without full rank, as after the first step


def test_parking_waits_where_the_robot_saw_something_lately_and_sees_nothing(small):
    lost = {"truth__sensor__effects": [{"kind": "frames", "every": [1, 1, 2, 3]}]}
    scenario = small("herath2007-stereo", **CLOSING | lost)
    trial, made, late = cs.simulate(scenario, run=3), dict[bool, set[int]](), dict[bool, int]()
    for patience in (True, False):
        filter_ = textbook.RobotCentredKalman("trial", inverse_range.Corrections(patience=patience))
        state, made[patience], late[patience] = filter_.init(problem_of(trial, scenario.belief)), set(), 0
        for k in range(1, trial.steps + 1):
            known = set(state.parked)
            state, _ = filter_.update(filter_.predict(state, trial.control(k)), trial.observation(k))
            if set(state.parked) - known:
                made[patience].add(k - max(state.seen.values()))
                late[patience] += k % textbook.EVERY > 0
        ours, twin = rc.compiled(filter_).run(trial, scenario.belief), step_through(filter_, trial, scenario.belief)
        assert np.abs(ours.pose - twin.pose).max() < 1e-9
    assert 0 in made[True]
    assert not made[True] & set(range(1, textbook.UNSEEN))
    assert made[False] & {1, 2}
    assert late[True] > 0
    assert late[False] == 0


@pytest.mark.parametrize("on", [0, 1, 2])
def test_the_chain_of_the_kernel_is_that_of_its_twin(rng, on):
    m, clones, number = 2, 3, np.array([2, 0, 1])
    poses, xi = rng.normal(size=(4, 3)), 0.3 * rng.normal(size=(4, 3))
    moved, C = inverse_range.chained(poses, xi, on=on)
    pixels = Pixels(1.0, 1.0, 1.0, Growth(np.ones(1), np.ones(1)), 0.0, 0.0, False, False, False)
    update = Converting(pixels, 20, 12, clones, True, True, True, True, 0.0, 1.0, True, 0.0025, 0.0004, 0.03, 0.4, 0.8)
    room = converting_arrays(update, 3, 3, m, 30)
    room.number[:], room.on[0], size = number, on, 3 + 3 * (m + clones)
    places = np.array([3 + 3 * (m + c) for c in range(clones)] + [0])[:, None] + np.arange(3)
    room.delta[places] = xi
    local = make_clones(Parking(50, 20, 4e-4, np.inf, True, True), 3, 30, 200, 9)
    local.origin[number] = poses[:3]
    state = State(np.append(poses[3], np.zeros(27)), np.zeros((30, 30)), 30, 0, np.zeros(9, int))
    before = room.delta.copy()
    aim_chained(state, m, clones, local, room)
    assert close(room.frames, moved, 1e-13)
    assert close(room.delta[places].ravel(), C @ xi.ravel(), 1e-13)
    P = rng.normal(size=(size, size))
    P, cast, whole = P @ P.T, P @ P.T, np.eye(size)
    whole[np.ix_(places.ravel(), places.ravel())] = C
    cast_columns(cast.T, size, room.place, m, clones, room)
    cast_columns(cast, size, room.place, m, clones, room)
    assert close(cast, whole @ P @ whole.T, 1e-11)
    unchain(room.delta, m, clones, room)
    assert close(room.delta[places], before[places], 1e-13)


# --- kernel and twin -----------------------------------------------------------------------------

CLOSING = {  # a lap in 150 steps: what was parked is seen again
    "truth__path__radius": 1.2, "truth__steps": 320, "truth__sensor__range": (0.5, 3.0),
    "truth__landmarks__x": (-4.0, 4.0), "truth__landmarks__y": (-4.0, 4.0), "truth__landmarks__count": 30,
}  # fmt: skip


@pytest.mark.parametrize("left_out", ["nothing", *inverse_range.Corrections._fields])
def test_kernel_equals_its_twin_round_a_loop(small, tilted, left_out):
    changes = {"truth__sensor__mount": tilted, "belief__sensor__mount": tilted}
    scenario = small("herath2007-stereo", **CLOSING, **changes)
    trial = cs.simulate(scenario, run=3)
    which = inverse_range.Corrections()._replace(**({} if left_out == "nothing" else {left_out: False}))
    filter_ = rc.compiled(textbook.RobotCentredKalman("trial", which))
    ours, twin = filter_.run(trial, scenario.belief), step_through(filter_.textbook, trial, scenario.belief)
    assert ours.failure is None
    assert twin.failure is None
    size = np.abs(twin.covariance).max(axis=(1, 2), keepdims=True)
    sigma = np.sqrt(np.einsum("kii->ki", twin.covariance))
    assert (np.abs(ours.pose - twin.pose) / sigma).max() < 1e-9
    assert (np.abs(ours.covariance - twin.covariance) / size).max() < 1e-8
    assert np.nanmax(np.abs(ours.nis - twin.nis) / np.maximum(twin.nis, 1.0)) < 1e-8
    assert np.nanmax(np.abs(ours.log_det - twin.log_det)) < 1e-8
    assert np.allclose(ours.map.mean, twin.map.mean, rtol=1e-7, atol=1e-9)
    assert np.abs(ours.map.joint - twin.map.joint).max() < 1e-8 * np.abs(twin.map.joint).max()
    whole = rc.compiled(textbook.RobotCentredKalman("trial", inverse_range.Corrections())).run(trial, scenario.belief)
    same = np.array_equal(ours.covariance, whole.covariance)
    assert (left_out in ("nothing", "adrift", "waiting", "forgetting")) == bool(same)  # of these see below


@pytest.mark.parametrize("local_from", [10, 40])
def test_updating_locally_changes_no_number_round_a_loop(monkeypatch, small, local_from):
    """Clones are called back, freed and taken again while the rest is passive."""
    scenario = small("herath2007-stereo", **CLOSING)
    filter_ = rc.compiled(textbook.RobotCentredKalman("trial", inverse_range.Corrections()))
    for run in range(3):
        trial = cs.simulate(scenario, run=run)
        said = []
        for each in (local_from, 10**9):
            monkeypatch.setattr(filter_, "local_from", each)
            said.append(filter_.run(trial, scenario.belief))
        local, dense = said
        size = np.abs(dense.covariance).max(axis=(1, 2), keepdims=True)
        assert np.abs(local.pose - dense.pose).max() < 1e-10
        assert (np.abs(local.covariance - dense.covariance) / size).max() < 1e-9
        assert np.nanmax(np.abs(local.nis - dense.nis) / np.maximum(dense.nis, 1.0)) < 1e-9
        assert np.allclose(local.map.mean, dense.map.mean, rtol=1e-9, atol=1e-11)
        assert np.allclose(local.map.covariance, dense.map.covariance, rtol=1e-7, atol=1e-12)
        assert not np.array_equal(local.covariance, dense.covariance), "nothing was updated locally"


def test_worlds_in_which_it_was_overconfident_are_mended():
    """Two that `consistency challenge` found: with the pose turned by whole corrections the mean NEES of the first is
    10.6, without the chain that of the second 46.

    The means over 24 runs, of 3.2 and 5.4 with seed 7, spread by 0.35 and 1 between seeds: less than one in a million
    is above the limits.
    """
    scenario = cs.load_scenario("herath2007-stereo")

    def world(name, odometry, sensor, **changes):
        motion, sigma = scenario.truth.motion, [sensor * each for each in scenario.truth.sensor.sigma]
        both = {"sensor__sigma": sigma, "motion__sigma_v": odometry * motion.sigma_v,
                "motion__sigma_omega": odometry * motion.sigma_omega}  # fmt: skip
        noise = {f"{half}__{key}": value for half in ("truth", "belief") for key, value in both.items()}
        return scenario.variant(name, **noise, **changes)

    path = scenario.truth.path.model_dump(exclude={"shape"}) | {"shape": "figure-of-eight", "radius": 2.0}
    eight = world(
        "eight", 1.9, 0.63, truth__steps=950, truth__path=path | {"start": (0.0, 0.0), "heading": 0.0},
        truth__landmarks=scenario.truth.landmarks.model_dump() | {
            "count": 79, "seed": 20, "x": (-6.0, 6.0), "y": (-8.0, 8.0)},
        truth__sensor__range=(0.5, 5.3),
    )  # fmt: skip
    laps = world("laps", 2.0, 0.51, truth__steps=1000, truth__landmarks__count=49, truth__landmarks__seed=34,
                 truth__sensor__range=(0.5, 4.1))  # fmt: skip
    for each, most in ((eight, 5.5), (laps, 12.0)):
        results = cs.run_trials(each, ["parked-ekf-uvd"], runs=24, seed=7)
        assert len(results.failures) == 0
        assert results.estimates["nees"].mean() < most


def test_a_chain_that_does_not_settle_is_given_up(monkeypatch, small):
    scenario = small("herath2007-stereo", **CLOSING)
    trial = cs.simulate(scenario, run=3)
    filter_ = rc.compiled(textbook.RobotCentredKalman("trial", inverse_range.Corrections()))
    whole = filter_.run(trial, scenario.belief)
    for module in (rc, textbook):
        monkeypatch.setattr(module, "PASSES_CHAINED", 2)  # too few for one whose noise is raised
    ours, twin = filter_.run(trial, scenario.belief), step_through(filter_.textbook, trial, scenario.belief)
    assert ours.failure is None
    assert not np.array_equal(ours.pose, whole.pose)
    assert np.abs(ours.pose - twin.pose).max() < 1e-9


TURNING = {f"{half}__motion__sigma_omega": np.deg2rad(30.0) for half in ("truth", "belief")}


def test_a_landmark_in_doubt_waits_until_the_turn_is_known(small):
    """Above 0.05 rad after its first update it stays parked, and then until the turn is known to 0.02 rad."""
    scenario = small("herath2007-stereo", **CLOSING | TURNING | {"truth__landmarks__count": 25})
    filter_, counts = (
        textbook.RobotCentredKalman("trial", inverse_range.Corrections()),
        dict.fromkeys([(first, waits) for first in (True, False) for waits in (True, False)], 0),
    )
    for run in range(4):
        trial = cs.simulate(scenario, run=run)
        state = filter_.init(problem_of(trial, scenario.belief))
        for k in range(1, trial.steps + 1):
            ahead, observation = filter_.predict(state, trial.control(k)), trial.observation(k)
            state, _ = filter_.update(ahead, observation)
            for label in set(observation.landmarks.tolist()) & set(ahead.parked):
                if state.seen[label] < k:
                    continue
                is_first, in_doubt = k - ahead.seen[label] > 1, filter_._is_in_doubt(ahead, label)
                waits = label in state.parked
                counts[is_first, waits] += in_doubt
                assert in_doubt or not waits
                if waits:
                    limit = textbook.UNTURNED if is_first else textbook.DOUBT
                    at = state.places[label] + 2
                    assert robocentric_state.turn_variance(state, label) > limit**2
                    assert np.sqrt(state.P[at, at]) < textbook.KNOWN * state.x[at]
    assert min(counts.values()) > 2, counts


@pytest.mark.parametrize(
    "turn, of_rho, is_first, waits",
    [
        (0.06, 0.011, True, True),
        (0.06, 0.013, True, False),
        (0.04, 0.011, True, False),
        (0.04, 0.011, False, True),
        (0.04, 0.013, False, False),
        (0.01, 0.011, False, False),
    ],
)
def test_a_landmark_waits_only_where_its_distance_is_well_known(uvd, turn, of_rho, is_first, waits):
    """At rho = 0.4 per metre 3 % are 0.012."""
    P = np.diag(np.square([0.1, 0.1, np.hypot(0.1, turn), 0.1, 0.1, of_rho, 0.1, 0.1, 0.1]))
    P[2, 8] = P[8, 2] = 0.01
    x = np.append([1.0, 2.0, 0.5, 1.0, 0.2, 0.4], np.zeros(3))
    state = robocentric_state.CentredState(
        x, P, problem_of(cs.simulate(uvd), uvd.belief), places={0: 3}, parked={0: 1}, clones={1: 6}
    )
    limit = textbook.UNTURNED if is_first else textbook.DOUBT
    filter_ = textbook.RobotCentredKalman("trial", inverse_range.Corrections())
    assert filter_._waits(state, 0, limit) is waits
    local = make_clones(Parking(50, 20, 4e-4, np.inf, True, True), 3, 9, 100, 1)
    local.of[0], local.here[0], local.doubted[0] = 0, 6, 1
    local.step[0], local.earlier[0] = 9, 2 if is_first else 8
    limits = textbook.UNTURNED**2, textbook.DOUBT**2, textbook.KNOWN
    update = Converting(*[0] * 8, 0.0, 0.0, True, *limits, textbook.BLURRED, textbook.NEAR)
    assert bool(_stays(update, 0, State(x, P, 9, 0, np.array([3])), local)) is waits
    local.doubted[0] = 0
    assert not _stays(update, 0, State(x, P, 9, 0, np.array([3])), local)


def slow_steps(**changes):
    """A step a second: landmarks are driven through, and returns do not settle."""
    landmarks = {"layout": "uniform", "count": 120, "seed": 505, "x": (-8, 8), "y": (-8, 8), "z": (-1.25, 1.25)}
    return cs.load_scenario("herath2007-stereo").variant(
        "slow steps", truth__landmarks=landmarks, truth__dt=1.0, truth__steps=80, **changes
    )


def returns(tilted):
    return {
        "waits": cs.load_scenario("herath2007-stereo").variant("waits", **CLOSING | TURNING),
        "slow": slow_steps(),
        "slow, tilted": slow_steps(truth__sensor__mount=tilted, belief__sensor__mount=tilted),
    }


@pytest.mark.parametrize("local_from", [10, 10**9])
@pytest.mark.parametrize("world", ["waits", "slow", "slow, tilted"])
def test_kernel_equals_its_twin_where_landmarks_wait_or_are_forgotten(monkeypatch, tilted, world, local_from):
    scenario, filter_ = (
        returns(tilted)[world],
        rc.compiled(textbook.RobotCentredKalman("trial", inverse_range.Corrections())),
    )
    monkeypatch.setattr(filter_, "local_from", local_from)
    trial = cs.simulate(scenario, run=2)
    ours, twin = filter_.run(trial, scenario.belief), step_through(filter_.textbook, trial, scenario.belief)
    sigma = np.sqrt(np.einsum("kii->ki", twin.covariance))
    assert (np.abs(ours.pose - twin.pose) / np.maximum(sigma, 1e-9)).max() < 1e-9
    assert ours.nis_dof.tolist() == twin.nis_dof.tolist()
    assert np.nanmax(np.abs(ours.nis - twin.nis) / np.maximum(twin.nis, 1.0)) < 1e-8
    assert ours.map.landmarks.tolist() == twin.map.landmarks.tolist()
    assert np.allclose(ours.map.mean, twin.map.mean, rtol=1e-7, atol=1e-9)
    assert np.abs(ours.map.joint - twin.map.joint).max() < 1e-8 * np.abs(twin.map.joint).max()
    for name in ("waiting", "forgetting") if world == "slow" else ("waiting",) if world == "waits" else ():
        which = inverse_range.Corrections()._replace(**{name: False})
        without = rc.compiled(textbook.RobotCentredKalman("trial", which)).run(trial, scenario.belief)
        assert not np.array_equal(without.pose, ours.pose), name


def test_what_is_driven_through_is_forgotten_and_what_does_not_settle_is_left_out():
    scenario = slow_steps()
    trial, filter_ = cs.simulate(scenario, run=2), textbook.RobotCentredKalman("trial", inverse_range.Corrections())
    state, gone, again, left_out = filter_.init(problem_of(trial, scenario.belief)), set(), 0, 0
    for k in range(1, trial.steps + 1):
        ahead, observation = filter_.predict(state, trial.control(k)), trial.observation(k)
        lost = set(state.places) - set(ahead.places)
        assert not lost & set(state.parked)
        assert all(k - state.seen[label] > 1 for label in lost)
        assert len(ahead.x) == len(state.x) - 3 * len(lost)
        gone |= lost
        labels = set(observation.landmarks.tolist())
        state, info = filter_.update(ahead, observation)
        known = labels & set(ahead.places)
        unused = {label for label in known if state.seen[label] < k}
        assert len(info.innovation) == 3 * (len(known) - len(unused))
        assert unused <= set(ahead.parked) & set(state.parked)
        again += len(labels & gone)
        gone -= labels
        left_out += len(unused)
    assert again > 0
    assert left_out > 0


@pytest.mark.parametrize(
    "y, sd, fresh, is_lost",
    [
        ([1.0, 0.2, 0.9], [0.1, 0.1, 0.3], 0.0, False),
        ([1.0, 0.2, -0.1], [0.1, 0.1, 0.2], 0.0, True),
        ([1.0, 0.2, 0.4], [0.41, 0.1, 0.1], 0.0, True),
        ([1.0, 0.2, 0.4], [0.41, 0.1, 0.1], 0.2, False),
        ([1.0, 0.2, 0.4], [0.1, 0.41, 0.1], 0.2, True),
        ([1.0, 0.2, 0.7], [0.1, 0.1, 0.4], 0.0, False),
        ([1.0, 0.2, 0.9], [0.1, 0.1, 0.4], 0.0, True),
    ],
)
def test_a_landmark_is_lost_where_a_linear_model_no_longer_holds(uvd, y, sd, fresh, is_lost):
    x, P = np.append([1.0, 2.0, 0.5], y), np.diag(np.square([0.1, 0.1, 0.1, *sd]))
    state = robocentric_state.CentredState(x, P, problem_of(cs.simulate(uvd), uvd.belief), places={0: 3})
    filter_ = textbook.RobotCentredKalman("trial", inverse_range.Corrections())
    update = Converting(*[0] * 8, 0.0, 0.0, True, 0.0, 0.0, 0.0, textbook.BLURRED, textbook.NEAR)
    assert filter_._is_driven_through(state, 0, fresh) is is_lost
    assert bool(_is_driven_through(update, x, P, 3, fresh)) is is_lost


def test_a_long_return_is_found_or_left_out():
    """Blind for 62 s. With updates that do not settle 5 of 40 runs are lost: NEES beyond 100."""
    points = np.random.default_rng(3).uniform((8.0, -1.5, -1.25), (13.0, 4.0, 1.25), (14, 3))
    path = {"shape": "circle", "radius": 11.0, "start": (11.0, 0.0), "heading": np.pi / 2.0, "speed": 1.0}
    noise = {"sigma_v": 0.1, "sigma_omega": np.deg2rad(10.0)}
    scenario = cs.load_scenario("herath2007-stereo").variant(
        "long return", truth__path=path, truth__steps=800,
        truth__landmarks={"layout": "listed", "points": points.tolist()},
        **{f"{side}__motion__{key}": value for side in ("truth", "belief") for key, value in noise.items()},
    )  # fmt: skip
    lost = []
    for waiting in (True, False):
        which = inverse_range.Corrections(waiting=waiting)
        nees = record_of(
            cs.run_trials(scenario, [rc.compiled(textbook.RobotCentredKalman("trial", which))], 40, 5, 1), "trial"
        ).errors.nees
        lost.append(int((nees[:, -1] > 100.0).sum()))
    assert lost[0] == 0
    assert lost[1] > 0


def test_a_return_whose_place_is_hardly_known_finds_the_robot():
    """One landmark, 2 m away, returns where the robot is known to 2.5 m and 0.5 rad."""
    landmarks = {"layout": "uniform", "count": 44, "seed": 2007, "x": (-8, 8), "y": (-8, 8), "z": (-1.25, 1.25)}
    tilted = {"position": (0.0, 0.0, 0.0), "rotation": (0.0, np.deg2rad(40.0), 0.0)}
    noise = {"sigma_v": 0.07, "sigma_omega": np.deg2rad(7.0)}
    scenario = cs.load_scenario("herath2007-stereo").variant(
        "hardly known", truth__landmarks=landmarks, truth__dt=0.42, truth__steps=130, truth__sensor__range=(0.5, 2.5),
        **{f"{side}__motion__{key}": value for side in ("truth", "belief") for key, value in noise.items()},
        **{f"{side}__sensor__mount": tilted for side in ("truth", "belief")},
    )  # fmt: skip
    lost = []
    for tempering in (True, False):
        which = inverse_range.Corrections(tempering=tempering, waiting=tempering)
        filter_ = rc.compiled(textbook.RobotCentredKalman("trial", which))
        runs = cs.run_trials(scenario, [filter_], 100, 778, 1)
        nees = record_of(runs, "trial").errors.nees
        lost.append(int((nees[:, -1] > 300.0).sum()))
        trial = cs.simulate(scenario, run=3, seed=778)
        ours, twin = filter_.run(trial, scenario.belief), step_through(filter_.textbook, trial, scenario.belief)
        sigma = np.sqrt(np.einsum("kii->ki", twin.covariance))
        assert (np.abs(ours.pose - twin.pose) / np.maximum(sigma, 1e-9))[5:].max() < 1e-6
    assert lost[0] == 0
    assert lost[1] >= 4


def test_a_return_whose_distance_is_hardly_known_turns_nothing_around():
    """A landmark that was seen 8 m away by a baseline of 5 cm is parked, and seen again as the robot passes it."""
    path = {"shape": "rounded-rectangle", "length": 8.0, "width": 5.0, "corner_radius": 1.0, "speed": 0.5}
    landmarks = {"layout": "uniform", "count": 49, "seed": 2008, "x": (-8, 8), "y": (-6.5, 6.5), "z": (-1.25, 1.25)}
    scenario = cs.load_scenario("herath2007-stereo").variant(
        "passed", truth__path=path | {"start": (0.0, -2.5), "heading": 0.0}, truth__landmarks=landmarks,
        truth__sensor__range=(0.5, 8.0), truth__sensor__B=0.05, belief__sensor__B=0.05,
    )  # fmt: skip
    trial, worst = cs.simulate(scenario, run=75, seed=805), []
    for tempering in (True, False):
        which = inverse_range.Corrections(tempering=tempering, waiting=tempering)
        ours = rc.compiled(textbook.RobotCentredKalman("trial", which)).run(trial, scenario.belief)
        worst.append(np.abs(ours.pose - trial.truth[1:])[324:330, 2].max())
    assert worst[0] < 0.1
    assert worst[1] > 1.0


def test_where_the_heading_is_little_known_a_return_tells_nothing_of_the_world():
    """Landmarks are parked and seen again within ten steps, where the robot is known to 1.5 m and 0.45 rad."""
    path = {"shape": "rounded-rectangle", "length": 8.27, "width": 5.17, "corner_radius": 1.01, "speed": 0.5}
    landmarks = {"layout": "uniform", "count": 100, "seed": 40, "x": (-8.1, 8.1), "y": (-6.6, 6.6), "z": (-1.25, 1.25)}
    noise = {"sigma_v": 0.1, "sigma_omega": np.deg2rad(10.0)}
    scenario = cs.load_scenario("herath2007-stereo").variant(
        "adrift", truth__path=path | {"start": (0.0, -2.585), "heading": 0.0}, truth__landmarks=landmarks,
        truth__dt=0.41, truth__steps=110, truth__sensor__range=(0.5, 2.6),
        **{f"{side}__motion__{key}": value for side in ("truth", "belief") for key, value in noise.items()},
    )  # fmt: skip
    ratio, trial = [], cs.simulate(scenario, run=3, seed=779)
    for adrift in (True, False):
        filter_ = rc.compiled(
            textbook.RobotCentredKalman("trial", inverse_range.Corrections(adrift=adrift, waiting=adrift))
        )
        nees = record_of(cs.run_trials(scenario, [filter_], 100, 779, 1), "trial").errors.nees
        ratio.append(float(np.median(nees[:, -1])) / 3.0)
        ours, twin = filter_.run(trial, scenario.belief), step_through(filter_.textbook, trial, scenario.belief)
        sigma = np.sqrt(np.einsum("kii->ki", twin.covariance))
        assert (np.abs(ours.pose - twin.pose) / np.maximum(sigma, 1e-9))[5:].max() < 1e-6
    assert ratio[0] < 2.0
    assert ratio[1] > 5.0


def test_landmarks_are_parked_and_come_back(small):
    scenario = small("herath2007-stereo", **CLOSING)
    trial, filter_ = cs.simulate(scenario, run=3), textbook.RobotCentredKalman("trial", inverse_range.Corrections())
    state = filter_.init(problem_of(trial, scenario.belief))
    parked, back = set(), set()
    for k in range(1, trial.steps + 1):
        before = dict(state.parked)
        state, _ = filter_.update(filter_.predict(state, trial.control(k)), trial.observation(k))
        parked |= set(state.parked)
        back |= set(before) - set(state.parked)
        assert set(state.clones) == set(state.parked.values())
        assert len(state.x) == 3 + 3 * (len(state.places) + len(state.clones))
    assert len(parked) > 5
    assert len(back) > 5


def test_the_place_of_a_clone_that_is_needed_no_more_is_free_again():
    clones = make_clones(Parking(50, 20, 4e-4, np.inf, True, True, start=10), 3, 36, 100, 2)
    clones.factors.Phi[:] = 1.0
    clones.of[:], clones.uses[0], clones.here[0] = 0, 2, 9
    state = State(np.ones(12), np.ones((12, 12)), 12, 9, np.array([3, 6]))
    unpark(0, state, clones)
    assert clones.uses[0] == 1
    assert state.P.all()
    unpark(1, state, clones)
    assert clones.of.tolist() == [-1, -1]
    assert clones.uses[0] == 0
    assert not state.P[:9, 9:].any()
    assert not np.triu(state.P[9:, 9:]).any()
    assert not state.x[9:].any()
    assert state.P[:9, :9].all()
    assert not clones.factors.Phi[9:12, :9].any()
    assert clones.factors.Phi[:9].all()


def test_the_state_is_split_only_where_the_step_has_room():
    """Room for 18 variables: those of the robot, of four landmarks in use, and of one more."""
    clones = make_clones(Parking(50, 20, 4e-4, np.inf, True, True, start=10), 3, 36, 100, 9)
    clones.of[4:] = 0
    whole = State(np.ones(36), np.eye(36), 36, 0, np.array([3, 6, 9, 12, 15, 18, -1, -1, -1]))
    assert len(clones.factors.x) == 18
    for labels, worth in (([0, 1], True), ([6], True), ([6, 7], False), ([4], False)):
        assert _is_worth_it(whole, np.array(labels), clones) == worth


# --- bad input -----------------------------------------------------------------------------------


def test_a_belief_without_search_range_is_refused(small):
    scenario = small("herath2007-stereo", belief__sensor__disparity=None)
    with pytest.raises(cs.InputError, match=r"key 'belief.sensor.disparity_px': missing; filter 'parked-ekf-uvd'"):
        cs.run_trials(scenario, ["parked-ekf-uvd"], runs=1)
