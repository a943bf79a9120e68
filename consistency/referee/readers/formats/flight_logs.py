"""Flight logs: innovations of PX4's EKF2 and of ArduPilot's EKF, or the test ratios that they log in their place.

ULog needs the extra ``ulog``, DataFlash the extra ``ardupilot``.
"""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from consistency.referee.diagnostics.monitor import GateRatios
from consistency.referee.diagnostics.number_words import plural
from consistency.referee.errors import InputError
from consistency.referee.extras import MissingPackageError, remedy
from consistency.referee.parsing import is_file, reading
from consistency.referee.readers.formats.innovation_files import NisLog, choose, numbered_log
from consistency.referee.readers.places import listed
from consistency.referee.readers.truth_matching import associate
from consistency.referee.types import Array

MICRO = 1e-6  # s in the unit of timestamps
INNOVATIONS, VARIANCES = TOPICS = ("estimator_innovations", "estimator_innovation_variances")
FLAGS = "estimator_status_flags"  # which sensors the EKF2 fuses
STATUS = "estimator_status"  # of firmware without these: their bits are in its field ...
MODE = "control_mode_flags"
BITS = {
    "cs_gps": 2, "cs_opt_flow": 3, "cs_mag_hdg": 4, "cs_mag_3d": 5, "cs_baro_hgt": 9, "cs_rng_hgt": 10,
    "cs_gps_hgt": 11, "cs_ev_pos": 12, "cs_ev_yaw": 13, "cs_ev_hgt": 14, "cs_fuse_beta": 15, "cs_fuse_aspd": 19,
    "cs_gps_yaw": 22, "cs_ev_vel": 24, "cs_gravity_vector": 34, "cs_mag": 35, "cs_gnss_vel": 44,
}  # fmt: skip
GPS_VELOCITY = ("cs_gps", "cs_gnss_vel")
HEIGHTS = ("cs_baro_hgt", "cs_rng_hgt", "cs_gps_hgt", "cs_ev_hgt")
YAWS = ("cs_mag_hdg", "cs_gps_yaw", "cs_gnss_yaw", "cs_ev_yaw")
FUSED_BY = {
    "gps_hvel": GPS_VELOCITY, "gps_vvel": GPS_VELOCITY, "gps_hpos": ("cs_gps", "cs_gnss_pos"),
    "gps_vpos": ("cs_gps_hgt",), "ev_hvel": ("cs_ev_vel",), "ev_vvel": ("cs_ev_vel",), "ev_hpos": ("cs_ev_pos",),
    "ev_vpos": ("cs_ev_hgt",), "baro_vpos": ("cs_baro_hgt",), "rng_vpos": ("cs_rng_hgt",), "flow": ("cs_opt_flow",),
    "heading": YAWS, "mag_field": ("cs_mag_3d", "cs_mag"), "mag": ("cs_mag_3d",), "airspeed": ("cs_fuse_aspd",),
    "beta": ("cs_fuse_beta",), "gravity": ("cs_gravity_vector",), "vel": ("cs_gps", "cs_ev_vel"),
    "hpos": ("cs_gps", "cs_ev_pos"), "vpos": HEIGHTS,
}  # flags by sensor, one of which is set while it is fused  # fmt: skip
OLD = "ekf2_innovations"  # of older firmware: innovations and variances in one message
OLD_FIELD = re.compile(r"(.+)(_innov|_innov_var)(\[\d+\])?")
SPLIT = ("vel[0]", "vel[1]", "vel[2]", "hpos[0]", "hpos[1]", "vpos")  # its vel_pos_innov, fused at different times
ULOG_SUFFIX = ".ulg"
COMPONENT = re.compile(r"\[\d+\]$")
CLOCKS = ("timestamp_sample", "timestamp")  # of the data that was fused, as both topics have it; of publication
TOGETHER = 1e-3  # s between the publication of an innovation and that of its variance, at most: a step of the EKF2
GAP = 5.0  # times the usual distance of messages, from which a distance is a gap
Fields = dict[str, Array]  # of the messages of a topic, (N,) each
DATAFLASH_SUFFIX = ".bin"
BEGIN = b"\xa3\x95\x80"  # of the message that declares the first format
EKFS = {"XKF4": "EK3", "NKF4": "EK2"}  # message with the test ratios, and the prefix of the filter's parameters
TILT = "NKF4"  # whose SVT is a measure of the tilt error
CORE = "C"  # field of the instance of the EKF
LEAST = 1.0  # sigma, of a gate: ArduPilot takes a smaller one for it


@dataclass(frozen=True)
class Pairs:
    """Innovations and their variances as the log has them together, N messages."""

    t: Array  # (N,), s, not decreasing; NaN of a clock that stands still
    innovation: Mapping[str, Array]  # (N,) for each component, as "gps_hpos[0]" or "baro_vpos"
    variance: Mapping[str, Array]
    alone: int = 0  # messages of one topic without their partner in the other

    def require_variances(self, path: Path, message: str, where: str) -> None:
        """Refuse a variance below zero; ``where`` with {field} and {t} says of which."""
        for field, variance in self.variance.items():
            for row in np.flatnonzero(variance < 0)[:1]:
                at = where.format(field=field, t=f"{self.t[row]:.10g} s", value=f"{variance[row]:.4g}")
                raise InputError(f"{path}: {message}{at}")

    def of(self, parts: Sequence[str]) -> tuple[Array, Array, Array]:
        """Innovations and variances of some components, (N, n), and which are fused: with a variance above zero."""
        innovation = np.column_stack([self.innovation[part] for part in parts])
        variance = np.column_stack([self.variance[part] for part in parts])
        return innovation, variance, np.isfinite(innovation) & np.isfinite(variance) & (variance > 0)

    def nis(self, parts: Sequence[str]) -> tuple[Array, Array, int]:
        """NIS (N,), degrees of freedom (N,), and the number of messages that repeat the one before."""
        innovation, variance, fused = self.of(parts)
        both = np.nan_to_num(np.hstack([innovation, variance]), nan=np.inf)
        same = np.append(False, (both[1:] == both[:-1]).all(axis=1))
        ratio = np.where(fused, np.square(innovation), 0.0) / np.where(fused, variance, 1.0)
        dof = np.where(same, 0, fused.sum(axis=1)).astype(float)
        repeated = int((same & fused.any(axis=1)).sum())
        return np.where(dof > 0, ratio.sum(axis=1), np.nan), dof, repeated


def read_ulog(path: Path, sensor: str | None = None, instance: int | None = None) -> NisLog:
    """Innovations of one sensor of the EKF2 as NIS: the sum over its components of innovation^2 / variance.

    The log has no covariance between the components of a sensor, which the EKF2 fuses one after the other: they are
    taken as independent. ``gps_hpos[0]`` in place of ``gps_hpos`` selects one component.

    A message that repeats the innovations before it is a step without a measurement: the EKF2 publishes what it fused
    last. So is one without an innovation (NaN), or with a variance of zero, as for a sensor that is not fused, and one
    at a time at which the flags of the EKF2 say so, as before the first fix of GPS.

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
    log = loaded(path, [*TOPICS, OLD, FLAGS, STATUS])
    innovations, variances, flags = _topics(path, log, instance)
    pairs = _paired(path, innovations, variances)
    pairs.require_variances(path, VARIANCES, ", field '{field}' at {t}: {value} is below 0")
    logged = pairs
    pairs = _fused(logged, flags, _clock(path, innovations, flags))
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
    notes = _notes(path, sensor, pairs, dof, held, log)
    if idle := int((logged.of(parts)[2] & ~pairs.of(parts)[2]).any(axis=1).sum()):
        what = f"the EKF2 did not fuse the sensor ({listed(_flags_of(parts[0], flags))} 0)"
        notes.append(f"{path}: {plural(idle, 'message')} do not count, as {what}")
    return numbered_log(sensor, pairs.t, nis, dof, notes)


def loaded(path: Path, topics: Sequence[str]) -> Any:
    """The messages of some topics of a log; raises InputError where it cannot be read."""
    try:
        from pyulog import ULog
    except ImportError:
        raise MissingPackageError(f"{path}: a ULog needs {remedy('ulog', package='pyulog')}") from None
    if not is_file(path):
        raise InputError(f"{path}: no such file")
    refusal = "cannot be read as a ULog, damaged or cut short"
    with reading(path, refusal), path.open("rb") as file, contextlib.redirect_stdout(io.StringIO()):
        return ULog(file, list(topics))  # prints what it skips


def _topics(path: Path, log: Any, instance: int | None) -> tuple[Fields, Fields, Fields]:
    """Innovations and variances of one instance of the EKF2, and its flags with their times, if they are logged."""
    found: dict[str, dict[int, Fields]] = {INNOVATIONS: {}, VARIANCES: {}, OLD: {}, FLAGS: {}, STATUS: {}}
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
    flags: Fields = {}
    for of_instances in (found[STATUS], found[FLAGS]):
        flags = of_instances.get(own, flags)
    if MODE in flags:
        bits = flags[MODE].astype(np.int64)
        flags = flags | {name: bits >> bit & 1 for name, bit in BITS.items()}
    return found[INNOVATIONS][own], found[VARIANCES][own], flags


def _flags_of(field: str, flags: Fields) -> list[str]:
    """Flags that are there, one of which is set while the sensor of a field is fused."""
    return [name for name in FUSED_BY.get(COMPONENT.sub("", field), ()) if name in flags]


def _fused(pairs: Pairs, flags: Fields, clock: str) -> Pairs:
    """Pairs without the variances of sensors that are not fused by their flags, of which the last ones before count."""
    if not flags or np.isnan(pairs.t).any():
        return pairs
    last = np.searchsorted(flags[clock].astype(float) * MICRO, pairs.t, side="right") - 1
    variance = dict(pairs.variance)
    for field, values in pairs.variance.items():
        if names := _flags_of(field, flags):
            is_fused = np.any([flags[name][np.maximum(last, 0)] != 0 for name in names], axis=0)
            variance[field] = np.where(is_fused, values, np.nan)
    return replace(pairs, variance=variance)


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


def _clock(path: Path, *topics: Fields) -> str:
    """The clock that the messages of some topics have in common."""
    clock = next((name for name in CLOCKS if all(name in topic for topic in topics if topic)), None)
    if clock is None:
        raise InputError(f"{path}: {INNOVATIONS} lacks a field 'timestamp'")
    return clock


def _paired(path: Path, innovations: Fields, variances: Fields) -> Pairs:
    clock = _clock(path, innovations, variances)
    t = times_of(path, INNOVATIONS, innovations[clock])
    other = times_of(path, VARIANCES, variances[clock])
    stands = len(t) > 1 and t[0] == t[-1]
    if innovations[clock] is variances[clock]:  # of one message
        rows = match = np.arange(len(t))
    elif stands:
        raise InputError(f"{path}: the timestamps of {INNOVATIONS} are all {t[0]:g} s, so that none has a partner")
    elif clock == CLOCKS[0]:  # of several with one stamp the first
        _, rows, match = np.intersect1d(t, other, return_indices=True)
    else:
        rows, match = associate(t, other, TOGETHER)
    if not len(rows):
        raise InputError(f"{path}: no message of {INNOVATIONS} has its partner in {VARIANCES}; both must be logged")
    own = {}
    of = {}
    for name in innovations:
        if name in variances and not name.startswith("timestamp"):
            with np.errstate(invalid="ignore"):  # of a NaN that signals
                own[name] = np.asarray(innovations[name], float)[rows]
                of[name] = np.asarray(variances[name], float)[match]
    return Pairs(np.full(len(t), np.nan) if stands else t[rows], own, of, len(t) + len(other) - 2 * len(rows))


def require_in_order(path: Path, topic: str, t: Array) -> None:
    """Refuse messages whose times go back."""
    if len(back := np.flatnonzero(np.diff(t) < 0)):
        raise InputError(f"{path}: message {back[0] + 2} of {topic} is older than the one before; the log is damaged")


def times_of(path: Path, topic: str, stamps: Array) -> Array:
    """Seconds of timestamps in us, (N,), which must not go back."""
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


class Ratio(NamedTuple):
    """Test ratios of a sensor."""

    field: str
    components: int  # that it covers at most
    gates: tuple[str, ...]  # parameters


class LoggedSensor(NamedTuple):
    """Innovations of a sensor with their variances."""

    message: str
    innovations: tuple[str, ...]
    variances: tuple[str, ...]
    power: int  # that makes these variances


RATIOS = {
    "vel": Ratio("SV", 3, ("VEL",)),
    "pos": Ratio("SP", 2, ("POS",)),
    "hgt": Ratio("SH", 1, ("HGT",)),
    "mag": Ratio("SM", 4, ("MAG", "YAW")),
    "tas": Ratio("SVT", 1, ("EAS",)),
}  # by sensor
STATED = {
    "odometry": LoggedSensor("XKFD", ("IX", "IY", "IZ"), ("IVX", "IVY", "IVZ"), 1),
    "beacon": LoggedSensor("XKF0", ("innov",), ("SIV",), 2),
}  # by sensor


class Messages(NamedTuple):
    """Messages of a kind and of one instance of the EKF, N of them."""

    t: Array  # (N,), s, not decreasing
    fields: dict[str, Array]  # (N,), 0 where a message lacks one


def is_dataflash(path: Path) -> bool:
    return path.suffix.lower() == DATAFLASH_SUFFIX


def read_ratios(path: Path, sensor: str | None = None, core: int | None = None) -> tuple[list[GateRatios], list[str]]:
    """Test ratios by sensor, and notes; of a sensor that is never fused there are none.

    The fields SV, SP, SH, SM and SVT of XKF4 and NKF4 are roots of squared innovations over the largest that the gate
    lets pass. (ArduPilot's description of the whole message calls them squares, those of its fields call them roots. Of
    squares, what a right filter exceeds here would be rarer still.)

    Parameters
    ----------
    sensor : one of ``vel``, ``pos``, ``hgt``, ``mag``, ``tas``; None for all
    core : instance of the EKF; None where there is one

    Raises
    ------
    InputError
        The file cannot be read, holds no test ratios, or lacks the sensor or the instance.

    Source: ardupilot.org, "Onboard Message Log Messages" (XKF4, NKF4) and "Complete Parameter List" (EK3_POS_I_GATE).
    """
    log = _Log(path, EKFS)
    message = next((name for name in EKFS if log.rows[name]), None)
    if message is None:
        raise InputError(f"{path}: holds no message {' or '.join(EKFS)}; log it with LOG_BITMASK, bit of the EKF")
    t, fields = log.messages(message, core, [ratio.field for ratio in RATIOS.values()])
    ratios = []
    for name, ratio in RATIOS.items():
        values = fields[ratio.field]
        fused = np.isfinite(values) & np.logical_or.accumulate(values > 0)
        if fused.any() and (message, name) != (TILT, "tas"):
            gate = log.gate(EKFS[message], ratio.gates)
            ratios.append(GateRatios(name, t[fused], values[fused], gate, ratio.components))
    if not ratios:
        raise InputError(f"{path}: the test ratios of {message} are 0 throughout; nothing was fused")
    if sensor is not None:
        there = [each.sensor for each in ratios]
        ratios = [ratios[there.index(choose(path, "filter", there, sensor, "sensor"))]]
    notes = [f"{path}: read as test ratios of {message}, {plural(len(t), 'message')}"]
    if bare := [each.sensor for each in ratios if np.isnan(each.gate)]:
        notes.append(f"{path}: PARM holds no gate of {listed(bare)}; what a right filter would exceed is not known")
    return ratios, notes


def read_stated(path: Path, sensor: str, core: int | None = None) -> NisLog:
    """The NIS of a sensor whose innovations are logged with their variances: ``odometry`` or ``beacon``.

    Raises
    ------
    InputError
        As :func:`read_ratios`, or a variance is below zero.

    Source: ardupilot.org, "Onboard Message Log Messages" (XKFD, XKF0).
    """
    stated = STATED[sensor]
    message = stated.message
    parts = stated.innovations
    log = _Log(path, [message])
    if not log.rows[message]:
        raise InputError(f"--filter {sensor}: {path} holds no message {message}, which has its innovations")
    t, fields = log.messages(message, core, (*parts, *stated.variances))
    as_logged = Pairs(t, fields, dict(zip(parts, map(fields.__getitem__, stated.variances), strict=True)))
    as_logged.require_variances(path, message, " at {t}: {value} is below 0, beside {field}")
    variances = {part: values**stated.power for part, values in as_logged.variance.items()}
    nis, dof, held = Pairs(t, fields, variances).nis(parts)
    note = f"{path}: {sensor}: {int((dof > 0).sum())} innovations in {plural(len(t), 'message')} {message}"
    if held:
        note += f"; {held} repeat the innovation before"
    return numbered_log(sensor, t, nis, dof, [note])


class _Log:
    """Messages of some kinds, and the smallest value of each parameter that is a gate."""

    def __init__(self, path: Path, kinds: Iterable[str]) -> None:
        try:
            from pymavlink.DFReader import DFReader_binary
        except ImportError:
            needed = remedy("ardupilot", package="pymavlink")
            raise MissingPackageError(f"{path}: a log of ArduPilot needs {needed}") from None
        if not is_file(path):
            raise InputError(f"{path}: no such file")
        with reading(path), path.open("rb") as file:
            if file.read(len(BEGIN)) != BEGIN:
                what = "is not a flight log of ArduPilot; one begins with the format of its messages"
                raise InputError(f"{path}: {what}")
        self.path = path
        self.rows: dict[str, list[dict[str, Any]]] = {kind: [] for kind in kinds}
        self.gates: dict[str, float] = {}
        said = io.StringIO()  # it prints what it skips
        with (
            reading(path),
            contextlib.redirect_stdout(said),
            contextlib.redirect_stderr(said),
            DFReader_binary(str(path)) as log,
        ):
            while (message := log.recv_match(type=[*self.rows, "PARM"])) is not None:
                fields = message.to_dict()
                if message.get_type() in self.rows:
                    self.rows[message.get_type()].append(fields)
                elif (name := str(fields["Name"])).endswith("_I_GATE"):
                    self.gates[name] = min(float(fields["Value"]), self.gates.get(name, np.inf))

    def gate(self, prefix: str, names: Iterable[str]) -> float:
        """The smallest of some gates, sigma; NaN where none is known."""
        smallest = min(self.gates.get(f"{prefix}_{name}_I_GATE", np.inf) for name in names)
        return max(LEAST, smallest / 100.0) if np.isfinite(smallest) else np.nan

    def messages(self, kind: str, core: int | None, names: Iterable[str]) -> Messages:
        """Fields of the messages of one instance of the EKF."""
        by_core: dict[int, list[dict[str, Any]]] = {}
        for row in self.rows[kind]:
            by_core.setdefault(int(row.get(CORE, 0)), []).append(row)
        rows = by_core[choose(self.path, "run", sorted(by_core), core, "core of the EKF")]
        t = np.array(list(map(_time, rows)))
        if not np.isfinite(t).all():
            raise InputError(f"{self.path}: {kind} has no field TimeUS")
        require_in_order(self.path, kind, t)
        fields = {}
        for name in names:
            fields[name] = np.array([row.get(name, 0.0) for row in rows], float)
        return Messages(t, fields)


def _time(row: dict[str, Any]) -> float:
    if "TimeUS" in row:
        return float(row["TimeUS"]) * MICRO
    return float(row.get("TimeMS", np.nan)) * 1e-3
