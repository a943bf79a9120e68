"""The conversion of recorded stereo tracks, on tracks small enough to check by hand, and on the recording."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scripts import experiment

import consistency as cs
from consistency.bench.scenario.models import project
from consistency.bench.store.recorded_log import read_log, write_log
from consistency.bench.types import Trial
from consistency.referee.system import manifest_of

ROOT = Path(__file__).parents[3]
KITTI = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # right, down, forward <- forward, left, up
CENTRE, F, B = np.array([600.0, 180.0]), 700.0, 0.5


experiment = experiment("e09_kitti07")
conversion = experiment.conversion


def recording(pixels, frames, poses=None):
    """Tracks given as (u, v, d) from frame 0 on, None where not seen; a robot that stands still."""
    features = np.full((4, max(pixels, default=0) + 1, frames), -1.0)
    for track, rows in pixels.items():
        for step, row in enumerate(rows):
            if row is not None:
                u, v = np.array(row[:2]) + CENTRE
                features[:, track, step] = u, v, u - row[2], v
    still = np.tile(np.eye(3, 4), (frames, 1, 1)) if poses is None else poses
    zero = np.zeros((3, frames))
    return conversion.Recording(
        features, 0.1 * np.arange(frames), zero, zero, F, CENTRE, B, KITTI, np.zeros(3), still, (1226, 370)
    )  # fmt: skip


def moving(steps, d=20.0, u=0.0):
    """A track that is never an exact copy of itself."""
    return [(u + 0.01 * step, 5.0, d) for step in range(steps)]


def test_a_point_to_the_right_and_below_has_positive_u_v_and_disparity():
    seen = project(10.0, -1.0, -0.5, F, B)  # forward, left, up
    assert min(seen) > 0
    rows = conversion.fresh_observations(recording({0: [seen]}, 1))
    assert_allclose(rows[["z0", "z1", "z2"]].to_numpy(), [seen])


def test_track_ends_at_a_stale_copy_of_all_four_numbers():
    slipped = [*moving(3), moving(3)[2], (9.0, 9.0, 30.0), (9.1, 9.0, 30.0)]
    half = [(1.0, 5.0, 20.0), (1.0, 5.0, 21.0), (1.0, 5.0, 22.0)]  # u and v stay, the right camera's u does not
    rows = conversion.fresh_observations(recording({0: slipped, 1: half}, 6))
    assert rows[rows["track"] == 0]["step"].tolist() == [0, 1, 2]
    assert rows[rows["track"] == 1]["step"].tolist() == [0, 1, 2]


def test_a_gap_starts_a_new_piece_and_small_disparities_are_left_out():
    gap = [*moving(2), None, *moving(5)[3:]]
    far = moving(5, d=conversion.MIN_DISPARITY - 0.1)
    rows = conversion.fresh_observations(recording({0: gap, 1: far}, 5))
    assert rows["track"].unique().tolist() == [0]
    assert rows.groupby("piece")["step"].apply(list).tolist() == [[0, 1], [3, 4]]


def test_a_track_that_leaves_the_common_motion_is_cut_there_and_only_there():
    """By the screening that any log may have: the robot stands still, and the last of nine tracks jumps by 10 px."""
    still = {track: moving(6, u=40.0 * track) for track in range(8)}
    still[8] = [(300.0 + 10.0 * (step >= 4), 5.0 + 0.01 * step, 20.0) for step in range(6)]
    lives = {}
    for gated in (True, False):
        trial, _ = conversion.log_of(recording(still, 6), slots=9, gated=gated)
        lives[gated] = sorted(conversion.rows_of(trial).groupby("piece")["step"].apply(list))
    assert lives[True] == sorted([[1, 2, 3], [4, 5], *[[1, 2, 3, 4, 5]] * 8])
    assert lives[False] == [[1, 2, 3, 4, 5]] * 9


def table(lives):
    """Pieces: number -> (first step, observations, u)."""
    rows = [(p, a + i, u, 0.0, 20.0) for p, (a, n, u) in lives.items() for i in range(n)]
    return pd.DataFrame(rows, columns=["piece", "step", "z0", "z1", "z2"])


def test_no_landmark_is_older_than_the_age_cut_and_cuts_are_staggered():
    seen = conversion.thinned(table(dict.fromkeys(range(4), (1, 40, 0.0))))
    ages = seen.groupby("landmark").size()
    assert ages.loc[[0, 1, 2, 3]].tolist() == [6, 12, 6, 12]
    assert ages.max() <= conversion.MAX_AGE
    assert seen.groupby("landmark")["step"].apply(lambda s: (s.diff().dropna() == 1).all()).all()


def test_slots_are_filled_from_all_columns_and_by_life_without_chance():
    lives = {p: (1, 3 + p % 2, u) for p, u in enumerate([-500.0, -490, -480, -470, -460, -450, 0, 10, 500])}
    rows = table(lives)
    seen = conversion.thinned(rows)
    assert seen.groupby("step").size().max() == conversion.SLOTS
    first = seen[seen["step"] == 1]
    assert sorted(first["z0"]) == [-490, -470, 10, 500]  # one a column, then the fullest; the longer lives
    shuffled = rows.sample(frac=1, random_state=1).sort_values(["piece", "step"])
    pd.testing.assert_frame_equal(seen, conversion.thinned(shuffled))
    assert (conversion.thinned(rows, slots=2).groupby("step").size() <= 2).all()


def test_step_0_and_single_sights_are_not_used():
    seen = conversion.thinned(table({0: (0, 3, 0.0), 1: (2, 1, 0.0)}))
    assert seen["step"].tolist() == [1, 2]
    with pytest.raises(cs.InputError, match="no track"):
        conversion.thinned(table({0: (2, 1, 0.0)}))


def test_planar_truth_of_a_left_turn_on_a_slope():
    heading = np.linspace(0.3, 0.3 + 4.0, 30)  # beyond pi: not wrapped
    flat = np.column_stack([np.cumsum(np.cos(heading)), np.cumsum(np.sin(heading)), np.zeros(30)])
    slope = conversion.rotation(0.05, -0.1, 0.0)
    lever = np.array([1.0, -0.3, 0.7])
    turns = np.stack([slope @ conversion.rotation(0.0, 0.0, h) for h in heading])
    camera = flat @ slope.T + turns @ lever
    poses = np.concatenate([KITTI @ turns @ KITTI.T, (camera @ KITTI.T)[:, :, None]], axis=2)
    # KITTI gives poses in the camera frame of frame 0
    start, origin = poses[0, :, :3].copy(), poses[0, :, 3].copy()
    poses = np.concatenate([start.T @ poses[:, :, :3], ((poses[:, :, 3] - origin) @ start)[:, :, None]], axis=2)
    data = dataclasses.replace(recording({}, 30, poses), lever=lever)
    truth = conversion.planar_truth(data)
    moved = (flat - flat[0]) @ conversion.rotation(0.0, 0.0, 0.3)
    assert_allclose(truth, np.column_stack([moved[:, :2], heading - 0.3]), atol=1e-9)


def test_unlinked_steps_and_the_floor_they_leave():
    # landmark 0 in steps 1-2, 1 in 2-3, 2 in 4: nothing links 4 to 3, nor 1 to the start, nor 5 to 4
    controls = np.tile([0.1, 1.0, 0.0], (5, 1))
    trial = Trial(
        0, np.zeros(3), controls, np.array([0, 1, 3, 4, 5, 5]), np.array([0, 0, 1, 1, 2]), np.ones((5, 3)), 3
    )  # fmt: skip
    assert experiment.unlinked_steps(trial).tolist() == [1, 4, 5]
    assert experiment.heading_floor(trial, 0.05) == pytest.approx(0.05 * 0.1 * np.sqrt(3))


ARRAYS = {
    "features": np.full((4, 2, 3), -1.0), "time_stamps": np.arange(3.0)[None], "linear_velocity": np.zeros((3, 3)),
    "rotational_velocity": np.zeros((3, 3)), "K": np.array([[718.856, 0, 607.2], [0, 718.856, 185.2], [0, 0, 1]]),
    "b": np.array(0.54), "cam_T_imu": np.eye(4),
}  # fmt: skip


def test_any_drive_is_read_with_the_poses_of_kitti_or_times_before_them(tmp_path):
    np.savez(tmp_path / "0034.npz", **ARRAYS)
    poses = np.arange(24.0).reshape(2, 12)
    for columns in (poses, np.column_stack([[0.1, 0.2], poses])):
        np.savetxt(tmp_path / "02.txt", columns)
        for at in (tmp_path, tmp_path / "0034.npz"):
            tracks, truth = conversion.find_recording(at)
            data = conversion.read_recording(tracks, truth)
            assert_array_equal(data.poses.reshape(2, 12), poses)
            assert data.features.shape == (4, 2, 2)  # the last frame has no truth
            assert data.size == (1241, 376)
            assert experiment.name_of(tracks) == "0034"
    assert experiment.name_of(Path("0027.npz")) == "kitti07"


@pytest.mark.parametrize(
    "changes, said",
    [
        ({"time_stamps": None}, r"0034\.npz: array 'time_stamps' is missing"),
        (
            {"features": np.zeros((3, 2, 3))},
            r"'features' has shape \(3, 2, 3\); must be 4 x any x any, for the 2 frames",
        ),
        ({"linear_velocity": np.zeros((3, 1))}, "'linear_velocity' has shape"),
        ({"b": np.array(np.nan)}, "'b' holds something that is not a finite number"),
        ({"K": 500.0 * np.eye(3)}, r"0034\.npz: array 'K': no rectified camera of KITTI has f = 500 px; they have 721"),
    ],
)
def test_a_drive_with_other_arrays(tmp_path, changes, said):
    np.savez(tmp_path / "0034.npz", **{k: v for k, v in (ARRAYS | changes).items() if v is not None})
    np.savetxt(tmp_path / "02.txt", np.zeros((2, 12)))
    with pytest.raises(cs.InputError, match=said):
        conversion.read_recording(*conversion.find_recording(tmp_path))


def test_unusable_data_is_told_in_one_line(tmp_path):
    def refused(said, *more):
        with pytest.raises(cs.InputError, match=said) as told:
            experiment.command(["--data", str(tmp_path), "--out", str(tmp_path / "out"), *more])
        assert "\n" not in str(told.value)
        assert not (tmp_path / "out").exists()

    refused(r"must hold one file \*\.npz of tracks, holds none; --data FILE names it")
    (tmp_path / "0027.npz").write_bytes(b"PK not an archive")
    refused(r"must hold one file \*\.txt of true poses, holds none; --truth FILE names it")
    np.savetxt(tmp_path / "kitti07_gt.txt", np.zeros((3, 13)))
    refused(r"0027\.npz: is not an archive of tracks")
    np.savez(tmp_path / "0027.npz", **ARRAYS)
    refused(r"none\.txt: ", "--truth", str(tmp_path / "none.txt"))
    (tmp_path / "kitti07_gt.txt").write_text("0 1 2\n0 1 2\n")
    refused(r"kitti07_gt\.txt: must hold 12 numbers a line, or a time and 12")
    (tmp_path / "second.npz").write_bytes(b"")
    refused(r"holds 0027\.npz, second\.npz; --data FILE")


def recorded():
    folder = Path(os.environ.get("CONSISTENCY_DATA", ROOT.parent / "shared" / "data")) / "ece276a_stereo_tracks"
    if not (folder / "0027.npz").is_file():
        pytest.skip("the KITTI 07 tracks are not here (not shipped: CC BY-NC-SA); set CONSISTENCY_DATA to their folder")
    return folder


@pytest.mark.slow
def test_the_recording_becomes_a_log_that_is_read_back(tmp_path):
    data = conversion.read_recording(*conversion.find_recording(recorded()))
    log = experiment.logs_of(data, seed=0)[experiment.MAIN]
    trial, belief = log.trials[0], log.belief
    assert (trial.steps, trial.n_landmarks) == (1100, 629)
    assert len(experiment.unlinked_steps(trial)) == 92  # the 91 slips, and step 1: nothing is seen in step 0
    path = np.hypot(*np.diff(trial.truth[:, :2], axis=0).T).sum()
    assert path == pytest.approx(692.0, abs=1.0)
    write_log(tmp_path / "log", [trial], belief, None, manifest_of(kind="log"), view=(data.size, tuple(data.centre)))
    back = read_log(tmp_path / "log")
    assert_array_equal(back.trials[0].z, trial.z)
    assert_array_equal(back.trials[0].landmark, trial.landmark)
    assert back.belief == belief


@pytest.mark.slow
def test_the_noise_of_the_twin_is_what_the_filter_believes():
    # with truth given, whitened noise has variance 1; 5 standard errors, so a false alarm in 1e6 a number
    data = conversion.read_recording(*conversion.find_recording(recorded()))
    trial, belief = conversion.log_of(data)
    quiet, loud = (experiment.white_twin(trial, belief, np.random.default_rng(s)) for s in (0, 1))
    whitened = (quiet.z - loud.z) / belief.sensor.sigma / np.sqrt(2)
    assert np.abs(whitened.var(axis=0) - 1).max() < 5 * np.sqrt(2 / len(whitened))
    assert np.hypot(*(loud.truth - trial.truth)[-1, :2]) < 1.0  # the unicycle model fits the drive


def test_consistency_bought_by_a_larger_error_is_no_improvement():
    def of(nees, largest):
        return experiment.Measured(nees, 0, np.ones(3), [0, 0, 0], 1.0, 1.0, 0.1, 1.0, largest)

    cut = [of(3.0, 7.0), of(15.0, 20.0)]
    assert experiment.are_better(cut, of(329.0, 58.0))
    assert experiment.are_better(cut, of(30.0, 20.0))
    assert not experiment.are_better(cut, of(329.0, 19.0))
    assert not experiment.are_better(cut[::-1], of(29.0, 58.0))


def test_the_log_says_which_disparities_are_reported(tmp_path):
    """A filter that allows for the search range takes it from sensor.toml."""
    data = recording({0: moving(30), 1: moving(30, u=150.0)}, 30)
    trial, belief = conversion.log_of(data)
    assert belief.sensor.disparity == (conversion.MIN_DISPARITY, 1226.0)
    write_log(tmp_path / "log", [trial], belief, None, manifest_of(kind="log", runs=1))
    assert "disparity = [" in (tmp_path / "log/sensor.toml").read_text()
    assert read_log(tmp_path / "log").belief.sensor.disparity == (8.0, 1226.0)
