"""(u, v, disparity) as azimuth, elevation and inverse range: mean and covariance of what a pixel says of a ray."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.sensor.models import Growth, Uvd, ratio_at
from consistency.referee.types import Array

BESIDE = 0.1  # cosine of the angle to the optical axis below which a prediction is in no image
BEYOND = 4.0  # standard deviations outside the search range at which a predicted disparity is held


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
