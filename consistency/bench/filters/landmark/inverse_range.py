"""A landmark as azimuth, elevation (rad) and inverse range (1/m) in the frame of the sensor, whose map moves.

Civera, Davison & Montiel (2008) on the parametrisation, Castellanos et al. (2007) on the moving frame. rho times a
point is linear in the ray and in rho, so that a change of frame is exact at any range.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.arrays import fill_matrix
from consistency.bench.filters.kernel.part_functions import Nine, Triple, landmark_width, world_point
from consistency.bench.filters.motion.unicycle import Frame
from consistency.bench.models.point import Mounting
from consistency.referee.types import Array


@part(update="Converting", covariance="Parking")
class InverseRange(NamedTuple):
    """Where the sensor is mounted on the robot."""

    mount: Mounting


@implement(landmark_width, InverseRange)
def inverse_range_width(landmark: InverseRange) -> int:
    return 3


@inner
def outward(mount: Mounting, x: float, y: float, z: float) -> Triple:
    """A direction in the frame of the sensor, in the robot's."""
    return (
        mount.xx * x + mount.xy * y + mount.xz * z,
        mount.yx * x + mount.yy * y + mount.yz * z,
        mount.zx * x + mount.zy * y + mount.zz * z,
    )


@inner
def inward(mount: Mounting, x: float, y: float, z: float) -> Triple:
    """Inverse of :func:`outward`."""
    return (
        mount.xx * x + mount.yx * y + mount.zx * z,
        mount.xy * x + mount.yy * y + mount.zy * z,
        mount.xz * x + mount.yz * y + mount.zz * z,
    )


@inner
def rays(a: float, e: float) -> Nine:
    """The unit vector of azimuth and elevation, and its derivatives by both."""
    ca, sa, ce, se = np.cos(a), np.sin(a), np.cos(e), np.sin(e)
    return ce * ca, ce * sa, se, -ce * sa, ce * ca, 0.0, -se * ca, -se * sa, ce


@inner
def by_ray(q: Triple, rho: float, there: Array, D: Array) -> float:
    """``there`` (3,) <- the landmark of the ray q and rho, ``D`` (3, 3) <- its derivative by q; returns 1 / |q|."""
    h2 = q[0] * q[0] + q[1] * q[1]
    r2 = h2 + q[2] * q[2]
    h, r = np.sqrt(h2), np.sqrt(r2)
    there[0], there[1], there[2] = np.arctan2(q[1], q[0]), np.arctan2(q[2], h), rho / r
    D[0, 0], D[0, 1], D[0, 2] = -q[1] / h2, q[0] / h2, 0.0
    D[1, 0], D[1, 1], D[1, 2] = -q[2] * q[0] / (h * r2), -q[2] * q[1] / (h * r2), h / r2
    g = -rho / (r * r2)
    D[2, 0], D[2, 1], D[2, 2] = g * q[0], g * q[1], g * q[2]
    return float(1.0 / r)


@inner
def carried(y: Array, turn: Frame, mount: Mounting, there: Array, J: Array, D: Array) -> Triple:
    """``there`` (3,) <- y (3,) after a change b -> R b + t of the robot's frame; ``J`` <- its derivative by y.

    ``D`` (3, 3) <- its derivative by rho times the point in the new frame of the robot, which is returned.
    """
    c, s, rho = turn.c, turn.s, y[2]
    m = rays(y[0], y[1])
    bx, by, bz = outward(mount, m[0], m[1], m[2])
    bx, by, bz = bx + rho * mount.x, by + rho * mount.y, bz + rho * mount.z
    px, py = c * bx - s * by + rho * turn.x, s * bx + c * by + rho * turn.y
    q = inward(mount, px - rho * mount.x, py - rho * mount.y, bz - rho * mount.z)
    per_range = by_ray(q, rho, there, D)
    ax, ay, az = outward(mount, m[3], m[4], m[5])
    a = inward(mount, c * ax - s * ay, s * ax + c * ay, az)
    ex, ey, ez = outward(mount, m[6], m[7], m[8])
    e = inward(mount, c * ex - s * ey, s * ex + c * ey, ez)
    ox, oy = c * mount.x - s * mount.y + turn.x - mount.x, s * mount.x + c * mount.y + turn.y - mount.y
    o = inward(mount, ox, oy, 0.0)
    for i in range(3):
        d0, d1, d2 = D[i, 0], D[i, 1], D[i, 2]
        J[i, 0] = d0 * a[0] + d1 * a[1] + d2 * a[2]
        J[i, 1] = d0 * e[0] + d1 * e[1] + d2 * e[2]
        J[i, 2] = d0 * o[0] + d1 * o[1] + d2 * o[2]
        D[i, 0], D[i, 1], D[i, 2] = outward(mount, d0, d1, d2)
    J[2, 2] += per_range
    return px, py, bz


@inner
def bent(q: Triple, rho: float, w: Triple) -> Triple:
    """Second derivative of azimuth, elevation and rho / |q| along q + s w, at s = 0."""
    h2 = q[0] * q[0] + q[1] * q[1]
    r2 = h2 + q[2] * q[2]
    h, r = np.sqrt(h2), np.sqrt(r2)
    flat = q[0] * w[0] + q[1] * w[1]
    whole = flat + q[2] * w[2]
    w2 = w[0] * w[0] + w[1] * w[1]
    dh, dr = flat / h, whole / r
    ddh, ddr = (w2 - dh * dh) / h, (w2 + w[2] * w[2] - dr * dr) / r
    de = (h * w[2] - q[2] * dh) / r2
    return (
        -2.0 * (q[0] * w[1] - q[1] * w[0]) * flat / (h2 * h2),
        -(q[2] * ddh + 2.0 * de * whole) / r2,
        rho * (2.0 * dr * dr / r - ddr) / r2,
    )


@inner
def curvature(
    b: Triple, rho: float, D: Array, turn: Frame, mount: Mounting, along: float, about: float
) -> tuple[Triple, Triple]:
    """What noise of the drive, m, and of the turn, rad, adds to the mean of a landmark, to second order.

    ``b``, ``D`` are those of :func:`carried`. An error s of the turn takes b to b + s (b_y, -b_x, 0) -
    s^2 / 2 (b_x, b_y, 0), one of the drive to b - s rho (c, s, 0).
    """
    q = inward(mount, b[0] - rho * mount.x, b[1] - rho * mount.y, b[2] - rho * mount.z)
    t0, t1, t2 = bent(q, rho, inward(mount, b[1], -b[0], 0.0))
    d0, d1, d2 = bent(q, rho, inward(mount, -rho * turn.c, -rho * turn.s, 0.0))
    drive, by_turn = 0.5 * along * along, 0.5 * about * about
    return (drive * d0, drive * d1, drive * d2), (
        by_turn * (t0 - D[0, 0] * b[0] - D[0, 1] * b[1]),
        by_turn * (t1 - D[1, 0] * b[0] - D[1, 1] * b[1]),
        by_turn * (t2 - D[2, 0] * b[0] - D[2, 1] * b[1]),
    )


@implement(world_point, InverseRange)
def inverse_range_in_world(
    landmark: InverseRange, frame: Frame, values: Array, point: Array, Dp: Array, Dl: Array
) -> None:
    mount, rho, c, s = landmark.mount, values[2], frame.c, frame.s
    m = rays(values[0], values[1])
    fill_matrix(Dp, 0.0)
    for j in range(3):
        x, y, z = outward(mount, m[3 * j], m[3 * j + 1], m[3 * j + 2])
        x, y, z = (c * x - s * y) / rho, (s * x + c * y) / rho, z / rho
        if j == 0:
            point[0] = frame.x + x + c * mount.x - s * mount.y
            point[1] = frame.y + y + s * mount.x + c * mount.y
            point[2] = z + mount.z
            Dl[0, 2], Dl[1, 2], Dl[2, 2] = -x / rho, -y / rho, -z / rho
        else:
            Dl[0, j - 1], Dl[1, j - 1], Dl[2, j - 1] = x, y, z
    Dp[0, 0] = Dp[1, 1] = 1.0
    Dp[0, 2], Dp[1, 2] = frame.y - point[1], point[0] - frame.x
