"""PX4 flight logs (ULog): the innovations of its EKF2, sensor by sensor; needs the extra ``ulog``."""

from __future__ import annotations

import contextlib
import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.diagnostics.words.numbers import plural
from consistency.referee.errors import InputError
from consistency.referee.extras import MissingPackageError, remedy
from consistency.referee.parsing import is_file, reading
from consistency.referee.readers.formats.innovation_files import NisLog, choose
from consistency.referee.readers.truth_matching import associate
from consistency.referee.types import Array

TOPICS = ("estimator_innovations", "estimator_innovation_variances")
OLD = "ekf2_innovations"  # of older firmware: innovations and variances in one message
SPLIT = [
    *((f"vel[{i}]") for i in range(3)),
    "hpos[0]",
    "hpos[1]",
    "vpos",
]  # its vel_pos_innov, fused at different times
SUFFIX = ".ulg"
COMPONENT = re.compile(r"\[\d+\]$")
CLOCKS = ("timestamp_sample", "timestamp")  # of the data that was fused, as both topics have it; of publication
TOGETHER = 1e-3  # s between the publication of an innovation and that of its variance, at most: a step of the EKF2
MICRO = 1e-6  # s in the unit of all timestamps
GAP = 5.0  # times the usual distance of messages, from which a distance is a gap


@dataclass(frozen=True)
class Pairs:
    """Innovations and their variances as the log has them together, N messages."""

    t: Array  # (N,), s, increasing
    innovation: dict[str, Array]  # (N,) for each component, as "gps_hpos[0]" or "baro_vpos"
    variance: dict[str, Array]
    alone: int  # messages of one topic without their partner in the other


def read_ulog(path: Path, sensor: str | None = None, instance: int | None = None) -> NisLog:
    """Innovations of one sensor of the EKF2 as NIS: the sum over its components of innovation^2 / variance.

    The log has no covariance between the components of a sensor, which the EKF2 fuses one after the other: they are
    taken as independent. ``gps_hpos[0]`` in place of ``gps_hpos`` selects one component.

    A message that repeats the innovations before it is a step without a measurement: the EKF2 publishes what it fused
    last. So is one without an innovation (NaN), or with a variance of zero, as for a sensor that is not fused.

    Parameters
    ----------
    sensor : a field of the messages; None where only one has innovations
    instance : of the EKF2, ``multi_id``; None where there is one

    Raises
    ------
    InputError
        The file cannot be read, lacks a topic or the sensor, or holds a variance below zero.

    Source: docs.px4.io, "ULog File Format" and "EstimatorInnovations (UORB message)"; the older message of PX4,
    ekf2_innovations.msg, whose first six are of velocity and position, north, east, down: ``vel``, ``hpos``, ``vpos``.
    """
    log = _loaded(path)
    topics = {(each.name, each.multi_id): each.data for each in log.data_list}
    if not any(name in TOPICS for name, _ in topics):
        for own in [i for name, i in topics if name == OLD]:
            topics[TOPICS[0], own], topics[TOPICS[1], own] = _divided(topics[OLD, own])
    for topic in TOPICS:
        if not any(name == topic for name, _ in topics):
            raise InputError(
                f"{path}: holds no message '{topic}'; log it with the profile 'Estimator replay' or default"
            )
    there = sorted({i for name, i in topics if name == TOPICS[0]} & {i for name, i in topics if name == TOPICS[1]})
    if not there:
        raise InputError(f"{path}: no instance of the EKF2 has both {' and '.join(TOPICS)}")
    own = choose(path, "run", there, instance, "instance of the EKF2")
    pairs = _paired(path, *(topics[topic, own] for topic in TOPICS))
    sensors = _sensors(path, pairs)
    if sensor is not None and sensor not in sensors and sensor in _groups(pairs):
        raise InputError(f"--filter {sensor}: is never fused in {path}; there are: {', '.join(sensors)}")
    known = [*sensors, *(part for parts in sensors.values() for part in parts)]
    name = choose(path, "filter", known if sensor in known else list(sensors), sensor, "sensor")
    parts = sensors.get(name, [name])
    nis, dof, held = nis_of(pairs, parts)
    notes = _notes(path, name, pairs, dof, held, log)
    return NisLog(name, np.arange(1.0, len(nis) + 1), pairs.t, nis, dof, tuple(notes))


def _loaded(path: Path) -> Any:
    try:
        from pyulog import ULog
    except ImportError:
        raise MissingPackageError(f"{path}: a ULog needs {remedy('ulog', package='pyulog')}") from None
    if not is_file(path):
        raise InputError(f"{path}: no such file")
    refusal = "cannot be read as a ULog, damaged or cut short"
    with reading(path, refusal), path.open("rb") as file, contextlib.redirect_stdout(io.StringIO()):
        return ULog(file, [*TOPICS, OLD])  # prints what it skips


def _divided(data: dict[str, Array]) -> tuple[dict[str, Array], dict[str, Array]]:
    """Innovations and variances of the older message, under names as in the newer two."""
    parts: tuple[dict[str, Array], dict[str, Array]] = ({}, {})
    for field, values in data.items():
        name, index = COMPONENT.sub("", field), COMPONENT.search(field)
        which = next((k for k, end in enumerate(("_innov", "_innov_var")) if name.endswith(end)), None)
        if field in CLOCKS:
            parts[0][field] = parts[1][field] = values
        elif which is not None:
            sensor = name[: -len(("_innov", "_innov_var")[which])]
            at = index[0] if index else ""
            parts[which][SPLIT[int(at[1:-1])] if sensor == "vel_pos" else sensor + at] = values
    return parts


def _paired(path: Path, innovations: dict[str, Array], variances: dict[str, Array]) -> Pairs:
    fields = [name for name in innovations if name in variances and not name.startswith("timestamp")]
    clock = next((name for name in CLOCKS if name in innovations and name in variances), None)
    if clock is None:
        raise InputError(f"{path}: {TOPICS[0]} lacks a field 'timestamp'")
    times, others = _times(path, TOPICS[0], innovations[clock]), _times(path, TOPICS[1], variances[clock])
    if clock == CLOCKS[0]:  # of several with one stamp the first
        _, rows, match = np.intersect1d(times, others, return_indices=True)
    else:
        rows, match = associate(times, others, TOGETHER)
    if not len(rows):
        raise InputError(f"{path}: no message of {TOPICS[0]} has its partner in {TOPICS[1]}; both must be logged")
    return Pairs(
        times[rows],
        {name: np.asarray(innovations[name], float)[rows] for name in fields},
        {name: np.asarray(variances[name], float)[match] for name in fields},
        len(times) + len(others) - 2 * len(rows),
    )


def _times(path: Path, topic: str, stamps: Array) -> Array:
    require_in_order(path, topic, stamps.astype(np.int64))
    return stamps.astype(float) * MICRO


def require_in_order(path: Path, topic: str, t: Array) -> None:
    """Refuse messages whose times go back."""
    if len(back := np.flatnonzero(np.diff(t) < 0)):
        raise InputError(f"{path}: message {back[0] + 2} of {topic} is older than the one before; the log is damaged")


def _groups(pairs: Pairs) -> dict[str, list[str]]:
    groups: dict[str, list[str]] = {}
    for field in pairs.innovation:
        groups.setdefault(COMPONENT.sub("", field), []).append(field)
    return groups


def _sensors(path: Path, pairs: Pairs) -> dict[str, list[str]]:
    """Components of each sensor that has an innovation."""
    for field, variance in pairs.variance.items():
        bad = np.flatnonzero(variance < 0)
        if len(bad):
            raise InputError(
                f"{path}: {TOPICS[1]}, field '{field}' at {pairs.t[bad[0]]:.10g} s: {variance[bad[0]]:.4g} is below 0"
            )
    found = {name: parts for name, parts in _groups(pairs).items() if _fused(pairs, parts).any()}
    if not found:
        raise InputError(f"{path}: holds no innovation with a variance; nothing was fused")
    return found


def _fused(pairs: Pairs, parts: list[str]) -> Array:
    """Components (N, n) with a finite innovation and a variance above zero."""
    innovation, variance = (np.column_stack([of[part] for part in parts]) for of in (pairs.innovation, pairs.variance))
    return np.asarray(np.isfinite(innovation) & np.isfinite(variance) & (variance > 0))


def nis_of(pairs: Pairs, parts: list[str]) -> tuple[Array, Array, int]:
    """NIS (N,), degrees of freedom (N,), and the number of messages that repeat the one before."""
    fused = _fused(pairs, parts)
    innovation, variance = (np.column_stack([of[part] for part in parts]) for of in (pairs.innovation, pairs.variance))
    both = np.nan_to_num(np.hstack([innovation, variance]), nan=np.inf)
    same = np.concatenate([[False], (both[1:] == both[:-1]).all(axis=1)])
    ratio = np.where(fused, np.square(innovation), 0.0) / np.where(fused, variance, 1.0)
    dof = np.where(same, 0, fused.sum(axis=1)).astype(float)
    return np.where(dof > 0, ratio.sum(axis=1), np.nan), dof, int((same & fused.any(axis=1)).sum())


def _notes(path: Path, name: str, pairs: Pairs, dof: Array, held: int, log: Any) -> list[str]:
    notes = [f"{path}: {name}: {int((dof > 0).sum())} innovations in {len(dof)} messages"]
    if held:
        notes[0] += f"; {plural(held, 'message')} repeat the innovation before, as no measurement came between"
    if pairs.alone:
        notes.append(f"{path}: {plural(pairs.alone, 'message')} have no partner in the other topic and are left out")
    step = np.diff(pairs.t)
    gaps = step[step > GAP * np.median(step)] if len(step) else step
    if len(gaps):
        notes.append(f"{path}: {plural(len(gaps), 'gap')} in the messages, the longest of {gaps.max():.3g} s")
    if log.dropouts:
        lost = sum(each.duration for each in log.dropouts) / 1e3
        notes.append(f"{path}: the logger lost messages {plural(len(log.dropouts), 'time')}, {lost:.3g} s in all")
    if log.file_corruption:
        notes.append(f"{path}: is damaged or cut short; what could be read of it is judged")
    return notes
