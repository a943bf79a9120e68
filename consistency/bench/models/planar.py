"""Range and bearing in the plane: h, its inverse, and the Jacobians of both."""

from __future__ import annotations

import numpy as np

from consistency.bench.models.jitable import Number, jitable

Four = tuple[Number, Number, Number, Number]


@jitable
def range_bearing(x: Number, y: Number) -> tuple[Number, Number]:
    """Point in the sensor frame (m) to range (m) and bearing (rad, counter-clockwise from x, within a half turn)."""
    return np.sqrt(x * x + y * y), np.arctan2(y, x)


@jitable
def range_bearing_jacobian(x: Number, y: Number) -> Four[Number]:
    """d(range, bearing) / d(x, y) by rows."""
    square = x * x + y * y
    distance = np.sqrt(square)
    return x / distance, y / distance, -y / square, x / square


@jitable
def at_range_bearing(distance: Number, bearing: Number) -> tuple[Number, Number]:
    """Inverse of :func:`range_bearing`: the point in the sensor frame (m)."""
    return distance * np.cos(bearing), distance * np.sin(bearing)


@jitable
def at_range_bearing_jacobian(distance: Number, bearing: Number) -> Four[Number]:
    """d(x, y) / d(range, bearing) by rows."""
    c, s = np.cos(bearing), np.sin(bearing)
    return c, -distance * s, s, distance * c
