"""A correction as a folder: correction.toml, runs with corrected covariances, lines for other programs, and a page."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from consistency.referee.diagnostics.records.groups_by_column import Groups
from consistency.referee.diagnostics.records.record import Record
from consistency.referee.fit_covariance.correct import ByGroup, Correction, by_group, with_factors
from consistency.referee.fit_covariance.correction_text import correction_sentence, data_of_correction
from consistency.referee.fit_covariance.factors import stated_errors
from consistency.referee.fit_covariance.fit_folder import toml, write_fit
from consistency.referee.fit_covariance.page import correction_page
from consistency.referee.readers.formats.file_kinds import CORRECTED, HELD_OUT
from consistency.referee.readers.formats.restated import TextFile
from consistency.referee.readers.formats.sheet import EMPTY


def write_correction(
    found: Correction, record: Record, files: Sequence[TextFile], folder: Path, overwrite: bool = False
) -> list[Path]:
    """Write the folder of a correction; its files.

    Parameters
    ----------
    record : all runs, as they are stated
    files : that the covariances came in; without any the errors and covariances are written as archives of NumPy
    """
    write = partial(_write_runs, found, record, files)
    head = f"{found.status} after: P' = D P D + F, with D = diag(sqrt(factor)) and F = diag(floor) of each component."
    texts = {"correction.toml": toml(head, data_of_correction(found)), "corrected_covariance.py": pasted(found)}
    return write_fit(folder, ("correction", found.name), texts, correction_page(found), write, overwrite)


def _write_runs(found: Correction, record: Record, files: Sequence[TextFile], folder: Path) -> list[str]:
    """Write held-out/, each judged run by the factors of others, and corrected/, all runs by the factors of all.

    Returns the names of what ``analyse`` reads: a file, or a folder of trajectories.
    """
    held_out = dict(zip(found.before.record.run_numbers.tolist(), found.used, strict=True))
    groups = record.groups
    is_text = bool(files) and (groups is None or all(file.by_column is not None for file in files))
    are_runs = record.unit == "run"  # pieces of one log are not in its file
    runs = record.run_numbers.tolist()
    if is_text and not are_runs:
        runs = [file.run for file in files]
    corrected = dict.fromkeys(runs, by_group(found.fits))
    return [
        _write_one(folder / HELD_OUT, found, record, files if is_text and are_runs else (), held_out),
        _write_one(folder / CORRECTED, found, record, files if is_text else (), corrected),
    ]


def _write_one(
    folder: Path, found: Correction, record: Record, files: Sequence[TextFile], of_runs: dict[int, ByGroup]
) -> str:
    """Write runs by their factors, as text or as an archive; the name of the file, or of the folder of several."""
    folder.mkdir()
    if not files:
        _write_archive(folder / f"{found.name}.npz", record, of_runs)
        return f"{folder.name}/{found.name}.npz"
    change = partial(_change, found.axes, record.groups, of_runs)
    for file in files:
        if file.run_column is not None or file.run in of_runs:
            (folder / file.path.name).write_text(file.restated(change), encoding="utf-8")
    made = [path.name for path in folder.iterdir()]
    return f"{folder.name}/{made[0]}" if len(made) == 1 else folder.name


def _change(
    axes: Sequence[str], groups: Groups | None, of_runs: dict[int, ByGroup], run: int, value: str
) -> dict[str, tuple[float, float]] | None:
    """Factor and floor of each component of a run by name, at a value of its column; None of a run that is left out."""
    if run not in of_runs:
        return None
    return of_runs[run][place_in(groups, value)].by_name(axes)


def place_in(groups: Groups | None, value: str) -> int:
    """The group of a value as it stands in a file; -1 where it is in none."""
    if groups is None or value.strip() in EMPTY:
        return -1
    if groups.edges is None:
        name = f"{groups.column} is {value.strip()}"
        return groups.names.index(name) if name in groups.names else -1
    number = float(value)
    return int(np.searchsorted(groups.edges, number)) if np.isfinite(number) else -1


def _write_archive(path: Path, record: Record, of_runs: dict[int, ByGroup]) -> None:
    """Errors and covariances as an archive that ``analyse`` reads, masked where a step does not count."""
    rows = np.flatnonzero(np.isin(record.run_numbers, list(of_runs)))
    some = record.of_runs(rows)
    used = [of_runs[run] for run in some.run_numbers.tolist()]
    error, P, nees = stated_errors(with_factors(some, used))
    counted = np.isfinite(nees)
    mask = ~counted
    for failure in some.failures:  # which stay failures
        mask[some.run_numbers == failure.run, failure.step - 1 :] = False
    axes = np.array(list(record.axes) or [f"axis {i}" for i in range(record.dof)])
    np.savez(
        path,
        errors=error,
        covariances=np.where(counted[..., None, None], P, np.eye(record.dof)),
        mask=mask,
        axes=axes,
    )


# --- lines for other programs -----------------------------------------------------------------------------------------


def pasted(found: Correction) -> str:
    """corrected_covariance.py: functions of a stated covariance in plain Python, for messages of ROS, and for GTSAM."""
    groups = found.before.record.groups
    value, given, place = "", "", 'FACTORS[""]'
    if len(found.fits) > 1 and groups is not None:
        value, given = ", value", f" at a value of {groups.column}"
        place = f'FACTORS[f"{groups.column} is {{value}}"]'
        if groups.edges is not None:
            place = f"list(FACTORS.values())[bisect.bisect_left({list(groups.edges)}, value)]"
    table = "".join(f"    {group!r}: {fit.factors.by_name(found.axes)},\n" for group, fit in found.shown.items())
    turn = "heading" if "heading" in found.axes else "yaw"
    order = ("x", "y", turn) if turn == "heading" else ("roll", "pitch", "yaw", "x", "y", "z")  # of Pose2, or Pose3
    return f'''"""Corrected covariances. {correction_sentence(found)}."""

import bisect

AXES = {found.axes}
ROS = ("x", "y", "z", "roll", "pitch", "{turn}")
GTSAM = {order}
FACTORS = {{  # factor and floor on the variance of each component
{table}}}


def corrected(P{value}, axes=AXES):
    """P' = D P D + F of a covariance P{given}, rows of numbers in the order of axes."""
    known = {place}
    factors = [known.get(axis, (1.0, 0.0)) for axis in axes]
    better = [
        [(s * t) ** 0.5 * number for (t, _), number in zip(factors, row)]
        for (s, _), row in zip(factors, P)
    ]
    for i, (_, floor) in enumerate(factors):
        better[i][i] += floor
    return better


def ros_covariance(numbers{value}):
    """36 numbers of a PoseWithCovariance, row by row; robot_localization takes them from the message."""
    rows = [numbers[6 * i : 6 * i + 6] for i in range(6)]
    return [number for row in corrected(rows{value}, axes=ROS) for number in row]


def gtsam_noise(P{value}):
    """Noise model of a pose, for a factor: P in the order of gtsam, {", ".join(order)}."""
    import gtsam

    return gtsam.noiseModel.Gaussian.Covariance(corrected(P{value}, axes=GTSAM))
'''
