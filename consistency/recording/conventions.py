"""Conventions of errors; they are defined in :mod:`consistency.geometry.conventions`."""

from __future__ import annotations

from consistency.geometry.conventions import (
    ADDITIVE,
    PLANAR,
    SPATIAL,
    half_cotangent,
    planar_error,
    se2_log,
    se3_log,
    spatial_error,
)

__all__ = ["ADDITIVE", "PLANAR", "SPATIAL", "half_cotangent", "planar_error", "se2_log", "se3_log", "spatial_error"]
