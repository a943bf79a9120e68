"""Bags of ROS 1 and ROS 2, written by rosbags and judged."""

import contextlib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command import consistency, refused
from numpy.testing import assert_allclose
from recorded import notes_of, read_recordings
from scipy.spatial.transform import Rotation

import consistency as cs
from consistency.referee.errors import InputError
from consistency.referee.readers.formats.ros_bag import _lines

pytest.importorskip("rosbags", reason="needs the extra 'ros'")

from bag import START, write, write_fixes

STEPS = 150
SIGMA = np.array([0.1, 0.2, 0.05, 0.01, 0.02, 0.03])
P = np.diag(SIGMA**2)


class Drive:
    """A winding drive at 10 Hz with its truth at 50 Hz, as arrays of poses."""

    def __init__(self, seed=5):
        rng = np.random.default_rng(seed)
        self.true_t = 0.02 * np.arange(5 * STEPS + 10)
        heading = 0.3 * self.true_t
        at = np.column_stack([np.sin(heading), -np.cos(heading), 0.02 * self.true_t])
        self.true = np.hstack([3.0 * at, Rotation.from_rotvec(np.outer(heading, [0.0, 0.0, 1.0])).as_quat()])
        self.t = self.true_t[: 5 * STEPS : 5]
        e = SIGMA * rng.normal(size=(STEPS, 6))
        true = self.true[: 5 * STEPS : 5]
        turn = Rotation.from_rotvec(-e[:, 3:]) * Rotation.from_quat(true[:, 3:])
        self.own = np.hstack([true[:, :3] - e[:, :3], turn.as_quat()])
        self.error, self.P = e, P


def read_poses(folder, drive):
    """The record of a drive whose bag has poses of ROS 1."""
    [record] = read_recordings(write(folder / "drive.bag", 1, "pose", drive), truth_topic="/vicon")
    return record


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize("kind, topic, truth", [("pose", "/pose", "/vicon"), ("odometry", "/odom", "map:body")])
def test_a_bag_is_read_to_the_last_digits(tmp_path, ros, kind, topic, truth):
    drive = Drive()
    bag = write(tmp_path / ("drive.bag" if ros == 1 else "drive"), ros, kind, drive)
    [r] = read_recordings(bag, topic=topic, truth_topic=truth)
    assert_allclose(r.errors.error[0], drive.error, atol=1e-6)
    assert_allclose(r.errors.covariance[0], np.broadcast_to(P, (STEPS, 6, 6)))
    assert_allclose(r.runs.t, START + drive.t)  # the stamps, not the times of writing
    assert r.errors.convention == "so3"
    [alone] = read_recordings(bag, truth_topic=truth)  # one topic has covariances
    assert np.array_equal(alone.errors.error, r.errors.error)
    assert ("the body is 'base' on /odom, but 'body' on map:body" in notes_of(r)) == (kind == "odometry")
    assert "the world is" not in notes_of(r)


def test_what_the_monitor_needs_is_no_bag(tmp_path, capsys):
    bag = write(tmp_path / "drive.bag", 1, "pose", Drive())
    for path in (bag, tmp_path):
        err = refused(capsys, "monitor", path)
        assert "no innovations" in err
        assert "innovation_variance" in err
        assert err.endswith(f"consistency inspect {path}\n")


def test_a_folder_of_bags_has_a_run_in_each(tmp_path):
    (tmp_path / "bags").mkdir()
    for seed in range(4):
        write(tmp_path / "bags" / f"{seed}.bag", 1, "pose", Drive(seed))
    [r] = read_recordings(tmp_path / "bags", truth_topic="/vicon")
    assert r.runs.numbers.tolist() == [0, 1, 2, 3]
    for seed in range(4):
        assert_allclose(r.errors.error[seed], Drive(seed).error, atol=1e-6)
    assert cs.read(tmp_path / "bags", truth_topic="/vicon", axes=["x", "yaw"]).errors.axes == ("x", "yaw")


def test_bags_of_a_program_are_deleted_once_they_are_read(tmp_path, monkeypatch, capsys):
    for seed in range(3):
        write(tmp_path / f"recorded/{seed}", 2, "pose", Drive(seed), ".mcap")
    monkeypatch.chdir(tmp_path)
    reading = ("--each", "recorded/*", "--estimates", "bag", "--truth-topic", "/vicon", "--json")
    words = ("--keep", "failed", "--out", "out", "--", "cp", "-r", "{input}", "bag")
    judged, _ = consistency(capsys, "monte-carlo", *reading, *words)
    assert "undecided" in judged
    assert consistency(capsys, "analyse", "out", "--json")[0] == judged
    assert not list((tmp_path / "out").rglob("bag"))


@pytest.mark.parametrize(
    "variances, unstated", [((0.2, 1e-3, 1e-3), ""), ((0.0, 1e-3, 1e-3), "z"), ((2e9, 0.1, 0.1), "z")]
)
def test_a_robot_in_the_plane_is_judged_in_the_plane(tmp_path, variances, unstated):
    """By the rule of all other files, also where some variances are not stated."""
    drive = Drive()
    drive.true[:, 2], drive.own[:, 2] = 0.0, 0.0
    heading = np.deg2rad(30.0) + drive.error[:, 5]
    turn = Rotation.from_quat(drive.true[: 5 * STEPS : 5, 3:]) * Rotation.from_rotvec(
        np.outer(heading, [0.0, 0.0, 1.0])
    )
    drive.own[:, 3:] = turn.as_quat()
    drive.P = np.diag([0.01, 0.04, *variances, 9e-4])
    r = read_poses(tmp_path, drive)
    assert r.errors.axes == ("x", "y", "yaw")
    left = "roll, pitch" if unstated else "z, roll, pitch"
    assert f"{left} are not estimated and left out" in notes_of(r)
    assert (f"the variances of {unstated} are 0, -1" in notes_of(r)) == bool(unstated)


@pytest.mark.usefixtures("without_hints")
def test_a_robot_in_the_plane_and_its_late_clock_are_found_beside_dummies(tmp_path):
    """An offset of 0.35 s makes an error of 0.3 m and 0.1 rad; without it NEES is 3, of 600: 0.5 is 5 sigma.

    The truth is 0.05 m lower, too; variances of z, roll and pitch are not stated, or are any number.
    """
    for seed in range(4):
        drive = Drive(seed)
        e = drive.error * [1.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        true = Rotation.from_quat(drive.true[: 5 * STEPS : 5, 3:])
        drive.true[:, 2] = -0.05
        drive.own[:, :3] = drive.true[: 5 * STEPS : 5, :3] - e[:, :3] + [0.0, 0.0, 0.05]
        drive.own[:, 3:] = (Rotation.from_rotvec(-e[:, 3:]) * true).as_quat()
        drive.P = np.diag([*SIGMA[:2] ** 2, 0.0, 1e6, 1e6, SIGMA[5] ** 2])
        drive.true_t = drive.true_t + 0.35
        write(tmp_path / f"{seed}.bag", 1, "pose", drive)
    [late] = read_recordings(tmp_path, truth_topic="/vicon")
    assert late.errors.axes == ("x", "y", "yaw")
    assert "by --axes x,y,yaw" in notes_of(late)
    offset = float(notes_of(late).split("--time-offset ")[1].split()[0])
    assert offset == pytest.approx(0.35, abs=0.01)
    [right] = read_recordings(tmp_path, truth_topic="/vicon", time_offset=offset)
    assert right.errors.axes == ("x", "y", "yaw")
    assert 2.5 < np.nanmean(right.errors.nees) < 3.5


@pytest.mark.parametrize("name", ["speed", "turn_rate", "linear_y", "angular_z"])
def test_the_twist_of_odometry_makes_groups(tmp_path, name):
    """Of two messages with one stamp the first counts, with its own pose and twist."""
    drive = Drive()
    drive.twist = np.random.default_rng().normal(size=(STEPS, 6))
    drive.t = drive.t.copy()
    drive.t[5] = drive.t[4]
    bag = write(tmp_path / "drive", 2, "odometry", drive)
    [r] = read_recordings(bag, truth_topic="map:body", by=name)
    linear, angular = np.delete(drive.twist, 5, axis=0).reshape(-1, 2, 3).swapaxes(0, 1)
    expected = {
        "speed": np.linalg.norm(linear, axis=1),
        "turn_rate": np.linalg.norm(angular, axis=1),
        "linear_y": linear[:, 1],
        "angular_z": angular[:, 2],
    }
    assert_allclose(r.runs.by[0], expected[name], rtol=1e-12)
    assert_allclose(r.errors.error[0], np.delete(drive.error, 5, axis=0), atol=1e-6)
    assert len(r.groups.names) == 5


def test_the_time_since_a_topic_makes_groups(tmp_path):
    drive = Drive()
    drive.fixes = [7.05, 2.4, 0.33]
    bag = write(tmp_path / "drive", 2, "odometry", drive)
    [r] = read_recordings(bag, topic="/odom", truth_topic="map:body", by="since:/amcl_pose")
    t = drive.t
    last = np.where(t < 2.4 - 1e-9, 0.33, np.where(t < 7.05, 2.4, 7.05))
    expected = np.where(t < 0.33, np.nan, t - last)
    assert_allclose(r.runs.by[0], expected, atol=1e-6)
    assert len(r.groups.names) == 5
    [r] = read_recordings(bag, topic="/odom", truth_topic="map:body", by="t")  # since the first row
    assert_allclose(r.runs.by[0], t - t[0], atol=1e-6)
    found = cs.inspect(bag)
    assert not found.command
    assert any(
        "--by since:/amcl_pose" in each for each in cs.inspect(bag, truth_topic="map:body", topic="/odom").findings
    )


def test_a_topic_since_which_no_time_is_known(tmp_path):
    bag = write(tmp_path / "drive", 2, "odometry", Drive())
    for topic, said in (("/gps", "is not there; there are: /odom, /tf"), ("/tf", "no message with a stamp")):
        with pytest.raises(InputError, match=rf"drive: --by since:{topic}: .*{said}"):
            read_recordings(bag, truth_topic="map:body", by=f"since:{topic}")


def test_a_column_that_a_bag_does_not_hold(tmp_path):
    has = "there are: speed, turn_rate, linear_x, linear_y, linear_z, angular_x"
    for kind, truth, said in (("odometry", "map:body", has), ("pose", "/vicon", "has no columns of its own")):
        bag = write(tmp_path / kind, 2, kind, Drive())
        with pytest.raises(InputError, match=rf"--by v: .*{kind}.*{said}"):
            read_recordings(bag, truth_topic=truth, by="v")


@pytest.mark.parametrize(
    "options, message",
    [
        ({}, r"needs --truth-topic, of poses or PARENT:CHILD of /tf; there are: PARENT:CHILD of /tf"),
        (
            {"truth_topic": "/gps"},
            r"--truth-topic /gps: is not there with poses; there are: /odom, PARENT:CHILD of /tf",
        ),
        ({"truth_topic": "odom:body"}, r"--truth-topic odom:body: is not a transform of /tf; there are: map:body"),
        (
            {"truth_topic": "map:body", "topic": "/tf"},
            r"--topic /tf: is not there with poses and cov.*there are: /odom",
        ),
        ({"truth_topic": "map:body", "state": ["x"]}, r"--state: does not go with"),
        ({"truth_topic": "map:body", "truth": "drive.bag"}, r"--truth: does not go with .*drive\.bag"),
        ({"truth_topic": "map:body", "error": "so2"}, r"--error so2: for a trajectory in space it is one of"),
        ({"truth_topic": "map:body", "axes": ["w"]}, r"--axes w: 'w' is not one of"),
        ({"truth_topic": "map:body", "time_offset": 900.0}, r"no estimate has a truth within 0.01 s"),
    ],
)
def test_what_a_bag_does_not_hold(tmp_path, options, message):
    bag = write(tmp_path / "drive.bag", 1, "odometry", Drive())
    with pytest.raises(cs.InputError, match=message):
        read_recordings(bag, **options)


def test_damaged_bags_are_refused(tmp_path):
    rng = np.random.default_rng()
    whole = write(tmp_path / "drive.bag", 1, "pose", Drive()).read_bytes()
    bad = tmp_path / "bad.bag"
    for content in (b"", b"#ROSBAG V2.0\n", whole[: len(whole) // 2], b"PK" + whole[2:]):
        bad.write_bytes(content)
        with pytest.raises(cs.InputError, match=r"bad\.bag: "):
            read_recordings(bad, truth_topic="/vicon")
    for _ in range(40):  # a flipped byte is refused in one sentence, or it is in a number and read
        flipped = bytearray(whole)
        flipped[rng.integers(len(whole))] ^= 0xFF
        bad.write_bytes(flipped)
        with contextlib.suppress(cs.InputError):
            read_recordings(bad, truth_topic="/vicon")
    folder = write(tmp_path / "two", 2, "pose", Drive())
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: 3\n")
    with pytest.raises(cs.InputError, match="cannot be read as a ROS bag"):
        read_recordings(folder, truth_topic="/vicon")
    (tmp_path / "e.csv").write_text("step,x\n1,2\n")
    with pytest.raises(cs.InputError, match="--topic: does not go with"):
        read_recordings(tmp_path / "e.csv", topic="/pose")


# --- files of ROS 2 by themselves, positions by satellite, and what is not stated ------------------------


@pytest.mark.parametrize("suffix", [".db3", ".mcap"])
def test_a_file_of_ros_2_without_its_metadata(tmp_path, suffix):
    drive = Drive()
    [file] = write(tmp_path / "drive", 2, "pose", drive, suffix).glob(f"*{suffix}")
    alone = file.rename(tmp_path / f"flight{suffix}")
    [r] = read_recordings(alone, truth_topic="/vicon")
    assert_allclose(r.errors.error[0], drive.error, atol=1e-6)  # type: ignore[index]
    (tmp_path / "parts").mkdir()
    for k in range(2):
        (tmp_path / "parts" / f"flight_{k}{suffix}").write_bytes(alone.read_bytes())
    with pytest.raises(cs.InputError, match=rf"flight_0{suffix} and others are parts of one recording; .*reindex"):
        read_recordings(tmp_path / "parts", truth_topic="/vicon")


def test_fixes_against_fixes(tmp_path):
    """NEES in the plane of the first true place; without a fix a message does not count."""
    from test_fixes import flight, plane
    from test_layouts import nees_of

    from consistency.referee.readers.formats.positions import axes_at

    place, C = flight()
    off = place + np.random.default_rng().normal(size=place.shape) * [5e-7, 5e-7, 0.05]
    bag = write_fixes(tmp_path / "a.bag", 3, off, place, C, body="base", status=-1)
    [r] = read_recordings(bag, topic="/fix", truth_topic="/rtk")
    kept = np.delete(np.arange(len(place)), 1)
    e = (plane(place, place[0]) - plane(off, place[0]))[kept]
    turns = axes_at(place[0]) @ np.swapaxes(axes_at(off[kept]), 1, 2)
    expected = nees_of(e, turns @ C[kept] @ np.swapaxes(turns, 1, 2))
    assert_allclose(r.errors.nees[0], expected, rtol=1e-6, atol=1e-6)  # metres are differences of millions of them
    assert "/fix read as positions by satellite, 11 of 12 messages with a fix" in notes_of(r)
    assert "the body is 'base' on /fix, but 'gps' on /rtk; the poses must be of one body" in notes_of(r)


def test_the_type_of_a_covariance_counts(tmp_path):
    from test_fixes import flight

    place, C = flight()
    off = place + np.array([1e-7, 1e-7, 0.01])
    [r] = read_recordings(write_fixes(tmp_path / "a.bag", 2, off, place, C), topic="/fix", truth_topic="/rtk")
    assert r.errors.parts == ((0,), (1,), (2,))
    stated = np.asarray(r.errors.covariance[0])
    assert_allclose(stated, C * np.eye(3), atol=1e-3 * stated.max())  # what is beside the diagonal is not
    bag = write_fixes(tmp_path / "b.bag", 0, off, place, C)
    with pytest.raises(cs.InputError, match=r"b\.bag: states no covariance: its variances are 0, -1"):
        read_recordings(bag, topic="/fix", truth_topic="/rtk")


@pytest.mark.parametrize("value", [0.0, -1.0, 1e9])
def test_blocks_that_are_not_stated_are_not_judged(tmp_path, value):
    drive = Drive()
    drive.P = P.copy()
    drive.P[3:, 3:] = value * np.eye(3)
    r = read_poses(tmp_path, drive)
    assert r.errors.axes == ("x", "y", "z")
    assert_allclose(r.errors.nees[0], (drive.error[:, :3] ** 2 / SIGMA[:3] ** 2).sum(axis=1), rtol=1e-6)
    said = "the variances of roll,pitch,yaw are 0, -1 or 1e+09 in every message, so not stated and not judged"
    assert said in notes_of(r)


def test_the_covariance_of_a_true_message(tmp_path):
    from test_fixes import flight

    from consistency.referee.readers.formats.positions import axes_at

    place, C = flight()
    turns = axes_at(place[0]) @ np.swapaxes(axes_at(place), 1, 2)
    bag = write_fixes(tmp_path / "a.bag", 3, place + np.array([1e-7, 1e-7, 0.01]), place, C)
    [r] = read_recordings(bag, topic="/fix", truth_topic="/rtk", truth_covariance="columns")
    assert_allclose(r.truth.covariance[0], turns @ C @ np.swapaxes(turns, 1, 2), rtol=1e-6, atol=1e-12)
    [r] = read_recordings(bag, topic="/fix", truth_topic="/rtk")
    assert any("/rtk" not in note and "which counts as 0" in note for note in r.origin.notes)
    drive = write(tmp_path / "b.bag", 1, "odometry", Drive())
    for value, said in (("P.txt", "with a bag it is 'columns'"), ("columns", "the messages of map:body state none")):
        with pytest.raises(cs.InputError, match=said):
            read_recordings(drive, truth_topic="map:body", truth_covariance=value)


class Tree:
    """A reader of transforms along x: by parent and child their times, s, and positions, m."""

    connections = (SimpleNamespace(topic="/tf", msgtype="tf2_msgs/msg/TFMessage"),)

    def __init__(self, **links):
        self.links = links

    def messages(self, connections):
        for link, (times, positions) in self.links.items():
            frame, child = link.split("_to_")
            for t, x in zip(times, positions, strict=True):
                stamp = SimpleNamespace(sec=int(t), nanosec=round(1e9 * (t - int(t))))
                header = SimpleNamespace(frame_id=frame, stamp=stamp)
                turn = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
                transform = SimpleNamespace(translation=SimpleNamespace(x=x, y=0.0, z=0.0), rotation=turn)
                each = SimpleNamespace(header=header, child_frame_id=child, transform=transform)
                yield connections[0], 0, SimpleNamespace(transforms=[each])

    def deserialize(self, raw, kind):
        return raw


def test_links_that_are_never_known_together_are_refused():
    early, late = np.arange(3.0), np.arange(5.0, 9.0)
    tree = Tree(map_to_odom=(early, early), odom_to_base=(late, late))
    with pytest.raises(InputError, match="--truth-topic map:base: its links are at no time known together"):
        _lines(Path("b"), tree, "map:base")
