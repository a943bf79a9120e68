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
from consistency.stereo.characterising.coordinate_fit import LAGS, Levels, moving_over_rest, rate, tails
from consistency.stereo.characterising.log_residuals import MARGIN, octaves, within_limits
from consistency.stereo.characterising.unknown_landmarks import Fitted, Seen, fit_points, without_gross

FREE = 0.1  # share of a value that the fits must leave for it to tell of the shape of the noise
FIXED = (
    "Landmarks are not known: each track's point was fitted. A bias map and constant offsets of tracks cannot be told "
    "from where the points are, so neither is estimated; what of a bias changes along a track counts as noise."
)


def characterise_posed(
    seen: Seen, sensor: PicturedSensor, source: str, notes: tuple[str, ...] = (), free_poses: bool = False
) -> Characterisation:
    """Noise, growth, correlation and tails from tracks of unknown points.

    With ``free_poses`` the pose of each step is fitted too, so that its error is not noise.

    Raises
    ------
    InputError
        Too few observations or tracks are left.
    """
    assert sensor.f is not None
    assert sensor.B is not None
    total = len(seen.z)
    seen = seen.long_enough()
    short = total - len(seen.z)
    _require_enough(seen, total, source)
    fitted = fit_points(seen, sensor.f, sensor.B, _parts(len(seen.z)), np.ones(3), free_poses)
    good = without_gross(fitted)
    inside = within_limits(fitted.ideal, MARGIN * fitted.sigma, sensor)
    kept = seen.keep(good & inside).long_enough()
    _require_enough(kept, total, source)
    plain = fit_points(kept, sensor.f, sensor.B, _parts(len(kept.z)), fitted.sigma, free_poses)
    nodes, by_disparity = _by_disparity(plain, sensor.f, sensor.B, free_poses)
    levels = Levels(RATE, growth=len(nodes))
    growth = None if by_disparity is None else _growth(nodes, by_disparity, levels)
    of = by_disparity if growth is not None and growth.shown and by_disparity is not None else plain
    wrong, limits = int((~good).sum()), int((good & ~inside).sum())
    tracks = len(np.unique(kept.track))
    u, v, d = (_coordinate(k, of, plain, levels) for k in range(3))
    ratio = moving_over_rest(of.scaled, of.free, of.seen.moving, of.seen.track, levels.of("sigma"))
    left_out = {"of tracks too short": short, "near a limit of the sensor": limits, "of tracks grossly wrong": wrong}
    return Characterisation(
        sensor, source, (u, v, d), growth, None, rate(wrong, len(good), levels.of("tails")), tracks, len(kept.z),
        left_out, levels, of.residuals, (FIXED, *notes, *_hidden((u, v, d)), *_shared(of, free_poses)), ratio,
    )  # fmt: skip


def _hidden(coordinates: tuple[Coordinate, ...]) -> tuple[str, ...]:
    if all(c.white is not False for c in coordinates):
        return ()
    return ("Where noise is correlated along a track, the fitted points take part of it: sigma is then a lower limit.",)


def _require_enough(seen: Seen, total: int, source: str) -> None:
    tracks = len(np.unique(seen.track))
    if len(seen.z) < LEAST or tracks < LEAST_TRACKS:
        raise InputError(
            f"{source}: {len(seen.z)} observations of {tracks} tracks are left of {total}, of tracks with 3 or more; "
            f"a noise takes at least {LEAST} of {LEAST_TRACKS}: record more, or longer tracks"
        )


def _parts(rows: int) -> Indices:
    return np.tile(np.arange(3), (rows, 1))


def _by_disparity(plain: Fitted, f: float, B: float, free_poses: bool) -> tuple[Array, Fitted | None]:
    """Nodes of disparity, and the fit with a noise of its own around each; None with one node."""
    d = np.maximum(plain.ideal[:, 2], 1e-3)
    nodes = octaves(d)
    nearest = hats(d, nodes).argmax(axis=1)
    if len(nodes) < 2 or np.bincount(nearest, minlength=len(nodes)).min() < LEAST_TRACKS:
        return nodes[:1], None
    parts = _parts(len(d))
    parts[:, 2] += nearest
    start = np.append(plain.sigma[:2], np.full(len(nodes), plain.sigma[2]))
    return nodes, fit_points(plain.seen, f, B, parts, start, free_poses)


def log_interval(of: Fitted, chosen: Array, sigma: float, level: float) -> tuple[Interval, float]:
    """Standard deviation of the values in ``chosen`` (N, 3), and the variance of its log.

    The wider of two: chi-square with the degrees of freedom that are left, for Gaussian noise, and the scatter of the
    tracks' sums of squares, for any noise.
    """
    excess = np.where(chosen, of.r**2 - sigma**2 * of.free, 0.0).sum(axis=1)
    _, where = np.unique(of.seen.track, return_inverse=True)
    dof = float(of.free[chosen].sum())
    of_tracks = np.bincount(where, excess)
    tracks = int((np.bincount(where, chosen.any(axis=1)) > 0).sum())
    model, robust = np.sqrt(0.5 / dof), 0.5 * np.sqrt((of_tracks**2).sum()) / (dof * sigma**2)
    half = max(model * stats.norm.isf(level / 2), robust * stats.t.isf(level / 2, max(tracks - 1, 1)))
    variance = max(model**2, robust**2)
    return Interval(sigma, float(sigma * np.exp(-half)), float(sigma * np.exp(half))), float(variance)


def _growth(nodes: Array, of: Fitted, levels: Levels) -> DisparityNoise:
    level = levels.of("growth")
    pairs = [log_interval(of, of.parts == 2 + j, float(of.sigma[2 + j]), level) for j in range(len(nodes))]
    logs, variances = np.log(of.sigma[2:]), np.array([variance for _, variance in pairs])
    mean = (logs / variances).sum() / (1.0 / variances).sum()
    p_value = float(stats.chi2.sf(((logs - mean) ** 2 / variances).sum(), len(nodes) - 1))
    return DisparityNoise(nodes, tuple(estimate for estimate, _ in pairs), p_value, p_value < levels.rate / 6)


def _coordinate(k: int, of: Fitted, plain: Fitted, levels: Levels) -> Coordinate:
    own = np.zeros(of.r.shape, bool)
    own[:, k] = True
    sigma = float(np.sqrt((of.r[:, k] ** 2).sum() / of.free[:, k].sum())) if of is plain else float(plain.sigma[k])
    estimate, _ = log_interval(plain, own, sigma, levels.of("sigma"))
    scaled = of.scaled[of.free[:, k] > FREE, k]
    lags, bounds, interval = correlations(of, k, levels.of("correlation"))
    return Coordinate(
        NAMES[k], estimate, np.nan, np.nan, interval, None, tails(scaled, levels.of("tails")), lags, bounds, scaled
    )


def correlations(of: Fitted, k: int, level: float) -> tuple[Array, Array, Interval | None]:
    """Autocorrelation (lags,) along tracks of coordinate ``k``, its 95 % bound if white, and the interval of lag 1.

    The fit of a point correlates the residuals of a track; what it does to neighbours is taken off. It also hides part
    of a true correlation in short tracks, so that values beyond lag 1 are drawn only for tracks that are long.
    """
    seen, e = of.seen, of.r[:, k] / of.sigma[of.parts[:, k]]
    given = of.neighbours[:, k] / of.sigma[of.parts[:, k]] ** 2
    lags, bounds = np.full(LAGS, np.nan), np.full(LAGS, np.nan)
    follows = np.append(False, (np.diff(seen.track) == 0) & (np.diff(seen.step) == 1))
    pair = np.flatnonzero(follows)
    if len(pair) < 20:
        return lags, bounds, None
    products = e[pair] * e[pair - 1] - given[pair]
    weight = np.sqrt(np.maximum(of.free[pair, k] * of.free[pair - 1, k], 0.0))
    _, where = np.unique(seen.track[pair], return_inverse=True)
    value = float(products.sum() / weight.sum())
    error = float(np.sqrt((np.bincount(where, products - value * weight) ** 2).sum()) / weight.sum())
    half = error * float(stats.t.isf(level / 2, max(where.max(), 1)))
    lags[0], bounds[0] = value, 1.96 * error
    return lags, bounds, Interval(value, max(value - half, -1.0), min(value + half, 1.0))


def _shared(of: Fitted, free_poses: bool) -> tuple[str, ...]:
    """A note on what all landmarks of a step have in common, which is the poses' or the rig's and not the noise's."""
    _, where, count = np.unique(of.seen.step, return_inverse=True, return_counts=True)
    pairs = float((count * (count - 1)).sum())
    if pairs < 1 or len(count) < 3:
        return ()
    texts = []
    for k, name in enumerate(NAMES):
        total, squares = np.bincount(where, of.r[:, k]), np.bincount(where, of.r[:, k] ** 2)
        texts.append(f"{name} {np.sqrt(max(float((total**2 - squares).sum()) / pairs, 0.0)):.2g}")
    if not any(float(text.split()[1]) for text in texts):
        return ()
    cause = "no pose explains it" if free_poses else "errors of the poses and shake of the rig"
    return (f"Of the noise, what all landmarks of a step share has sd {', '.join(texts)} px: {cause}.",)
