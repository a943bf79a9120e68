"""ArduPilot's flight logs (DataFlash): test ratios of its EKF, and innovations where it logs their variances, too.

Needs the extra ``ardupilot``.
"""

from __future__ import annotations

import contextlib
import io
from pathlib import Path

import numpy as np

from consistency.referee.diagnostics.monitoring.gate_ratios import GateRatios
from consistency.referee.diagnostics.words.numbers import plural
from consistency.referee.errors import InputError
from consistency.referee.extras import MissingPackageError, remedy
from consistency.referee.parsing import is_file, reading
from consistency.referee.readers.formats.innovation_files import NisLog, choose
from consistency.referee.readers.formats.px4_log import MICRO, Pairs, nis_of, require_in_order
from consistency.referee.readers.places import listed
from consistency.referee.types import Array

SUFFIX = ".bin"
BEGIN = b"\xa3\x95\x80"  # of the message that declares the first format
EKFS = {"XKF4": "EK3", "NKF4": "EK2"}  # message with the test ratios, and the prefix of the filter's parameters
# by sensor: the field, how many components it covers at most, the parameters of its gates
RATIOS = {
    "vel": ("SV", 3, ("VEL",)),
    "pos": ("SP", 2, ("POS",)),
    "hgt": ("SH", 1, ("HGT",)),
    "mag": ("SM", 4, ("MAG", "YAW")),
    "tas": ("SVT", 1, ("EAS",)),
}
TILT = "NKF4"  # whose SVT is a measure of the tilt error
# by sensor: the message, innovations, variances, and the power that makes these variances
STATED = {"odometry": ("XKFD", "IX IY IZ", "IVX IVY IVZ", 1), "beacon": ("XKF0", "innov", "SIV", 2)}
CORE = "C"  # field of the instance of the EKF
LEAST = 1.0  # sigma, of a gate: ArduPilot takes a smaller one for it


def is_dataflash(path: Path) -> bool:
    return path.suffix.lower() == SUFFIX


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
    wanted = {name: [field for field, _, _ in RATIOS.values()] for name in EKFS}
    found, gates = _loaded(path, wanted)
    message = next((name for name in EKFS if found[name]), None)
    if message is None:
        raise InputError(f"{path}: holds no message {' or '.join(EKFS)}; log it with LOG_BITMASK, bit of the EKF")
    rows = _of_core(path, found[message], core)
    t = _times(path, message, rows)
    ratios = []
    for name, (field, components, keys) in RATIOS.items():
        values = np.array([row.get(field, 0.0) for row in rows], float)
        fused = np.isfinite(values) & (np.cumsum(values > 0) > 0)
        if fused.any() and not (field == "SVT" and message == TILT):
            stated = [gates[key] for key in (f"{EKFS[message]}_{key}_I_GATE" for key in keys) if key in gates]
            gate = max(LEAST, min(stated) / 100.0) if stated else np.nan
            ratios.append(GateRatios(name, t[fused], values[fused], gate, components))
    if not ratios:
        raise InputError(f"{path}: the test ratios of {message} are 0 throughout; nothing was fused")
    if sensor is not None:
        there = [each.sensor for each in ratios]
        ratios = [ratios[there.index(choose(path, "filter", there, sensor, "sensor"))]]
    notes = [f"{path}: read as test ratios of {message}, {plural(len(rows), 'message')}"]
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
    message, innovations, variances, power = STATED[sensor]
    parts = innovations.split()
    found, _ = _loaded(path, {message: [*parts, *variances.split()]})
    if not found[message]:
        raise InputError(f"--filter {sensor}: {path} holds no message {message}, which has its innovations")
    rows = _of_core(path, found[message], core)
    t = _times(path, message, rows)
    own, of = ({part: np.array([row[name] for row in rows], float) for part, name in zip(parts, names, strict=True)}
               for names in (parts, variances.split()))  # fmt: skip
    if low := [(name, values) for name, values in of.items() if (values < 0).any()]:
        at = int(np.argmax(low[0][1] < 0))
        raise InputError(f"{path}: {message} at {t[at]:.10g} s: {low[0][1][at]:.4g} is below 0, beside {low[0][0]}")
    nis, dof, held = nis_of(Pairs(t, own, {part: values**power for part, values in of.items()}, 0), parts)
    note = f"{path}: {sensor}: {int((dof > 0).sum())} innovations in {plural(len(rows), 'message')} {message}"
    if held:
        note += f"; {held} repeat the innovation before"
    return NisLog(sensor, np.arange(1.0, len(nis) + 1), t, nis, dof, (note,))


def _loaded(path: Path, wanted: dict[str, list[str]]) -> tuple[dict[str, list[dict[str, float]]], dict[str, float]]:
    """Rows of messages, with their time and instance, and the smallest value of each parameter that is a gate."""
    try:
        from pymavlink.DFReader import DFReader_binary
    except ImportError:
        raise MissingPackageError(
            f"{path}: a log of ArduPilot needs {remedy('ardupilot', package='pymavlink')}"
        ) from None
    if not is_file(path):
        raise InputError(f"{path}: no such file")
    with reading(path), path.open("rb") as file:
        if file.read(len(BEGIN)) != BEGIN:
            raise InputError(f"{path}: is not a flight log of ArduPilot; one begins with the format of its messages")
    rows: dict[str, list[dict[str, float]]] = {name: [] for name in wanted}
    gates: dict[str, float] = {}
    said = io.StringIO()  # it prints what it skips
    with (
        reading(path),
        contextlib.redirect_stdout(said),
        contextlib.redirect_stderr(said),
        DFReader_binary(str(path)) as log,
    ):
        while (message := log.recv_match(type=[*wanted, "PARM"])) is not None:
            kind = message.get_type()
            if kind in rows:
                fields = {"TimeUS", "TimeMS", CORE, *wanted[kind]} & {*message.get_fieldnames()}
                rows[kind].append({name: float(getattr(message, name)) for name in fields})
            elif str(message.Name).endswith("_I_GATE"):
                gates[message.Name] = min(float(message.Value), gates.get(message.Name, np.inf))
    return rows, gates


def _of_core(path: Path, rows: list[dict[str, float]], core: int | None) -> list[dict[str, float]]:
    cores = sorted({int(row.get(CORE, 0)) for row in rows})
    own = choose(path, "run", cores, core, "core of the EKF")
    return [row for row in rows if int(row.get(CORE, 0)) == own]


def _times(path: Path, message: str, rows: list[dict[str, float]]) -> Array:
    t = np.array([row["TimeUS"] * MICRO if "TimeUS" in row else row.get("TimeMS", np.nan) * 1e-3 for row in rows])
    if not np.isfinite(t).all():
        raise InputError(f"{path}: {message} has no field TimeUS")
    require_in_order(path, message, t)
    return t
