"""PX4 flight logs (ULog): the innovations of its EKF2, sensor by sensor; needs the extra ``ulog``."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.diagnostics.words.numbers import plural
from consistency.referee.errors import InputError
from consistency.referee.extras import MissingPackageError, remedy
from consistency.referee.parsing import is_file, reading
from consistency.referee.readers.formats.innovation_files import (
    MICRO,
    NisLog,
    Pairs,
    choose,
    numbered_log,
    require_in_order,
)
from consistency.referee.readers.truth_matching import associate
from consistency.referee.types import Array

INNOVATIONS, VARIANCES = TOPICS = ("estimator_innovations", "estimator_innovation_variances")
OLD = "ekf2_innovations"  # of older firmware: innovations and variances in one message
OLD_FIELD = re.compile(r"(.+)(_innov|_innov_var)(\[\d+\])?")
SPLIT = ("vel[0]", "vel[1]", "vel[2]", "hpos[0]", "hpos[1]", "vpos")  # its vel_pos_innov, fused at different times
SUFFIX = ".ulg"
COMPONENT = re.compile(r"\[\d+\]$")
CLOCKS = ("timestamp_sample", "timestamp")  # of the data that was fused, as both topics have it; of publication
TOGETHER = 1e-3  # s between the publication of an innovation and that of its variance, at most: a step of the EKF2
GAP = 5.0  # times the usual distance of messages, from which a distance is a gap
Fields = dict[str, Array]  # of the messages of a topic, (N,) each


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
    pairs = _paired(path, *_topics(path, log, instance))
    pairs.require_variances(path, VARIANCES, ", field '{field}' at {t}: {value} is below 0")
    groups: dict[str, list[str]] = {}
    for field in pairs.innovation:
        groups.setdefault(COMPONENT.sub("", field), []).append(field)
    sensors = {name: parts for name, parts in groups.items() if pairs.of(parts)[2].any()}
    if not sensors:
        raise InputError(f"{path}: holds no innovation with a variance; nothing was fused")
    if sensor in groups and sensor not in sensors:
        raise InputError(f"--filter {sensor}: is never fused in {path}; there are: {', '.join(sensors)}")
    if sensor is not None and any(sensor in parts for parts in sensors.values()):
        sensors[sensor] = [sensor]  # one component
    else:
        sensor = str(choose(path, "filter", list(sensors), sensor, "sensor"))
    parts = sensors[sensor]
    nis, dof, held = pairs.nis(parts)
    return numbered_log(sensor, pairs.t, nis, dof, _notes(path, sensor, pairs, dof, held, log))


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


def _topics(path: Path, log: Any, instance: int | None) -> tuple[Fields, Fields]:
    """Innovations and variances of one instance of the EKF2."""
    found: dict[str, dict[int, Fields]] = {INNOVATIONS: {}, VARIANCES: {}, OLD: {}}
    for each in log.data_list:
        found[each.name][each.multi_id] = each.data
    if not found[INNOVATIONS] and not found[VARIANCES]:
        for own, data in found[OLD].items():
            found[INNOVATIONS][own], found[VARIANCES][own] = _divided(data)
    for topic in TOPICS:
        if not found[topic]:
            advice = "log it with the profile 'Estimator replay' or default"
            raise InputError(f"{path}: holds no message '{topic}'; {advice}")
    there = sorted(set(found[INNOVATIONS]) & set(found[VARIANCES]))
    if not there:
        raise InputError(f"{path}: no instance of the EKF2 has both {' and '.join(TOPICS)}")
    own = choose(path, "run", there, instance, "instance of the EKF2")
    return found[INNOVATIONS][own], found[VARIANCES][own]


def _divided(data: Fields) -> tuple[Fields, Fields]:
    """Innovations and variances of the older message, under names as in the newer two."""
    parts: dict[str, Fields] = {"_innov": {}, "_innov_var": {}}
    for field, values in data.items():
        if field in CLOCKS:
            parts["_innov"][field] = parts["_innov_var"][field] = values
        elif match := OLD_FIELD.fullmatch(field):
            sensor, kind, index = match.groups("")
            name = f"{sensor}{index}"
            if sensor == "vel_pos":
                name = SPLIT[int(index[1:-1])]
            parts[kind][name] = values
    return parts["_innov"], parts["_innov_var"]


def _paired(path: Path, innovations: Fields, variances: Fields) -> Pairs:
    clock = next((name for name in CLOCKS if name in innovations and name in variances), None)
    if clock is None:
        raise InputError(f"{path}: {INNOVATIONS} lacks a field 'timestamp'")
    t = _times(path, INNOVATIONS, innovations[clock])
    other = _times(path, VARIANCES, variances[clock])
    if clock == CLOCKS[0]:  # of several with one stamp the first
        _, rows, match = np.intersect1d(t, other, return_indices=True)
    else:
        rows, match = associate(t, other, TOGETHER)
    if not len(rows):
        raise InputError(f"{path}: no message of {INNOVATIONS} has its partner in {VARIANCES}; both must be logged")
    own = {}
    of = {}
    for name in innovations:
        if name in variances and not name.startswith("timestamp"):
            own[name] = np.asarray(innovations[name], float)[rows]
            of[name] = np.asarray(variances[name], float)[match]
    return Pairs(t[rows], own, of, len(t) + len(other) - 2 * len(rows))


def _times(path: Path, topic: str, stamps: Array) -> Array:
    require_in_order(path, topic, stamps.astype(np.int64))
    return stamps.astype(float) * MICRO


def _notes(path: Path, name: str, pairs: Pairs, dof: Array, held: int, log: Any) -> list[str]:
    what = f"{name}: {int((dof > 0).sum())} innovations in {len(dof)} messages"
    if held:
        what += f"; {plural(held, 'message')} repeat the innovation before, as no measurement came between"
    notes = [what]
    if pairs.alone:
        notes.append(f"{plural(pairs.alone, 'message')} have no partner in the other topic and are left out")
    step = np.diff(pairs.t)
    gaps = step[step > GAP * np.median(step)] if len(step) else step
    if len(gaps):
        notes.append(f"{plural(len(gaps), 'gap')} in the messages, the longest of {gaps.max():.3g} s")
    if log.dropouts:
        lost = sum(each.duration for each in log.dropouts) / 1e3
        notes.append(f"the logger lost messages {plural(len(log.dropouts), 'time')}, {lost:.3g} s in all")
    if log.file_corruption:
        notes.append("is damaged or cut short; what could be read of it is judged")
    return [f"{path}: {note}" for note in notes]
