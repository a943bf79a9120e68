"""Estimation of a sensor model from residuals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiled import one_blas_thread
from consistency.bench.scenario import PicturedSensor
from consistency.bench.scenario.effects.node_tables import hats
from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.errors import InputError
from consistency.referee.types import Array
from consistency.stereo.characterising import coordinate_fit
from consistency.stereo.characterising.bias_map import GRID, BiasEstimate, estimate_bias, grid_of
from consistency.stereo.characterising.coordinate_fit import Levels, ResidualTails, moving_over_rest, rate, tails
from consistency.stereo.characterising.likelihood import LikelihoodFit, Rows, fit
from consistency.stereo.characterising.truth_residuals import Residuals, octaves, select

NAMES = ("u", "v", "d")
RATE = 0.01  # probability that any interval misses
LEAST = 100  # rows from which a noise can be told
LEAST_TRACKS = 5
SHORTEST = 1.5  # rows of a track in the mean, from which offset and correlation can be told


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
