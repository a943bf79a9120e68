"""Estimates of one run beside samples of the truth, before any error is taken."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from consistency.referee.geometry.conventions import planar_error
from consistency.referee.readers.formats.sheet import Places
from consistency.referee.readers.matching import Known, Manifold, nearest, truth_at
from consistency.referee.types import Array, Indices


@dataclass(frozen=True)
class Poses:
    """One run; N estimates and M samples of the truth.

    ``convention`` is that of the error which the covariance describes. Broken values are NaN.
    """

    place: Places  # (N,), "est.csv, line 7"
    t: Array  # (N,), s, increasing
    estimate: Array  # (N, m)
    covariance: Array  # (N, n, n)
    stated: Array  # (N,) of bool: there is a covariance
    true_t: Array  # (M,), s, increasing
    truth: Array  # (M, m)
    manifold: Manifold
    convention: str
    max_dt: float  # s
    cross: Array | None = None  # (N, n, n), E e_before e' with the row before; dropped where rows are chosen
    true_covariance: Array | None = None  # (M, n, n), of the truth's own error in the convention; NaN where it has none

    def known(self, shift: float = 0.0) -> Known:
        """The truth at the timestamps, ``shift`` s later."""
        return truth_at(self.t + shift, self.true_t, self.truth, self.manifold, self.max_dt)

    def truth_covariances(self, known: Known, shift: float = 0.0) -> Array | None:
        """Covariance of the truth at the rows of ``known``, that of the nearest sample, (k, n, n)."""
        if self.true_covariance is None:
            return None
        return self.true_covariance[nearest(self.t[known.rows] + shift, self.true_t, known.before)]

    def errors(self, shift: float = 0.0) -> Array:
        """Truth less estimate, (N, n), with the truth ``shift`` s later; NaN where one of both is not known."""
        known = self.known(shift)
        out = np.full(self.covariance.shape[:2], np.nan)
        out[known.rows] = self.error_of(known.rows, known.truth)
        return out

    def error_of(self, rows: Indices, truth: Array) -> Array:
        """Error (k, n) of some rows; NaN where the estimate is not finite."""
        estimate = self.estimate[rows]
        finite = np.isfinite(estimate).all(axis=1)
        out = np.full((len(rows), self.covariance.shape[-1]), np.nan)
        error = planar_error
        if self.manifold == "spatial":
            from consistency.referee.geometry.space_errors import state_error as error
        out[finite] = error(truth[finite], estimate[finite], self.convention)
        return out

    def later(self, shift: float) -> Poses:
        return replace(self, t=self.t + shift) if shift else self

    def sound(self) -> Poses:
        """The estimates that are finite, with a finite covariance."""
        return self._of(
            np.flatnonzero(np.isfinite(self.estimate).all(axis=1) & np.isfinite(self.covariance).all((1, 2)))
        )

    def some(self, most: int) -> Poses:
        """At most ``most`` estimates, evenly chosen."""
        if len(self.t) <= most:
            return self
        return self._of(np.unique(np.linspace(0, len(self.t) - 1, most).astype(int)))

    def alone(self) -> Poses:
        """Without velocities and biases behind the poses in space."""
        if self.manifold != "spatial" or self.covariance.shape[-1] == 6:
            return self
        return replace(
            self, estimate=self.estimate[:, :7], covariance=self.covariance[:, :6, :6], truth=self.truth[:, :7]
        )

    @classmethod
    def bare(
        cls, place: Places, t: Array, estimate: Array, true_t: Array, truth: Array, manifold: Manifold, max_dt: float
    ) -> Poses:
        """Poses without covariances, which are NaN."""
        n = 6 if manifold == "spatial" else truth.shape[1]
        P = np.broadcast_to(np.nan, (len(t), n, n))
        return cls(place, t, estimate, P, np.zeros(len(t), bool), true_t, truth, manifold, "left", max_dt)

    def _of(self, rows: Indices) -> Poses:
        return replace(
            self, place=self.place.at(rows), t=self.t[rows], estimate=self.estimate[rows],
            covariance=self.covariance[rows], stated=self.stated[rows], cross=None,
        )  # fmt: skip


class NamedPoses(NamedTuple):
    """A run of a file without its covariances, by name."""

    name: str
    poses: Poses
    clock: Array  # (N,), s, of the estimates; NaN where they are numbered by steps alone
