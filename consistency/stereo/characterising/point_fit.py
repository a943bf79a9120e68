"""Characterisation with known poses, or a camera at rest, and unknown landmarks.

Each track's point is fitted, and the degrees of freedom that it takes are paid for. In a step of least squares for
points and poses together the points are eliminated, and the poses solved for at once.

A component of the noise (u, v, or d at some disparities) has the variance at which its squared residuals are what the
degrees of freedom left to it say (Helmert 1907; Foerstner 1979): ``sum r^2 = sigma^2 sum (1 - h)``, with ``h`` the
leverage of each observation in the fit of its point.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import stats
from scipy.spatial.transform import Rotation

from consistency.bench.scenario import PicturedSensor, models
from consistency.bench.scenario.observations import hats
from consistency.referee.diagnostics.verdict_parts import Interval
from consistency.referee.errors import InputError
from consistency.referee.types import Array, Indices
from consistency.stereo.characterising.characterise import (
    GROSS,
    LEAST,
    LEAST_TRACKS,
    MAD,
    MARGIN,
    NAMES,
    RATE,
    Characterisation,
    Coordinate,
    DisparityNoise,
    Residuals,
    octaves,
    within_limits,
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
from consistency.stereo.visual_odometry.relative_pose import cross_matrix

FREE = 0.1  # share of a value that the fits must leave for it to tell of the shape of the noise
FIXED = (
    "Landmarks are not known: each track's point was fitted. A bias map and constant offsets of tracks cannot be told "
    "from where the points are, so neither is estimated; what of a bias changes along a track counts as noise."
)
HIDDEN = "Where noise is correlated along a track, the fitted points take part of it: sigma is then a lower limit."
SHORTEST = 3  # observations of a track: with two, most of what is seen is used up by the point
ROUNDS = 30
SETTLED = 1e-6  # relative change of a sigma at which the rounds end
POSE = 6  # values of a pose: shift (m) and rotation vector (rad) in sensor axes
NEAREST = 1e-4  # m, in front of the sensor that a point has at least


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


@dataclass(frozen=True)
class Sightings:
    """N observations of unknown points from known poses, sorted by track and step."""

    z: Array  # (N, 3), u, v, d in px
    R: Array  # (N, 3, 3), world from sensor axes (forward, left, up)
    t: Array  # (N, 3), m, the sensor in the world
    track: Indices  # (N,)
    step: Indices  # (N,)
    moving: Array  # (N,) of bool

    def keep(self, chosen: Array) -> Sightings:
        """The rows for which ``chosen`` (N,) is true."""
        return Sightings(*(value[chosen] for value in vars(self).values()))

    def long_enough(self) -> Sightings:
        """The rows of tracks with enough observations."""
        _, where, count = np.unique(self.track, return_inverse=True, return_counts=True)
        return self.keep(count[where] >= SHORTEST)


class PointFit(NamedTuple):
    """Residuals about fitted points, N rows as in ``seen``."""

    seen: Sightings
    ideal: Array  # (N, 3), px, projections of the fitted points
    r: Array  # (N, 3), px
    free: Array  # (N, 3), 1 - h: share of each observation that the fit leaves
    parts: Indices  # (N, 3), component of the noise of each value
    sigma: Array  # (components,), px
    neighbours: Array  # (N, 3), covariance that the fit alone gives a residual and that of the row before, px^2

    @property
    def scaled(self) -> Array:
        """Residuals over their standard deviations, (N, 3)."""
        return self.r / (self.sigma[self.parts] * np.sqrt(np.maximum(self.free, 1e-9)))

    def sums_of_tracks(self, values: Array) -> Array:
        """Sums (K,) of values (N,) over the rows of each track."""
        _, where = np.unique(self.seen.track, return_inverse=True)
        return np.bincount(where, values)

    @property
    def residuals(self) -> Residuals:
        """Residuals of the fit, in the form of residuals about a truth."""
        return Residuals(self.r, self.ideal, self.seen.track, self.seen.step, self.seen.moving)


def fit_points(
    seen: Sightings,
    f: float,
    B: float,
    parts: Indices,
    start: Array,
    free_poses: bool = False,
) -> PointFit:
    """Fit the point of each track and the noise of each component, in turns until both stay.

    Parameters
    ----------
    parts : (N, 3), component of each value
    start : (components,), px, first guess of the noise
    free_poses : whether the pose of each step is fitted too, six values each, from the one that is given
    """
    sigma = np.asarray(start, float)
    points = _first_points(seen, f, B)
    groups = list(_groups(seen))
    steps, step_of_row = np.unique(seen.step, return_inverse=True)
    steps_of_groups = [step_of_row[rows] for _, rows in groups]
    r = np.zeros(seen.z.shape)
    free = np.zeros(seen.z.shape)
    neighbours = np.zeros(seen.z.shape)
    for _ in range(ROUNDS):
        s = sigma[parts]
        slopes = []
        for tracks, rows in groups:
            own = slopes_of(seen.z[rows], seen.R[rows], seen.t[rows], points[tracks], f, B, s[rows])
            slopes.append(own)
        if free_poses:
            done, moves = steps_of_both(slopes, steps_of_groups, len(steps))
            seen = _moved(seen, moves[step_of_row])
        else:
            done = list(map(step_of_points, slopes))
        for (tracks, rows), step in zip(groups, done, strict=True):
            points[tracks] += step.points
            r[rows] = step.r * s[rows]
            free[rows] = step.free
            neighbours[rows] = step.neighbours
        neighbours[1:] *= s[1:] * s[:-1]
        squares = np.bincount(parts.ravel(), (r**2).ravel())
        dof = np.bincount(parts.ravel(), free.ravel())
        new = np.sqrt(squares / dof)
        change = np.abs(new / sigma - 1.0).max()
        sigma = np.maximum(new, 1e-9)
        if change < SETTLED:
            break
    return PointFit(seen, seen.z - r, r, free, parts, sigma, neighbours)


def _moved(seen: Sightings, moves: Array) -> Sightings:
    """A copy with poses moved by shifts and rotation vectors (N, 6) in sensor axes."""
    t = seen.t + np.einsum("nij,nj->ni", seen.R, moves[:, :3])
    turn = Rotation.from_rotvec(moves[:, 3:]).as_matrix()
    return replace(seen, R=seen.R @ turn, t=t)


def without_gross(fitted: PointFit) -> Array:
    """Rows (N,) of tracks whose residuals are all within ``GROSS`` robust standard deviations of their component."""
    scaled = np.abs(fitted.r / np.sqrt(np.maximum(fitted.free, 0.05)))
    limit = np.empty(len(fitted.sigma))
    for k in range(len(limit)):
        limit[k] = MAD * np.median(scaled[fitted.parts == k]) * GROSS
    wrong = (scaled > limit[fitted.parts]).any(axis=1)
    return ~np.isin(fitted.seen.track, fitted.seen.track[wrong])


def _first_points(seen: Sightings, f: float, B: float) -> Array:
    """Points (tracks, 3) from the nearest observation of each, m in the world."""
    _, first = np.unique(seen.track, return_index=True)
    best = np.lexsort((-seen.z[:, 2], seen.track))[first]
    u, v, d = seen.z[best].T
    local = np.stack(models.triangulate(u, v, d, f, B), axis=-1)
    return np.einsum("nij,nj->ni", seen.R[best], local) + seen.t[best]


def _groups(seen: Sightings) -> Iterator[tuple[Indices, Indices]]:
    """Tracks (T,) of one length n and their rows (T, n), so that all are worked on at once."""
    _, first, count = np.unique(seen.track, return_index=True, return_counts=True)
    for n in np.unique(count):
        tracks = np.flatnonzero(count == n)
        yield tracks, first[tracks][:, None] + np.arange(n)


class Slopes(NamedTuple):
    """Residuals and derivatives of T tracks of n observations, by the standard deviations of the values."""

    r: Array  # (T, n, 3)
    by_point: Array  # (T, n, 3, 3), of a prediction by the point in the world
    by_pose: Array  # (T, n, 3, 6)
    cov: Array  # (T, 3, 3), of the point if the poses are right

    @property
    def pose_by_point(self) -> Array:
        """Mixed second derivatives of the cost, (T, n, 6, 3)."""
        return np.einsum("tnci,tncj->tnij", self.by_pose, self.by_point)


def slopes_of(
    z: Array,
    R: Array,
    t: Array,
    points: Array,
    f: float,
    B: float,
    sigma: Array,
) -> Slopes:
    """Slopes at points (T, 3) seen as ``z`` (T, n, 3) from poses (T, n, 3, 3), (T, n, 3), with noise (T, n, 3)."""
    in_sensor = np.einsum("tnji,tnj->tni", R, points[:, None] - t)
    in_sensor[..., 0] = np.maximum(in_sensor[..., 0], NEAREST)
    x, y, w = np.moveaxis(in_sensor, -1, 0)
    predicted = np.stack(models.project(x, y, w, f, B), axis=-1)
    entries = np.stack(models.project_jacobian(x, y, w, f, B), axis=-1)
    J = entries.reshape(*x.shape, 3, 3) / sigma[..., None]
    by_point = J @ np.swapaxes(R, -1, -2)
    by_pose = np.concatenate([-J, J @ cross_matrix(in_sensor)], axis=-1)
    cov = np.linalg.pinv(np.einsum("tnci,tncj->tij", by_point, by_point), hermitian=True)
    return Slopes((z - predicted) / sigma, by_point, by_pose, cov)


class Step(NamedTuple):
    """What one step of least squares does to T tracks of n observations, in standard deviations."""

    points: Array  # (T, 3), m
    r: Array  # (T, n, 3), residuals after the step, to first order
    free: Array  # (T, n, 3), 1 - leverage
    neighbours: Array  # (T, n, 3), covariance that the fit gives a residual and that of the observation before


def step_of_points(s: Slopes) -> Step:
    """The step with the poses held."""
    move = np.einsum("tij,tncj,tnc->ti", s.cov, s.by_point, s.r)
    r = s.r - np.einsum("tnci,ti->tnc", s.by_point, move)
    free = 1.0 - np.einsum("tnci,tij,tncj->tnc", s.by_point, s.cov, s.by_point)
    neighbours = np.zeros_like(r)
    own = s.by_point[:, 1:]
    before = s.by_point[:, :-1]
    neighbours[:, 1:] = -np.einsum("tnci,tij,tncj->tnc", own, s.cov, before)
    return Step(move, r, free, neighbours)


def steps_of_both(slopes: list[Slopes], at: list[Indices], steps: int) -> tuple[list[Step], Array]:
    """The step of all points and of all poses.

    Parameters
    ----------
    slopes : of tracks of one length each
    at : for each of these the number 0, 1, ... of the step of each observation, (T, n)
    steps : number of poses

    Returns
    -------
    steps of the points, and the moves (steps, 6) of the poses
    """
    N = np.zeros((steps, steps, POSE, POSE))
    g = np.zeros((steps, POSE))
    for s, own in zip(slopes, at, strict=True):
        W = s.pose_by_point
        pull = np.einsum("tij,tncj,tnc->ti", s.cov, s.by_point, s.r)
        with_points_held = np.einsum("tnci,tnc->tni", s.by_pose, s.r)
        np.add.at(g, own, with_points_held - np.einsum("tnij,tj->tni", W, pull))
        np.add.at(N, (own, own), np.einsum("tnci,tncj->tnij", s.by_pose, s.by_pose))
        by_points = np.einsum("tnij,tjk,tmlk->tnmil", W, s.cov, W)
        np.subtract.at(N, (own[:, :, None], own[:, None, :]), by_points)
    flat = N.swapaxes(1, 2).reshape(steps * POSE, -1)
    # inverse on all but the six directions in which poses and points move together, which no observation tells
    values, axes = np.linalg.eigh(flat)
    Q = ((axes[:, POSE:] / values[POSE:]) @ axes[:, POSE:].T).reshape(steps, POSE, steps, POSE)
    moves = np.einsum("siuj,uj->si", Q, g)
    return [_step(s, own, Q, moves) for s, own in zip(slopes, at, strict=True)], moves


def _step(
    s: Slopes,
    at: Indices,
    Q: Array,
    moves: Array,
) -> Step:
    held = step_of_points(s)
    W = s.pose_by_point
    own_moves = moves[at]  # (T, n, 6)
    points = held.points - np.einsum("tij,tnkj,tnk->ti", s.cov, W, own_moves)
    r = s.r - np.einsum("tnci,ti->tnc", s.by_point, points)
    r -= np.einsum("tnci,tni->tnc", s.by_pose, own_moves)
    # a prediction by the poses of all steps of its track, the point following them
    n = at.shape[1]
    each = np.arange(n)
    slope = -np.einsum("tnci,tij,tmkj->tncmk", s.by_point, s.cov, W)
    slope[:, each, :, each] += np.moveaxis(s.by_pose, 1, 0)
    flat = slope.reshape(*slope.shape[:3], -1)  # (T, n, 3, 6 n)
    own = Q[at[:, :, None], :, at[:, None, :], :]
    own = own.swapaxes(2, 3).reshape(len(at), POSE * n, -1)
    along = flat @ own[:, None]
    free = held.free - np.einsum("tnck,tnck->tnc", along, flat)
    neighbours = held.neighbours.copy()
    neighbours[:, 1:] -= np.einsum("tnck,tnck->tnc", along[:, 1:], flat[:, :-1])
    return Step(points, r, free, neighbours)
