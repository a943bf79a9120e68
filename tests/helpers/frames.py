"""Bags of ROS 2 with links of /tf, poses at the origin on /pose, and odometry at the origin on /odom."""

import numpy as np
from bag import types_of
from rosbags.rosbag2 import StoragePlugin, Writer


def write_frames(path, links, t, odometry=None):
    """The bag; ``odometry`` is the variance that /odom states.

    A link is (parent, child, stamps, s, positions (N, 3), quaternions (N, 4)).
    """
    store = types_of(2)
    T = store.types

    def geometry(name, *values):
        return T[f"geometry_msgs/msg/{name}"](*values)

    def header(seconds, frame):
        whole, rest = divmod(round(seconds * 1e9), 10**9)
        return T["std_msgs/msg/Header"](T["builtin_interfaces/msg/Time"](whole, rest), frame)

    still, zero = geometry("Quaternion", 0.0, 0.0, 0.0, 1.0), geometry("Vector3", 0.0, 0.0, 0.0)
    pose = geometry("Pose", geometry("Point", 0.0, 0.0, 0.0), still)
    messages = []
    for parent, child, stamps, places, turns in links:
        for seconds, place, turn in zip(stamps, places, turns, strict=True):
            moved = geometry(
                "Transform", geometry("Vector3", *map(float, place)), geometry("Quaternion", *map(float, turn))
            )
            each = geometry("TransformStamped", header(seconds, parent), child, moved)
            messages.append(("/tf", "tf2_msgs/msg/TFMessage", seconds, T["tf2_msgs/msg/TFMessage"]([each])))
    for seconds in t:
        stated = geometry("PoseWithCovariance", pose, np.eye(6).ravel())
        name = "geometry_msgs/msg/PoseWithCovarianceStamped"
        messages.append(("/pose", name, seconds, T[name](header(seconds, "map"), stated)))
        if odometry is not None:
            still_ = geometry("TwistWithCovariance", geometry("Twist", zero, zero), np.zeros(36))
            stated = geometry("PoseWithCovariance", pose, odometry * np.eye(6).ravel())
            odom = T["nav_msgs/msg/Odometry"](header(seconds, "map"), "base", stated, still_)
            messages.append(("/odom", "nav_msgs/msg/Odometry", seconds, odom))
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        kinds = {topic: kind for topic, kind, _, _ in messages}
        to = {topic: bag.add_connection(topic, kind, typestore=store) for topic, kind in kinds.items()}
        for topic, kind, seconds, message in messages:
            bag.write(to[topic], round(seconds * 1e9), store.serialize_cdr(message, kind))
    return path
