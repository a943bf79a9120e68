"""Motions from rendered images, tracks, trajectories and the planar log."""

import dataclasses
import os
import sys
from pathlib import Path

import numpy as np
import pytest
import scene
from numpy.testing import assert_allclose, assert_array_equal
from recorded import read_recordings
from scipy.spatial.transform import Rotation

import consistency as cs
from consistency.bench.store.recorded_log import read_log
from consistency.referee.geometry import spatial_error
from consistency.referee.system import read_manifest
from consistency.stereo.frontend import FrontendOptions, write_frontend_log
from consistency.stereo.frontend.camera_truth import read_truth
from consistency.stereo.frontend.images_to_log import (
    CAMERA,
    in_robot_axes,
    motions_text,
    planar_motions,
    planar_path,
    relative,
    robot_axes,
)
from consistency.stereo.visual_odometry.odometry import trajectory, visual_odometry
from consistency.stereo.visual_odometry.relative_motion import ESTIMATORS, MotionSettings, RelativeMotion
from consistency.stereo.visual_odometry.sequence import read_sequence
from consistency.stereo.visual_odometry.tracks import linked
from consistency.vision import ConsensusError, RelativePose, relative_motion

pytest.importorskip("cv2", reason="OpenCV (the extra vision) is not installed")
ROOT = Path(__file__).parents[3]
FRAMES = 6


@pytest.fixture(scope="module")
def wall():
    return scene.texture(np.random.default_rng(0))


@pytest.fixture(scope="module")
def images(tmp_path_factory, wall):
    """A KITTI sequence of a drive towards a wall."""
    folder = tmp_path_factory.mktemp("scene") / "seq"
    scene.write_kitti(folder, scene.drive(FRAMES), wall)
    return folder


@pytest.fixture(scope="module")
def log(images):
    out = images.parent / "log"
    write_frontend_log(images, out, FrontendOptions(max_landmarks=30))
    return out


# --- one motion ----------------------------------------------------------------------------------


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_motion_of_rendered_images(wall, estimator, rng):
    """Rendering leaves errors of 0.02 px: far below 6 stated sigma, which no texture reaches by chance (1e-8)."""
    poses = scene.drive(2)
    before, after = (scene.pair(pose, wall) for pose in poses)
    m = relative_motion(scene.rig(), before, after, rng=rng, estimator=estimator)
    error = m.pose.vector - poses[1].vector
    assert m.inliers.sum() > 500
    assert error @ np.linalg.solve(m.covariance, error) < 6.0**2
    assert np.linalg.norm(error[:3]) < {"reprojection": 0.0005}.get(estimator, 0.01)
    wrong = m.pose.vector - poses[1].inverse().vector  # negative control: the other direction
    assert wrong @ np.linalg.solve(m.covariance, wrong) > 6.0**2


def test_colour_images_and_the_same_generator_give_the_same(wall):
    before, after = (scene.pair(pose, wall) for pose in scene.drive(2))
    colour = [tuple(np.repeat(image[..., None], 3, axis=2) for image in pair) for pair in (before, after)]
    one = relative_motion(scene.rig(), before, after, rng=np.random.default_rng(3))
    two = relative_motion(scene.rig(), colour[0], colour[1], rng=np.random.default_rng(3))
    assert_array_equal(one.pose.matrix, two.pose.matrix)
    assert_array_equal(one.covariance, two.covariance)


def test_unusable_images(wall, rng):
    rig, pair = scene.rig(), scene.pair(scene.drive(1)[0], wall)
    with pytest.raises(cs.InputError, match="after right: has 100 x 50 px, but the rig is for 480 x 320 px"):
        relative_motion(rig, pair, (pair[0], np.zeros((50, 100), np.uint8)), rng=rng)
    blank = np.zeros(scene.SIZE[::-1], np.uint8)
    with pytest.raises(ConsensusError, match="0 matches through all four images"):
        relative_motion(rig, pair, (blank, blank), rng=rng)
    with pytest.raises(ConsensusError, match="0 matches through all four images"):  # no disparity anywhere
        relative_motion(rig, (pair[0], pair[0]), (pair[0], pair[0]), rng=rng)
    later = scene.pair(scene.drive(2)[1], wall)
    with pytest.raises(ConsensusError, match="cameras swapped"):
        relative_motion(rig, pair[::-1], later[::-1], rng=rng)
    low, later_low = ((left, np.roll(right, 1, axis=0)) for left, right in (pair, later))
    with pytest.raises(ConsensusError, match="cameras swapped or badly calibrated, or is sigma_per_scale too small"):
        relative_motion(rig, low, later_low, rng=rng, settings=MotionSettings(sigma_per_scale=0.02))
    elsewhere = scene.pair(scene.drive(1)[0], scene.texture(rng))
    with pytest.raises(cs.InputError, match="before to after: "):
        relative_motion(rig, pair, elsewhere, rng=rng)


@pytest.mark.parametrize(
    "settings, said",
    [({"estimator": "icp"}, "one of reprojection"), ({"ratio": 0.0}, "ratio: 0.0"), ({"features": 1}, "at least 8")],
)
def test_unusable_settings(settings, said):
    with pytest.raises(cs.InputError, match=said):
        MotionSettings(**settings)  # type: ignore[arg-type]


def test_without_opencv(monkeypatch, wall, rng):
    pair = scene.pair(scene.drive(1)[0], wall)
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(cs.InputError, match="pip install"):
        relative_motion(scene.rig(), pair, pair, rng=rng)


def test_a_dark_frame_is_bridged(wall, tmp_path):
    """Counted, with its reason, in the manifest and on the terminal; what follows is measured again."""
    cv2, folder = pytest.importorskip("cv2"), tmp_path / "seq"
    scene.write_kitti(folder, scene.drive(14), wall)
    dark = sorted((folder / "image_0").iterdir())[6]
    cv2.imwrite(str(dark), np.zeros(scene.SIZE[::-1], np.uint8))
    summary = write_frontend_log(folder, tmp_path / "log", FrontendOptions(max_landmarks=30))
    assert sum(bool(motion.fault) for motion in summary.motions) == 2
    assert "2 of 13 motions could not be measured and are bridged" in "\n".join(summary.lines(tmp_path / "log"))
    assert list(read_manifest(tmp_path / "log")["bridged"]) == ["5", "6"]
    (recording,) = read_recordings(
        tmp_path / "log/trajectory.tum", tmp_path / "log/truth.tum", tmp_path / "log/covariance.txt", "so3"
    )
    assert np.isfinite(recording.errors.nees[0]).all()


# --- tracks and trajectories ---------------------------------------------------------------------


def test_matches_of_consecutive_pairs_become_tracks():
    links = [np.array([[0, 5], [1, 6]]), np.array([[6, 2], [7, 3]]), np.array([[2, 0], [9, 1]])]
    assert [t.tolist() for t in linked(links)] == [[0, 1], [1, 2], [1, 3]]


def test_motions_begin_with_the_identity():
    lines = motions_text(np.array([0.0, 0.5]), np.eye(3)[None], np.array([[1.0, 2.0, 3.0]]), np.eye(6)[None]).split(
        "\n"
    )
    assert lines[0].split() == ["0.000000000", "0", "0", "0", "0", "0", "0", "1", *["0"] * 36]
    assert lines[1].split()[:8] == ["0.500000000", "1", "2", "3", "0", "0", "0", "1"]


def motion(pose, S):
    none = np.empty((0, 4))
    return RelativeMotion(pose, S, np.empty(0, bool), 1.0, 1, none, none, none, none, np.empty((0, 2), np.int64))


def test_covariance_of_a_trajectory_is_that_of_samples(rng):
    """20,000 samples: each variance ratio within 5.5 sigma of sampling (false alarm below 1e-6 for all 18 together).

    The way turns by 90 degrees about the camera's vertical axis, where Euler angles are locked.
    """
    n = 20_000
    poses = [RelativePose.from_vector(np.array([0.1, 0.0, 1.0, 0.02, np.pi / 6, 0.01]))] * 3
    A = rng.normal(size=(6, 6))
    S = 1e-6 * (A @ A.T + np.eye(6))
    R, t, P = trajectory([motion(pose, S) for pose in poses])
    assert_allclose(P, np.swapaxes(P, 1, 2))
    estimate = np.concatenate([t, Rotation.from_matrix(R).as_quat()], axis=1)
    drawn = [pose.vector + rng.multivariate_normal(np.zeros(6), S, n) for pose in poses]
    turn, place = Rotation.identity(n), np.zeros((n, 3))
    for k, values in enumerate(drawn, start=1):
        place = place + turn.apply(values[:, :3])
        turn = turn * Rotation.from_euler("ZYX", values[:, [5, 4, 3]])
        error = spatial_error(np.concatenate([place, turn.as_quat()], axis=1), estimate[k], "so3")
        whitened = np.linalg.solve(np.linalg.cholesky(P[k]), error.T)
        assert np.abs(np.mean(whitened**2, axis=1) - 1.0).max() < 5.5 * np.sqrt(2 / n)


def test_a_planar_motion_survives_the_plane():
    axes = CAMERA.T
    moves = np.array([[1.0, 0.0, 0.1], [0.8, 0.05, -0.2], [1.2, -0.02, 0.0]])
    R = np.array([axes.T @ Rotation.from_euler("z", m[2]).as_matrix() @ axes for m in moves])
    t = np.array([axes.T @ [m[0], m[1], 0.0] for m in moves])
    assert_allclose(planar_motions(*in_robot_axes(R, t, axes, 0.0)), moves, atol=1e-12)
    path = planar_path(moves)
    heading = 0.0
    place = np.zeros(2)
    for move, pose in zip(moves, path[1:], strict=True):
        place += Rotation.from_euler("z", heading).as_matrix()[:2, :2] @ move[:2]
        heading += move[2]
        assert_allclose(pose, [*place, heading], atol=1e-12)


def test_a_lever_moves_the_point_back():
    turn = Rotation.from_euler("z", 0.3).as_matrix()
    ahead = np.array([2.0, 0.0, 0.0])
    camera = turn @ ahead - ahead + np.array([1.0, 0.0, 0.0])  # the point behind goes 1 m forward, the camera swings
    R, t = CAMERA.T.T @ turn @ CAMERA.T, CAMERA.T.T @ camera
    assert_allclose(in_robot_axes(R[None], t[None], CAMERA.T, 2.0)[1][0], [1.0, 0.0, 0.0], atol=1e-12)


def test_forward_is_where_the_robot_goes():
    down = np.array([0.0, 0.05, 1.0])  # a camera that looks up by 0.05 rad goes down in its own axes
    axes = robot_axes(np.tile(down, (5, 1)))
    assert_allclose(axes @ down, [np.linalg.norm(down), 0, 0], atol=1e-12)
    assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    assert_allclose(robot_axes(-np.tile(down, (5, 1))), axes)  # backwards
    for aside in (np.array([1.0, 0.0, 0.1]), np.array([0.0, 0.0, 1e-4])):  # sideways; standing still
        assert_allclose(robot_axes(np.tile(aside, (5, 1))), CAMERA.T)


# --- the log -------------------------------------------------------------------------------------


def test_log_of_rendered_images_is_near_the_truth(log):
    recorded = read_log(log)
    trial = recorded.trials[0]
    assert (trial.steps, len(recorded.trials)) == (FRAMES - 1, 1)
    assert_allclose(np.diff(trial.truth[:, 0]), 0.1, atol=0.002)
    assert_allclose(trial.controls[:, 1], np.diff(trial.truth[:, 0]) / 0.1, atol=0.02)
    assert_allclose(trial.controls[:, 2], np.diff(trial.truth[:, 2]) / 0.1, atol=0.005)
    assert 0 < trial.n_landmarks <= 30
    assert max(recorded.belief.sensor.sigma) < 1.0
    assert read_manifest(log)["opencv"]


def test_nothing_is_left_of_a_log_that_fails(images, tmp_path):
    (tmp_path / "poses.txt").write_text("1 2 3\n")
    with pytest.raises(cs.InputError, match=r"poses\.txt"):
        write_frontend_log(images, tmp_path / "out", FrontendOptions(truth=tmp_path / "poses.txt"))
    assert [path.name for path in tmp_path.iterdir()] == ["poses.txt"]


# --- real images ---------------------------------------------------------------------------------


def data(name):
    folder = Path(os.environ.get("CONSISTENCY_DATA", ROOT.parent / "shared" / "data")) / name
    if not folder.is_dir():
        pytest.skip(f"no {folder}; set CONSISTENCY_DATA to the folder that holds {name}")
    return folder


@pytest.mark.parametrize(
    "name, truth, metres, degrees",
    [("kitti06_f0-50", "poses.txt", 0.020, 0.03), ("euroc_static", "groundtruth_first97.csv", 0.001, 0.1)],
)
def test_real_images(name, truth, metres, degrees, rng):
    """Medians over the last motions; the reference of EuRoC moves by 0.07 degrees although the rig stands still."""
    folder = data(name)
    whole = read_sequence(folder)
    R, t = relative(*read_truth(folder / truth, whole))
    few = dataclasses.replace(whole, left=whole.left[-6:], right=whole.right[-6:])
    motions = visual_odometry(few, rng=rng)
    errors = [m.pose.t - true for m, true in zip(motions, t[-5:], strict=True)]
    turns = [Rotation.from_matrix(m.pose.R @ true.T).magnitude() for m, true in zip(motions, R[-5:], strict=True)]
    assert np.median(np.linalg.norm(errors, axis=1)) < metres
    assert np.rad2deg(np.median(turns)) < degrees
