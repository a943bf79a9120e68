"""Characterisation with known poses, or a camera at rest, and unknown landmarks."""

from __future__ import annotations

import numpy as np
from scipy import stats

from consistency.bench.scenario import PicturedSensor
from consistency.bench.scenario.effects.node_tables import hats
from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.errors import InputError
from consistency.referee.types import Array, Indices
from consistency.stereo.characterising.characterise import (
    LEAST,
    LEAST_TRACKS,
    NAMES,
    RATE,
    Characterisation,
    Coordinate,
    DisparityNoise,
)
from consistency.stereo.characterising.coordinate_fit import (
    FEWEST_PAIRS,
    LAGS,
    Levels,
    interval_on_scale,
    moving_over_rest,
    rate,
    tails,
    wider,
)
from consistency.stereo.characterising.point_fit import PointFit, Sightings, fit_points, without_gross
from consistency.stereo.characterising.truth_residuals import MARGIN, octaves, within_limits

FREE = 0.1  # share of a value that the fits must leave for it to tell of the shape of the noise
FIXED = (
    "Landmarks are not known: each track's point was fitted. A bias map and constant offsets of tracks cannot be told "
    "from where the points are, so neither is estimated; what of a bias changes along a track counts as noise."
)
HIDDEN = "Where noise is correlated along a track, the fitted points take part of it: sigma is then a lower limit."


def characterise_posed(
    seen: Sightings,
    sensor: PicturedSensor,
    source: str,
    notes: tuple[str, ...] = (),
    free_poses: bool = False,
) -> Characterisation:
    """Noise, growth, correlation and tails from tracks of unknown points.

    With ``free_poses`` the pose of each step is fitted too, so that its error is not noise.

    Raises
    ------
    InputError
        Too few observations or tracks are left.
    """
    total = len(seen.z)
    seen = seen.long_enough()
    _require_enough(seen, total, source)
    first = fit_points(seen, *sensor.rig, coordinates_as_parts(seen), np.ones(3), free_poses)
    good = without_gross(first)
    inside = within_limits(first.ideal, MARGIN * first.sigma, sensor)
    kept = seen.keep(good & inside).long_enough()
    _require_enough(kept, total, source)
    plain = fit_points(kept, *sensor.rig, coordinates_as_parts(kept), first.sigma, free_poses)
    levels = Levels(RATE)
    chosen = plain
    growth = None
    nodes, nearest = _disparity_nodes(plain)
    if nearest is not None:
        levels = Levels(RATE, growth=len(nodes))
        by_disparity = _fit_by_disparity(plain, nearest, len(nodes), sensor, free_poses)
        growth = _growth(nodes, by_disparity, levels)
        if growth.shown:
            chosen = by_disparity
    u, v, d = (_coordinate(k, chosen, plain, levels) for k in range(3))
    notes = (FIXED, *notes)
    if any(coordinate.white is False for coordinate in (u, v, d)):
        notes = (*notes, HIDDEN)
    wrong = int((~good).sum())
    return Characterisation(
        sensor,
        source,
        coordinates=(u, v, d),
        growth=growth,
        bias=None,
        gross=rate(wrong, len(good), levels.of("tails")),
        tracks=len(np.unique(kept.track)),
        rows=len(kept.z),
        left_out={
            "of tracks too short": total - len(seen.z),
            "near a limit of the sensor": int((good & ~inside).sum()),
            "of tracks grossly wrong": wrong,
        },
        level=levels,
        kept=chosen.residuals,
        notes=(*notes, *_shared(chosen, free_poses)),
        ratio=moving_over_rest(chosen.scaled, chosen.free, kept.moving, kept.track, levels.of("sigma")),
    )


def _require_enough(seen: Sightings, total: int, source: str) -> None:
    tracks = len(np.unique(seen.track))
    if len(seen.z) < LEAST or tracks < LEAST_TRACKS:
        raise InputError(
            f"{source}: {len(seen.z)} observations of {tracks} tracks are left of {total}, of tracks with 3 or more; "
            f"a noise takes at least {LEAST} of {LEAST_TRACKS}: record more, or longer tracks"
        )


def coordinates_as_parts(seen: Sightings) -> Indices:
    """Components (N, 3) of a noise that each coordinate has one of."""
    return np.tile(np.arange(3), (len(seen.z), 1))


def _disparity_nodes(plain: PointFit) -> tuple[Array, Indices | None]:
    """Nodes (m,) of disparity, and the nearest to each row (N,); None where the data are too few for two nodes."""
    d = np.maximum(plain.ideal[:, 2], 1e-3)
    nodes = octaves(d)
    nearest = hats(d, nodes).argmax(axis=1)
    if len(nodes) < 2 or np.bincount(nearest, minlength=len(nodes)).min() < LEAST_TRACKS:
        return nodes, None
    return nodes, nearest


def _fit_by_disparity(
    plain: PointFit, nearest: Indices, nodes: int, sensor: PicturedSensor, free_poses: bool
) -> PointFit:
    """The fit in which the disparity has a noise of its own around each node."""
    parts = coordinates_as_parts(plain.seen)
    parts[:, 2] += nearest
    start = np.append(plain.sigma[:2], np.full(nodes, plain.sigma[2]))
    return fit_points(plain.seen, *sensor.rig, parts, start, free_poses)


def log_interval(of: PointFit, chosen: Array, sigma: float, level: float) -> tuple[Interval, float]:
    """Standard deviation of the values in ``chosen`` (N, 3), and the variance of its log.

    The wider of two: chi-square with the degrees of freedom that are left, for Gaussian noise, and the scatter of the
    tracks' sums of squares, for any noise.
    """
    dof = of.free[chosen].sum()
    excess = np.where(chosen, of.r**2 - sigma**2 * of.free, 0.0).sum(axis=1)
    of_tracks = of.sums_of_tracks(excess)
    tracks = int(np.count_nonzero(of.sums_of_tracks(chosen.sum(axis=1))))
    gaussian = np.sqrt(0.5 / dof)
    any_noise = 0.5 * np.sqrt((of_tracks**2).sum()) / (dof * sigma**2)
    half = float(wider(gaussian, any_noise, tracks, level))
    interval = interval_on_scale(lambda log: sigma * np.exp(log), 0.0, half)
    return interval, max(gaussian, any_noise) ** 2


def _growth(nodes: Array, of: PointFit, levels: Levels) -> DisparityNoise:
    intervals = []
    weights = np.empty(len(nodes))
    for j in range(len(nodes)):
        part = 2 + j
        interval, variance = log_interval(of, of.parts == part, of.sigma[part], levels.of("growth"))
        intervals.append(interval)
        weights[j] = 1.0 / variance
    logs = np.log(of.sigma[2:])
    mean = (logs * weights).sum() / weights.sum()
    chi2 = ((logs - mean) ** 2 * weights).sum()
    p_value = float(stats.chi2.sf(chi2, len(nodes) - 1))
    return DisparityNoise(nodes, tuple(intervals), p_value, p_value < levels.rate / 6)


def _coordinate(k: int, of: PointFit, plain: PointFit, levels: Levels) -> Coordinate:
    interval, _ = log_interval(plain, plain.parts == k, plain.sigma[k], levels.of("sigma"))
    scaled = of.scaled[of.free[:, k] > FREE, k]
    lags, bounds, correlation = correlations(of, k, levels.of("correlation"))
    return Coordinate(
        NAMES[k],
        sigma=interval,
        pooled=np.nan,
        about_tracks=np.nan,
        correlation=correlation,
        offset=None,
        tails=tails(scaled, levels.of("tails")),
        lags=lags,
        bounds=bounds,
        residuals=scaled,
    )


def correlations(of: PointFit, k: int, level: float) -> tuple[Array, Array, Interval | None]:
    """Autocorrelation (lags,) along tracks of coordinate ``k``, its 95 % bound if white, and the interval of lag 1.

    The fit of a point correlates the residuals of a track; what it does to neighbours is taken off. It also hides part
    of a true correlation in short tracks, so that values beyond lag 1 are drawn only for tracks that are long.
    """
    lags = np.full(LAGS, np.nan)
    bounds = np.full(LAGS, np.nan)
    seen = of.seen
    same_track = np.diff(seen.track) == 0
    next_step = np.diff(seen.step) == 1
    pair = 1 + np.flatnonzero(same_track & next_step)
    if len(pair) < FEWEST_PAIRS:
        return lags, bounds, None
    sigma = of.sigma[of.parts[:, k]]
    e = of.r[:, k] / sigma
    free = of.free[:, k]
    by_fit = of.neighbours[:, k] / sigma**2
    products = e[pair] * e[pair - 1] - by_fit[pair]
    weight = np.sqrt(np.maximum(free[pair] * free[pair - 1], 0.0))
    value = float(products.sum() / weight.sum())
    _, where = np.unique(seen.track[pair], return_inverse=True)
    of_tracks = np.bincount(where, products - value * weight)
    error = float(np.sqrt((of_tracks**2).sum()) / weight.sum())
    half = error * float(stats.t.isf(level / 2, max(where.max(), 1)))
    lags[0] = value
    bounds[0] = 1.96 * error
    return lags, bounds, Interval(value, max(value - half, -1.0), min(value + half, 1.0))


def _shared(of: PointFit, free_poses: bool) -> tuple[str, ...]:
    """A note on what all landmarks of a step have in common, which is the poses' or the rig's and not the noise's."""
    _, where, count = np.unique(of.seen.step, return_inverse=True, return_counts=True)
    pairs = (count * (count - 1)).sum()
    if pairs < 1 or len(count) < 3:
        return ()
    shared = np.zeros(3)
    for k in range(3):
        total = np.bincount(where, of.r[:, k])
        squares = np.bincount(where, of.r[:, k] ** 2)
        shared[k] = np.sqrt(max((total**2 - squares).sum() / pairs, 0.0))
    if not shared.any():
        return ()
    u, v, d = shared
    cause = "errors of the poses and shake of the rig"
    if free_poses:
        cause = "no pose explains it"
    return (f"Of the noise, what all landmarks of a step share has sd u {u:.2g}, v {v:.2g}, d {d:.2g} px: {cause}.",)
