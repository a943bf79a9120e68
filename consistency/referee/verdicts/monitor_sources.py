"""The monitor over recorded innovations: files and folders to what it said of them, in a row and a sentence.

Also the test ratios of a gate, sensor by sensor, and what they do not say. The statistics are in
``diagnostics.monitor``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from consistency.referee.defaults import FALSE_ALARM, GATE_FALSE_ALARM, NIS_TOLERANCE
from consistency.referee.diagnostics.monitor import CAVEAT, RARE, Alarm, GateRatios, Monitor, accepted_scales
from consistency.referee.diagnostics.number_words import p_text, percent, plural
from consistency.referee.diagnostics.record import Skip
from consistency.referee.diagnostics.verdict import CLOCK, MICROSECOND
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
from consistency.referee.show.blocks import Cell, Column, Document, Quantity, Text, table
from consistency.referee.types import Array
from consistency.referee.verdicts.judge_sources import refused

OPTIMAL = "optimal"
SHOWN = 4  # dimensions of innovations, of which the smallest spike is printed
NO_NIS = (
    "These are test ratios and no NIS: the log does not hold the variances of the innovations, which allows "
    "no verdict and no alarm. A ratio above 1 was rejected. A right filter has no larger shares than the table says, "
    "up to chance; smaller shares do not show that it is right."
)
HEADS = (
    "gate",
    "messages",
    "largest",
    "above 1",
    "right filter",
    "unusual above",
    "unusual",
    "right filter",
    "in a tenth",
)


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
    tolerance: float = NIS_TOLERANCE,
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
        share = None
        if gate is not None:
            text = str(gate)
            share = float(text.removesuffix("%"))
            if text.endswith("%"):
                share /= 100.0
    except ValueError:
        raise InputError(f"--gate {gate}: must be a probability, such as 99% or 0.99") from None
    try:
        return Monitor(false_alarm, tolerance, share, mission)
    except ValueError as error:
        raise refused(error) from None


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


# --- what it said -----------------------------------------------------------------------------------------------------


def monitor_document(
    name: str, monitor: Monitor, alarm: Alarm | None, t: float, since_t: float, start: float = 0.0
) -> Document:
    """One row of numbers and a sentence, and the numbers as data.

    Parameters
    ----------
    name : of the innovations
    monitor : after the last step
    alarm : its steps as the file numbers them
    t, since_t : s, of the alarm and of the beginning of the fault; NaN where they are not known
    start : s, the first time of the log; the sentence counts from it where the clock does not begin with the log
    """
    m = monitor
    share = m.gate_share
    data = {
        "innovations": name, "steps": m.steps, "measurements": m.measurements, "rejected": m.rejections,
        "judged": m.innovations, "nis_ratio": m.ratio, "scale": m.scale, "evidence": m.evidence,
        "largest_evidence": m.largest, "threshold": m.threshold, "false_alarm": m.false_alarm,
        "tolerance": m.tolerance, "gate": m.gate, "mission": m.mission, "note": CAVEAT,
        "gate_share": share and {
            "tried": m.tried, "refused": m.refused, "expected": 1.0 - float(m.gate or 0.0), "finding": share.finding,
            "p_few": share.few, "p_many": share.many, "fewest": share.fewest,
        },
        "smallest_spikes": [
            {"dof": dof, "found": found, "right": right} for dof, (found, right) in m.smallest_spikes.items()
        ],
        "alarm": None if alarm is None else {
            "step": alarm.step, "since": alarm.since, "t": t, "since_t": since_t, "direction": alarm.direction,
            "evidence": alarm.evidence, "scale": alarm.scale, "outlier": alarm.outlier,
            "rest": alarm.rest, "sentence": str(alarm),
        },
    }  # fmt: skip
    cells: list[tuple[str, Cell]] = [("steps", str(m.steps)), ("judged", str(m.innovations))]
    if m.gate is not None:
        cells.append(("rejected", str(m.rejections)))
    cells.append(("NIS/dof", Quantity(m.ratio, digits=".3f")))
    if m.gate is not None:
        cells.append(("scale", Quantity(m.scale, digits=".3f")))
    cells += [("e-value", f"{m.evidence:.3g}"), ("largest", f"{m.largest:.3g}"), ("alarm at", f"{m.threshold:.4g}")]
    columns = (Column("innovations"), *(Column(head, number=True) for head, _ in cells))
    shown = table(columns, [(name, *(cell for _, cell in cells))], f"Monitor of {name}")
    return Document(name, "", (), (shown, Text(""), Text(_sentence(m, alarm, t, since_t, start))), data)


def _sentence(monitor: Monitor, alarm: Alarm | None, t: float, since_t: float, start: float) -> str:
    if alarm is None:
        sentence = f"no alarm: no evidence that the NIS is off ({accepted_scales(monitor.tolerance)}). {CAVEAT}."
        if monitor.tolerance > 1.0:
            sentence += " --tolerance 1 asks whether it is right exactly, and so may find what is accepted here."
    else:
        sentence = str(alarm)
        if np.isfinite(t):
            after = ""
            if start > CLOCK:
                t, since_t = np.round([t - start, since_t - start], MICROSECOND)
                after = " after the start"
            sentence += f" Alarm at t = {t:.10g} s, since t = {since_t:.10g} s{after}."
    return " ".join([sentence, *_gate(monitor)])


def _gate(m: Monitor) -> list[str]:
    """Whether the gate rejects as often as that of a right filter, and the smallest spike that it rejects."""
    share = m.gate_share
    if share is None or m.gate is None:
        return []
    text = f"The gate rejected {percent(m.rejections / m.measurements)} of {plural(m.measurements, 'measurement')}"
    if m.tried < m.measurements:
        text += f", and {percent(m.refused / m.tried)} of the {m.tried} that do not come right after a rejection"
    text += f" (a right filter: {percent(1 - m.gate)})"
    rate = f"at a false-alarm rate of {percent(FALSE_ALARM)}"
    if share.finding == "too few":
        text += (
            f": too few (p {p_text(share.few)}, {rate}), so that the stated innovation covariance is too large, unless "
            "the log leaves out what was rejected."
        )
    elif share.finding:
        text += (
            f": too many (p {p_text(share.many)}, {rate}): the stated innovation covariance is too small, or there are "
            "outliers."
        )
    elif m.refused == 0:
        text += f", which shows nothing: {share.fewest} without a rejection would show that there are too few."
    else:
        text += f", which is not shown to be too few or too many ({rate})."
    spikes = []
    for dof, (found, right) in list(m.smallest_spikes.items())[:SHOWN]:
        is_off = np.isfinite(m.scale) and not 1.0 / m.tolerance <= m.scale <= m.tolerance
        of_right = f" ({right:.2g} if its covariance were right)" if is_off else ""
        spikes.append(f"{found if np.isfinite(m.scale) else right:.2g} in {dof}-D{of_right}")
    return [
        text,
        f"The smallest spike that it rejects with a chance of 50 % has, in true standard deviations: "
        f"{', '.join(spikes)}.",
    ]


def ratios_document(name: str, ratios: Sequence[GateRatios]) -> Document:
    """A row for each sensor, and the numbers as data."""
    columns = (Column("sensor"), *(Column(head, number=True) for head in HEADS))
    rows: list[tuple[Cell, ...]] = []
    sensors = {}
    for each in ratios:
        (begin, share), known = each.over_time(each.unusual), not np.isnan(each.gate)
        rejected, unusual, largest = each.above(1.0), each.above(each.unusual), float(each.ratio.max())
        most = int(np.nanargmax(share)) if known else 0
        of_gate = (
            f"≤ {each.rejected:.1g}", f"{each.unusual:.2f}", f"{unusual:.1%}", f"≤ {RARE:.0%}",
            f"{share[most]:.1%} from {begin[most]:.4g} s",
        )  # fmt: skip
        rows.append((
            each.sensor, f"{each.gate:g} sigma" if known else "", str(len(each.ratio)), f"{largest:.2f}",
            "" if np.isnan(rejected) else f"{rejected:.1%}", *(of_gate if known else [""] * len(of_gate)),
        ))  # fmt: skip
        sensors[each.sensor] = {
            "gate": each.gate, "messages": len(each.ratio), "largest": largest,
            "above_1": rejected, "above_1_of_a_right_filter": each.rejected, "unusual_above": each.unusual,
            "unusual": unusual, "unusual_of_a_right_filter": RARE,
            "over_time": [{"t": float(t), "unusual": float(s)} for t, s in zip(begin, share, strict=True)],
        }  # fmt: skip
    shown = table(columns, rows, f"Test ratios of {name}")
    data = {"log": name, "note": NO_NIS, "sensors": sensors}
    return Document(name, "", (), (shown, Text(""), Text(NO_NIS)), data)
