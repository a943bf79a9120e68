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
from consistency.bench.filters.kernel.linalg import fill_matrix
from consistency.bench.filters.kernel.part_functions import Frame, Nine, Triple, landmark_width, world_point
from consistency.bench.filters.parts.sensors import Growth, Uvd, ratio_at
from consistency.bench.scenario.models import Mounting
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
def carried(y: Array, turn: Frame, mount: Mounting, there: Array, J: Array, D: Array, B: Array) -> Triple:
    """``there`` (3,) <- y (3,) after a change b -> R b + t of the robot's frame; ``J`` <- its derivative by y.

    ``D`` (3, 3) <- its derivative by rho times the point in the new frame of the robot, b, which is returned; ``B``
    (3, 3) <- the derivative by y of b less rho times the place of the sensor.
    """
    c, s, rho = turn.c, turn.s, y[2]
    m = rays(y[0], y[1])
    bx, by, bz = outward(mount, m[0], m[1], m[2])
    bx, by, bz = bx + rho * mount.x, by + rho * mount.y, bz + rho * mount.z
    px, py = c * bx - s * by + rho * turn.x, s * bx + c * by + rho * turn.y
    q = inward(mount, px - rho * mount.x, py - rho * mount.y, bz - rho * mount.z)
    per_range = by_ray(q, rho, there, D)
    for j in range(2):
        x, v, B[2, j] = outward(mount, m[3 + 3 * j], m[4 + 3 * j], m[5 + 3 * j])
        B[0, j], B[1, j] = c * x - s * v, s * x + c * v
    B[0, 2] = c * mount.x - s * mount.y + turn.x - mount.x
    B[1, 2] = s * mount.x + c * mount.y + turn.y - mount.y
    B[2, 2] = 0.0
    for i in range(3):
        D[i, 0], D[i, 1], D[i, 2] = outward(mount, D[i, 0], D[i, 1], D[i, 2])
        for j in range(3):
            J[i, j] = row_times(D, i, B[0, j], B[1, j], B[2, j])
    J[2, 2] += per_range
    return px, py, bz


@inner
def row_times(A: Array, i: int, x: float, y: float, z: float) -> float:
    """Row i of A (3, 3) times (x, y, z)."""
    return float(A[i, 0] * x + A[i, 1] * y + A[i, 2] * z)


@inner
def second_order(
    y: Array,
    L: Array,
    b: Triple,
    D: Array,
    B: Array,
    turn: Frame,
    mount: Mounting,
    of_drive: float,
    of_turn: float,
    first: int,
    ways: Array,
    means: Array,
    own: Array,
) -> None:
    """``means`` (2, 3) <- what the noise of drive and of turn adds to the mean of a landmark y (3,), to second order.

    ``own`` (3, 3) <- the covariance that its own error and both noises add, less the squares of these: the sum over
    pairs of the five errors of g g', with g the second derivative of the landmark along both, of size one standard
    deviation each, and half of that for the square of one. An error s of the turn takes b to Rz(-s) b, one of the drive
    to b - s rho (c, s, 0).

    With the first derivatives a, e, l and t of azimuth, elevation, logarithm of the range and rho, those of second
    order along two straight ways u and w are -(a_u k_w + a_w k_u) with k = l - e tan, -(e_u l_w + e_w l_u) -
    a_u a_w sin cos and -(t_u l_w + t_w l_u) - rho (e_u e_w + a_u a_w cos^2), of the elevation. A way that bends adds D
    times its own second derivative. rho here is that of the new frame.

    Parameters
    ----------
    L : (3, 3), lower root of the covariance of y
    b, D, B : as of :func:`carried`
    of_drive, of_turn : standard deviations of drive (m) and turn (rad)
    first : 0, or 3 for the two noises alone
    ways : (5, 9), scratch: by each error, the derivatives of b - rho s (3), with s the place of the sensor, and of
        rho; then a, e, t, l and k
    """
    rho, sine, cosine = y[2], np.sin(y[1]), np.cos(y[1])
    x, v, z = b[0] - rho * mount.x, b[1] - rho * mount.y, b[2] - rho * mount.z
    per_range2 = 1.0 / (x * x + v * v + z * z)
    per_range = np.sqrt(per_range2)
    up = per_range * (mount.xz * x + mount.yz * v + mount.zz * z)
    flat2 = 1.0 - up * up
    flat, n0, n1, n2 = np.sqrt(flat2), x - rho * B[0, 2], v - rho * B[1, 2], z
    for k in range(first, 5):
        way = ways[k]
        way[2] = way[3] = 0.0
        if k == 3:
            way[0], way[1] = -of_drive * rho * turn.c, -of_drive * rho * turn.s
        elif k == 4:
            way[0], way[1] = of_turn * b[1], -of_turn * b[0]
        else:
            way[3] = L[2, k]
            for a in range(3):
                way[a] = row_times(B, a, L[0, k], L[1, k], L[2, k])
        for a in range(3):
            way[4 + a] = row_times(D, a, way[0], way[1], way[2])
        way[6] += way[3] * per_range
        way[7] = per_range2 * (x * way[0] + v * way[1] + z * way[2])
        way[8] = way[7] - way[5] * up / flat
    fill_matrix(own, 0.0)
    for k in range(first, 5):
        u = ways[k]
        for i in range(k, 5):
            w = ways[i]
            if i == 4:
                x, v, z = of_turn * (u[1] + u[3] * mount.y), -of_turn * (u[0] + u[3] * mount.x), 0.0
            elif i == 3:
                x, v, z = -of_drive * turn.c * u[3], -of_drive * turn.s * u[3], 0.0
            else:
                aa, ae, ee = L[0, k] * L[0, i], L[0, k] * L[1, i] + L[1, k] * L[0, i], L[1, k] * L[1, i]
                by_n, by_a, by_e = -cosine * cosine * aa - ee, -ae * sine / cosine, sine * cosine * aa
                x = by_n * n0 + by_a * B[0, 0] + by_e * B[0, 1]
                v = by_n * n1 + by_a * B[1, 0] + by_e * B[1, 1]
                z = by_n * n2 + by_a * B[2, 0] + by_e * B[2, 1]
            a = row_times(D, 0, x, v, z) - u[4] * w[8] - w[4] * u[8]
            e = row_times(D, 1, x, v, z) - u[5] * w[7] - w[5] * u[7] - up * flat * u[4] * w[4]
            t = row_times(D, 2, x, v, z) - u[6] * w[7] - w[6] * u[7]
            t -= rho * per_range * (u[5] * w[5] + flat2 * u[4] * w[4])
            if k == i and k > 2:
                means[k - 3, 0], means[k - 3, 1], means[k - 3, 2] = 0.5 * a, 0.5 * e, 0.5 * t
            else:
                add_square(0.5 if k == i else 1.0, a, e, t, own)


@inner
def add_square(weight: float, x: float, y: float, z: float, A: Array) -> None:
    """Upper half of A (3, 3) <- A + weight (x, y, z) (x, y, z)'."""
    A[0, 0] += weight * x * x
    A[0, 1] += weight * x * y
    A[0, 2] += weight * x * z
    A[1, 1] += weight * y * y
    A[1, 2] += weight * y * z
    A[2, 2] += weight * z * z


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
