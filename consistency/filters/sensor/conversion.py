"""(u, v, disparity) as azimuth, elevation and inverse range: mean and covariance of what a pixel says of a ray."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from consistency.filters.kernel.jit import inner
from consistency.filters.kernel.slam import Triple
from consistency.filters.sensor.uvd import Uvd
from consistency.types import Array

BESIDE = 0.1  # cosine of the angle to the optical axis below which a prediction is in no image
BEYOND = 4.0  # standard deviations outside the search range at which a predicted disparity is held


class Pixels(NamedTuple):
    """Standard deviations in px, the search range in px, and which corrections are made."""

    su: float
    sv: float
    sd: float
    low: float
    high: float
    truncation: bool
    debiasing: bool
    prediction: bool


@inner
def convert(sensor: Uvd, u: float, v: float, d: float, y: Array) -> None:
    """``y`` (3,) <- azimuth and elevation (rad) and inverse range (1/m)."""
    a = np.arctan2(-u, sensor.f)
    e = np.arctan2(-v * np.cos(a), sensor.f)
    y[0], y[1], y[2] = a, e, d * np.cos(e) * np.cos(a) / (sensor.f * sensor.B)


@inner
def conversion_jacobian(sensor: Uvd, u: float, v: float, d: float, J: Array) -> None:
    """``J`` (3, 3) <- derivatives of :func:`convert`."""
    f, g = sensor.f, 1.0 / (sensor.f * sensor.B)
    a = np.arctan2(-u, f)
    sa, ca = np.sin(a), np.cos(a)
    e = np.arctan2(-v * ca, f)
    se, ce = np.sin(e), np.cos(e)
    a_u, e_v = -f / (f * f + u * u), -ce * ce * ca / f
    e_u = ce * ce * v * sa * a_u / f
    J[0, 0], J[0, 1], J[0, 2] = a_u, 0.0, 0.0
    J[1, 0], J[1, 1], J[1, 2] = e_u, e_v, 0.0
    J[2, 0], J[2, 1], J[2, 2] = -d * g * (se * ca * e_u + ce * sa * a_u), -d * g * se * ca * e_v, g * ce * ca


@inner
def add_bias(sensor: Uvd, pixels: Pixels, z: Triple, weight: float, around: Array, y: Array) -> None:
    """``y`` += weight (mean of the conversion - conversion of the mean), by three points in u and in v."""
    u, v, d = z
    for i in range(2):
        step = np.sqrt(3.0) * (pixels.su if i == 0 else pixels.sv)
        for sign in (-1.0, 1.0, 0.0):
            along = sign * step
            convert(sensor, u + (along if i == 0 else 0.0), v + (along if i == 1 else 0.0), d, around)
            share = weight / 6.0 if sign != 0.0 else -weight / 3.0
            for a in range(3):
                y[a] += share * around[a]


@inner
def untruncated(pixels: Pixels, d: float, expected: float) -> tuple[float, float]:
    """What d would be without the search range, and its variance: moments of the truncated normal."""
    sigma = pixels.sd
    e = min(max(expected, pixels.low - BEYOND * sigma), pixels.high + BEYOND * sigma)
    alpha, beta = (pixels.low - e) / sigma, (pixels.high - e) / sigma
    mass = 0.5 * (math.erfc(-beta / math.sqrt(2.0)) - math.erfc(-alpha / math.sqrt(2.0)))
    root = math.sqrt(2.0 * math.pi)
    at_low, at_high = math.exp(-0.5 * alpha * alpha) / root, math.exp(-0.5 * beta * beta) / root
    shift = (at_low - at_high) / mass
    kappa = 1.0 + (alpha * at_low - beta * at_high) / mass - shift * shift
    return e + (d - e - sigma * shift) / kappa, sigma * sigma / kappa


@inner
def observe_range(
    sensor: Uvd, pixels: Pixels, z: Array, expected: Array, y: Array, R: Array, J: Array, around: Array
) -> None:
    """``y`` (3,) <- the observation z where ``expected`` (3,) is predicted, ``R`` (3, 3) <- its noise."""
    ca, ce = np.cos(expected[0]), np.cos(expected[1])
    u, v, d, measured, variance = z[0], z[1], z[2], z[2], pixels.sd * pixels.sd
    if ca > BESIDE and ce > BESIDE:
        u = -sensor.f * np.tan(expected[0])
        v = -sensor.f * np.tan(expected[1]) / ca
        d = expected[2] * sensor.f * sensor.B / (ce * ca)
    if pixels.truncation:
        measured, variance = untruncated(pixels, measured, d)
    if not pixels.prediction:
        u, v, d = z[0], z[1], measured
    convert(sensor, z[0], z[1], measured, y)
    if pixels.debiasing:
        add_bias(sensor, pixels, (z[0], z[1], measured), -1.0, around, y)
    conversion_jacobian(sensor, u, v, d, J)
    for a in range(3):
        for b in range(3):
            R[a, b] = (
                J[a, 0] * pixels.su * pixels.su * J[b, 0]
                + J[a, 1] * pixels.sv * pixels.sv * J[b, 1]
                + J[a, 2] * variance * J[b, 2]
            )
