"""Equivariant filter SLAM, compiled. Equations and source: :mod:`consistency.bench.filters.textbook.equivariant`.

A robot-centred map in its polar symmetry: landmarks in the frame of the sensor, m, and their polar error. The error of
a landmark is (left, up, s): turns about the axes across the line of sight, in rad, and the logarithm of the scale. That
of the pose is right-invariant, T_true = Exp(xi) T.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiled import variants
from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.linalg import add_transposed_times, fill, fill_matrix
from consistency.bench.filters.kernel.part_functions import (
    Data,
    Factors,
    Frame,
    Nine,
    Slam,
    State,
    Triple,
    combine,
    correct,
    insert,
    landmark_width,
    locate,
    measure_jacobian,
    move,
    noise_columns,
    pose_covariance,
    predict_innovation,
    propagate,
    retract,
    robot_frame,
    to_body,
    to_body_jacobian,
    to_error,
    world_point,
)
from consistency.bench.filters.kernel.update_steps import (
    Scratch,
    add_gram_to_state,
    add_noise,
    combine_seen,
    correct_at_once,
    gather,
    innovate,
    linearise_seen,
    move_block,
)
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.parts.invariant_pose import move_pose, shifted_covariance
from consistency.bench.filters.parts.inverse_range import inward, outward
from consistency.bench.filters.parts.sensors import Uvd
from consistency.bench.filters.parts.world_point import combine_world_point
from consistency.bench.filters.textbook.equivariant import EquivariantKalman
from consistency.bench.protocols import Problem
from consistency.bench.scenario import models
from consistency.bench.scenario.models import Mounting
from consistency.referee.types import Array


@part(error="Polar", update="EquivariantOutput", covariance="Dense")
class SensorPoint(NamedTuple):
    """Where the sensor is mounted on the robot. A landmark is its position in the frame of the sensor, m."""

    mount: Mounting


@inner
def sight(q: Array) -> tuple[Nine, float]:
    """The unit vectors b1, b2, n of the line of sight to q (3,), and its length in m."""
    h = np.sqrt(q[0] * q[0] + q[1] * q[1])
    r = np.sqrt(h * h + q[2] * q[2])
    c, s = (q[0] / h, q[1] / h) if h > 0.0 else (1.0, 0.0)
    up, flat = q[2] / r, h / r
    return (-s, c, 0.0, -up * c, -up * s, flat, flat * c, flat * s, up), r


@implement(landmark_width, SensorPoint)
def sensor_point_width(landmark: SensorPoint) -> int:
    return 3


@implement(to_body, SensorPoint)
def to_body_of_sensor_point(landmark: SensorPoint, frame: Frame, values: Array) -> Triple:
    return models.from_sensor(values[0], values[1], values[2], landmark.mount)


@implement(to_body_jacobian, SensorPoint)
def to_body_jacobian_of_sensor_point(
    landmark: SensorPoint, frame: Frame, values: Array, body: Triple, row: Triple, Hp: Array, Hl: Array
) -> None:
    fill(Hp, 0.0)
    Hl[0], Hl[1], Hl[2] = inward(landmark.mount, row[0], row[1], row[2])


@implement(insert, SensorPoint)
def insert_sensor_point(
    landmark: SensorPoint, frame: Frame, body: Triple, Jb: Array, mount: Mounting, values: Array, Jp: Array, Jz: Array
) -> None:
    """``Jz`` (3, 3) is that of the polar error."""
    values[0], values[1], values[2] = models.to_sensor(body[0], body[1], body[2], mount)
    e, r = sight(values)
    fill_matrix(Jp, 0.0)
    for j in range(3):
        x, y, z = inward(mount, Jb[0, j], Jb[1, j], Jb[2, j])
        for a in range(3):
            Jz[a, j] = (e[3 * a] * x + e[3 * a + 1] * y + e[3 * a + 2] * z) / r


@implement(world_point, SensorPoint)
def sensor_point_in_world(
    landmark: SensorPoint, frame: Frame, values: Array, point_: Array, Dp: Array, Dl: Array
) -> None:
    mount, c, s = landmark.mount, frame.c, frame.s
    bx, by, bz = models.from_sensor(values[0], values[1], values[2], mount)
    point_[0], point_[1], point_[2] = models.turned_to_world(frame.x, frame.y, c, s, bx, by, bz)
    fill_matrix(Dp, 0.0)
    Dp[0, 0] = Dp[1, 1] = 1.0
    Dp[0, 2], Dp[1, 2] = frame.y - point_[1], point_[0] - frame.x
    for j in range(3):
        x, y, z = outward(mount, 1.0 if j == 0 else 0.0, 1.0 if j == 1 else 0.0, 1.0 if j == 2 else 0.0)
        Dl[0, j], Dl[1, j], Dl[2, j] = c * x - s * y, s * x + c * y, z


implement(combine, SensorPoint)(combine_world_point)


@part(landmark="SensorPoint", point="AtEstimate")
class Polar(NamedTuple):
    """No parameters. Right-invariant error of the pose; turn and logarithm of the scale of each landmark."""


@implement(propagate, Polar)
def propagate_polar(
    error: Polar, slam: Slam, state: State, k: int, u: Array, Phi: Array, scratch: Scratch[NamedTuple]
) -> None:
    """Pose and landmarks move; P <- F P F' + G Q G', F the identity but for a block for each landmark."""
    x, P, n, G = state.x, state.P, state.n, scratch.small
    noise_columns(slam.motion, x[:3], u, G)
    before = robot_frame(x[:3])
    move(x[:3], u, x[:3])
    after, noise = robot_frame(x[:3]), scratch.rows[:2, :n]
    for o in range(3, n, 3):
        body = _move_landmark(slam.landmark.mount, before, after, x[o : o + 3], scratch.Jz, scratch.Jb)
        move_block(P, n, o, scratch.Jz)
        for i in range(2):
            dx = -after.c * G[0, i] - after.s * G[1, i] + G[2, i] * body[1]
            dy = after.s * G[0, i] - after.c * G[1, i] - G[2, i] * body[0]
            for a in range(3):
                noise[i, o + a] = scratch.Jb[a, 0] * dx + scratch.Jb[a, 1] * dy
    for i in range(2):
        turn = G[2, i]
        noise[i, 0], noise[i, 1], noise[i, 2] = G[0, i] + x[1] * turn, G[1, i] - x[0] * turn, turn
    add_gram_to_state(1.0, noise, P, n)


@inner
def _move_landmark(mount: Mounting, before: Frame, after: Frame, q: Array, F: Array, B: Array) -> Triple:
    """q (3,) <- as it is seen from ``after``, F (3, 3) <- derivative of its error by that before.

    ``B`` (3, 3) <- derivative of the error by the position in the new frame of the robot, which is returned.
    """
    old, r_old = sight(q)
    bx, by, bz = models.from_sensor(q[0], q[1], q[2], mount)
    wx, wy, wz = models.turned_to_world(before.x, before.y, before.c, before.s, bx, by, bz)
    body = models.turned_to_robot(after.x, after.y, after.c, after.s, wx, wy, wz)
    q[0], q[1], q[2] = models.to_sensor(body[0], body[1], body[2], mount)
    new, r = sight(q)
    c, s = after.c * before.c + after.s * before.s, after.s * before.c - after.c * before.s
    for a in range(3):
        x, y, z = outward(mount, new[3 * a], new[3 * a + 1], new[3 * a + 2])
        B[a, 0], B[a, 1], B[a, 2] = x / r, y / r, z / r
        back = inward(mount, c * x - s * y, s * x + c * y, z)  # the row in the frame before
        for b in range(3):
            F[a, b] = (back[0] * old[3 * b] + back[1] * old[3 * b + 1] + back[2] * old[3 * b + 2]) * r_old / r
    return body


@implement(to_error, Polar)
def to_polar(error: Polar, pose: Array, values: Array, Hp: Array, Hl: Array) -> None:
    e, r = sight(values)
    for a in range(len(Hp)):
        Hp[a, 2] += pose[0] * Hp[a, 1] - pose[1] * Hp[a, 0]
        x, y, z = Hl[a, 0], Hl[a, 1], Hl[a, 2]
        for b in range(3):
            Hl[a, b] = r * (x * e[3 * b] + y * e[3 * b + 1] + z * e[3 * b + 2])


@implement(retract, Polar)
def retract_polar(error: Polar, slam: Slam, state: State, A: Array, y: Array, scratch: Scratch[NamedTuple]) -> None:
    """Pose (3,) <- Exp(xi) T, each landmark (3,) <- e^s exp(Omega) q, with the error A' y."""
    x, delta = state.x, scratch.delta[: state.n]
    fill(delta, 0.0)
    add_transposed_times(A, y, delta)
    move_pose(x[:3], delta[:3], x[:3])
    for o in range(3, state.n, 3):
        e, r = sight(x[o : o + 3])
        left, up = delta[o], delta[o + 1]
        angle = np.sqrt(left * left + up * up)
        across, along = np.sin(angle) / angle if angle > 0.0 else 1.0, np.cos(angle)
        r *= np.exp(delta[o + 2])
        for a in range(3):
            x[o + a] = r * (across * (left * e[a] + up * e[3 + a]) + along * e[6 + a])


@implement(pose_covariance, Polar)
def polar_pose_covariance(error: Polar, x: Array, P: Array, out: Array) -> None:
    shifted_covariance(x, P, out)


@part(sensor="Uvd", landmark="SensorPoint", error="Polar")
class EquivariantOutput(NamedTuple):
    """No parameters. The joint update with C* in the place of the Jacobian."""


implement(correct, EquivariantOutput)(correct_at_once)


@implement(predict_innovation, EquivariantOutput)
def predict_innovation_equivariant(
    update: EquivariantOutput,
    slam: Slam,
    state: State,
    data: Data,
    k: int,
    m: int,
    factors: Factors,
    scratch: Scratch[NamedTuple],
) -> tuple[int, float]:
    gather(slam, state, m, factors, scratch)
    linearise_seen(slam, state, k, m, scratch)
    for i in range(m):
        _average(slam.sensor, data.z[scratch.known[i]], state.x[scratch.at[i] : scratch.at[i] + 3], scratch.Hl[i])
    combine_seen(slam, state, m, scratch)
    innovate(slam, state, data, m, scratch)
    return 0, add_noise(slam, state, data, m, scratch)


@inner
def _average(sensor: Uvd, z: Array, q: Array, H: Array) -> None:
    """H (3, 3) <- C*, the mean of H, at the estimate q (3,), and of the derivative along the group at z (3,)."""
    if z[2] <= 0.0:  # of no point
        return
    e, _ = sight(q)
    x, y, w = locate(sensor, z)
    J = measure_jacobian(sensor, x, y, w)
    columns = (
        (e[4] * w - e[5] * y, e[5] * x - e[3] * w, e[3] * y - e[4] * x),  # b2 x y
        (e[2] * y - e[1] * w, e[0] * w - e[2] * x, e[1] * x - e[0] * y),  # -b1 x y
        (x, y, w),
    )
    for b in range(3):
        for a in range(3):
            along = J[3 * a] * columns[b][0] + J[3 * a + 1] * columns[b][1] + J[3 * a + 2] * columns[b][2]
            H[a, b] = 0.5 * (H[a, b] + along)


def parts(problem: Problem, controls: Array, uvd: bool) -> Slam:
    slam = ekf.parts(problem, controls, uvd)
    return slam._replace(landmark=SensorPoint(slam.sensor.mount), error=Polar(), update=EquivariantOutput())


FILTERS = variants(EquivariantKalman, "eqf", parts, "uvd")
