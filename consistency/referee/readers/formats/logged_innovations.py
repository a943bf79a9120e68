"""Innovations of flight logs with the variance of each component, as they become NIS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.types import Array

MICRO = 1e-6  # s in the unit of timestamps


@dataclass(frozen=True)
class Pairs:
    """Innovations and their variances as the log has them together, N messages."""

    t: Array  # (N,), s, increasing
    innovation: Mapping[str, Array]  # (N,) for each component, as "gps_hpos[0]" or "baro_vpos"
    variance: Mapping[str, Array]
    alone: int = 0  # messages of one topic without their partner in the other

    def require_variances(self, path: Path, message: str, where: str) -> None:
        """Refuse a variance below zero; ``where`` with {field} and {t} says of which."""
        for field, variance in self.variance.items():
            for row in np.flatnonzero(variance < 0)[:1]:
                at = where.format(field=field, t=f"{self.t[row]:.10g} s", value=f"{variance[row]:.4g}")
                raise InputError(f"{path}: {message}{at}")

    def of(self, parts: Sequence[str]) -> tuple[Array, Array, Array]:
        """Innovations and variances of some components, (N, n), and which are fused: with a variance above zero."""
        innovation = np.column_stack([self.innovation[part] for part in parts])
        variance = np.column_stack([self.variance[part] for part in parts])
        return innovation, variance, np.isfinite(innovation) & np.isfinite(variance) & (variance > 0)

    def nis(self, parts: Sequence[str]) -> tuple[Array, Array, int]:
        """NIS (N,), degrees of freedom (N,), and the number of messages that repeat the one before."""
        innovation, variance, fused = self.of(parts)
        both = np.nan_to_num(np.hstack([innovation, variance]), nan=np.inf)
        same = np.append(False, (both[1:] == both[:-1]).all(axis=1))
        ratio = np.where(fused, np.square(innovation), 0.0) / np.where(fused, variance, 1.0)
        dof = np.where(same, 0, fused.sum(axis=1)).astype(float)
        repeated = int((same & fused.any(axis=1)).sum())
        return np.where(dof > 0, ratio.sum(axis=1), np.nan), dof, repeated


def require_in_order(path: Path, topic: str, t: Array) -> None:
    """Refuse messages whose times go back."""
    if len(back := np.flatnonzero(np.diff(t) < 0)):
        raise InputError(f"{path}: message {back[0] + 2} of {topic} is older than the one before; the log is damaged")
