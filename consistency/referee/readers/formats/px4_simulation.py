"""Flight logs of PX4 in simulation: poses beside their true ones, with the variances of the EKF2; needs ``ulog``."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.readers.formats.geodetic import axes_at, centred
from consistency.referee.readers.formats.px4_log import Fields, loaded, times_of
from consistency.referee.readers.formats.rotations import not_unit
from consistency.referee.readers.formats.text_blocks import Lines
from consistency.referee.readers.formats.tum import SpaceRun, poses_without_covariances, space_estimator
from consistency.referee.readers.options import Reading
from consistency.referee.readers.truth_matching import Estimator, finite_rows, nearest, truth_at
from consistency.referee.types import Array, Indices

POSITION, ATTITUDE, STATES = "vehicle_local_position", "vehicle_attitude", "estimator_states"
TRUE = "_groundtruth"
ERROR_STATES = 25  # states of the EKF2 whose covariance has a rotation vector in the place of a quaternion
PLACES = (7, 6)  # of the variances of the position, behind those of the attitude and the velocity: of 24 and 25 states
QUATERNION = ("q[1]", "q[2]", "q[3]", "q[0]")  # x, y, z, w
NED = [1, 0, 2]  # axes of east, north, up that are north, east and the opposite of down
WHY = "; north, east, down as PX4 logs them"


class Track(NamedTuple):
    """Poses (N, 7) at times (N,), s, and the numbers of their messages."""

    t: Array
    poses: Array
    line: Array
    origin: Array | None  # (3,), latitude and longitude, degrees, and height, m; None where it is not logged


def read_simulation(path: Path, r: Reading, poses_alone: bool = False) -> list[Estimator]:
    """One estimator: position and attitude of a log beside those of the simulation, with standard deviations.

    Each pose has the variances of the nearest message ``estimator_states``, the diagonal of the covariance. Firmware
    with 25 states has those of a rotation vector about north, east, down; with 24 of a quaternion, of which the
    variance of the heading follows, and that of the tilt, which is taken as equal about north and east.

    Raises
    ------
    InputError
        The log cannot be read, lacks a topic, or holds a variance below zero.

    Source: docs.px4.io, VehicleLocalPosition, VehicleAttitude and EstimatorStates (UORB messages).
    """
    log = loaded(path, [POSITION, ATTITUDE, POSITION + TRUE, ATTITUDE + TRUE, STATES])
    own = _track(path, log, "")
    true = _track(path, log, TRUE)
    place = true.poses.copy()
    if own.origin is not None and true.origin is not None:
        between = axes_at(own.origin) @ (centred(true.origin) - centred(own.origin))
        place[:, :3] += between[NED] * [1.0, 1.0, -1.0]
    states = _topic(path, log, STATES, *(f"covariances[{i}]" for i in range(10)))
    variances = _variances(path, own, states)
    values = np.column_stack([own.t, own.poses, np.sqrt(variances)])
    note = f"{path}: read as a log of PX4 in simulation, {POSITION} and {ATTITUDE} with the variances of {STATES}"
    lines = Lines(path, values, own.line, note, unit=f"message of {POSITION}")
    truth = Lines(path, np.column_stack([true.t, place]), true.line, unit=f"message of {POSITION}{TRUE}")
    run = SpaceRun(lines, truth, (path, f"{POSITION}{TRUE} of {path}"))
    return [poses_without_covariances(path, [run], r) if poses_alone else space_estimator(path, [run], r, WHY)]


def _topic(path: Path, log: Any, name: str, *needed: str) -> Fields:
    """Fields of the messages of the first instance of a topic."""
    found = sorted((each.multi_id, k) for k, each in enumerate(log.data_list) if each.name == name)
    if not found:
        advice = "a simulation logs its truth; innovations of any log are for 'consistency monitor'"
        raise InputError(f"{path}: holds no message '{name}'; {advice}")
    data: Fields = log.data_list[found[0][1]].data
    for field in ("timestamp", *needed):
        if field not in data:
            raise InputError(f"{path}: message '{name}' lacks the field '{field}'")
    return data


def _columns(data: Fields, names: Iterable[str]) -> Array:
    """Numbers of four bytes as floats, (N, columns)."""
    with np.errstate(invalid="ignore"):  # of a NaN that signals
        return np.column_stack([data[name].astype(float) for name in names])


def _stamps(path: Path, name: str, data: Fields) -> Array:
    """Times of the data of messages, s; those of publication where they are not logged."""
    sample = data.get("timestamp_sample")
    return times_of(path, name, data["timestamp"] if sample is None or not sample.any() else sample)


def _track(path: Path, log: Any, ending: str) -> Track:
    """Positions that are valid, each with the attitude at its time."""
    position = _topic(path, log, POSITION + ending, *"xyz")
    attitude = _topic(path, log, ATTITUDE + ending, *QUATERNION)
    t, first = np.unique(_stamps(path, POSITION + ending, position), return_index=True)
    at, rows = np.unique(_stamps(path, ATTITUDE + ending, attitude), return_index=True)
    turns = np.column_stack([np.zeros((len(at), 3)), _columns(attitude, QUATERNION)[rows]])
    bad = not_unit(turns)[0] | ~finite_rows(turns)
    known = truth_at(t, at[~bad], turns[~bad], "spatial", 0.1) if not bad.all() else None
    place = _columns(position, "xyz")[first]
    valid = finite_rows(place)
    for flag in ("xy_valid", "z_valid"):
        valid &= position.get(flag, np.ones(len(t)))[first] != 0
    kept = np.empty(0, int) if known is None else known.rows[valid[known.rows]]
    if known is None or not len(kept):
        raise InputError(f"{path}: {POSITION}{ending} has no valid position with an attitude within 0.1 s")
    origin = None
    if {"ref_lat", "ref_lon", "ref_alt"} <= set(position):
        origin = np.array([position[f"ref_{part}"][-1] for part in ("lat", "lon", "alt")], float)
        origin = origin if np.isfinite(origin).all() and origin[:2].any() else None
    return Track(t[kept], np.column_stack([place[kept], known.truth[valid[known.rows], 3:]]), first[kept] + 1, origin)


def _variances(path: Path, own: Track, states: Fields) -> Array:
    """Variances (N, 6) of the position and of the rotation vector about north, east, down."""
    t = _stamps(path, STATES, states)
    is_vector = f"states[{ERROR_STATES - 1}]" in states
    first = PLACES[is_vector]
    P = _columns(states, [f"covariances[{i}]" for i in range(first + 3)])
    if (P < 0).any():
        raise InputError(f"{path}: {STATES} holds a variance below 0 ({P.min():.4g})")
    if is_vector:
        rotation = P[:, :3]
    else:
        x, y, z, w = own.poses[_nearest(t, own.t), 3:].T
        squares = 0.25 * np.square([[x, y, z], [w, z, y], [z, w, x], [y, x, w]])  # of d q / d (north, east, down)
        A = np.moveaxis(np.stack([squares[:, 0] + squares[:, 1], squares[:, 2]], axis=1), -1, 0)
        transposed = np.swapaxes(A, 1, 2)
        fitted = np.linalg.solve(transposed @ A, transposed @ P[:, :4, None])[..., 0]
        rotation = np.maximum(fitted, 0.0)[:, [0, 0, 1]]
    return np.hstack([P[:, first:], rotation])[_nearest(own.t, t)]


def _nearest(times: Array, reference: Array) -> Indices:
    """The nearest of ``reference`` (M,) to each of ``times`` (k,), s, both in order."""
    return nearest(times, reference, np.clip(np.searchsorted(reference, times, side="right") - 1, 0, None))
