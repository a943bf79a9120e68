"""A robot-centred map whose observations are converted to its variables: parts, work arrays, motion, new landmarks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.covariance_update.parking import Clones
from consistency.bench.filters.kernel.arrays import blocks, copy, fill_matrix, integers, matrix, vector
from consistency.bench.filters.kernel.covariance import add_gram_to_state, multiply_columns, multiply_rows
from consistency.bench.filters.kernel.part_functions import Slam, State, make_room, place, predict
from consistency.bench.filters.kernel.work_arrays import Work
from consistency.bench.filters.landmark.inverse_range import (
    Pixels,
    carried,
    conversion_jacobian,
    convert,
    curvature,
    subtract_bias,
)
from consistency.bench.filters.motion.unicycle import Frame, move, noise_columns
from consistency.referee.types import Array, Indices


@part(sensor="Uvd", landmark="InverseRange", error="InvariantPose", covariance="Parking")
class Converting(NamedTuple):
    """What is known of the pixels, and what is done about a return.

    ``waiting``: alone and in doubt it stays parked if its distance is known to this part of it; ``passes`` of such an
    update at most, and of one in a ``chain``, tried first, 0 for none; ``clones`` at most, and no more than landmarks.
    ``recency``: a moved robot keeps the errors from before its last motion; ``curvature``: a motion moves landmarks
    by the mean of its noise to second order; ``spread``: and adds to their covariance what that noise spreads them.
    The noise of a new return in doubt is raised by so many ``decades`` at first, that of any return by as many as it is
    below what is predicted if these are 0, and by ``cooling`` less in each pass.
    """

    pixels: Pixels
    waiting: float
    passes: int
    chain: int
    clones: int
    recency: bool
    curvature: bool
    spread: bool
    decades: float
    cooling: float


@part(update="Converting")
class Converted(NamedTuple):
    """No parameters. Observations are linear in the map, so there is no point at which they are linearised."""


class ConvertingRoom(NamedTuple):
    """For up to m landmarks and c clones in a step, and a state of up to n variables."""

    at: Indices  # (m + c,) offsets of the seen landmarks, then of clones: of those that are parked, or all
    number: Indices  # (c,) numbers of these clones
    clone: Indices  # (m,) which of these clones a landmark has, or -1
    rows: Array  # (3 + 3 (m + c), n) rows of P, and behind them of Phi, of the robot and of all these
    among: Array  # (3 + 3 (m + c), 3 + 3 (m + c)) their columns of these alone
    cast: Array  # (3 + 3 (m + c), 3 + 3 (m + c)) and by errors about the poses of a pass
    place: Indices  # (m + c,) their offsets there
    on: Indices  # (1,) which of these clones the robot hangs on
    frames: Array  # (c + 1, 3) poses of the clones and of the robot where ``delta`` leads
    turns: Array  # (c + 1, 3, 3) error about each / d delta
    links: Array  # (c + 1, 3, 3) how errors about them are chained
    own: Array  # (m, 3, 3) Jacobian with respect to the landmark
    shift: Array  # (m, 3, 3) and to xi of its clone less that of the pose, about the moved state
    by_clone: Array  # (m, 3, 3) and to xi of its clone
    by_pose: Array  # (m, 3, 3) and to xi of the pose about the state before
    y: Array  # (m, 3) converted observations
    h: Array  # (m, 3) what is expected
    R: Array  # (m, 3, 3)
    delta: Array  # (3 + 3 (m + c),) a correction of the robot and of all these
    before: Array  # (3 + 3 (m + c),)
    noise: Array  # (4, n) what the motion of this step added to the errors, for each of its noises and their squares
    moving: Indices  # (n / 3,) offsets of the landmarks that move
    J: Array  # (n / 3, 3, 3) how
    mixed: Array  # (n / 3, 3) error of each by the noise of the drive times that of its rho, one standard deviation
    three: Array  # (4, 3, 3)
    poses: Array  # (5, 3)


@inner
def _every_third(n: int) -> Indices:
    """3, 6, 9, ..., (n,)."""
    places = integers(n, 0)
    for i in range(n):
        places[i] = 3 + 3 * i
    return places


@implement(make_room, Converting)
def converting_room(update: Converting, w: int, s: int, m: int, n: int) -> ConvertingRoom:
    c = max(m, min(update.clones, (n - 3) // 6))
    most = 3 + 3 * (m + c)
    return ConvertingRoom(
        integers(m + c, 0), integers(c, 0), integers(m, 0), matrix(most, n),
        matrix(most, most), matrix(most, most), _every_third(m + c), integers(1, 0),
        matrix(c + 1, 3), blocks(c + 1, 3, 3), blocks(c + 1, 3, 3),
        blocks(m, 3, 3), blocks(m, 3, 3), blocks(m, 3, 3), blocks(m, 3, 3),
        matrix(m, 3), matrix(m, 3), blocks(m, 3, 3), vector(most), vector(most),
        matrix(4, n), integers(n // 3, 0), blocks(n // 3, 3, 3), matrix(n // 3, 3),
        blocks(4, 3, 3), matrix(5, 3),
    )  # fmt: skip


@implement(predict, Converting)
def predict_centred(
    update: Converting,
    slam: Slam,
    state: State,
    k: int,
    u: Array,
    local: Clones,
    work: Work[ConvertingRoom],
) -> None:
    x, P, n, room, G = state.x, state.P, state.n, work.room, work.small
    noise_columns(slam.motion, x[:3], u, G)
    move(x[:3], u, x[:3])
    noise = room.noise[: 4 if update.spread else 2, :n]
    fill_matrix(noise, 0.0)
    for c in range(2):
        noise[c, 0], noise[c, 1], noise[c, 2] = G[0, c] + x[1] * G[2, c], G[1, c] - x[0] * G[2, c], G[2, c]
    forward, c, s = u[0] * u[1], np.cos(u[0] * u[2]), -np.sin(u[0] * u[2])
    turn = Frame(-c * forward, -s * forward, c, s)
    moving = 0
    for label in range(len(state.offset)):
        o = state.offset[label]
        if o >= 0 and local.of[label] < 0:
            J, D, there = room.J[moving], room.three[0], room.poses[0]
            rho = x[o + 2]
            point = carried(x[o : o + 3], turn, slam.landmark.mount, there, J, D)
            along, about = u[0] * slam.motion.sigma_v, u[0] * slam.motion.sigma_omega
            for a in range(3):
                noise[0, o + a] = -along * rho * (D[a, 0] * c + D[a, 1] * s)
                noise[1, o + a] = about * (D[a, 0] * point[1] - D[a, 1] * point[0])
            if update.curvature or update.spread:
                of_drive, of_turn = curvature(point, rho, D, turn, slam.landmark.mount, along, about)
                for a in range(3):
                    if update.curvature:
                        there[a] += of_drive[a] + of_turn[a]
                    if update.spread:  # the square of a normal of variance s^2 has variance 2 s^4
                        noise[2, o + a], noise[3, o + a] = np.sqrt(2.0) * of_drive[a], np.sqrt(2.0) * of_turn[a]
                        by_range = along * np.sqrt(P[o + 2, o + 2])
                        room.mixed[moving, a] = by_range * (D[a, 0] * c + D[a, 1] * s)
            copy(there, x[o : o + 3])
            room.moving[moving] = o
            moving += 1
    _move_rows(P, n, room.moving, room.J, moving)
    for i in range(moving if state.base > 0 else 0):
        multiply_rows(local.factors.Phi[room.moving[i] : room.moving[i] + 3], room.J[i], 0, state.base)
    add_gram_to_state(1.0, noise, P, n)
    for i in range(moving if update.spread else 0):
        o = room.moving[i]
        for a in range(3):
            for b in range(a, 3):
                P[o + a, o + b] += room.mixed[i, a] * room.mixed[i, b]


@inner
def _move_rows(P: Array, n: int, at: Indices, J: Array, count: int) -> None:
    """P <- F P F' where F is the identity but for blocks J (count, 3, 3) at offsets ``at``."""
    for i in range(count):
        o, F = at[i], J[i]
        p0, p1, p2 = P[o], P[o + 1], P[o + 2]
        p1[o], p2[o], p2[o + 1] = p0[o + 1], p0[o + 2], p1[o + 2]
        multiply_rows(P[o : o + 3], F, o, n)
    for j in range(n):
        row = P[j]
        for i in range(count):
            o, F = at[i], J[i]
            if o + 2 >= j:
                multiply_columns(row, o, F)


@implement(place, Converted)
def place_converted(
    point: Converted, slam: Slam, state: State, k: int, label: int, z: Array, work: Work[ConvertingRoom]
) -> None:
    sensor, pixels, y = slam.sensor, slam.update.pixels, state.x[state.n : state.n + 3]
    convert(sensor, z[0], z[1], z[2], y)
    if pixels.debiasing:
        subtract_bias(sensor, pixels, z[0], z[1], z[2], y)
    conversion_jacobian(sensor, z[0], z[1], z[2], work.Jz)
    fill_matrix(work.Jp, 0.0)
