"""ROS bags: poses with covariance on one topic, the truth on another or in TF; needs the extra ``ros``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from consistency.referee.diagnostics import Evidence
from consistency.referee.errors import InputError
from consistency.referee.extras import MissingPackageError, remedy
from consistency.referee.geometry.conventions import SPATIAL
from consistency.referee.parsing import reading
from consistency.referee.parsing.options import Reading
from consistency.referee.readers.poses import Poses
from consistency.referee.readers.record import symmetric
from consistency.referee.readers.sheet import Places
from consistency.referee.readers.spatial import WHOLE, TrajectorySource, recordings_of, require_axes
from consistency.referee.readers.tum import UNIT
from consistency.referee.types import Array

STATED = ("geometry_msgs/msg/PoseWithCovarianceStamped", "nav_msgs/msg/Odometry")  # with a covariance
POSES = (*STATED, "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped")
TREE = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
SECOND = 1e-9  # s in a nanosecond


class TopicPoses(NamedTuple):
    """Poses of one topic in order of their stamps, N of them."""

    t: Array  # (N,), s
    pose: Array  # (N, 7): x, y, z and the quaternion x, y, z, w
    covariance: Array  # (N, 6, 6), NaN where the message has none


def is_bag(path: Path) -> bool:
    """A file of ROS 1, a folder of ROS 2, or a folder that holds such."""
    return _is_one(path) or (path.is_dir() and any(_is_one(part) for part in path.iterdir()))


def _is_one(path: Path) -> bool:
    return (path.suffix == ".bag" and path.is_file()) or (path.is_dir() and (path / "metadata.yaml").is_file())


def read_bags(path: Path, r: Reading) -> list[Evidence]:
    """Evidence of one estimator: a bag, or a folder with a bag for each run.

    The topic of the estimates is of PoseWithCovarianceStamped or Odometry, and need not be named where there is one;
    that of the truth is of poses, or PARENT:CHILD, two frames of /tf that follow each other.

    Raises
    ------
    InputError
        A bag cannot be read, or lacks the topic; says which there are.
    """
    if r.error not in (None, *SPATIAL):
        raise InputError(f"--error {r.error}: for a trajectory in space it is one of {', '.join(SPATIAL)}")
    require_axes(r.axes)
    bags = [path] if _is_one(path) else sorted(part for part in path.iterdir() if _is_one(part))
    poses = [_poses(bag, r.topic, r.truth_topic, r.error or "so3", r.tolerance) for bag in bags]
    why = "" if r.error else "; as the ROS messages define it; declare yours with --error"
    source = TrajectorySource(path, [(bag, f"{r.truth_topic} of {bag}") for bag in bags], path, why)
    return recordings_of(source, poses, WHOLE, r)


def _poses(bag: Path, topic: str | None, truth: str | None, convention: str, max_dt: float) -> Poses:
    with _opened(bag) as reader:
        topic = _chosen(bag, reader, topic)
        if truth is None:
            others = [name for name in _topics(reader, POSES) if name != topic]
            raise InputError(
                f"{bag}: needs --truth-topic, of poses or PARENT:CHILD of /tf; there are: {_listed(others, reader)}"
            )
        own = _track(bag, topic, _messages(reader, topic))
        true = _track(bag, truth, _transforms(bag, reader, truth) if ":" in truth else _truth(bag, reader, truth))
    place = Places(lambda row: f"{bag}, message {row + 1} of {topic}", np.arange(len(own.t)))
    if not np.isfinite(true.pose).all():
        raise InputError(f"{bag}: the truth on {truth} is not finite")
    P = symmetric(own.covariance, place.__getitem__)
    stated = np.ones(len(own.t), bool)
    return Poses(place, own.t, own.pose, P, stated, true.t, true.pose, "spatial", convention, max_dt)


# --- messages ---------------------------------------------------------------------------------------


@contextmanager
def _opened(bag: Path) -> Iterator[Any]:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingPackageError(f"{bag}: a ROS bag needs {remedy('ros')}") from None
    with reading(bag, "cannot be read as a ROS bag, damaged or cut short"):
        reader = AnyReader([bag], default_typestore=get_typestore(Stores.LATEST))
        reader.open()
    try:
        with reading(bag, "cannot be read as a ROS bag, damaged or cut short"):
            yield reader
    finally:
        reader.close()


def _topics(reader: Any, kinds: Sequence[str]) -> list[str]:
    return sorted({connection.topic for connection in reader.connections if connection.msgtype in kinds})


def _listed(topics: Sequence[str], reader: Any) -> str:
    frames = ["PARENT:CHILD of /tf"] if _topics(reader, TREE) else []
    return ", ".join([*topics, *frames]) or "none that would do"


def _chosen(bag: Path, reader: Any, topic: str | None) -> str:
    """The topic of the estimates."""
    there = _topics(reader, STATED)
    if topic is None and len(there) == 1:
        return there[0]
    if topic not in there:
        asked = "needs --topic" if topic is None else f"--topic {topic}: is not there with poses and covariances"
        raise InputError(f"{bag}: {asked}; there are: {', '.join(there) or 'none that would do'}")
    return str(topic)


def _truth(bag: Path, reader: Any, topic: str) -> Iterator[tuple[Any, Any]]:
    if topic not in (there := _topics(reader, POSES)):
        raise InputError(f"{bag}: --truth-topic {topic}: is not there with poses; there are: {_listed(there, reader)}")
    return _messages(reader, topic)


def _messages(reader: Any, topic: str) -> Iterator[tuple[Any, Any]]:
    """Header and content of the messages of a topic."""
    connections = [connection for connection in reader.connections if connection.topic == topic]
    for connection, _, raw in reader.messages(connections=connections):
        message = reader.deserialize(raw, connection.msgtype)
        yield message.header, getattr(message, "pose", None) or message.transform


def _transforms(bag: Path, reader: Any, frames: str) -> Iterator[tuple[Any, Any]]:
    """Header and transform of CHILD in PARENT from /tf."""
    parent, child = (frame.strip().lstrip("/") for frame in frames.split(":", 1))
    connections = [connection for connection in reader.connections if connection.msgtype in TREE]
    seen = set()
    for connection, _, raw in reader.messages(connections=connections) if connections else ():  # of none it gives all
        for each in reader.deserialize(raw, connection.msgtype).transforms:
            pair = each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/")
            seen.add(":".join(pair))
            if pair == (parent, child):
                yield each.header, each.transform
    if f"{parent}:{child}" not in seen:
        has = ", ".join(sorted(seen)[:12]) or "none"
        raise InputError(f"{bag}: --truth-topic {frames}: is no transform of /tf; there are: {has}")


def _track(bag: Path, topic: str, messages: Iterator[tuple[Any, Any]]) -> TopicPoses:
    """Poses in order of their stamps; of several with the same stamp only the first."""
    rows = [_row(header, content) for header, content in messages]
    if not rows:
        raise InputError(f"{bag}: {topic} holds no message")
    t, pose, covariance = (np.array(column, float) for column in zip(*rows, strict=True))
    _, first = np.unique(t, return_index=True)
    pose = pose[first]
    length = np.linalg.norm(pose[:, 3:], axis=1)
    bad = np.flatnonzero(np.isfinite(pose).all(axis=1) & (np.abs(length - 1.0) > UNIT))
    if len(bad):
        raise InputError(
            f"{bag}, {topic}: the quaternion at {t[first][bad[0]]:.10g} s has length {length[bad[0]]:.4g}, not 1"
        )
    return TopicPoses(t[first], pose, covariance[first].reshape(-1, 6, 6))


def _row(header: Any, content: Any) -> tuple[float, list[float], Array]:
    """Stamp, s, pose (7,) and covariance (36,) of a message; NaN without a covariance."""
    covariance = getattr(content, "covariance", None)
    pose = content if covariance is None else content.pose
    position = getattr(pose, "position", None) or pose.translation
    turn = getattr(pose, "orientation", None) or pose.rotation
    t = header.stamp.sec + SECOND * header.stamp.nanosec
    values = [position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w]
    return t, values, np.full(36, np.nan) if covariance is None else np.asarray(covariance, float)
