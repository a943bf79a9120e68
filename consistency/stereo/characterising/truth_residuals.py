"""Residuals of (u, v, d) where the truth is known, and which of them tell of the noise without being chosen by it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from consistency.bench.models import point, stereo
from consistency.bench.scenario import PicturedSensor
from consistency.bench.scenario.effects.node_tables import hats
from consistency.bench.types import Trial
from consistency.referee.types import Array, Indices

APART = 1.25  # factor between neighbouring nodes of disparity at least
FEW = 30  # rows that a node takes
ENDS = 0.005  # of the data lies beyond the first and beyond the last node of disparity
MARGIN = 4.0  # standard deviations from a limit within which the noise decides whether a row is there at all
GROSS = 6.0  # robust standard deviations: a Gaussian error is beyond in 2 of 10^9
MAD = 1.482602218505602  # standard deviation of a Gaussian over its median absolute deviation
HUBER = 1.345  # standard deviations beyond which a row counts less, Huber (1964)


def octaves(d: Array) -> Array:
    """Nodes (m,) of disparity: the ends of the data and the powers of two between them, px.

    Powers of two are left out until each node has ``FEW`` rows around it; a node by itself is the median.
    """
    low, high = np.quantile(d, [ENDS, 1.0 - ENDS])
    if high < APART * low:
        return np.array([np.median(d)])
    least = np.ceil(np.log2(low * APART))
    most = np.floor(np.log2(high / APART))
    nodes = np.array([low, *2.0 ** np.arange(least, most + 1), high])
    rows = hats(d, nodes).sum(axis=0)
    while len(nodes) > 2 and rows.min() < FEW:
        nodes = np.delete(nodes, np.clip(rows.argmin(), 1, len(nodes) - 2))
        rows = hats(d, nodes).sum(axis=0)
    if rows.min() < FEW:
        return np.array([np.median(d)])
    return nodes


@dataclass(frozen=True)
class Residuals:
    """N observations beside what they would be without error, sorted by track and step."""

    r: Array  # (N, 3), measured less ideal, px
    ideal: Array  # (N, 3), u, v, d in px
    track: Indices  # (N,), a landmark in a run
    step: Indices  # (N,)
    moving: Array  # (N,) of bool, whether the sensor moved before this observation

    def __len__(self) -> int:
        return len(self.r)

    def keep(self, chosen: Array) -> Residuals:
        """The rows for which ``chosen`` (N,) is true."""
        return Residuals(*(value[chosen] for value in vars(self).values()))

    @property
    def first(self) -> Indices:
        """First row of each track, (K,)."""
        return np.flatnonzero(np.append(True, np.diff(self.track) != 0)).astype(np.int64)

    @property
    def gap(self) -> Array:
        """Steps since the row before in the track, (N,); 0 in its first."""
        gap = np.diff(self.step, prepend=self.step[:1]).astype(float)
        gap[self.first] = 0.0
        return gap


def residuals_of(trials: Sequence[Trial], sensor: PicturedSensor) -> tuple[Residuals, int]:
    """Residuals of trials with true poses and landmarks, and how many rows are of things that are not landmarks.

    What is ideal is Herath et al. (2007) eq. 22 at the true poses.
    """
    parts = []
    strange = 0
    for number, trial in enumerate(trials):
        assert trial.truth is not None
        assert trial.landmarks is not None
        rows = np.lexsort((trial.step, trial.landmark))
        rows = rows[trial.landmark[rows] < len(trial.landmarks)]
        strange += len(trial.z) - len(rows)
        step = trial.step[rows]
        landmark = trial.landmark[rows]
        body = point.to_robot(*trial.truth[step].T, *trial.landmarks[landmark].T)
        in_sensor = point.to_sensor(*body, sensor.mount.packed())
        ideal = np.stack(stereo.project(*in_sensor, *sensor.rig), axis=-1)
        track = landmark + number * trial.n_landmarks
        parts.append((trial.z[rows] - ideal, ideal, track, step, moved_before(trial.truth)[step]))
    return Residuals(*map(np.concatenate, zip(*parts, strict=True))), strange


def moved_before(poses: Array) -> Array:
    """Whether poses (T + 1, 3) differ from the one before, (T + 1,) of bool."""
    moved = (np.diff(poses, axis=0) != 0.0).any(axis=1)
    return np.append(False, moved)


class RowSelection(NamedTuple):
    """The rows that the noise is estimated from, and the others."""

    kept: Residuals
    gross: int  # rows too far off to be of the noise
    at_limits: int  # rows left out because of the search range or the edge of the image
    rough: Array  # (3,), px, robust standard deviations


def select(data: Residuals, sensor: PicturedSensor, regressors: Array) -> RowSelection:
    """Leave out rows near the limits of the sensor, by their ideal values, and those that are grossly wrong.

    Near the ends of the search range only some noise is measured; ``MARGIN`` standard deviations away, the variance
    lacks less than one part in 1000. The ideal value decides, which knows nothing of the noise of its row.

    Parameters
    ----------
    regressors : (N, p), of the bias map
    """
    fits = np.column_stack([_robust(column, regressors) for column in data.r.T])
    centred = data.r - fits
    rough = np.array([robust_sd(column) for column in centred.T])
    scale = np.tile(rough, (len(data), 1))
    scale[:, 2] = _local_spread(centred[:, 2], data)
    inside = within_limits(data.ideal + fits, MARGIN * scale, sensor)
    gross = inside & (np.abs(centred) > GROSS * scale).any(axis=1)
    return RowSelection(
        data.keep(inside & ~gross),
        gross=int(gross.sum()),
        at_limits=int((~inside).sum()),
        rough=rough,
    )


def within_limits(place: Array, margin: Array, sensor: PicturedSensor) -> Array:
    """Rows (N,) whose u, v, d (N, 3) are by ``margin``, (N, 3) or (3,), within search range and image."""
    inside = np.ones(len(place), bool)
    if sensor.disparity is not None:
        low, high = sensor.disparity
        inside &= place[:, 2] >= low + margin[..., 2]
        inside &= place[:, 2] <= high - margin[..., 2]
    if sensor.image is not None:
        for k in range(2):
            edge = margin[..., k]
            middle = sensor.centre[k]
            inside &= place[:, k] >= edge - middle
            inside &= place[:, k] <= sensor.image[k] - middle - edge
    return inside


def _robust(r: Array, X: Array) -> Array:
    """Values (N,) of the regression of ``r`` on ``X`` with Huber's weights; coefficients without data are 0."""
    beta = np.full(X.shape[1], np.median(r))
    for _ in range(10):
        e = r - X @ beta
        limit = HUBER * robust_sd(e)
        weight = np.minimum(1.0, limit / np.maximum(np.abs(e), 1e-12))
        normal = (X * weight[:, None]).T @ X + 1e-3 * np.eye(X.shape[1])
        beta = np.linalg.solve(normal, X.T @ (weight * r))
    return X @ beta


def robust_sd(e: Array) -> float:
    """Robust standard deviation of a sample."""
    return max(MAD * np.median(np.abs(e - np.median(e))), 1e-9)


def _local_spread(e: Array, data: Residuals) -> Array:
    """Robust standard deviation (N,) of rows of about the same disparity."""
    d = np.maximum(data.ideal[:, 2], 1e-3)
    nodes = octaves(d)
    nearest = hats(d, nodes).argmax(axis=1)
    out = np.full(len(e), robust_sd(e))
    for node in range(len(nodes)):
        own = nearest == node
        if own.sum() >= FEW:
            out[own] = robust_sd(e[own])
    return out
