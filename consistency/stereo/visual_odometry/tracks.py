"""Landmarks over frames: matches linked to tracks, few of them chosen for filters that are O(n^2), and their screening.

Screened is a log itself, before any filter, of observations that leave the motion that most others of a step share:
moving things, tracks that slip. Two observations of a landmark in consecutive steps give a point and where it went, and
one motion of the robot in space is fitted to all points of a step, with Cauchy weights. No truth and no estimate of a
filter is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from consistency.bench.scenario import Belief, BelievedSensor, models
from consistency.bench.store.recorded_log import Log
from consistency.bench.types import Trial
from consistency.referee.errors import InputError
from consistency.referee.geometry import wrap
from consistency.referee.types import Array, Indices

PIXELS = ["z0", "z1", "z2"]
FREE = -1  # in place of a landmark's number
GATE = 4.0  # standard deviations that a gate is taken for, as that of an inlier of the front-end
SOFT = 2.0  # standard deviations, at which the Cauchy weight of a misfit is one half
LOOSE = np.array([0.0, 0.1, 0.1, 0.02, 0.02, 0.0])  # m, rad a step, of what odometry does not tell: slip, bumps
STEPS = 10  # of reweighted least squares
NEAREST = 0.5  # m, depth of a point that a fit may move behind the camera
MAD = 1.4826  # standard deviation over median deviation, of a Gaussian


def linked(links: Sequence[Indices]) -> list[Indices]:
    """Numbers of the tracks that matches of consecutive frames are part of.

    Parameters
    ----------
    links : for each pair of frames k, k + 1 the rows (M_k, 2) of one feature in both; a row occurs once at most

    Returns
    -------
    for each pair (M_k,), the track of each match; a track continues where the row in frame k + 1 is one of the next
    pair, and tracks are numbered in the order in which they begin
    """
    tracks: list[Indices] = []
    going: dict[int, int] = {}  # row in the frame that two pairs share -> track
    count = 0
    for rows in links:
        now = np.empty(len(rows), np.int64)
        for match, row in enumerate(rows[:, 0].tolist()):
            now[match] = going.get(row, count)
            count += row not in going
        going = dict(zip(rows[:, 1].tolist(), now.tolist(), strict=True))
        tracks.append(now)
    return tracks


class TrackSelection(NamedTuple):
    """Which observations become those of landmarks."""

    slots: int  # landmarks seen at once, at most
    max_age: int  # observations of a landmark, at most
    min_life: int  # observations of a landmark, at least
    bands: int  # columns of the image that the slots are spread over
    width: float  # of the image, px


def thinned(rows: pd.DataFrame, rule: TrackSelection) -> pd.DataFrame:
    """Rows (step, landmark, z0, z1, z2) of at most ``rule.slots`` landmarks at once.

    A free slot goes to the emptiest column of the image, there to the piece with the longest life ahead,
    then the nearer, then the first: nothing is drawn by chance. Step 0 has no observation.

    Parameters
    ----------
    rows : columns piece, step, z0, z1, z2, sorted by piece, then step, in which a piece skips no step; z0 from the
        middle of the image

    Raises
    ------
    InputError
        Nothing is left.
    """
    rows = rows[rows["step"] >= 1].reset_index(drop=True)
    column = (rows["z0"] + rule.width / 2) * rule.bands // rule.width  # of the image, from the left
    band = np.clip(column, 0, rule.bands - 1).to_numpy(np.int64)
    left = rows.groupby("piece").cumcount(ascending=False).to_numpy() + 1  # observations to come, with this one
    order = np.lexsort((rows["piece"], -rows["z2"], -np.minimum(left, rule.max_age), rows["step"]))
    landmark = np.full(len(rows), FREE)
    count = 0
    starts = 1 + np.flatnonzero(np.diff(rows["step"].to_numpy()[order]))
    for at in np.split(order, starts):
        taken = landmark[at] != FREE
        crowd = np.bincount(band[at[taken]], minlength=rule.bands)
        candidates = at[~taken & (left[at] >= rule.min_life)]
        for row in _next_rows(candidates, band, crowd, rule.slots - taken.sum()):
            life = left[row]
            if life > rule.max_age:
                life = rule.max_age
                if count % 2 == 0:  # every other is half as long: cut all in one frame, nothing would link it on
                    life //= 2
            landmark[row : row + life] = count
            count += 1
    if not count:
        raise InputError(
            f"the recording holds no track that could be used: {rule.min_life} observations in a row after step 0"
        )
    table: pd.DataFrame = rows.assign(landmark=landmark)[landmark != FREE]
    return table.sort_values(["step", "landmark"], ignore_index=True)[["step", "landmark", *PIXELS]]


def _next_rows(candidates: Indices, band: Indices, crowd: Indices, free: int) -> list[int]:
    """The first observations of the next landmarks, each from the emptiest column of the image."""
    queues = {b: list(candidates[band[candidates] == b]) for b in range(len(crowd))}
    chosen: list[int] = []
    while len(chosen) < free:
        waiting = [b for b, queue in queues.items() if queue]
        if not waiting:
            break
        emptiest = min(waiting, key=crowd.__getitem__)
        chosen.append(queues[emptiest].pop(0))
        crowd[emptiest] += 1
    return chosen


class Screened(NamedTuple):
    """Trials in which landmarks restart where they leave the common motion, and how often they do."""

    trials: list[Trial]
    scale: Array  # (s,), in units of z, standard deviation of the misfits by their median: a gate is some times it
    offered: int  # observations
    judged: int  # of these, whose landmark was seen in the step before
    broken: int  # of these, that leave the common motion


def screened(trials: Sequence[Trial], belief: Belief, gate: Array) -> Screened:
    """Recorded trials in which a landmark restarts, under another number, where it leaves the common motion.

    Parameters
    ----------
    gate : (s,), greatest misfit of each value of an observation, in units of z: px, m or rad. What is left in a step of
        one or two landmarks, which any motion fits, passes.

    Raises
    ------
    InputError
        The sensor is ``linear``, whose observations are of no point that moves.
    """
    if belief.sensor.model == "linear":
        raise InputError("a log of a sensor 'linear' cannot be screened: it observes no points that move")
    broken = []
    misfits = []
    for trial in trials:
        before, after = _pairs(trial)
        misfit = np.abs(_misfits(trial, before, after, belief, gate))
        broken.append(after[(misfit > gate).any(axis=1)])
        misfits.append(misfit)
    every = np.concatenate(misfits)
    scale = np.zeros(len(gate))
    if len(every):
        scale = MAD * np.median(every, axis=0)
    offered = sum(len(trial.z) for trial in trials)
    return Screened(
        _restarted(trials, broken),
        scale,
        offered=offered,
        judged=len(every),
        broken=sum(map(len, broken)),
    )


def _pairs(trial: Trial) -> tuple[Indices, Indices]:
    """Rows (n,) of observations, and of those of the same landmark in the step after; sorted by step."""
    step = trial.step - 1
    order = np.lexsort((step, trial.landmark))
    same_landmark = np.diff(trial.landmark[order]) == 0
    next_step = np.diff(step[order]) == 1
    follows = same_landmark & next_step
    before = order[:-1][follows]
    after = order[1:][follows]
    by_step = np.argsort(step[after], kind="stable")
    return before[by_step], after[by_step]


def _misfits(
    trial: Trial,
    before: Indices,
    after: Indices,
    belief: Belief,
    gate: Array,
) -> Array:
    """Seen less expected (n, s) at the common motion of each step, over its standard deviation by leverage."""
    step = trial.step[after] - 1
    points = _points(trial.z[before], belief.sensor)
    seen = trial.z[after]
    out = np.empty_like(seen)
    for k in np.unique(step):
        rows = step == k
        dt, v, omega = trial.controls[k]
        mean = np.array([dt * v, 0.0, 0.0, 0.0, 0.0, dt * omega])
        noise = dt * np.repeat([belief.motion.sigma_v, belief.motion.sigma_omega], 3)
        sigma = np.hypot(noise, LOOSE)
        out[rows] = _misfit(points[rows], seen[rows], mean, sigma, gate / GATE, belief.sensor)
    return out


def _misfit(
    points: Array,
    seen: Array,
    mean: Array,
    sigma: Array,
    scale: Array,
    sensor: BelievedSensor,
) -> Array:
    """Misfits (n, s) of points (n, 3) in the robot frame a step before, by reweighted least squares from the odometry.

    A fit takes after the observations that it rests on: a misfit is divided by sqrt(1 - leverage) (Cook & Weisberg
    1982, sec. 2.1).
    """
    move = mean.copy()
    for _ in range(STEPS):
        error, slope = _error_and_slope(points, seen, move, sensor)
        squared = ((error / (SOFT * scale)) ** 2).sum(axis=1)
        weight = 1.0 / (1.0 + squared)
        J = slope / scale[:, None]
        normal = np.einsum("n,nij,nik->jk", weight, J, J) + np.diag(sigma**-2)
        right = np.einsum("n,nij,ni->j", weight, J, error / scale) + (mean - move) / sigma**2
        move = move + np.linalg.solve(normal, right)
    error, slope = _error_and_slope(points, seen, move, sensor)
    J = slope / scale[:, None]
    leverage = weight[:, None] * np.einsum("nij,jk,nik->ni", J, np.linalg.inv(normal), J)
    return error / np.sqrt(np.maximum(1.0 - leverage, 1e-3))


def _error_and_slope(
    points: Array,
    seen: Array,
    move: Array,
    sensor: BelievedSensor,
) -> tuple[Array, Array]:
    """Seen less expected z (n, s), and the derivative (n, s, 6) of the expected by shift and rotation vector."""
    turn = Rotation.from_rotvec(move[3:]).as_matrix()
    moved = (points - move[:3]) @ turn
    expected, by_point = _expected(moved, sensor)
    by_turn = np.cross(moved[:, None, :], np.eye(3)).transpose(0, 2, 1)
    by_move = np.concatenate([np.broadcast_to(-turn.T, by_turn.shape), by_turn], axis=2)
    error = seen - expected
    if sensor.model == "range-bearing":
        error[:, 1] = wrap(error[:, 1])
    return error, by_point @ by_move


def _points(z: Array, sensor: BelievedSensor) -> Array:
    """Observations (n, s) as points in the robot frame (n, 3), m; those of a sensor in the plane have height 0."""
    if sensor.model == "uvd":
        u, v, d = z.T
        at = models.triangulate(u, v, d, *sensor.rig)
    elif sensor.model == "range-bearing":
        at = *models.at_range_bearing(z[:, 0], z[:, 1]), np.zeros(len(z))
    else:
        at = tuple(np.pad(z, ((0, 0), (0, 3 - sensor.size))).T)
    return np.column_stack(models.from_sensor(*at, sensor.mount.packed()))


def _expected(points: Array, sensor: BelievedSensor) -> tuple[Array, Array]:
    """Observations (n, s) of points (n, 3) in the robot frame, and their derivative (n, s, 3)."""
    mount = sensor.mount.packed()
    bx, by, bz = points.T
    x, y, z = models.to_sensor(bx, by, bz, mount)
    if sensor.model == "uvd":
        x = np.maximum(x, NEAREST)
        seen = np.column_stack(models.project(x, y, z, *sensor.rig))
        slope = np.array(models.project_jacobian(x, y, z, *sensor.rig)).reshape(3, 3, -1)
    elif sensor.model == "range-bearing":
        seen = np.column_stack(models.range_bearing(x, y))
        flat = np.array(models.range_bearing_jacobian(x, y)).reshape(2, 2, -1)
        slope = np.pad(flat, ((0, 0), (0, 1), (0, 0)))
    else:
        seen = np.column_stack([x, y, z])[:, : sensor.size]
        slope = np.repeat(np.eye(3)[: sensor.size, :, None], len(x), axis=2)
    from_robot = np.array(mount[3:]).reshape(3, 3).T
    return seen, slope.transpose(2, 0, 1) @ from_robot


def _restarted(trials: Sequence[Trial], broken: Sequence[Indices]) -> list[Trial]:
    """Trials in which a landmark has another id from each row in ``broken`` on: its n-th new one is one in all trials.

    The ids of landmarks stay what they are, new ones follow; then those of things that are not landmarks, likewise.
    """
    ids = max(trial.n_landmarks for trial in trials)
    known = ids
    if trials[0].landmarks is not None:
        known = len(trials[0].landmarks)
    pieces = list(map(_piece, trials, broken))
    count = np.ones(ids, np.int64)
    for trial, piece in zip(trials, pieces, strict=True):
        np.maximum.at(count, trial.landmark, piece + 1)
    parent = np.repeat(np.arange(ids), count)
    place = np.cumsum(count) - count  # of the first of each parent
    new = np.arange(len(parent)) != place[parent]
    order = np.lexsort((new, parent >= known))
    rank = np.argsort(order)
    again = []
    for trial, piece in zip(trials, pieces, strict=True):
        landmark = rank[place[trial.landmark] + piece]
        again.append(_renumbered(trial, landmark, parent[order], new[order]))
    return again


def _piece(trial: Trial, broken: Indices) -> Indices:
    """How often the landmark of each row (M,) has restarted up to it; rows are in order of the steps."""
    order = np.argsort(trial.landmark, kind="stable")
    breaks = np.isin(order, broken).astype(np.int64)
    before = np.cumsum(breaks) - breaks
    first = np.searchsorted(trial.landmark[order], trial.landmark[order])
    out = np.empty(len(order), np.int64)
    out[order] = before + breaks - before[first]
    return out


def _renumbered(
    trial: Trial,
    landmark: Indices,
    parent: Indices,
    new: Array,
) -> Trial:
    """A trial with the ids ``landmark`` (M,) of its rows, each a ``new`` one or not, of ``parent`` in the trial."""
    labels = np.arange(len(parent))
    if trial.labels is not None:
        labels = trial.labels[parent]
    labels[new] = labels.max(initial=-1) + 1 + np.arange(new.sum())
    source = trial.source
    if source is not None:
        source = np.where(source == trial.landmark, landmark, source)
    places = trial.landmarks
    if places is not None:
        places = places[parent[parent < len(places)]]
    return replace(trial, landmark=landmark, n_landmarks=len(parent), labels=labels, source=source, landmarks=places)


def screened_log(log: Log, gate: str | Array) -> Log:
    """A log in which landmarks restart where they leave the common motion; ``screening`` says how often.

    Parameters
    ----------
    gate : (s,) or text, greatest misfit of each value of an observation, in units of z

    Raises
    ------
    InputError
        ``gate`` is not one positive number for each value; the sensor is linear.
    """
    values = np.zeros(0)
    given: Sequence[str] | Array = gate
    if isinstance(gate, str):
        given = gate.split(",")
    with suppress(ValueError):
        values = np.array(given, float)
    size = log.belief.sensor.size
    if values.shape != (size,) or not (np.isfinite(values) & (values > 0)).all():
        example = ",".join(["2", "2", "1"][:size])
        raise InputError(
            f"--screen {gate}: must be {size} positive numbers for a sensor '{log.belief.sensor.model}', as {example}"
        )
    found = screened(log.trials, log.belief, values)
    screening = {
        "gate": values.tolist(),
        "scale": found.scale.tolist(),
        "offered": found.offered,
        "judged": found.judged,
        "broken": found.broken,
    }
    landmarks = log.landmarks
    first = found.trials[0]
    if landmarks is not None and first.landmarks is not None and first.labels is not None:
        places = pd.DataFrame(first.landmarks, columns=["x", "y", "z"])
        places.insert(0, "landmark", first.labels[: len(places)])
        landmarks = pd.concat([landmarks, places]).drop_duplicates("landmark", ignore_index=True)
    return replace(log, trials=found.trials, landmarks=landmarks, screening=screening)


def screening_line(log: Log) -> str:
    """What a screening found, for a terminal."""
    found = log.screening or {}
    gate = ", ".join(f"{value:.2g}" for value in found["gate"])
    scale = ", ".join(f"{value:.2g}" for value in found["scale"])
    return (
        f"screen: {found['broken']} of {found['judged']} observations that follow another of their landmark leave the "
        f"common motion by more than {gate}; a landmark restarts there (standard deviation of the rest: {scale})"
    )
