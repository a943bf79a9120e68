"""f, h and their inverses: Jacobians by complex step, signs, mounts, and the kernels composed from them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from consistency.bench.filters.filter_inputs import sensor_noise
from consistency.bench.filters.kernel import part_functions
from consistency.bench.filters.kernel.part_functions import State
from consistency.bench.filters.kernel.update_steps import (
    linearise,
    linearise_at,
    make_scratch,
    observe,
    place_observed,
)
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.methods.kf import Reference, place_about_reference
from consistency.bench.filters.textbook.basics import PointSensor, motion_jacobians
from consistency.bench.protocols import Problem
from consistency.bench.scenario import Belief, BelievedMotion, BelievedSensor, Mount, models
from consistency.bench.types import Control

F, B = 150.0, 0.09
METRES = st.floats(-20.0, 20.0)
AHEAD = st.floats(0.3, 30.0)
PIXELS = st.floats(-200.0, 200.0)
DISPARITY = st.floats(0.5, 60.0)
ANGLE = st.floats(-7.0, 7.0)


def complex_step(function, at):
    """Jacobian by Im f(x + i h) / h, exact to rounding (Squire & Trapp 1998)."""
    columns = []
    for j in range(len(at)):
        x = np.array(at, complex)
        x[j] += 1e-30j
        columns.append(np.imag(np.array(function(x))) / 1e-30)
    return np.column_stack(columns)


def close(a, b, tolerance=1e-12):
    """Equal within ``tolerance`` of the largest entry."""
    return bool(np.abs(np.subtract(a, b)).max() <= tolerance * max(1.0, np.abs(b).max()))


# --- motion ------------------------------------------------------------------------------------


@given(METRES, METRES, ANGLE, st.floats(0.01, 1.0), st.floats(-3.0, 3.0), st.floats(-2.0, 2.0))
def test_motion_jacobians(x, y, heading, dt, v, omega):
    exact = complex_step(lambda p: models.unicycle(*p, dt, v, omega), np.array([x, y, heading]))
    assert close(np.array(models.unicycle_jacobian(heading, dt, v)), exact[:2, 2])
    G = complex_step(lambda c: models.unicycle(x, y, heading, dt, *c), np.array([v, omega]))
    twin_F, twin_G = motion_jacobians(np.array([x, y, heading]), Control(dt, v, omega))
    assert close(twin_F, exact)
    assert close(twin_G, G)
    xx, xy, yy, hh = models.unicycle_noise(heading, dt, 0.3, 0.2)
    assert close(np.array([[xx, xy, 0], [xy, yy, 0], [0, 0, hh]]), G @ np.diag([0.09, 0.04]) @ G.T)


def test_robot_drives_along_its_heading_and_turns_counter_clockwise():
    assert np.allclose(models.unicycle(1.0, 2.0, np.pi / 2, 0.5, 2.0, 0.4), (1.0, 3.0, np.pi / 2 + 0.2))


def test_dead_reckoning_repeats_single_steps(rng):
    controls = np.column_stack([rng.uniform(0.05, 0.2, 40), rng.normal(size=(40, 2))])
    path = models.dead_reckoning(np.array([1.0, -2.0, 0.7]), controls)
    pose = path[0]
    for k, control in enumerate(controls):
        pose = np.array(models.unicycle(*pose, *control))
        assert np.allclose(path[k + 1], pose, rtol=0, atol=1e-12)


# --- stereo --------------------------------------------------------------------------------------


@given(AHEAD, METRES, METRES)
def test_projection_jacobian(x, y, z):
    exact = complex_step(lambda p: models.project(*p, F, B), np.array([x, y, z]))
    assert close(np.reshape(models.project_jacobian(x, y, z, F, B), (3, 3)), exact)


@given(PIXELS, PIXELS, DISPARITY)
def test_triangulation_jacobian(u, v, d):
    exact = complex_step(lambda p: models.triangulate(*p, F, B), np.array([u, v, d]))
    assert close(np.reshape(models.triangulate_jacobian(u, v, d, F, B), (3, 3)), exact)


@given(AHEAD, METRES, METRES)
def test_triangulation_inverts_projection(x, y, z):
    back = models.triangulate(*models.project(x, y, z, F, B), F, B)
    assert np.allclose(back, (x, y, z), rtol=1e-12, atol=1e-12)


def test_signs_of_pixels():
    """Left of the axis u < 0, above it v < 0, and the disparity is f B / x."""
    u, v, d = models.project(2.0, 0.5, 0.25, F, B)
    assert (u, v, d) == (-37.5, -18.75, F * B / 2.0)


def test_published_nominal_pixel():
    """Herath et al. (2007) sec. 4.5: a point 10 m ahead and 1 m aside is seen at |u| = 15 px.

    The text prints d = 1.32 px; with its f = 150 px and B = 0.09 m, f B / x is 1.35 px.
    """
    u, _, d = models.project(10.0, 1.0, 0.0, F, B)
    assert abs(u) == pytest.approx(15.0)
    assert d == pytest.approx(1.35)


# --- frames ------------------------------------------------------------------------------------


@given(METRES, METRES, ANGLE, METRES, METRES, METRES)
def test_robot_frame_inverse(px, py, heading, lx, ly, lz):
    back = models.to_world(px, py, heading, *models.to_robot(px, py, heading, lx, ly, lz))
    assert np.allclose(back, (lx, ly, lz), rtol=0, atol=1e-12 * 100)


def test_robot_frame_signs():
    """A robot facing world +y: a point further along y is ahead, one at smaller x is to the right."""
    assert np.allclose(models.to_robot(1.0, 1.0, np.pi / 2, 1.0, 3.0, 0.5), (2.0, 0.0, 0.5))
    assert np.allclose(models.to_robot(1.0, 1.0, np.pi / 2, 2.0, 1.0, 0.0), (0.0, -1.0, 0.0))


@given(METRES, METRES, METRES, ANGLE, st.floats(-1.5, 1.5), ANGLE)
def test_mount_inverse(x, y, z, roll, pitch, heading):
    mount = Mount(position=(0.3, -0.2, 0.5), rotation=(roll, pitch, heading)).packed()
    there = models.to_sensor(x, y, z, mount)
    assert np.allclose(models.from_sensor(*there, mount), (x, y, z), rtol=0, atol=1e-11)
    assert np.linalg.norm(there) == pytest.approx(np.linalg.norm(np.subtract((x, y, z), mount[:3])), abs=1e-11)


# --- sensors: textbook and kernels ---------------------------------------------------------------


def _sensor(tilted):
    return BelievedSensor(model="uvd", sigma=(1.0, 1.0, 0.5), f=F, B=B, mount=Mount.model_validate(tilted))


CASES = [
    (np.array([1.0, -2.0, 0.7]), np.array([4.0, 2.0, 0.9])),
    (np.array([-3.0, 0.5, -2.2]), np.array([-4.5, -3.0, -0.4])),
    (np.array([0.0, 0.0, 40.0]), np.array([-1.0, 3.5, 1.1])),
]


@pytest.mark.parametrize("pose, landmark", CASES)
@pytest.mark.parametrize("uvd", [False, True])
def test_textbook_sensor_jacobians(pose, landmark, uvd, tilted):
    sensor = PointSensor(_sensor(tilted), uvd)
    Hp, Hl = sensor.jacobians(pose, landmark)
    assert close(Hp, complex_step(lambda p: sensor.measure(p, landmark), pose))
    assert close(Hl, complex_step(lambda p: sensor.measure(pose, p), landmark))
    z = sensor.measure(pose, landmark)
    where, Jp, Jz = sensor.locate(pose, z)
    assert close(where, landmark)
    # the inverse function theorem: h(pose, g(pose, z)) = z
    assert close(Hl @ Jz, np.eye(3))
    assert close(Hp + Hl @ Jp, np.zeros((3, 3)), 1e-11)


def _slam(sensor, uvd):
    belief = Belief(motion=BelievedMotion(sigma_v=0.1, sigma_omega=0.1), sensor=sensor)
    return ekf.parts(Problem(belief, np.zeros(3)), np.zeros((0, 3)), uvd)


@pytest.mark.parametrize("pose, landmark", CASES)
@pytest.mark.parametrize("uvd", [False, True])
def test_kernels_equal_the_textbook_sensor(pose, landmark, uvd, tilted):
    belief = _sensor(tilted)
    sensor, slam = PointSensor(belief, uvd), _slam(belief, uvd)
    frame, expected = part_functions.robot_frame(pose), sensor.measure(pose, landmark)
    z, Hp, Hl = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    observe(slam, frame, landmark, z)
    assert close(z, expected)
    linearise_at(slam, frame, landmark, z, Hp, Hl)
    assert close(z, expected)
    for kernel, textbook in zip((Hp, Hl), sensor.jacobians(pose, landmark), strict=True):
        assert close(kernel, textbook)
    where, work = np.empty(3), make_scratch(slam, 6, 1, 1, 1)
    place_observed(slam, pose, expected, where, work)
    for kernel, textbook in zip((where, work.Jp, work.Jz), sensor.locate(pose, expected), strict=True):
        assert close(kernel, textbook)


def test_linear_kernel_is_the_first_order_expansion(tilted):
    belief = _sensor(tilted)
    sensor = PointSensor(belief, uvd=False)
    pose0, landmark0 = CASES[0]
    reference = Reference(np.array([pose0, pose0]), np.array([landmark0]))
    slam = _slam(belief, uvd=False)._replace(point=reference)
    Hp0, Hl0 = sensor.jacobians(pose0, landmark0)
    step, move = np.array([0.4, -0.3, 0.5]), np.array([0.2, 0.6, -0.1])
    z, Hp, Hl, work = np.empty(3), np.empty((3, 3)), np.empty((3, 3)), make_scratch(slam, 6, 1, 1, 1)
    linearise(slam, pose0 + step, landmark0 + move, 0, 0, z, Hp, Hl, work)
    assert close(Hp, Hp0)
    assert close(Hl, Hl0)
    assert close(z, sensor.measure(pose0, landmark0) + Hp0 @ step + Hl0 @ move)
    x = np.concatenate([pose0 + step, np.empty(3)])
    place_about_reference(reference, slam, State(x, np.zeros((6, 6)), 3, 0, np.zeros(1, int)), 0, 0, z, work)
    assert close(x[3:], landmark0 + move)
    assert close(Hl0 @ work.Jz, np.eye(3))
    assert close(Hp0 + Hl0 @ work.Jp, np.zeros((3, 3)))
    # negative control: so large a step is not linear
    assert not close(z, sensor.measure(pose0 + step, landmark0 + move), 1e-3)


def test_converted_noise_is_propagated_to_first_order(rng):
    """R = J diag(sigma^2) J' with J the Jacobian of eq. 21 at the measurement."""
    sensor = BelievedSensor(model="uvd", sigma=(1.34, 1.53, 0.65), f=F, B=B)
    z = np.column_stack([rng.uniform(-100, 100, (6, 2)), rng.uniform(2, 20, 6)])
    points, R = sensor_noise(z, sensor, converted=True)
    for i, measured in enumerate(z):
        J = complex_step(lambda p: models.triangulate(*p, F, B), measured)
        assert close(R[i], J @ np.diag(np.square(sensor.sigma)) @ J.T)
        assert close(points[i], np.array(models.triangulate(*measured, F, B)))
    same, R = sensor_noise(z, sensor, converted=False)
    assert np.array_equal(same, z)
    assert np.array_equal(R, np.broadcast_to(np.diag(np.square(sensor.sigma)), (6, 3, 3)))
