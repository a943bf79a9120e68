"""Estimation of a sensor model from residuals, with its bias map.

Which residuals tell of the noise is chosen here, and not by their size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import optimize, stats

from consistency.bench.filters.compiled import one_blas_thread
from consistency.bench.scenario import PicturedSensor, models
from consistency.bench.scenario.observations import bilinear, hats
from consistency.bench.types import Trial
from consistency.referee.diagnostics.verdict_parts import Interval
from consistency.referee.errors import InputError
from consistency.referee.types import Array, Indices
from consistency.stereo.characterising import coordinate_fit
from consistency.stereo.characterising.coordinate_fit import (
    Levels,
    LikelihoodFit,
    ResidualTails,
    Rows,
    fit,
    moving_over_rest,
    rate,
    tails,
)

NAMES = ("u", "v", "d")
RATE = 0.01  # probability that any interval misses
LEAST = 100  # rows from which a noise can be told
LEAST_TRACKS = 5
SHORTEST = 1.5  # rows of a track in the mean, from which offset and correlation can be told
GRID = (5, 4)  # nodes across and down
TRACKS = 3  # that a node needs
UNSURE = 5.0  # px, standard deviation of the prior that keeps a node without data from being singular
APART = 1.25  # factor between neighbouring nodes of disparity at least
FEW = 30  # rows that a node takes
ENDS = 0.005  # of the data lies beyond the first and beyond the last node of disparity
MARGIN = 4.0  # standard deviations from a limit within which the noise decides whether a row is there at all
GROSS = 6.0  # robust standard deviations: a Gaussian error is beyond in 2 of 10^9
MAD = 1.482602218505602  # standard deviation of a Gaussian over its median absolute deviation
HUBER = 1.345  # standard deviations beyond which a row counts less, Huber (1964)


@dataclass(frozen=True)
class Coordinate:
    """Estimates for one coordinate, u, v or d."""

    name: str
    sigma: Interval  # px, of what is drawn again
    pooled: float  # px, about the mean of all rows: noise, offsets and bias together; NaN where that is not known
    about_tracks: float  # px, about the means of tracks; NaN likewise
    correlation: Interval | None  # with the step before
    offset: Interval | None  # share of the variance about the bias map
    tails: ResidualTails
    lags: Array  # (lags,), autocorrelation along tracks
    bounds: Array  # (lags,), 95 % bound if white
    residuals: Array  # (N,), whitened and standardised

    @property
    def white(self) -> bool | None:
        """Whether no correlation is shown; None where it cannot be told."""
        if self.correlation is None:
            return None
        return self.correlation.holds(0.0)

    @property
    def offset_px(self) -> float:
        """Standard deviation of the offsets of tracks, px."""
        if self.offset is None:
            return float("nan")
        return self.sigma.value * np.sqrt(self.offset.value / max(1.0 - self.offset.value, 1e-12))


class DisparityNoise(NamedTuple):
    """Standard deviation of disparity by disparity."""

    nodes: Array  # (m,), px
    sigma: tuple[Interval, ...]  # px, at each node
    p_value: float  # that it is the same at all
    shown: bool


@dataclass(frozen=True)
class Characterisation:
    """Estimated model of a sensor, with its data."""

    sensor: PicturedSensor  # as believed so far: model, calibration, image, mount
    source: str
    coordinates: tuple[Coordinate, Coordinate, Coordinate]
    growth: DisparityNoise | None
    bias: BiasEstimate | None  # None where it cannot be told from where the landmarks are
    gross: Interval  # share of rows that are grossly wrong
    tracks: int
    rows: int
    left_out: Mapping[str, int]  # reason: rows
    level: Levels
    kept: Residuals
    notes: tuple[str, ...] = ()  # what could not be estimated, and limits
    ratio: tuple[Interval, ...] = ()  # sd while moving over sd at rest, of u, v, d


@one_blas_thread()  # its matrices are small: a second one takes twice the time of the processors, and gains nothing
def characterise(
    data: Residuals,
    sensor: PicturedSensor,
    source: str,
    strange: int = 0,
    grid: tuple[int, int] = GRID,
    alone: bool = False,
    miss: float = RATE,
) -> Characterisation:
    """Noise, growth, bias map, offsets, correlation and tails from residuals about the truth.

    Parameters
    ----------
    data : residuals of (u, v, d), px
    sensor : calibration, image and search range
    strange : rows that were of no landmark
    grid : nodes of the bias map across and down
    alone : whether the rows of a track are not in order of time and have no offset in common
    miss : probability that any interval misses

    Raises
    ------
    InputError
        Too few rows or tracks are left.
    """
    nodes_of_map = _nodes(data, sensor, grid)
    chosen = select(data, sensor, grid_of(data, *nodes_of_map).regressors(data))
    kept = chosen.kept
    tracks = len(np.unique(kept.track))
    if len(kept) < LEAST or tracks < LEAST_TRACKS:
        raise InputError(
            f"{source}: {len(kept)} observations of {tracks} tracks are left of {len(data)}; a noise takes at least "
            f"{LEAST} of {LEAST_TRACKS}: record more"
        )
    cells = grid_of(kept, *nodes_of_map)
    X = cells.regressors(kept)

    def fitted(k: int, G: Array) -> LikelihoodFit:
        rows = Rows(kept.r[:, k], X, G, kept.first, kept.gap, cells.ridge)
        try:
            return fit(rows, chosen.rough[k], memory=rows.length >= SHORTEST and not alone)
        except ValueError as error:
            raise InputError(f"{source}: {error} of {NAMES[k]}; record more or longer tracks") from None

    one_noise = np.ones((len(kept), 1))
    fits = [fitted(0, one_noise), fitted(1, one_noise), fitted(2, one_noise)]
    nodes = octaves(kept.ideal[:, 2])
    levels = Levels(miss, growth=len(nodes), bias=3 * int(cells.known.sum()))
    growth = None
    if len(nodes) > 1:
        by_disparity = fitted(2, hats(kept.ideal[:, 2], nodes))
        p_value = coordinate_fit.growth_p_value(by_disparity)
        intervals = coordinate_fit.at_nodes(by_disparity, levels.of("growth"))
        growth = DisparityNoise(nodes, tuple(intervals), p_value, p_value < levels.rate / 6)
        if growth.shown:
            fits[2] = by_disparity
    u, v, d = (_coordinate(k, each, levels) for k, each in enumerate(fits))
    residuals = np.column_stack([each.regression.residual for each in fits])
    return Characterisation(
        sensor,
        source,
        coordinates=(u, v, d),
        growth=growth,
        bias=estimate_bias(fits, cells, levels.of("bias"), levels.rate / 18),
        gross=rate(chosen.gross, len(kept) + chosen.gross, levels.of("tails")),
        tracks=tracks,
        rows=len(kept),
        left_out={
            "near a limit of the sensor": chosen.at_limits,
            "grossly wrong": chosen.gross,
            "of no landmark": strange,
        },
        level=levels,
        kept=kept,
        ratio=moving_over_rest(residuals, np.ones_like(residuals), kept.moving, kept.track, levels.of("sigma")),
    )


def _nodes(data: Residuals, sensor: PicturedSensor, grid: tuple[int, int]) -> tuple[Array, Array]:
    """Nodes of the bias map, evenly from edge to edge of the image, or of the data where no image is known."""
    if sensor.image is None:
        low, high = np.quantile(data.ideal[:, :2], [0.01, 0.99], axis=0)
    else:
        low = -np.array(sensor.centre)
        high = np.array(sensor.image) - sensor.centre
    across, down = grid
    return np.linspace(low[0], high[0], across), np.linspace(low[1], high[1], down)


def _coordinate(k: int, of: LikelihoodFit, levels: Levels) -> Coordinate:
    r = of.rows.r
    track = of.rows.track
    n = np.bincount(track)
    centred = r - (np.bincount(track, r) / n)[track]
    spare = max(len(r) - len(n), 1)
    correlation = None
    offset = None
    if of.memory:
        correlation = coordinate_fit.correlation(of, levels.of("correlation"))
        offset = coordinate_fit.offset_share(of, levels.of("offset"))
    lags, bounds = coordinate_fit.autocorrelation(of)
    w = of.regression.residual
    return Coordinate(
        NAMES[k],
        sigma=coordinate_fit.noise_interval(of, levels.of("sigma")),
        pooled=r.std(ddof=1),
        about_tracks=np.sqrt((centred**2).sum() / spare),
        correlation=correlation,
        offset=offset,
        tails=tails(w, levels.of("tails")),
        lags=lags,
        bounds=bounds,
        residuals=w / w.std(),
    )


class Grid(NamedTuple):
    """Nodes of the image, and which have data; K across, L down."""

    u: Array  # (K,), px from the principal point
    v: Array  # (L,)
    rows: Array  # (L K,), observations, each shared out over the nodes around it
    known: Array  # (L K,) of bool

    def regressors(self, data: Residuals) -> Array:
        """Weights (N, L K) of the nodes in each row."""
        return bilinear(data.ideal[:, 0], data.ideal[:, 1], self.u, self.v)

    @property
    def ridge(self) -> Array:
        """Precision (L K,) of a prior: some where there are too few data, none elsewhere."""
        return np.where(self.known, 0.0, UNSURE**-2)


def grid_of(data: Residuals, u: Array, v: Array) -> Grid:
    """Nodes at ``u`` (K,) and ``v`` (L,), and what the data have around each."""
    weights = bilinear(data.ideal[:, 0], data.ideal[:, 1], u, v)
    rows = weights.sum(axis=0)
    if not len(data):
        return Grid(u, v, rows, np.zeros(len(rows), bool))
    tracks = (np.add.reduceat(weights, data.first, axis=0) > 1.0).sum(axis=0)
    return Grid(u, v, rows, (rows >= FEW) & (tracks >= TRACKS))


class BiasEstimate(NamedTuple):
    """Bias of u, v, d at the nodes of a grid."""

    grid: Grid
    value: Array  # (3, L K), px
    half: Array  # (3, L K), px, half widths of simultaneous intervals
    p_value: Array  # (3,), that there is no bias anywhere
    shown: Array  # (3,) of bool
    believed: Array  # (3, L K), px: shrunken, 0 where nothing is known or shown

    def matrix(self, k: int) -> Array:
        """What is believed of u, v or d, (L, K)."""
        return self.believed[k].reshape(len(self.grid.v), len(self.grid.u))


def estimate_bias(
    fits: Sequence[LikelihoodFit],
    grid: Grid,
    level: float,
    rate: float,
) -> BiasEstimate:
    """Bias of each coordinate from its fit.

    Parameters
    ----------
    level : probability that the interval of one node misses
    rate : probability of finding a bias in a coordinate that has none
    """
    known = grid.known
    value = np.full((3, len(known)), np.nan)
    half = np.full((3, len(known)), np.nan)
    believed = np.zeros((3, len(known)))
    p_value = np.ones(3)
    for k, of_coordinate in enumerate(fits):
        beta, width, C = coordinate_fit.bias_coefficients(of_coordinate, level)
        value[k, known] = beta[known]
        half[k, known] = width[known]
        if not known.any():
            continue
        b = beta[known]
        S = C[np.ix_(known, known)]
        p_value[k] = stats.chi2.sf(b @ np.linalg.solve(S, b), len(b))
        if p_value[k] < rate:
            believed[k, known] = shrunken(b, S)
    return BiasEstimate(grid, value, half, p_value, p_value < rate, believed)


def shrunken(b: Array, S: Array) -> Array:
    """Estimates (m,) with covariance (m, m) drawn towards zero as much as their own scatter asks for.

    The true values are taken as draws from N(0, w^2), with w of the largest likelihood: empirical Bayes, Efron &
    Morris (1973).
    """
    values, axes = np.linalg.eigh(S)
    along = axes.T @ b

    def negative(log_w: float) -> float:
        variance = np.exp(2.0 * log_w) + values
        return 0.5 * (np.log(variance) + along**2 / variance).sum()

    largest = np.abs(b).max() + np.sqrt(values.max()) + 1e-9
    top = np.log(largest) + 1.0
    best = optimize.minimize_scalar(negative, bounds=(top - 12.0, top), method="bounded")
    w2 = np.exp(2.0 * best.x)
    return axes @ (along * w2 / (w2 + values))


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
    def gap(self) -> Indices:
        """Steps since the row before in the track, (N,); 0 in its first."""
        gap = np.diff(self.step, prepend=self.step[:1])
        gap[self.first] = 0
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
        body = models.to_robot(*trial.truth[step].T, *trial.landmarks[landmark].T)
        in_sensor = models.to_sensor(*body, sensor.mount.packed())
        ideal = np.stack(models.project(*in_sensor, *sensor.rig), axis=-1)
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
