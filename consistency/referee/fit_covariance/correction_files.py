"""A correction as a folder: correction.toml, runs with corrected covariances, lines for other programs, and a page."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from consistency.referee.diagnostics.records.groups import Groups
from consistency.referee.diagnostics.records.record import Record
from consistency.referee.fit_covariance.correct import ByGroup, Correction, by_group, with_factors
from consistency.referee.fit_covariance.correction_text import data, sentence
from consistency.referee.fit_covariance.page import correction_page
from consistency.referee.fit_covariance.writing import pairs, write_fit
from consistency.referee.readers.formats.file_kinds import CORRECTED, HELD_OUT
from consistency.referee.readers.formats.restated import TextFile
from consistency.referee.readers.formats.sheet import EMPTY
from consistency.referee.readers.truth_matching import AXES
from consistency.referee.types import Array

POSITION_AND_TURN = {**{axis: i for i, axis in enumerate(AXES)}, "heading": 5}  # places in messages of ROS


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
    texts = {"correction.toml": toml(found), **snippets(found)}
    return write_fit(folder, ("correction", found.name), texts, correction_page(found), write, overwrite)


def _write_runs(found: Correction, record: Record, files: Sequence[TextFile], folder: Path) -> list[str]:
    """Write held-out/, each judged run by the factors of others, and corrected/, all runs by the factors of all."""
    groups = record.groups
    numbers = dict(zip(found.runs, record.run_numbers.tolist(), strict=True))
    judged = {numbers[name]: factors for name, factors in zip(found.judged, found.used, strict=True)}
    every = dict.fromkeys(numbers.values(), by_group(found.fits))
    for name, of_runs in ((HELD_OUT, judged), (CORRECTED, every)):
        at = folder / name
        at.mkdir()
        pieces = record.unit != "run" and name == HELD_OUT
        if not files or pieces or (groups is not None and any(file.by_column is None for file in files)):
            _write_archive(at / f"{found.name}.npz", record, of_runs)
            continue
        of_files = every if record.unit == "run" else dict.fromkeys((file.run for file in files), by_group(found.fits))
        change = partial(_change, found.axes, groups, judged if name == HELD_OUT else of_files)
        for file in files:
            if file.run_column is not None or change(file.run, "") is not None:
                (at / file.path.name).write_text(file.restated(change), encoding="utf-8")
    return [HELD_OUT, CORRECTED]


def _change(
    axes: Sequence[str], groups: Groups | None, of_runs: dict[int, ByGroup], run: int, value: str
) -> dict[str, tuple[float, float]] | None:
    """Factor and floor of each component of a run by name, at a value of its column; None of a run that is left out."""
    if run not in of_runs:
        return None
    factor, floor = of_runs[run][place_in(groups, value)].of_components()
    return dict(zip(axes, zip(factor.tolist(), floor.tolist(), strict=True), strict=True))


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
    """Errors and covariances as an archive that ``analyse`` reads; NaN where a step does not count."""
    rows = np.flatnonzero(np.isin(record.run_numbers, list(of_runs)))
    some = record.of_runs(rows)
    used = [of_runs[run] for run in some.run_numbers.tolist()]
    corrected = with_factors(some, used)
    assert corrected.nees is not None
    assert corrected.error is not None
    assert corrected.covariance is not None
    counted = np.isfinite(corrected.nees)
    axes = np.array(list(record.axes) or [f"axis {i}" for i in range(record.dof)])
    np.savez(
        path,
        errors=corrected.error,
        covariances=np.where(counted[..., None, None], corrected.covariance, np.eye(record.dof)),
        mask=~counted,
        axes=axes,
    )


# --- lines for other programs -----------------------------------------------------------------------------------------


def toml(found: Correction) -> str:
    """correction.toml: factors with their intervals, and the data that they hold for."""
    known = data(found)
    del known["referee"]
    blocks = known.pop("blocks")
    tables = {key: known.pop(key) for key in ("stated", "corrected")}
    lines = [
        f"# {found.status} after: P' = D P D + F, with D = diag(sqrt(factor)) and F = diag(floor) of each component.",
        *pairs(known),
    ]
    for key, values in tables.items():
        lines += ["", f"[{key}]", *pairs(values)]
    for block in blocks:
        lines += ["", "[[blocks]]", *pairs(block)]
    return "\n".join(lines) + "\n"


def snippets(found: Correction) -> dict[str, str]:
    """Files for other programs by name: plain Python, and ROS, robot_localization and GTSAM of a pose."""
    factor, floor = found.fit.factors.of_components()
    if len(found.fits) > 1:
        return {"corrected_covariance.py": plain_python_by_group(found)}
    texts = {"corrected_covariance.py": plain_python(found)}
    pose = [i for i, axis in enumerate(found.axes) if axis in POSITION_AND_TURN]
    if not pose:
        return texts
    d, f = np.ones(6), np.zeros(6)
    for i in pose:
        place = POSITION_AND_TURN[found.axes[i]]
        d[place], f[place] = np.sqrt(factor[i]), floor[i]
    return texts | {"ros_covariance.py": ros(found, d, f), "gtsam_noise.py": gtsam(found, d, f)}


def _head(found: Correction) -> str:
    return f"{found.status.capitalize()} on held-out {found.unit}s; {sentence(found).partition(': ')[2]}."


def plain_python(found: Correction) -> str:
    """A function of a covariance as lists of rows."""
    factor, floor = found.fit.factors.of_components()
    return f'''"""The corrected covariance of {", ".join(found.axes)}.

{_head(found)}
"""

FACTOR = [{_numbers(factor)}]  # on the variances
FLOOR = [{_numbers(floor)}]


def corrected(P):
    """D P D + F of a covariance P, rows of {len(factor)} numbers."""
    n = range({len(factor)})
    scaled = [[(FACTOR[i] * FACTOR[j]) ** 0.5 * P[i][j] for j in n] for i in n]
    for i in n:
        scaled[i][i] += FLOOR[i]
    return scaled
'''


def plain_python_by_group(found: Correction) -> str:
    """A function of a covariance as lists of rows, and of the column that its factors go by."""
    groups = found.before.record.groups
    assert groups is not None
    rows = []
    for group, fit in found.shown.items():
        factor, floor = (_numbers(values) for values in fit.factors.of_components())
        rows.append(f"    {group!r}: ([{factor}], [{floor}]),")
    table = "\n".join(rows)
    place = f'GROUPS[f"{groups.column} is {{value}}"]'
    if groups.edges is not None:
        place = f"list(GROUPS.values())[bisect.bisect_left([{_numbers(groups.edges)}], value)]"
    return f'''"""The corrected covariance of {", ".join(found.axes)}, by {groups.column}.

{_head(found)}
"""

import bisect

GROUPS = {{  # factors on the variances, and floors
{table}
}}


def corrected(P, value):
    """D P D + F of a covariance P, rows of {len(found.axes)} numbers, at a value of {groups.column}."""
    factor, floor = {place}
    n = range({len(found.axes)})
    scaled = [[(factor[i] * factor[j]) ** 0.5 * P[i][j] for j in n] for i in n]
    for i in n:
        scaled[i][i] += floor[i]
    return scaled
'''


def ros(found: Correction, d: Array, floor: Array) -> str:
    """A function of the 36 numbers of a message, and a relay for robot_localization."""
    rows = ["    " + _numbers(row) + "," for row in np.outer(d, d)]
    floors = ["    " + _numbers(row) + "," for row in np.diag(floor)]
    return "\n".join([
        '"""ROS: the covariance of a PoseWithCovariance, 36 numbers row by row (x, y, z, roll, pitch, yaw).',
        "",
        _head(found),
        '"""',
        "",
        "import numpy as np",
        "",
        "FACTOR = np.array([", *rows, "])",
        "FLOOR = np.array([", *floors, "])",
        "",
        "",
        "def corrected(covariance):",
        '    """36 numbers of a corrected covariance."""',
        "    return FACTOR * np.asarray(covariance) + FLOOR",
        "",
        "",
        "def relay(message):",
        '    """For robot_localization, which takes covariances from messages: publish this one in its place."""',
        "    message.pose.covariance = corrected(message.pose.covariance)",
        "    return message",
        "",
    ])  # fmt: skip


def gtsam(found: Correction, d: Array, floor: Array) -> str:
    """A function of a noise model."""
    kind, order = "Pose2", [0, 1, 5]
    if any(axis in ("z", "roll", "pitch", "yaw") for axis in found.axes):
        kind, order = "Pose3", [3, 4, 5, 0, 1, 2]  # the rotation first
    names = ", ".join(AXES[i] for i in order)
    return f'''"""GTSAM: noise of a pose by a corrected covariance.

{_head(found)}
"""

import gtsam
import numpy as np

# {names}: the order of gtsam.{kind}
D = np.diag([{_numbers(d[order])}])
FLOOR = np.diag([{_numbers(floor[order])}])


def noise(P: np.ndarray) -> gtsam.noiseModel.Gaussian:
    """Noise model of a stated covariance P in this order, as of gtsam.PriorFactor{kind}."""
    return gtsam.noiseModel.Gaussian.Covariance(D @ P @ D + FLOOR)
'''


def _numbers(values: Iterable[float]) -> str:
    return ", ".join(f"{value:.17g}" for value in values)
