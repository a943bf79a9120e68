"""A landmark as azimuth, elevation (rad) and inverse range (1/m) in the frame of the sensor, whose map moves.

Civera, Davison & Montiel (2008) on the parametrisation, Castellanos et al. (2007) on the moving frame. rho times a
point is linear in the ray and in rho, so that a change of frame is exact at any range.

The second half converts a pixel (u, v, disparity) to these three: mean and covariance of what it says of a ray.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.arrays import fill_matrix
from consistency.bench.filters.kernel.part_functions import Nine, Triple, landmark_width, world_point
from consistency.bench.filters.kernel.unicycle import Frame
from consistency.bench.filters.parts.sensors import Growth, Uvd, ratio_at
from consistency.bench.models.point import Mounting
from consistency.referee.types import Array

BESIDE = 0.1  # cosine of the angle to the optical axis below which a prediction is in no image
BEYOND = 4.0  # standard deviations outside the search range at which a predicted disparity is held


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
def bent(q: Triple, rho: float, u: Array, w: Array) -> Triple:
    """Second derivative of azimuth, elevation and rho / |q| along u (4,) and w (4,), derivatives of q and of rho."""
    h2 = q[0] * q[0] + q[1] * q[1]
    r2 = h2 + q[2] * q[2]
    h, r = np.sqrt(h2), np.sqrt(r2)
    flat_u, flat_w = q[0] * u[0] + q[1] * u[1], q[0] * w[0] + q[1] * w[1]
    across_u, across_w = q[0] * u[1] - q[1] * u[0], q[0] * w[1] - q[1] * w[0]
    whole_u, whole_w = flat_u + q[2] * u[2], flat_w + q[2] * w[2]
    up_u, up_w = h * u[2] - q[2] * flat_u / h, h * w[2] - q[2] * flat_w / h
    level = u[0] * w[0] + u[1] * w[1]
    by_range = rho * (3.0 * whole_u * whole_w / r2 - level - u[2] * w[2]) - u[3] * whole_w - w[3] * whole_u
    return (
        -(across_u * flat_w + across_w * flat_u) / (h2 * h2),
        -(up_u * whole_w + up_w * whole_u) / (r2 * r2) - q[2] * (level - flat_u * flat_w / h2) / (h * r2),
        by_range / (r * r2),
    )


@inner
def second_order(
    y: Array,
    L: Array,
    b: Triple,
    D: Array,
    turn: Frame,
    mount: Mounting,
    along: float,
    about: float,
    ways: Array,
    rays_by: Array,
    means: Array,
    own: Array,
) -> None:
    """``means`` (2, 3) <- what the noise of drive and of turn adds to the mean of a landmark y (3,), to second order.

    ``own`` (3, 3) <- the covariance that its own error and both noises add, less the squares of these: the sum over
    pairs of the five errors of g g', with g the second derivative of the landmark along both, of size one standard
    deviation each, and half of that for the square of one. An error s of the turn takes b to Rz(-s) b, one of the drive
    to b - s rho (c, s, 0).

    Parameters
    ----------
    L : (3, 3), lower root of the covariance of y
    b, D : as of :func:`carried`
    along, about : standard deviations of drive (m) and turn (rad)
    ways, rays_by : (5, 4), work arrays: derivatives of b, and of the ray, with that of rho behind both
    """  # fmt: skip
    m, rho, c, s = rays(y[0], y[1]), y[2], turn.c, turn.s
    for k in range(5):
        way, r = ways[k], L[2, k] if k < 3 else 0.0
        if k < 3:
            x, v, z = outward(mount, L[0, k] * m[3] + L[1, k] * m[6], L[0, k] * m[4] + L[1, k] * m[7], L[1, k] * m[8])
            x, v = x + r * mount.x, v + r * mount.y
            way[0], way[1], way[2] = c * x - s * v + r * turn.x, s * x + c * v + r * turn.y, z + r * mount.z
        elif k == 3:
            way[0], way[1], way[2] = -along * rho * c, -along * rho * s, 0.0
        else:
            way[0], way[1], way[2] = about * b[1], -about * b[0], 0.0
        x, v, z = inward(mount, way[0] - r * mount.x, way[1] - r * mount.y, way[2] - r * mount.z)
        rays_by[k, 0], rays_by[k, 1], rays_by[k, 2], way[3], rays_by[k, 3] = x, v, z, r, r
    q = inward(mount, b[0] - rho * mount.x, b[1] - rho * mount.y, b[2] - rho * mount.z)
    fill_matrix(own, 0.0)
    for k in range(5):
        for i in range(k, 5):
            z = 0.0
            if i == 4:
                x, v = about * ways[k, 1], -about * ways[k, 0]
            elif i == 3:
                x, v = -along * c * ways[k, 3], -along * s * ways[k, 3]
            else:
                flat, up = L[0, k] * L[0, i], L[1, k] * L[1, i]
                mixed = L[0, k] * L[1, i] + L[1, k] * L[0, i]
                x, v, z = outward(
                    mount, -(flat + up) * m[0] - mixed * m[7], -(flat + up) * m[1] + mixed * m[6], -up * m[2]
                )
                x, v = c * x - s * v, s * x + c * v
            p = _bent_and_moved(bent(q, rho, rays_by[k], rays_by[i]), D, x, v, z)
            for a in range(3):
                if k == i and k > 2:
                    means[k - 3, a] = 0.5 * p[a]
                    continue
                for j in range(a, 3):
                    own[a, j] += (0.5 if k == i else 1.0) * p[a] * p[j]


@inner
def _bent_and_moved(g: Triple, D: Array, x: float, y: float, z: float) -> Triple:
    """g + D (x, y, z)."""
    return (
        g[0] + D[0, 0] * x + D[0, 1] * y + D[0, 2] * z,
        g[1] + D[1, 0] * x + D[1, 1] * y + D[1, 2] * z,
        g[2] + D[2, 0] * x + D[2, 1] * y + D[2, 2] * z,
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


# --- pixels ----------------------------------------------------------------------------------------


class Pixels(NamedTuple):
    """Standard deviations in px, the search range in px, and which corrections are made."""

    su: float
    sv: float
    sd: float
    growth: Growth  # of sd, with the disparity
    low: float
    high: float
    truncation: bool
    debiasing: bool
    prediction: bool


@inner
def _cosines(sensor: Uvd, u: float, v: float) -> tuple[float, float]:
    """Of the azimuth and the elevation of a pixel; cos(atan(x)) = 1 / sqrt(1 + x^2)."""
    f = sensor.f
    ca = f / math.sqrt(f * f + u * u)
    return ca, f / math.sqrt(f * f + v * ca * v * ca)


@inner
def convert(sensor: Uvd, u: float, v: float, d: float, y: Array) -> None:
    """``y`` (3,) <- azimuth and elevation (rad) and inverse range (1/m)."""
    ca, ce = _cosines(sensor, u, v)
    y[0], y[1], y[2] = math.atan2(-u, sensor.f), math.atan2(-v * ca, sensor.f), d * ce * ca / (sensor.f * sensor.B)


@inner
def conversion_jacobian(sensor: Uvd, u: float, v: float, d: float, J: Array) -> None:
    """``J`` (3, 3) <- derivatives of :func:`convert`."""
    f, g = sensor.f, 1.0 / (sensor.f * sensor.B)
    ca, ce = _cosines(sensor, u, v)
    sa, se = -u / f * ca, -v * ca / f * ce
    a_u, e_v = -f / (f * f + u * u), -ce * ce * ca / f
    e_u = ce * ce * v * sa * a_u / f
    J[0, 0], J[0, 1], J[0, 2] = a_u, 0.0, 0.0
    J[1, 0], J[1, 1], J[1, 2] = e_u, e_v, 0.0
    J[2, 0], J[2, 1], J[2, 2] = -d * g * (se * ca * e_u + ce * sa * a_u), -d * g * se * ca * e_v, g * ce * ca


@inner
def subtract_bias(sensor: Uvd, pixels: Pixels, u: float, v: float, d: float, y: Array) -> None:
    """``y`` (3,), the conversion, <- less what its mean differs from it, by three points in u and in v."""
    f, g = sensor.f, 1.0 / (sensor.f * sensor.B)
    a, e, rho = 6.0 * y[0], 6.0 * y[1], 6.0 * y[2]
    du, dv = math.sqrt(3.0) * pixels.su, math.sqrt(3.0) * pixels.sv
    for sign in (-1.0, 1.0):
        ca, ce = _cosines(sensor, u + sign * du, v)
        a += y[0] - math.atan2(-u - sign * du, f)
        e += y[1] - math.atan2(-v * ca, f)
        rho += y[2] - d * g * ce * ca
    ca, _ = _cosines(sensor, u, v)  # an error of v leaves the azimuth as it is
    for sign in (-1.0, 1.0):
        beside = (v + sign * dv) * ca
        e += y[1] - math.atan2(-beside, f)
        rho += y[2] - d * g * ca * f / math.sqrt(f * f + beside * beside)
    y[0], y[1], y[2] = a / 6.0, e / 6.0, rho / 6.0


@inner
def untruncated(low: float, high: float, sigma: float, d: float, expected: float) -> tuple[float, float]:
    """What d would be without the search range, and its variance: moments of the truncated normal."""
    e = min(max(expected, low - BEYOND * sigma), high + BEYOND * sigma)
    alpha, beta = (low - e) / sigma, (high - e) / sigma
    mass = 0.5 * (math.erfc(-beta / math.sqrt(2.0)) - math.erfc(-alpha / math.sqrt(2.0)))
    root = math.sqrt(2.0 * math.pi)
    at_low, at_high = math.exp(-0.5 * alpha * alpha) / root, math.exp(-0.5 * beta * beta) / root
    shift = (at_low - at_high) / mass
    kappa = 1.0 + (alpha * at_low - beta * at_high) / mass - shift * shift
    return e + (d - e - sigma * shift) / kappa, sigma * sigma / kappa


@inner
def observe_range(
    sensor: Uvd, pixels: Pixels, z: Array, of_d: float, shift: float, expected: Array, y: Array, R: Array, J: Array
) -> None:
    """``y`` (3,) <- the observation z where ``expected`` (3,) is predicted, ``R`` (3, 3) <- its noise.

    ``of_d`` is the variance of its disparity in px^2 where it was measured, ``shift`` the bias that was subtracted.
    """
    ca, ce = np.cos(expected[0]), np.cos(expected[1])
    u, v, d, measured, variance = z[0], z[1], z[2], z[2], of_d
    if ca > BESIDE and ce > BESIDE:
        u = -sensor.f * np.sin(expected[0]) / ca
        v = -sensor.f * np.sin(expected[1]) / (ce * ca)
        d = expected[2] * sensor.f * sensor.B / (ce * ca)
    if pixels.prediction:
        sigma = pixels.sd * ratio_at(pixels.growth, d)
        variance = sigma * sigma
    if pixels.truncation:
        measured, variance = untruncated(pixels.low - shift, pixels.high - shift, math.sqrt(variance), measured, d)
    if not pixels.prediction:
        u, v, d = z[0], z[1], measured
    convert(sensor, z[0], z[1], measured, y)
    if pixels.debiasing:
        subtract_bias(sensor, pixels, z[0], z[1], measured, y)
    conversion_jacobian(sensor, u, v, d, J)
    for a in range(3):
        for b in range(3):
            R[a, b] = (
                J[a, 0] * pixels.su * pixels.su * J[b, 0]
                + J[a, 1] * pixels.sv * pixels.sv * J[b, 1]
                + J[a, 2] * variance * J[b, 2]
            )
