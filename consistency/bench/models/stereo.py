"""Rectified small-baseline stereo, Herath, Kodagoda & Dissanayake (2007) eq. 21 and 22.

Pixels are relative to the principal point: u grows to the right, v downwards, d is the disparity.
"""

from __future__ import annotations

from consistency.bench.models.jitable import Number, jitable

Nine = tuple[Number, Number, Number, Number, Number, Number, Number, Number, Number]


@jitable
def project(x: Number, y: Number, z: Number, f: float, B: float) -> tuple[Number, Number, Number]:
    """Eq. 22: point in the sensor frame (m) to (u, v, d) in px; f in px, baseline B in m."""
    return -f * y / x, -f * z / x, f * B / x


@jitable
def project_jacobian(x: Number, y: Number, z: Number, f: float, B: float) -> Nine[Number]:
    """d(u, v, d) / d(x, y, z) by rows."""
    g = f / x
    return g * y / x, -g, 0.0 * g, g * z / x, 0.0 * g, -g, -g * B / x, 0.0 * g, 0.0 * g


@jitable
def triangulate(u: Number, v: Number, d: Number, f: float, B: float) -> tuple[Number, Number, Number]:
    """Eq. 21: (u, v, d) in px to the point in the sensor frame (m)."""
    return B * f / d, -B * u / d, -B * v / d


@jitable
def triangulate_jacobian(u: Number, v: Number, d: Number, f: float, B: float) -> Nine[Number]:
    """d(x, y, z) / d(u, v, d) by rows."""
    g = B / d
    return 0.0 * g, 0.0 * g, -g * f / d, -g, 0.0 * g, g * u / d, 0.0 * g, -g, g * v / d
