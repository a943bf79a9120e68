"""Bags of ROS 1 and ROS 2, written by rosbags and judged."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import read_recordings
from scipy.spatial.transform import Rotation

import consistency as cs
from consistency.referee.types import Array

pytest.importorskip("rosbags", reason="needs the extra 'ros'")

from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

START, STEPS = 1_700_000_000, 150
SIGMA = np.array([0.1, 0.2, 0.05, 0.01, 0.02, 0.03])
P = np.diag(SIGMA**2)


class Drive:
    """A winding drive at 10 Hz with its truth at 50 Hz, as arrays of poses."""

    def __init__(self, seed: int = 5) -> None:
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
        self.error = e


def messages(store: Any, kind: str, drive: Drive, ros1: bool) -> Iterator[tuple[str, str, int, Any]]:
    """Topic, type, time of writing and message; the stamps are those of the drive, the times a little later."""
    T = store.types

    def header(t: float, frame: str) -> Any:
        ns = START * 10**9 + round(t * 1e9)
        stamp = T["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
        extra = {"seq": 0} if ros1 else {}
        return T["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **extra)

    def pose(values: Array) -> Any:
        point = T["geometry_msgs/msg/Point"](*map(float, values[:3]))
        return T["geometry_msgs/msg/Pose"](point, T["geometry_msgs/msg/Quaternion"](*map(float, values[3:])))

    zero = T["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    stated = T["geometry_msgs/msg/PoseWithCovariance"]
    for t, values in zip(drive.t, drive.own, strict=True):
        content = stated(pose(values), P.ravel())
        if kind == "odometry":
            twist = T["geometry_msgs/msg/TwistWithCovariance"](T["geometry_msgs/msg/Twist"](zero, zero), np.zeros(36))
            message = T["nav_msgs/msg/Odometry"](header(t, "map"), "base", content, twist)
            yield "/odom", "nav_msgs/msg/Odometry", late(t), message
        else:
            name = "geometry_msgs/msg/PoseWithCovarianceStamped"
            yield "/pose", name, late(t), T[name](header(t, "map"), content)
    for t, values in zip(drive.true_t, drive.true, strict=True):
        if kind == "odometry":
            turn = T["geometry_msgs/msg/Quaternion"](*map(float, values[3:]))
            moved = T["geometry_msgs/msg/Transform"](T["geometry_msgs/msg/Vector3"](*map(float, values[:3])), turn)
            each = T["geometry_msgs/msg/TransformStamped"](header(t, "/map"), "body", moved)
            yield "/tf", "tf2_msgs/msg/TFMessage", late(t), T["tf2_msgs/msg/TFMessage"]([each])
        else:
            name = "geometry_msgs/msg/PoseStamped"
            yield "/vicon", name, late(t), T[name](header(t, "map"), pose(values))


def late(t: float) -> int:
    return START * 10**9 + round((t + 0.3) * 1e9)


def write(path: Path, ros: int, kind: str, drive: Drive) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    if ros == 1:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    writer = Writer1(path) if ros == 1 else Writer2(path, version=9)
    with writer:
        connections: dict[str, Any] = {}
        for topic, name, at, message in messages(store, kind, drive, ros == 1):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            raw = store.serialize_ros1(message, name) if ros == 1 else store.serialize_cdr(message, name)
            writer.write(connections[topic], at, raw)
    return path


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize(("kind", "topic", "truth"), [("pose", "/pose", "/vicon"), ("odometry", "/odom", "map:body")])
def test_a_bag_is_read_to_the_last_digits(tmp_path: Path, ros: int, kind: str, topic: str, truth: str) -> None:
    drive = Drive()
    bag = write(tmp_path / ("drive.bag" if ros == 1 else "drive"), ros, kind, drive)
    [r] = read_recordings(bag, topic=topic, truth_topic=truth)
    assert r.error is not None
    assert r.covariance is not None
    np.testing.assert_allclose(r.error[0], drive.error, atol=1e-6)
    np.testing.assert_allclose(r.covariance[0], np.broadcast_to(P, (STEPS, 6, 6)))
    np.testing.assert_allclose(r.t, START + drive.t)  # the stamps, not the times of writing
    assert r.convention == "so3"
    [alone] = read_recordings(bag, truth_topic=truth)  # one topic has covariances
    assert np.array_equal(alone.error, r.error)  # type: ignore[arg-type]


def test_one_command_from_bag_to_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from consistency.referee.cli import main

    bag = write(tmp_path / "drive.bag", 1, "pose", Drive())
    with pytest.raises(SystemExit) as end:
        main(["analyse", str(bag), "--truth-topic", "/vicon", "--report", str(tmp_path / "out")])
    assert not end.value.code
    assert "drive is " in capsys.readouterr().out
    assert "Errors and stated bounds" in (tmp_path / "out" / "report.html").read_text()


def test_a_folder_of_bags_has_a_run_in_each(tmp_path: Path) -> None:
    (tmp_path / "bags").mkdir()
    for seed in range(4):
        write(tmp_path / "bags" / f"{seed}.bag", 1, "pose", Drive(seed))
    [r] = read_recordings(tmp_path / "bags", truth_topic="/vicon")
    assert r.runs.tolist() == [0, 1, 2, 3]
    assert r.error is not None
    for seed in range(4):
        np.testing.assert_allclose(r.error[seed], Drive(seed).error, atol=1e-6)
    assert cs.read(tmp_path / "bags", truth_topic="/vicon", axes=["x", "yaw"]).axes == ("x", "yaw")


def test_of_two_messages_with_one_stamp_the_first_counts(tmp_path: Path) -> None:
    drive = Drive()
    drive.t = drive.t.copy()
    drive.t[5] = drive.t[4]
    [r] = read_recordings(write(tmp_path / "drive.bag", 1, "pose", drive), truth_topic="/vicon")
    assert r.error is not None
    np.testing.assert_allclose(r.error[0], np.delete(drive.error, 5, axis=0), atol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, r"needs --truth-topic, of poses or PARENT:CHILD of /tf; there are: PARENT:CHILD of /tf"),
        (
            {"truth_topic": "/gps"},
            r"--truth-topic /gps: is not there with poses; there are: /odom, PARENT:CHILD of /tf",
        ),
        ({"truth_topic": "odom:body"}, r"--truth-topic odom:body: is no transform of /tf; there are: map:body"),
        (
            {"truth_topic": "map:body", "topic": "/tf"},
            r"--topic /tf: is not there with poses and cov.*there are: /odom",
        ),
        ({"truth_topic": "map:body", "state": ["x"]}, r"--state: does not go with"),
        ({"truth_topic": "map:body", "error": "so2"}, r"--error so2: for a trajectory in space it is one of"),
        ({"truth_topic": "map:body", "axes": ["w"]}, r"--axes w: 'w' is not one of"),
        ({"truth_topic": "map:body", "time_offset": 900.0}, r"no estimate has a truth within 0.01 s"),
    ],
)
def test_what_a_bag_does_not_hold(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    bag = write(tmp_path / "drive.bag", 1, "odometry", Drive())
    with pytest.raises(cs.InputError, match=message):
        read_recordings(bag, **options)


def test_damaged_bags_are_refused(tmp_path: Path) -> None:
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
