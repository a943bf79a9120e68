"""A way that each turn adds, where wheels slip: fitted by least squares beside the mean."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from consistency.referee.fit_covariance.motion_windows import DriveWindows, lengthened, rotation_vectors, ways
from consistency.referee.fit_covariance.systematic_errors import carriers, error_derivatives, fit_mean
from consistency.referee.types import Array

BY_TURN = "by turn"  # a correction with a way by turn
ROUNDS = 4  # of slip and mean in turn
APART = 1e-3  # of the squared effect of a slip that a mean must leave, so that both are told from each other


def fit_slip(windows: DriveWindows) -> float:
    """Way that a turn adds, m a rad; 0 where it cannot be told from a scale of the way, or of turns."""
    slip = 0.0
    for _ in range(ROUNDS):
        longer = replace(windows, pieces=lengthened(windows.pieces, slip))
        mean = fit_mean(longer)
        now = mean.applied(longer)
        error, effect = now.errors, effect_of(now.pieces)
        both = np.concatenate([error_derivatives(now.pieces), effect[..., None], error[..., None]], axis=-1)
        both = (both / np.maximum(np.sqrt((error**2).mean(axis=0)), 1e-150)[:, None]).reshape(error.size, -1)
        X, both = both[:, :-2], both[:, -2:]
        effect, error = (both - X @ np.linalg.lstsq(X, both, rcond=None)[0]).T
        if not effect @ effect > APART * both[:, 0] @ both[:, 0]:
            return 0.0
        slip += float(effect @ error / (effect @ effect)) / mean.way
    return slip


def effect_of(pieces: Array) -> Array:
    """Derivative (W, n) of the errors by the way that a radian of turn adds."""
    d, way = pieces.shape[-1] - 1, ways(pieces)
    turn = np.linalg.norm(rotation_vectors(pieces), axis=-1)
    local = np.zeros((*way.shape, 3 if d == 2 else 6))
    along = np.swapaxes(pieces[..., :d, :d], -1, -2) @ pieces[..., :d, d, None]
    local[..., :d] = along[..., 0] * (turn / np.where(way > 0, way, np.inf))[..., None]
    return np.asarray((carriers(pieces)[:, 1:] @ local[..., None]).sum(axis=1)[..., 0])


def held_out_gain(windows: DriveWindows, blocks: list[Array]) -> float:
    """Share of the squared error of positions that a slip takes out of the blocks that chose nothing of it."""
    squares = np.zeros(2)
    for block in blocks:
        rest, judged = windows.of(np.setdiff1d(np.arange(len(windows.drive)), block)), windows.of(block)
        for k, slip in enumerate((0.0, fit_slip(rest))):
            longer, own = (replace(each, pieces=lengthened(each.pieces, slip)) for each in (judged, rest))
            squares[k] += (fit_mean(own).applied(longer).errors[:, : windows.d] ** 2).sum()
    return float(1.0 - squares[1] / squares[0]) if squares[0] > 0 else 0.0
