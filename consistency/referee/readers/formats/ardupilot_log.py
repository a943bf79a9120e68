"""ArduPilot's flight logs (DataFlash): test ratios of its EKF, and innovations where it logs their variances, too.

Needs the extra ``ardupilot``.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from consistency.referee.diagnostics.monitoring.gate_ratios import GateRatios
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
from consistency.referee.readers.places import listed
from consistency.referee.types import Array

DATAFLASH_SUFFIX = ".bin"
BEGIN = b"\xa3\x95\x80"  # of the message that declares the first format
EKFS = {"XKF4": "EK3", "NKF4": "EK2"}  # message with the test ratios, and the prefix of the filter's parameters
TILT = "NKF4"  # whose SVT is a measure of the tilt error
CORE = "C"  # field of the instance of the EKF
LEAST = 1.0  # sigma, of a gate: ArduPilot takes a smaller one for it


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
                self._keep(message.get_type(), message.to_dict())

    def _keep(self, kind: str, fields: dict[str, Any]) -> None:
        if kind in self.rows:
            self.rows[kind].append(fields)
        elif str(fields["Name"]).endswith("_I_GATE"):
            name = fields["Name"]
            value = float(fields["Value"])
            self.gates[name] = min(value, self.gates.get(name, np.inf))

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
