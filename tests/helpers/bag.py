"""Bags of ROS 1 and ROS 2, written by rosbags, for the tests and a benchmark to read."""

from __future__ import annotations

from functools import cache
from typing import Protocol

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from consistency.referee.types import Array

START = 1_700_000_000
STORAGE = {".db3": StoragePlugin.SQLITE3, ".mcap": StoragePlugin.MCAP}


class Track(Protocol):
    """Estimated and true poses (N, 7), position and quaternion, at times since ``START``."""

    t: Array
    own: Array
    P: Array  # (6, 6)
    true_t: Array
    true: Array


@cache
def types_of(ros):
    """The types of ROS 1 or 2, which compile on first use."""
    if ros == 2:
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    return store


def messages(store, kind, drive, ros1):
    """Topic, type, time of writing and message; the stamps are those of the drive, the times a little later."""
    T = store.types

    def header(t, frame):
        ns = START * 10**9 + round(t * 1e9)
        stamp = T["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
        extra = {"seq": 0} if ros1 else {}
        return T["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **extra)

    def pose(values):
        point = T["geometry_msgs/msg/Point"](*map(float, values[:3]))
        return T["geometry_msgs/msg/Pose"](point, T["geometry_msgs/msg/Quaternion"](*map(float, values[3:])))

    stated = T["geometry_msgs/msg/PoseWithCovariance"]
    twists = getattr(drive, "twist", np.zeros((len(drive.t), 6)))
    for t, values, moving in zip(drive.t, drive.own, twists, strict=True):
        content = stated(pose(values), drive.P.ravel())
        if kind == "odometry":
            linear, angular = (T["geometry_msgs/msg/Vector3"](*part) for part in moving.reshape(2, 3).tolist())
            twist = T["geometry_msgs/msg/TwistWithCovariance"](
                T["geometry_msgs/msg/Twist"](linear, angular), np.zeros(36)
            )
            message = T["nav_msgs/msg/Odometry"](header(t, "map"), "base", content, twist)
            yield "/odom", "nav_msgs/msg/Odometry", late(t), message
        else:
            name = "geometry_msgs/msg/PoseWithCovarianceStamped"
            yield "/pose", name, late(t), T[name](header(t, "map"), content)
    for t in getattr(drive, "fixes", ()):  # of which the stamps alone are read
        name = "geometry_msgs/msg/PoseWithCovarianceStamped"
        yield "/amcl_pose", name, late(t), T[name](header(t, "map"), stated(pose(drive.own[0]), drive.P.ravel()))
    for t, values in zip(drive.true_t, drive.true, strict=True):
        if kind == "odometry":
            turn = T["geometry_msgs/msg/Quaternion"](*map(float, values[3:]))
            moved = T["geometry_msgs/msg/Transform"](T["geometry_msgs/msg/Vector3"](*map(float, values[:3])), turn)
            each = T["geometry_msgs/msg/TransformStamped"](header(t, "/map"), "body", moved)
            yield "/tf", "tf2_msgs/msg/TFMessage", late(t), T["tf2_msgs/msg/TFMessage"]([each])
        else:
            name = "geometry_msgs/msg/PoseStamped"
            yield "/vicon", name, late(t), T[name](header(t, "map"), pose(values))


def late(t):
    return START * 10**9 + round((t + 0.3) * 1e9)


def write(path, ros, kind, drive, suffix=".db3"):
    """A bag of ROS 1, or the folder of one of ROS 2, with /odom and /tf ("odometry") or /pose and /vicon ("pose")."""
    store = types_of(ros)
    writer = Writer1(path) if ros == 1 else Writer2(path, version=9, storage_plugin=STORAGE[suffix])
    with writer:
        connections = {}
        for topic, name, at, message in messages(store, kind, drive, ros == 1):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            raw = store.serialize_ros1(message, name) if ros == 1 else store.serialize_cdr(message, name)
            writer.write(connections[topic], at, raw)
    return path


def write_fixes(path, kind, own, true, C, body="gps", status=0):
    """Fixes on /fix with covariances C (N, 3, 3), true ones on /rtk, at 10 Hz; the second of /fix has ``status``."""
    store = types_of(1)
    T = store.types
    with Writer1(path) as writer:
        for topic, places, number in (("/fix", own, kind), ("/rtk", true, 3)):
            connection = writer.add_connection(topic, "sensor_msgs/msg/NavSatFix", typestore=store)
            for k, (place, stated) in enumerate(zip(places, C, strict=True)):
                ns = START * 10**9 + k * 10**8
                stamp = T["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
                header = T["std_msgs/msg/Header"](seq=k, stamp=stamp, frame_id=body if topic == "/fix" else "gps")
                fix = T["sensor_msgs/msg/NavSatStatus"](status=status if k == 1 and topic == "/fix" else 2, service=1)
                message = T["sensor_msgs/msg/NavSatFix"](header, fix, *map(float, place), stated.ravel(), number)
                writer.write(connection, ns, store.serialize_ros1(message, "sensor_msgs/msg/NavSatFix"))
    return path
