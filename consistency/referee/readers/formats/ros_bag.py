"""ROS bags: poses with covariance on one topic, the truth on another or in TF; needs the extra ``ros``."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.extras import MissingPackageError, remedy
from consistency.referee.geometry.conventions import SPATIAL
from consistency.referee.geometry.groups import inverse, matrices, vectors
from consistency.referee.parsing import reading
from consistency.referee.readers.formats.file_kinds import is_one_bag
from consistency.referee.readers.formats.geodetic import Fixes
from consistency.referee.readers.formats.pose_rows import POSE
from consistency.referee.readers.formats.sheet import Lines
from consistency.referee.readers.formats.tum import UNIT, SpaceRun, poses_of, space_estimator
from consistency.referee.readers.options import COLUMNS, Reading
from consistency.referee.readers.truth_matching import AXES, Estimator, Poses, truth_at
from consistency.referee.readers.windows import MARGINAL
from consistency.referee.types import Array

STATED = ("geometry_msgs/msg/PoseWithCovarianceStamped", "nav_msgs/msg/Odometry")  # with a covariance
FIX = "sensor_msgs/msg/NavSatFix"
ESTIMATES = (*STATED, FIX)
POSES = (*ESTIMATES, "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped")
TREE = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
SECOND = 1e-9  # s in a nanosecond
PART = re.compile(r"(.+)_\d+")  # names of the files of one recording of ROS 2
UNKNOWN, DIAGONAL = 0, 2  # types of covariance in sensor_msgs/NavSatFix
ENDLESS = 1e9  # a variance from which on it is not stated


def read_bags(path: Path, r: Reading, poses_alone: bool = False) -> list[Estimator]:
    """One estimator: a bag, or a folder with a bag for each run.

    The topic of the estimates is of PoseWithCovarianceStamped, Odometry or NavSatFix, and need not be named where there
    is one; that of the truth is of poses or NavSatFix, or PARENT:CHILD, two frames of /tf that its links join.

    Parameters
    ----------
    poses_alone : covariances are not looked at, and the topic of the estimates need not have any

    Raises
    ------
    InputError
        A bag cannot be read, or lacks the topic; says which there are.
    """
    bags = _bags(path)
    if poses_alone:
        return [poses_of(path, [_bare_run(bag, r) for bag in bags], r)]
    if r.relative is not None:
        raise InputError(f"{path}: --relative: {MARGINAL}")
    if r.error not in (None, *SPATIAL):
        raise InputError(f"--error {r.error}: for a trajectory in space it is one of {', '.join(SPATIAL)}")
    if twice := _parts_of_one(bags):
        raise InputError(
            f"{path}: {twice} and others are parts of one recording; make its metadata by 'ros2 bag reindex'"
        )
    why = "; as the ROS messages define it; declare yours with --error"
    mixed = f"{path}: the covariances of some bags have cross terms, of others none; judge them apart"
    found = space_estimator(path, (_run_of(bag, r) for bag in bags), r, why, mixed)
    judged, note = _stated(path, found.runs)
    if r.axes is not None or not note:
        return [found]
    return [replace(found, judged=judged, notes=(*found.notes, note))]


def _bags(path: Path) -> list[Path]:
    return [path] if is_one_bag(path) else sorted(part for part in path.iterdir() if is_one_bag(part))


def _run_of(bag: Path, r: Reading) -> SpaceRun:
    """Estimates and truth of a bag, whose covariances stand in the lines, and notes on their frames."""
    with _opened(bag) as reader:
        topic, truth = _chosen(bag, reader, r.topic), r.truth_topic
        if truth is None:
            others = [name for name in _topics(reader, POSES) if name != topic]
            raise InputError(
                f"{bag}: needs --truth-topic, of poses or PARENT:CHILD of /tf; there are: {_listed(others, reader)}"
            )
        own = _lines(bag, reader, topic)
        true = _lines(bag, reader, truth)
        notes = _other_frames(bag, (topic, _frames(reader, topic)), (truth, _frames(reader, truth)))
    covariance = 4 if isinstance(true, Fixes) else POSE
    if r.truth_covariance not in (None, COLUMNS):
        raise InputError(f"--truth-covariance {r.truth_covariance}: with a bag it is '{COLUMNS}', of the messages")
    if r.truth_covariance is not None and not (true.values[:, covariance:] > 0).any():
        raise InputError(f"{bag}: --truth-covariance {COLUMNS}: the messages of {r.truth_topic} state none")
    if not np.isfinite(true.values[:, 1:covariance]).all():
        raise InputError(f"{bag}: the truth on {truth} is not finite")
    return SpaceRun(own, true, (bag, f"{r.truth_topic} of {bag}"), notes=notes)


def _parts_of_one(bags: Sequence[Path]) -> str:
    """Name of a file of ROS 2 that has another part beside it, as drive_0.db3 and drive_1.db3; "" without any."""
    stems = [match[1] for bag in bags if bag.is_file() and (match := PART.fullmatch(bag.stem)) and bag.suffix != ".bag"]
    return next((bag.name for bag in bags if (match := PART.fullmatch(bag.stem)) and stems.count(match[1]) > 1), "")


def _stated(path: Path, poses: Sequence[Poses]) -> tuple[list[int], str]:
    """Components whose variance is stated in some step, and a note on the others, "" without any.

    What a node does not know it writes as 0 in every step, as -1 in the first variance of a block, or as a huge number.

    Raises
    ------
    InputError
        None is stated.
    """
    variances = np.concatenate([np.diagonal(one.covariance, axis1=1, axis2=2) for one in poses])
    n = variances.shape[1]
    none = (variances == 0).all(axis=0) | (variances >= ENDLESS).all(axis=0) | np.isnan(variances).all(axis=0)
    for first in range(0, n, 3):
        none[first : first + 3] |= bool((variances[:, first] == -1).all())
    left = np.flatnonzero(~none).tolist()
    if not left:
        raise InputError(f"{path}: states no covariance: its variances are 0, -1 or {ENDLESS:g} in every message")
    missing = ",".join(AXES[i] for i in range(n) if i not in left)
    if not missing:
        return left, ""
    what = f"{path}: the variances of {missing} are 0, -1 or {ENDLESS:g} in every message, so not stated and not judged"
    return left, what


def _other_frames(bag: Path, *of: tuple[str, tuple[str, str]]) -> list[str]:
    """A note on frames of estimates and truth by other names, which may be the same."""
    (topic, own), (truth, true) = of
    notes = []
    remedies = "add --align where they are not the same", "the poses must be of one body"
    for which, a, b, advice in zip(("world", "body"), own, true, remedies, strict=True):
        if a and b and a != b:
            notes.append(f"{bag}: the {which} is '{a}' on {topic}, but '{b}' on {truth}; {advice}")
    return notes


# --- messages ---------------------------------------------------------------------------------------


@contextmanager
def _opened(bag: Path) -> Iterator[Any]:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingPackageError(f"{bag}: a ROS bag needs {remedy('ros', package='rosbags')}") from None
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
    there = _topics(reader, STATED) or _topics(reader, (FIX,))
    if topic is None and len(there) == 1:
        return there[0]
    if topic not in (there := _topics(reader, ESTIMATES)):
        asked = "needs --topic" if topic is None else f"--topic {topic}: is not there with poses and covariances"
        raise InputError(f"{bag}: {asked}; there are: {', '.join(there) or 'none that would do'}")
    return str(topic)


def _raw(reader: Any, topic: str) -> Iterator[Any]:
    connections = [connection for connection in reader.connections if connection.topic == topic]
    for connection, _, raw in reader.messages(connections=connections):
        yield reader.deserialize(raw, connection.msgtype)


def _frames(reader: Any, topic: str) -> tuple[str, str]:
    """World and body by the first message of a topic, or of PARENT:CHILD; "" where it does not name one."""
    if ":" in topic:
        parent, child = topic.split(":", 1)
        return parent.strip().lstrip("/"), child.strip().lstrip("/")
    first = next(_raw(reader, topic), None)
    if first is None:
        return "", ""
    frame, child = first.header.frame_id.lstrip("/"), getattr(first, "child_frame_id", "").lstrip("/")
    return ("", frame) if hasattr(first, "latitude") else (frame, child)


def _transforms(bag: Path, reader: Any, frames: str) -> Lines:
    """Poses of one frame of /tf in another, along the links between both.

    Their times are those of the link with most messages, while all others that move are known; between its messages a
    link moves evenly, as tf has it, and one with a single message stands still.
    """
    parent, child = (frame.strip().lstrip("/") for frame in frames.split(":", 1))
    connections = [connection for connection in reader.connections if connection.msgtype in TREE]
    links: dict[tuple[str, str], list[tuple[Any, Any]]] = {}
    for connection, _, raw in reader.messages(connections=connections) if connections else ():  # of none it gives all
        for each in reader.deserialize(raw, connection.msgtype).transforms:
            pair = each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/")
            links.setdefault(pair, []).append((each.header, each.transform))
    chain = _chain(list(links), parent, child)
    if not chain:
        has = ", ".join(sorted(map(":".join, links))) or "none"
        raise InputError(f"{bag}: --truth-topic {frames}: is not a transform of /tf; there are: {has}")
    tracks = {pair: _track(bag, ":".join(pair), iter(links[pair])) for pair, _ in chain}
    longest = max(tracks.values(), key=lambda lines: len(lines.t))
    if chain == [((parent, child), True)]:
        return longest
    moving = [lines.t for lines in tracks.values() if len(lines.t) > 1] or [longest.t]
    rows = (longest.t >= max(t[0] for t in moving)) & (longest.t <= min(t[-1] for t in moving))
    if not rows.any():
        raise InputError(f"{bag}: --truth-topic {frames}: its links are at no time known together")
    t = longest.t[rows]
    T = np.eye(4)
    for pair, forward in chain:
        own = tracks[pair]
        link = matrices(truth_at(t, own.t, own.values[:, 1:POSE], "spatial", np.inf).truth)
        T = T @ (link if forward else inverse(link))
    values = np.column_stack([t, vectors(T), np.full((len(t), 36), np.nan)])
    return replace(longest, values=values, line=longest.line[rows], unit=f"message of {frames}")


def _chain(pairs: Sequence[tuple[str, str]], start: str, end: str) -> list[tuple[tuple[str, str], bool]]:
    """The links from one frame to another, each with whether it is taken from parent to child; none if apart."""
    ways: dict[str, list[tuple[tuple[str, str], bool]]] = {start: []}
    for frame in (queue := [start]):
        for pair in pairs:
            for here, there, forward in ((*pair, True), (*pair[::-1], False)):
                if here == frame and there not in ways:
                    ways[there] = [*ways[frame], (pair, forward)]
                    queue.append(there)
    return ways.get(end, [])


def _lines(bag: Path, reader: Any, topic: str) -> Lines:
    """Poses of a topic with their covariances, or positions by satellite, in order of their stamps."""
    if ":" in topic:
        return _transforms(bag, reader, topic)
    if topic not in (there := _topics(reader, POSES)):
        raise InputError(f"{bag}: --truth-topic {topic}: is not there with poses; there are: {_listed(there, reader)}")
    if topic in _topics(reader, (FIX,)):
        return _fixes(bag, topic, list(_raw(reader, topic)))
    messages = ((each.header, getattr(each, "pose", None) or each.transform) for each in _raw(reader, topic))
    return _track(bag, topic, messages)


def _fixes(bag: Path, topic: str, messages: Sequence[Any]) -> Fixes:
    """Positions of NavSatFix messages, without those that have no fix; of equal stamps the first."""
    kept = [each for each in messages if each.status.status >= 0]
    if not kept:
        raise InputError(f"{bag}: {topic} holds no message with a fix")
    rows = [[_stamp(each.header), each.latitude, each.longitude, each.altitude] for each in kept]
    kinds = {int(each.position_covariance_type) for each in kept}
    P = np.array([np.asarray(each.position_covariance, float) for each in kept])
    P[[each.position_covariance_type == UNKNOWN for each in kept]] = np.nan
    if kinds <= {DIAGONAL}:
        P *= np.eye(3).ravel()
    values = np.column_stack([np.array(rows, float), P])
    _, first = np.unique(values[:, 0], return_index=True)
    note = f"{bag}: {topic} read as positions by satellite, {len(kept)} of {len(messages)} messages with a fix"
    alone = kinds <= {DIAGONAL}
    if alone:
        note += ", deviations alone"
    return Fixes(bag, values[first], first + 1, note, f"message of {topic}", alone=alone)


def _track(bag: Path, topic: str, messages: Iterator[tuple[Any, Any]]) -> Lines:
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
            f"{bag}, {topic}: the quaternion at {t[first][bad[0]]:.15g} s has length {length[bad[0]]:.4g}, not 1"
        )
    return Lines(bag, np.column_stack([t[first], pose, covariance[first]]), first + 1, unit=f"message of {topic}")


def _row(header: Any, content: Any) -> tuple[float, list[float], Array]:
    """Stamp, s, pose (7,) and covariance (36,) of a message; NaN without a covariance."""
    covariance = getattr(content, "covariance", None)
    pose = content if covariance is None else content.pose
    position = getattr(pose, "position", None) or pose.translation
    turn = getattr(pose, "orientation", None) or pose.rotation
    values = [position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w]
    return _stamp(header), values, np.full(36, np.nan) if covariance is None else np.asarray(covariance, float)


def _stamp(header: Any) -> float:
    return float(header.stamp.sec + SECOND * header.stamp.nanosec)


def _bare_run(bag: Path, r: Reading) -> SpaceRun:
    """Poses of a bag, of a topic with or without covariances."""
    with _opened(bag) as reader:
        topic = r.topic
        if topic not in _topics(reader, POSES):
            topic = _chosen(bag, reader, r.topic)
        if r.truth_topic is None:
            others = [name for name in _topics(reader, POSES) if name != topic]
            raise InputError(f"{bag}: needs --truth-topic; there are: {_listed(others, reader)}")
        own, true = (_lines(bag, reader, each) for each in (topic, r.truth_topic))
    if isinstance(own, Fixes) or isinstance(true, Fixes):
        raise InputError(f"{bag}: positions by satellite have no orientations, which motions need")
    return SpaceRun(own, true, (bag, f"{r.truth_topic} of {bag}"))
