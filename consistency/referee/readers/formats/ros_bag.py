"""ROS bags: poses with covariance on one topic, the truth on another or in TF; needs the extra ``ros``."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.extras import MissingPackageError, remedy
from consistency.referee.geometry import SPATIAL, inverse, matrices, vectors
from consistency.referee.parsing import reading
from consistency.referee.readers.formats.file_kinds import is_one_bag
from consistency.referee.readers.formats.pose_rows import FULL, POSE_NUMBERS, not_unit, require_spatial
from consistency.referee.readers.formats.positions import Fixes
from consistency.referee.readers.formats.text_blocks import Lines
from consistency.referee.readers.formats.tum import SpaceRun, poses_without_covariances, space_estimator
from consistency.referee.readers.options import COLUMNS, Reading
from consistency.referee.readers.runs_to_record import MARGINAL
from consistency.referee.readers.truth_matching import AXES, Estimator, Poses, truth_at
from consistency.referee.system import with_progress
from consistency.referee.types import Array

STATED = ("geometry_msgs/msg/PoseWithCovarianceStamped", "nav_msgs/msg/Odometry")  # with a covariance
FIX = ("sensor_msgs/msg/NavSatFix",)
ESTIMATES = STATED + FIX
POSES = (*ESTIMATES, "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped")
TREE = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
SECOND = 1e-9  # s in a nanosecond
PART = re.compile(r"(.+)_\d+")  # names of the files of one recording of ROS 2
UNKNOWN, DIAGONAL = 0, 2  # types of covariance in sensor_msgs/NavSatFix
TWIST = ("speed", "turn_rate", *(f"{kind}_{axis}" for kind in ("linear", "angular") for axis in "xyz"))  # for --by
SINCE = "since:"  # before a topic, in --by: the time since its last message
ENDLESS = 1e9  # a variance from which on it is not stated
READING = ("reading", "bags")
DAMAGED = "cannot be read as a ROS bag, damaged or cut short"
Link = tuple[str, str]  # frames of a transform, parent and child
Frames = tuple[str, str]  # of the world and of the body


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
    bags = [path]
    if not is_one_bag(path):
        bags = sorted(filter(is_one_bag, path.iterdir()))
    if poses_alone:
        return [poses_without_covariances(path, [_bare_run(bag, r) for bag in with_progress(bags, *READING)], r)]
    if r.runs.relative is not None:
        raise InputError(f"{path}: --relative: {MARGINAL}")
    require_spatial(r.conventions.error, SPATIAL)
    _require_whole(path, bags)
    why = "; as the ROS messages define it; declare yours with --error"
    mixed = f"{path}: the covariances of some bags have cross terms, of others none; judge them apart"
    found = space_estimator(path, (_run_of(bag, r) for bag in with_progress(bags, *READING)), r, why, mixed)
    if r.statement.unstated and not any(one.own.covariance.any() for one in found.runs):
        return [found]
    judged, note = _stated(path, found.runs)
    if r.components.axes is not None or not note:
        return [found]
    return [found.with_error(judged=judged).with_notes(note)]


def _require_whole(path: Path, bags: Sequence[Path]) -> None:
    """Refuse files of ROS 2 that are parts of one recording, as drive_0.db3 and drive_1.db3."""
    recordings: dict[str, Path] = {}
    for bag in bags:
        part = PART.fullmatch(bag.stem)
        if part is None or not bag.is_file() or bag.suffix == ".bag":
            continue
        first = recordings.setdefault(part[1], bag)
        if first is not bag:
            advice = "make its metadata by 'ros2 bag reindex'"
            raise InputError(f"{path}: {first.name} and others are parts of one recording; {advice}")


def _run_of(bag: Path, r: Reading) -> SpaceRun:
    """Estimates and truth of a bag, whose covariances stand in the lines, and notes on their frames."""
    with _opened(bag) as reader:
        run = _run_on(bag, reader, r, _chosen(bag, reader, r.sources.topic), ", of poses or PARENT:CHILD of /tf")
        if r.groups.by is not None and r.groups.by.startswith(SINCE):
            ages = _since(bag, reader, r.groups.by.removeprefix(SINCE), run.own.values[:, 0])
            run = replace(run, own=replace(run.own, columns={**run.own.columns, r.groups.by: ages}))
    numbers = 4 if isinstance(run.true, Fixes) else POSE_NUMBERS  # of a row before its covariance
    of_truth = r.truth.truth_covariance
    if of_truth not in (None, COLUMNS):
        raise InputError(f"--truth-covariance {of_truth}: with a bag it is '{COLUMNS}', of the messages")
    if of_truth is not None and not (run.true.values[:, numbers:] > 0).any():
        raise InputError(f"{bag}: --truth-covariance {COLUMNS}: the messages of {r.sources.truth_topic} state none")
    if not np.isfinite(run.true.values[:, 1:numbers]).all():
        raise InputError(f"{bag}: the truth on {r.sources.truth_topic} is not finite")
    return run


def _bare_run(bag: Path, r: Reading) -> SpaceRun:
    """Poses of a bag, of a topic with or without covariances."""
    with _opened(bag) as reader:
        topic = r.sources.topic
        if topic not in _topics(reader, POSES):
            topic = _chosen(bag, reader, topic)
        run = _run_on(bag, reader, r, topic)
    if isinstance(run.own, Fixes) or isinstance(run.true, Fixes):
        raise InputError(f"{bag}: positions by satellite have no orientations, which motions need")
    return run


def _run_on(bag: Path, reader: Any, r: Reading, topic: str, needed: str = "") -> SpaceRun:
    """A run on a topic beside that of the truth; ``needed`` says in a message what the latter may be."""
    truth = r.sources.truth_topic
    if truth is None:
        there = [name for name in _topics(reader, POSES) if name != topic]
        raise InputError(f"{bag}: needs --truth-topic{needed}; there are: {_listed(there, reader)}")
    own = _lines(bag, reader, topic)
    true = _lines(bag, reader, truth)
    notes = []
    remedies = "add --align where they are not the same", "the poses must be of one body"
    frames = zip(("world", "body"), _frames(reader, topic), _frames(reader, truth), remedies, strict=True)
    for which, a, b, advice in frames:  # which may be the same by another name
        if a and b and a != b:
            notes.append(f"{bag}: the {which} is '{a}' on {topic}, but '{b}' on {truth}; {advice}")
    return SpaceRun(own, true, (bag, f"{truth} of {bag}"), notes=notes)


def _stated(path: Path, poses: Sequence[Poses]) -> tuple[list[int], str]:
    """Components whose variance is stated in some step, and a note on the others, "" without any.

    What a node does not know it writes as 0 in every step, as -1 in the first variance of a block, or as a huge number.

    Raises
    ------
    InputError
        None is stated.
    """
    variances = np.concatenate([one.variances for one in poses])
    none = np.isnan(variances).all(axis=0)
    none |= (variances == 0).all(axis=0)
    none |= (variances >= ENDLESS).all(axis=0)
    of_blocks = (variances[:, ::3] == -1).all(axis=0)
    none |= np.repeat(of_blocks, 3)
    values = f"0, -1 or {ENDLESS:g} in every message"
    if none.all():
        raise InputError(f"{path}: states no covariance: its variances are {values}")
    missing = ",".join(AXES[i] for i in np.flatnonzero(none))
    note = f"{path}: the variances of {missing} are {values}, so not stated and not judged"
    note += f", as by --axes {','.join(AXES[i] for i in np.flatnonzero(~none))}"
    return np.flatnonzero(~none).tolist(), note if missing else ""


# --- topics -----------------------------------------------------------------------------------------


class Topic(NamedTuple):
    """A topic of a bag."""

    name: str
    kind: str
    messages: int
    text: str  # its kind, messages, rate and frames


def topics_of(path: Path) -> list[Topic]:
    """The topics of a bag by name; of a folder of bags those of its first one.

    Raises
    ------
    InputError
        It cannot be read.
    """
    bag = path if is_one_bag(path) else min(filter(is_one_bag, path.iterdir()))
    found = []
    with _opened(bag) as reader:
        seconds = SECOND * reader.duration
        for name, topic in sorted(reader.topics.items()):
            text = f"{name}  {topic.msgtype}, {topic.msgcount} messages"
            if topic.msgcount > 1 and seconds > 0:
                text += f", {topic.msgcount / seconds:.3g} Hz"
            if topic.msgtype in POSES:
                text += f", frames {' and '.join(filter(None, _frames(reader, name))) or 'without names'}"
            found.append(Topic(name, topic.msgtype or "", topic.msgcount, text))
    return found


@contextmanager
def _opened(bag: Path) -> Iterator[Any]:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingPackageError(f"{bag}: a ROS bag needs {remedy('ros', package='rosbags')}") from None
    with reading(bag, DAMAGED):
        reader = AnyReader([bag], default_typestore=get_typestore(Stores.LATEST))
        reader.open()
    try:
        with reading(bag, DAMAGED):
            yield reader
    finally:
        reader.close()


def _topics(reader: Any, kinds: Sequence[str]) -> list[str]:
    return sorted({connection.topic for connection in reader.connections if connection.msgtype in kinds})


def _listed(topics: Sequence[str], reader: Any) -> str:
    frames = ["PARENT:CHILD of /tf"] if _topics(reader, TREE) else []
    return ", ".join([*topics, *frames]) or "none that would do"


def _chosen(bag: Path, reader: Any, topic: str | None) -> str:
    likely = _topics(reader, STATED) or _topics(reader, FIX)
    if topic is None and len(likely) == 1:
        return likely[0]
    there = _topics(reader, ESTIMATES)
    if topic in there:
        return str(topic)
    asked = "needs --topic"
    if topic is not None:
        asked = f"--topic {topic}: is not there with poses and covariances"
    raise InputError(f"{bag}: {asked}; there are: {', '.join(there) or 'none that would do'}")


def _messages(reader: Any, wanted: str | Sequence[str]) -> Iterator[Any]:
    """Messages of a topic, or of all topics of some kinds."""
    connections = []
    for connection in reader.connections:
        if connection.topic == wanted or (connection.msgtype in wanted and not isinstance(wanted, str)):
            connections.append(connection)
    if not connections:  # of none the reader gives all
        return
    for connection, _, raw in reader.messages(connections=connections):
        yield reader.deserialize(raw, connection.msgtype)


def _frames(reader: Any, topic: str) -> Frames:
    """World and body by the first message of a topic, or of PARENT:CHILD; "" where it does not name one."""
    if ":" in topic:
        return _link(topic)
    first = next(_messages(reader, topic), None)
    if first is None:
        return "", ""
    frame = first.header.frame_id.lstrip("/")
    if hasattr(first, "latitude"):
        return "", frame
    return frame, getattr(first, "child_frame_id", "").lstrip("/")


def _link(frames: str) -> Link:
    """Parent and child of PARENT:CHILD."""
    parent, child = frames.split(":", 1)
    return parent.strip().lstrip("/"), child.strip().lstrip("/")


# --- poses ------------------------------------------------------------------------------------------


def _lines(bag: Path, reader: Any, topic: str) -> Lines:
    """Poses of a topic with their covariances, or positions by satellite, in order of their stamps."""
    if ":" in topic:
        return _transforms(bag, reader, topic)
    if topic not in (there := _topics(reader, POSES)):
        raise InputError(f"{bag}: --truth-topic {topic}: is not there with poses; there are: {_listed(there, reader)}")
    if topic in _topics(reader, FIX):
        return _fixes(bag, topic, list(_messages(reader, topic)))
    rows = []
    for each in _messages(reader, topic):
        content = getattr(each, "pose", None) or each.transform
        rows.append(np.append(_row(each.header, content), _twist(each)))
    return _track(bag, topic, rows)


def _fixes(bag: Path, topic: str, messages: Sequence[Any]) -> Fixes:
    """Positions of NavSatFix messages, without those that have no fix; of equal stamps the first."""
    rows = []
    kinds = set()
    for each in messages:
        if each.status.status < 0:
            continue
        kinds.add(int(each.position_covariance_type))
        P = np.asarray(each.position_covariance, float)
        if each.position_covariance_type == UNKNOWN:
            P = np.full(9, np.nan)
        rows.append([_stamp(each.header), each.latitude, each.longitude, each.altitude, *P])
    if not rows:
        raise InputError(f"{bag}: {topic} holds no message with a fix")
    note = f"{bag}: {topic} read as positions by satellite, {len(rows)} of {len(messages)} messages with a fix"
    values = np.array(rows, float)
    alone = kinds == {DIAGONAL}
    if alone:
        values[:, 4:] *= np.eye(3).ravel()
        note += ", deviations alone"
    _, first = np.unique(values[:, 0], return_index=True)
    return Fixes(bag, values[first], first + 1, note, f"message of {topic}", alone=alone)


def _track(bag: Path, topic: str, rows: Iterable[Array]) -> Lines:
    """Poses in order of their stamps; of several with the same stamp only the first."""
    values = np.array(list(rows))
    if not len(values):
        raise InputError(f"{bag}: {topic} holds no message")
    t, first = np.unique(values[:, 0], return_index=True)
    values = values[first]
    bad, length = not_unit(values[:, 1:POSE_NUMBERS])
    for row in np.flatnonzero(bad):
        what = f"the quaternion at {t[row]:.15g} s has length {length[row]:.4g}, not 1"
        raise InputError(f"{bag}, {topic}: {what}")
    columns = dict(zip(TWIST, values[:, POSE_NUMBERS + FULL :].T, strict=False))
    return Lines(bag, values[:, : POSE_NUMBERS + FULL], first + 1, unit=f"message of {topic}", columns=columns)


def _since(bag: Path, reader: Any, topic: str, t: Array) -> Array:
    """Seconds since the last message of a topic at the times t (N,), by their stamps; NaN before the first one."""
    if topic not in reader.topics:
        raise InputError(f"{bag}: --by {SINCE}{topic}: is not there; there are: {', '.join(sorted(reader.topics))}")
    messages = [each for each in _messages(reader, topic) if hasattr(each, "header")]
    if not messages:
        raise InputError(f"{bag}: --by {SINCE}{topic}: has no message with a stamp")
    stamps = np.sort([_stamp(each.header) for each in messages])
    last = np.searchsorted(stamps, t + SECOND, side="right") - 1
    return np.where(last < 0, np.nan, np.maximum(t - stamps[last], 0.0))


def _twist(message: Any) -> list[float]:
    """Speed, m/s, turn rate, rad/s, and their three components each; nothing without a twist."""
    if not hasattr(message, "twist"):
        return []
    of = message.twist.twist
    parts = [getattr(vector, axis) for vector in (of.linear, of.angular) for axis in "xyz"]
    return [math.hypot(*parts[:3]), math.hypot(*parts[3:]), *parts]


def _row(header: Any, content: Any) -> Array:
    """Stamp, s, pose and covariance of a message, (44,); NaN without a covariance."""
    covariance = getattr(content, "covariance", None)
    if covariance is None:
        covariance = np.full(FULL, np.nan)
    else:
        content = content.pose
    p = getattr(content, "position", None) or content.translation
    q = getattr(content, "orientation", None) or content.rotation
    pose = (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
    return np.array([_stamp(header), *pose, *covariance], float)


def _stamp(header: Any) -> float:
    return float(header.stamp.sec + SECOND * header.stamp.nanosec)


# --- frames of /tf ----------------------------------------------------------------------------------


def _transforms(bag: Path, reader: Any, frames: str) -> Lines:
    """Poses of one frame of /tf in another, along the links between both.

    Their times are those of the link with most messages, while all others that move are known; between its messages a
    link moves evenly, as tf has it, and one with a single message stands still.
    """
    rows: dict[Link, list[Array]] = {}
    for message in _messages(reader, TREE):
        for each in message.transforms:
            link = each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/")
            rows.setdefault(link, []).append(_row(each.header, each.transform))
    chain = _chain(list(rows), _link(frames))
    where = f"{bag}: --truth-topic {frames}"
    if not chain:
        has = ", ".join(sorted(map(":".join, rows))) or "none"
        raise InputError(f"{where}: is not a transform of /tf; there are: {has}")
    tracks = {link: _track(bag, ":".join(link), rows[link]) for link, _ in chain}
    longest = max(tracks.values(), key=lambda lines: len(lines.t))
    if chain == [(_link(frames), True)]:
        return longest
    together = np.ones(len(longest.t), bool)
    for lines in tracks.values():
        if len(lines.t) > 1:
            together &= (longest.t >= lines.t[0]) & (longest.t <= lines.t[-1])
    if not together.any():
        raise InputError(f"{where}: its links are at no time known together")
    t = longest.t[together]
    T = np.eye(4)
    for link, forward in chain:
        own = tracks[link]
        poses = truth_at(t, own.t, own.values[:, 1:POSE_NUMBERS], "spatial", np.inf).truth
        step = matrices(poses)
        T = T @ (step if forward else inverse(step))
    unstated = np.full((len(t), FULL), np.nan)
    values = np.column_stack([t, vectors(T), unstated])
    return replace(longest, values=values, line=longest.line[together], unit=f"message of {frames}")


def _chain(links: Sequence[Link], ends: Link) -> list[tuple[Link, bool]]:
    """The links from one frame to another, each with whether it is taken from parent to child; none if apart."""
    start, end = ends
    ways: dict[str, list[tuple[Link, bool]]] = {start: []}
    for frame in (queue := [start]):
        for link in links:
            for here, there, forward in ((*link, True), (*link[::-1], False)):
                if here == frame and there not in ways:
                    ways[there] = [*ways[frame], (link, forward)]
                    queue.append(there)
    return ways.get(end, [])
