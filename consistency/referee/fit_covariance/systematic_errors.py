"""The mean error of a window: a scale of the way, a scale of the turn, and a heading that drifts with the way."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.fit_covariance.windows import Windows, lengthened, rests, turns, ways
from consistency.referee.geometry.groups import adjoint, inverse
from consistency.referee.types import Array

ROUNDS = 2  # of Gauss and Newton from nothing; from a mean that is nearly right one is enough
WEAK = 1e-6  # of the largest singular value, below which a direction is not determined and stays 0


@dataclass(frozen=True)
class Mean:
    """What is corrected before noise is fitted; nothing by default."""

    way: float = 1.0  # true over estimated length
    turn: float = 1.0  # true over estimated rotation
    drift: tuple[float, ...] = (0.0,)  # rad a m, about the axes of the body: (1,), or (3,) in space
    slip: float = 0.0  # m a rad, that each turn adds to the estimated way before all else

    def corrected(self, pieces: Array) -> Array:
        """Motions (W, P, d + 1, d + 1) with this mean taken out."""
        d, pieces = pieces.shape[-1] - 1, lengthened(pieces, self.slip)
        way, out = ways(pieces), np.array(pieces)
        angle = self.turn * turns(pieces) + way[..., None] * np.asarray(self.drift)
        out[..., :d, d] *= self.way
        if d == 2:
            c, s = np.cos(angle[..., 0]), np.sin(angle[..., 0])
            out[..., :2, :2] = np.moveaxis(np.array([[c, -s], [s, c]]), (0, 1), (-2, -1))
        else:
            out[..., :3, :3] = Rotation.from_rotvec(angle.reshape(-1, 3)).as_matrix().reshape(*out.shape[:2], 3, 3)
        return out

    def applied(self, windows: Windows) -> Windows:
        return replace(windows, pieces=self.corrected(windows.pieces))


def fit_mean(windows: Windows, covariance: Array | None = None, start: Mean | None = None) -> Mean:
    """Mean by generalised least squares.

    Parameters
    ----------
    covariance : (W, n, n) of the errors; None weighs by their mean square
    start : a mean that is nearly right
    """
    mean = none_of(windows) if start is None else start
    for _ in range(ROUNDS if start is None else 1):
        now = mean.applied(windows)
        error, design = now.errors, design_of(now.pieces)
        P = np.diag(np.maximum((error**2).mean(axis=0), 1e-300))[None] if covariance is None else covariance
        whiten = np.linalg.inv(np.linalg.cholesky(P))
        X, y = (whiten @ design).reshape(-1, design.shape[-1]), (whiten @ error[..., None]).ravel()
        size = np.maximum(np.linalg.norm(X, axis=0), 1e-300)
        step = np.linalg.lstsq(X / size, y, rcond=WEAK)[0] / size
        drift = np.asarray(mean.drift) * (1 + step[1]) + step[2:] * mean.way
        mean = Mean(float(mean.way * (1 + step[0])), float(mean.turn * (1 + step[1])), tuple(drift.tolist()))
    return mean


def none_of(windows: Windows) -> Mean:
    """The mean that corrects nothing."""
    return Mean(drift=(0.0,) * (1 if windows.d == 2 else 3))


def design_of(pieces: Array) -> Array:
    """Derivative (W, n, 2 + 1) or (W, n, 2 + 3) of the errors by scale of the way, scale of the turn, and drift."""
    W, P, m, _ = pieces.shape
    d, n = m - 1, 3 if m == 3 else 6
    A = carriers(pieces)[:, 1:]
    way, turn = ways(pieces), turns(pieces)
    local = np.zeros((W, P, n, n - d + 2))
    # at the end of its piece, a longer way is an error along R' t
    R = pieces[..., :d, :d]
    local[..., :d, 0] = (np.swapaxes(R, -1, -2) @ pieces[..., :d, d, None])[..., 0]
    local[..., d:, 1] = turn
    local[..., d:, 2:] = way[..., None, None] * np.eye(n - d)
    return np.asarray((A @ local).sum(axis=1))


def carriers(pieces: Array) -> Array:
    """A_k (W, P + 1, n, n) that carry an error at each end of a piece to the end of the window: Ad(rest)^-1."""
    return adjoint(inverse(rests(pieces)))
