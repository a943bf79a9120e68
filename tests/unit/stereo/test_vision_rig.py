"""The stereo rig: projection, triangulation, and what they refuse."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from consistency.referee.errors import InputError
from consistency.referee.geometry import rotation
from consistency.vision import PointError, StereoRig, triangulable, triangulate, triangulation_covariance

K = np.array([[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]])
SIZE = (640, 480)
TURN, BASE = rotation(0.04, 0.016, 0.014), np.array([0.385, 0.007, 0.0])
RIG = StereoRig(K, K, TURN, BASE, SIZE)
LEVEL = StereoRig(K, K, np.eye(3), [0.4, 0.0, 0.0], SIZE)


def test_projection_into_a_level_rig():
    """u = f x / z + u0, and a disparity of f B / z."""
    assert LEVEL.project([[1.0, -0.5, 5.0]]) == pytest.approx(np.array([[420.0, 189.0, 380.0, 189.0]]))


def test_right_camera_has_the_pose_that_is_given():
    """A point on the right camera's optical axis is seen at its principal point; eq. 2.2 read literally misses it."""
    p = TURN @ [0.0, 0.0, 7.0] + BASE
    assert RIG.project(p[None])[0, 2:] == pytest.approx([320.0, 240.0])
    literal = K @ (TURN @ p + BASE)
    assert np.abs(literal[:2] / literal[2] - [320.0, 240.0]).max() > 20


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(1.5, 300.0), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_triangulation_inverts_projection(x, y, z, roll, yaw):
    rig = StereoRig(K, 0.9 * K + np.diag([0, 0, 0.1]), rotation(roll, -0.05, yaw / 3), [0.4, 0.01, -0.02], SIZE)
    point = np.array([[x, y, z]])
    assert np.abs(triangulate(rig, rig.project(point)) - point).max() < 1e-8 * z**2


def test_no_points_are_no_error():
    nothing = np.zeros((0, 4))
    assert triangulate(RIG, nothing).shape == (0, 3)
    assert triangulation_covariance(RIG, nothing, np.eye(4)).shape == (0, 3, 3)


@pytest.mark.parametrize(
    "uv, why",
    [
        ([400.0, 240.0, 400.0, 240.0], "zero disparity: at infinity"),
        ([380.0, 240.0, 400.0, 240.0], "negative disparity: behind"),
        ([400.0, 240.0, 400.0, 250.0], "no disparity along the baseline"),
    ],
)
def test_points_that_are_not_in_front_are_named(uv, why):
    matches = np.array([[420.0, 240.0, 400.0, 240.0], uv])
    with pytest.raises(PointError, match="match 1 has zero or negative disparity"):
        triangulate(LEVEL, matches)
    with pytest.raises(PointError, match="match 1"):
        triangulation_covariance(LEVEL, matches, np.eye(4))
    assert triangulable(LEVEL, matches).tolist() == [True, False], why


@pytest.mark.parametrize("disparity", [0.0, 1e-12, 1e-9, 1e-6])
@pytest.mark.parametrize("rows", [0.0, 1.0])
def test_parallel_rays_meet_nowhere_in_the_image(disparity, rows, rng):
    """Rounding leaves A'A a small determinant of either sign."""
    pixels = rng.uniform([0.0, 0.0], SIZE, (5000, 2))
    uv = np.column_stack([pixels, pixels - [disparity, rows]])
    assert not triangulable(LEVEL, uv).any()
    turned = StereoRig(K, K, rotation(0.1, -0.1, 0.2), [0.4, 0.1, -0.05], SIZE)
    rays = np.column_stack([rng.uniform(-0.5, 0.5, (5000, 2)), np.ones(5000)])
    left, right = rays @ K.T, rays @ turned.R @ K.T
    assert not triangulable(turned, np.column_stack([left[:, :2] / left[:, 2:], right[:, :2] / right[:, 2:]])).any()


def test_far_points_are_still_points(rng):
    p = np.column_stack([rng.uniform(-0.5, 0.5, (5000, 2)), np.ones(5000)]) * 3e5 * LEVEL.baseline
    np.testing.assert_allclose(triangulate(LEVEL, LEVEL.project(p)), p, rtol=0.01)


@pytest.mark.parametrize("z", [0.0, -4.0])
def test_projection_refuses_points_behind(z):
    with pytest.raises(PointError, match="number 1 is at or behind a camera"):
        RIG.project([[0.0, 0.0, 4.0], [0.1, 0.1, z]])


def test_a_point_behind_the_right_camera_only():
    across = StereoRig(K, K, rotation(0.0, -0.5, 0.0), [3.0, 0.0, 0.0], SIZE)
    with pytest.raises(PointError):
        across.project([[9.0, 0.0, 0.5]])


BAD = [
    ({"K_left": np.eye(2)}, "K_left: shape"),
    ({"K_left": -K}, "K_left: give"),
    ({"K_right": K.T}, "K_right: give"),
    ({"K_right": np.diag([0.0, 510.0, 1.0])}, "positive fu"),
    ({"R": 1.01 * np.eye(3)}, "R: not a rotation"),
    ({"R": np.diag([1.0, 1.0, -1.0])}, "determinant"),
    ({"R": np.full((3, 3), np.nan)}, "R: not finite"),
    ({"t": np.zeros(3)}, "no baseline"),
    ({"t": "far"}, "t: not an array of numbers"),
    ({"image_size": (640,)}, "image_size"),
    ({"image_size": (640, 0)}, "image_size"),
]


@pytest.mark.parametrize("change, message", BAD)
def test_a_rig_that_is_none(change, message):
    good = {"K_left": K, "K_right": K, "R": TURN, "t": BASE, "image_size": SIZE}
    with pytest.raises(InputError, match=message):
        StereoRig(**(good | change))


def test_a_rig_cannot_be_changed():
    given_, rig = TURN.copy(), StereoRig(K, K, TURN, BASE, SIZE)
    with pytest.raises(ValueError, match="read-only"):
        rig.R[0, 0] = 2.0
    assert (given_ == TURN).all()


@pytest.mark.parametrize(
    "S, message",
    [
        (np.eye(3), r"S_uv: shape \(3, 3\)"),
        (np.diag([1.0, 1.0, 1.0, -0.1]), "not positive semidefinite"),
        (np.eye(4) + np.eye(4, k=1), "not symmetric"),
        (np.full((4, 4), np.nan), "not finite"),
    ],
)
def test_covariances_of_pixels_are_checked(S, message):
    with pytest.raises(InputError, match=message):
        triangulation_covariance(RIG, RIG.project([[0.0, 0.0, 4.0]]), S)


def test_matches_are_checked():
    with pytest.raises(InputError, match=r"uv: shape \(3,\)"):
        triangulate(RIG, np.zeros(3))
    with pytest.raises(InputError, match=r"uv: not finite at index \(1, 2\)"):
        triangulate(RIG, np.where(np.arange(8).reshape(2, 4) == 6, np.nan, 1.0))


def test_covariance_in_a_level_rig():
    """On the axis, z = f B / d: sigma_z = z^2 / (f B) sigma_d, Matthies & Shafer (1987); no noise, no covariance."""
    uv = LEVEL.project([[0.0, 0.0, 8.0]])
    S = triangulation_covariance(LEVEL, uv, 0.25 * np.eye(4))[0]
    assert S[2, 2] == pytest.approx((8.0**2 / (500 * 0.4)) ** 2 * 0.5)
    assert S[1, 1] == pytest.approx((8.0 / 510) ** 2 * 0.25 / 2)
    assert triangulation_covariance(LEVEL, uv, np.zeros((4, 4))).max() == 0.0


def test_inside_the_images():
    assert RIG.inside(np.array([[0, 0, 639, 479], [-1, 0, 5, 5], [0, 0, 640, 5.0]])).tolist() == [True, False, False]
