"""The monitor over recorded innovations: files and folders to what it said of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from consistency.referee.defaults import GATE_FALSE_ALARM
from consistency.referee.diagnostics.monitor import Alarm, Monitor
from consistency.referee.diagnostics.record import Skip
from consistency.referee.errors import InputError
from consistency.referee.readers.formats.file_kinds import is_bag
from consistency.referee.readers.formats.flight_logs import STATED, ULOG_SUFFIX, is_dataflash, read_stated, read_ulog
from consistency.referee.readers.formats.innovation_files import (
    DEFAULT,
    NisLog,
    choose,
    read_nis,
    refuse_options,
    stream_nis,
)
from consistency.referee.readers.options import Reading
from consistency.referee.types import Array
from consistency.referee.verdicts.judge_sources import refused

OPTIMAL = "optimal"


@dataclass(frozen=True)
class Watched:
    """What a monitor said of the innovations of one run."""

    name: str
    monitor: Monitor  # after the last step
    alarm: Alarm | None  # its steps as the file numbers them
    alarm_t: float  # s; NaN where unknown
    since_t: float
    step: Array  # (N,); all four are empty for lines as they came
    t: Array  # (N,)
    nis_over_dof: Array  # (N,), NaN where there is no innovation
    evidence: Array  # (N,), e-value after each step


def make_monitor(
    innovations: str | None,
    gate: str | float | None = None,
    false_alarm: float = GATE_FALSE_ALARM,
    tolerance: float = 1.2,
    mission: int | None = None,
) -> Monitor:
    """A monitor by the options of the command; ``innovations`` must declare them to be those of an optimal gain.

    Parameters
    ----------
    gate : a probability, 0.99, or a text, 99%

    Raises
    ------
    InputError
        The declaration is missing, or an option is out of its range.
    """
    if innovations != OPTIMAL:
        value = ""
        if innovations is not None:
            value = f", got '{innovations}'"
        raise InputError(
            f"--innovations must be '{OPTIMAL}'{value}: declare that the filter has the optimal (Kalman) gain for its "
            "model. Of any other filter the innovations are not white, and no false-alarm rate holds"
        )
    try:
        text = str(gate)
        share = None if gate is None else float(text.removesuffix("%")) / (100.0 if text.endswith("%") else 1.0)
    except ValueError:
        raise InputError(f"--gate {gate}: must be a probability, such as 99% or 0.99") from None
    try:
        return Monitor(false_alarm, tolerance, share, mission)
    except ValueError as error:
        name, rest = str(error).split(" ", 1)
        raise InputError(f"--{name.replace('_', '-')} {rest}") from None


def refuse_bags(path: Path) -> None:
    """Refuse ROS bags, in which no innovations stand, by saying what is needed instead."""
    if is_bag(path):
        raise InputError(
            f"{path}: a ROS bag holds poses and no innovations; for 'monitor' write a table of t, innovation and "
            f"innovation_variance, or of nis and nis_dof; judge the poses beside a truth: consistency inspect {path}"
        )


def read_innovations(
    path: Path, filter_name: str | None = None, run: int | None = None, r: Reading = DEFAULT
) -> NisLog:
    """Read the innovations of one run from a file.

    Of a flight log (.ulg of PX4, .bin of ArduPilot), ``filter_name`` is the sensor, and ``run`` the EKF's instance;
    ``r`` is of tables.

    Raises
    ------
    InputError
        Something cannot be used, or there are several filters or runs and none is named.
    """
    if path.suffix.lower() == ULOG_SUFFIX or is_dataflash(path):
        refuse_options(path, r)
    if path.suffix.lower() == ULOG_SUFFIX:
        return read_ulog(path, filter_name, run)
    if is_dataflash(path):
        return read_stated(path, choose(path, "filter", list(STATED), filter_name), run)
    return read_nis(path, filter_name, run, r)


def skip_first(log: NisLog, skip: Skip | None) -> NisLog:
    """The innovations after the first steps or seconds, which keep their numbers.

    Raises
    ------
    InputError
        Nothing is left, or seconds are asked for and there are no times.
    """
    if skip is None:
        return log
    try:
        kept = ~skip.mask((1, len(log.nis)), log.t[None])[0]
    except ValueError as error:
        raise refused(error) from None
    if not kept.any():
        raise InputError(f"--skip {skip.option}: nothing of {log.name} is left, which has {len(kept)} steps")
    arrays = {name: getattr(log, name)[kept] for name in ("step", "t", "nis", "dof")}
    return replace(log, **arrays, notes=(*log.notes, f"{log.name}: {skip.text} are left out (--skip)"))


def watch(log: NisLog, monitor: Monitor) -> Watched:
    """Put the innovations of a run through a new monitor; beside an outlier, the whole log counts."""
    evidence = np.empty(len(log.nis))
    for row, (nis, dof) in enumerate(zip(log.nis.tolist(), log.dof.tolist(), strict=True)):
        monitor.update(nis, int(dof))
        evidence[row] = monitor.evidence
    alarm = monitor.alarm
    times = (math.nan, math.nan)
    if alarm is not None:
        row = alarm.step - 1
        since = alarm.since - 1
        times = float(log.t[row]), float(log.t[since])
        alarm = replace(alarm, step=int(log.step[row]), since=int(log.step[since]))
        if alarm.outlier is not None:
            alarm = replace(alarm, outlier=int(log.step[alarm.outlier - 1]), rest=monitor.rest)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(log.dof > 0, log.nis / log.dof, np.nan)
    return Watched(log.name, monitor, alarm, *times, log.step, log.t, ratio, evidence)


def watch_lines(
    lines: Iterable[str], name: str, monitor: Monitor, on_alarm: Callable[[Alarm], None], r: Reading = DEFAULT
) -> Watched:
    """Put lines of a CSV file through a new monitor as they come; step k is the k-th row.

    ``on_alarm`` is called in the row in which the alarm is raised.

    Raises
    ------
    InputError
        A line that cannot be used.
    """
    try:
        for place, nis, dof in stream_nis(lines, name, r):
            try:
                alarm = monitor.update(nis, dof)  # type: ignore[arg-type]  # refuses what is not whole
            except ValueError as error:
                raise InputError(f"{place}: {error}") from None
            if alarm is not None:
                on_alarm(alarm)
    except UnicodeDecodeError:
        raise InputError(f"{name}: not text; lines of a CSV file are needed") from None
    empty = np.empty(0)
    return Watched(name, monitor, monitor.alarm, math.nan, math.nan, empty, empty, empty, empty)
