"""What a fit leaves as a folder.

A model or a correction has a file in TOML, files of data, lines for other programs, and a page with pictures.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from consistency.referee.diagnostics.groups import Groups
from consistency.referee.diagnostics.record import Record
from consistency.referee.fit_covariance.correct import (
    ByGroup,
    Correction,
    by_group,
    correction_document,
    correction_sentence,
    data_of_correction,
    with_factors,
)
from consistency.referee.fit_covariance.correct_bounds import HEAD as HEAD_OF_BOUNDS
from consistency.referee.fit_covariance.correct_bounds import (
    BoundCorrection,
    bound_correction_document,
    data_of_bounds,
)
from consistency.referee.fit_covariance.covariance_ratios import write_motions
from consistency.referee.fit_covariance.drives import PIECES, ways
from consistency.referee.fit_covariance.factors import stated_errors
from consistency.referee.fit_covariance.noise_model import NoiseModel, correction, data_of_model, noise_document
from consistency.referee.fit_covariance.pictures import draw_correction, draw_noise
from consistency.referee.pages.write_pages import note_sentence
from consistency.referee.readers.formats.file_kinds import CORRECTED, HELD_OUT
from consistency.referee.readers.formats.restated import Factors, TextFile
from consistency.referee.readers.formats.sheet import EMPTY
from consistency.referee.show import as_html, as_json
from consistency.referee.show.blocks import Chapter, Document, Figure, Status, Text
from consistency.referee.system import manifest_of, write_folder
from consistency.referee.types import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

PLACES = {3: (0, 1, 5), 6: (0, 1, 2, 3, 4, 5)}  # of the axes in messages of ROS: x, y, z, roll, pitch, yaw
HEAD = """\
Cov Log(D^-1 M) = factor * (sum over steps of A diag(variance_per_m |way| + variance_per_rad |turn|) A'
+ diag(floor)); D is the estimated motion after the correction of [mean], M the true one, and A
carries a step's error to the end of the motion. Shown for motions over the span, and for no others."""


def write_fit(
    folder: Path,
    kind_and_source: tuple[str, str],
    texts: dict[str, str],
    page: Document,
    data: Callable[[Path], Sequence[str]],
    overwrite: bool = False,
) -> list[Path]:
    """Write what a fit leaves, as a folder that appears whole or not at all; its files.

    Pictures need ``[plot]``; without it the page has none.

    Parameters
    ----------
    texts : files by name, the model first
    page : what is shown, and as data
    data : writes files of data into a folder, and returns their names

    Raises
    ------
    InputError
        The folder exists or cannot be written.
    """
    kind, source = kind_and_source
    texts = texts | {"verdict.json": as_json.render(page) + "\n", "report.html": as_html.render(page)}
    names: list[str] = []

    def contents(at: Path) -> None:
        names.extend(data(at))
        for name, text in texts.items():
            (at / name).write_text(text, encoding="utf-8")

    write_folder(folder, manifest_of(kind=kind, source=source), contents, overwrite)
    first, *rest = texts
    return [folder / name for name in (first, *names, *rest)]


def toml(comment: str, values: Mapping[str, Any]) -> str:
    """Plain data as TOML below lines of comment; what the referee says is left out, as it is in verdict.json."""
    lines = [f"# {line}" for line in comment.splitlines()]
    known = {key: value for key, value in values.items() if key != "referee"}
    return "\n".join([*lines, *_lines(known)]) + "\n"


def _lines(values: Mapping[str, Any], above: str = "") -> list[str]:
    """Numbers and words, then tables and arrays of tables; a value of None is left out."""
    lines, tables = [], []
    for key, value in values.items():
        if isinstance(value, Mapping):
            tables += ["", f"[{above}{key}]", *_lines(value, f"{above}{key}.")]
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            for each in value:
                tables += ["", f"[[{above}{key}]]", *_lines(each, f"{above}{key}.")]
        elif value is not None:
            lines.append(f"{key} = {_text(value)}")
    return lines + tables


def _text(value: Any) -> str:
    """A number, a word or a list of these, of which None is a number that is not known."""
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_text, value))}]"
    return "nan" if value is None else json.dumps(value, ensure_ascii=False)


def write_model(model: NoiseModel, folder: Path, overwrite: bool = False) -> list[Path]:
    """Write the folder of a noise model; its files."""
    motions = partial(write_motions, model.stretches)
    return write_fit(folder, ("noise", model.name), snippets(model), noise_page(model), motions, overwrite)


def robot_localization(model: NoiseModel) -> str:
    """A function of the covariance of a twist message, whose integration has the covariance of the model."""
    noise = model.noise
    places = PLACES[len(noise.axes)]
    at_rest = noise.floor / seconds(model)
    numbers = noise.factor * np.column_stack([noise.per_m, noise.per_rad, at_rest])
    rows = []
    for axis, place, (per_m, per_rad, rest) in zip(noise.axes, places, numbers.tolist(), strict=True):
        variance = f"{per_m:.17g} * abs(v) + {per_rad:.17g} * abs(w) + {rest:.17g}"
        rows.append(f"    covariance[{7 * place}] = ({variance}) / dt  # {axis}")
    if len(places) < 6:
        rows.append("    # z, roll, pitch: set two_d_mode")
    assignments = "\n".join(rows)
    return f'''"""robot_localization: fuse the twist of the odometry, not its pose. {_origin(model)}

In differential mode two poses are turned into a twist with the sum of their covariances, which is not that
of a motion; a twist is integrated as it is. Set odom0_config to the velocities alone.
"""


def twist_covariance(v: float, w: float, dt: float) -> list[float]:
    """36 numbers of a TwistWithCovariance: v in m/s, w in rad/s, dt in s since the message before."""
    covariance = [0.0] * 36
{assignments}
    return covariance
'''


def seconds(model: NoiseModel) -> float:
    """Median time that a motion over the span takes, s, over which the floor is spread; 1 without a clock."""
    windows = model.windows
    took = []
    for i, first, last in zip(windows.drive, windows.first, windows.last, strict=True):
        took.append(np.ptp(windows.drives[i].t[[first, last]]))
    median = float(np.median(took))
    return median if np.isfinite(median) and median > 0 else 1.0


def gtsam(model: NoiseModel) -> str:
    """A function of the noise model of a BetweenFactor."""
    noise = model.noise
    n = len(noise.axes)
    # Pose3 has the rotation first, Pose2 the position
    order, turn, kind = [0, 1, 2], "[2:]", "Pose2"
    if n == 6:
        order, turn, kind = [3, 4, 5, 0, 1, 2], "[:3]", "Pose3"
    return f'''"""GTSAM: noise of a BetweenFactor{kind}. {_origin(model)}"""

import gtsam
import numpy as np

# {", ".join(noise.axes[i] for i in order)}: the order of gtsam.{kind}
PER_M = np.array([{_numbers(noise.factor * noise.per_m[order])}])
PER_RAD = np.array([{_numbers(noise.factor * noise.per_rad[order])}])
FLOOR = np.array([{_numbers(noise.factor * noise.floor[order])}])
PIECES = {PIECES}


def covariance(delta: gtsam.{kind}) -> np.ndarray:
    """Of the error Log(delta^-1 true) of a corrected motion over the span, taken as even."""
    xi = gtsam.{kind}.Logmap(delta) / PIECES
    way, turn = np.linalg.norm(np.asarray(gtsam.{kind}.Expmap(xi).translation())), np.linalg.norm(xi{turn})
    Q, S = np.diag(PER_M * way + PER_RAD * turn), np.zeros(({n}, {n}))
    for k in range(PIECES + 1):
        A = gtsam.{kind}.Expmap(-k * xi).AdjointMap()
        S += (0.5 if k in (0, PIECES) else 1.0) * A @ Q @ A.T
    return S + np.diag(FLOOR)


def noise(delta: gtsam.{kind}) -> gtsam.noiseModel.Gaussian:
    """Noise model of gtsam.BetweenFactor{kind}(i, j, delta, noise(delta))."""
    return gtsam.noiseModel.Gaussian.Covariance(covariance(delta))
'''


def ceres(model: NoiseModel) -> str:
    """A header with the square root of the information of a straight motion over the span."""
    root = np.linalg.cholesky(np.linalg.inv(straight(model))).T
    rows = ",\n".join(f"    {_numbers(row)}" for row in root)
    return f"""// Ceres: residual = kSqrtInformation * Log(D^-1 M), with {", ".join(model.noise.axes)} in this order.
// {_origin(model)}
// Of a straight motion over the span; for others take the inverse square root of the covariance in motions.csv.
#pragma once

constexpr int kErrorSize = {len(root)};
constexpr double kSqrtInformation[{root.size}] = {{
{rows}}};
"""


def straight(model: NoiseModel) -> Array:
    """Covariance (n, n) of a straight motion as long as the median one of the windows."""
    corrected = model.noise.mean.corrected(model.windows.pieces)
    way = float(np.median(ways(corrected).sum(axis=1)))
    if model.windows.d == 2:
        return model.covariance([way, 0.0, 0.0])
    return model.covariance([way, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


def _origin(model: NoiseModel) -> str:
    """Span and correction, for the head of a file."""
    return f"Shown for motions over {model.span} alone; {correction(model) or 'nothing is corrected'}."


def _numbers(values: Array) -> str:
    return ", ".join(f"{value:.17g}" for value in values)


def snippets(model: NoiseModel) -> dict[str, str]:
    """Files of the model for other programs, by name."""
    return {
        "noise.toml": toml(HEAD, data_of_model(model)),
        "robot_localization_noise.py": robot_localization(model),
        "gtsam_noise.py": gtsam(model),
        "ceres_noise.h": ceres(model),
    }


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
    if found.assumed:
        head += " P is I, as none is stated."
    texts = {"correction.toml": toml(head, data_of_correction(found)), "corrected_covariance.py": pasted(found)}
    return write_fit(folder, ("correction", found.name), texts, correction_page(found), write, overwrite)


def write_bound_correction(
    found: BoundCorrection, groups: Groups | None, files: Sequence[TextFile], folder: Path, overwrite: bool = False
) -> list[Path]:
    """Write the factors of bounds, the tables that state them by these factors, and a page; its files.

    Parameters
    ----------
    groups : of the record, by whose factors lines are written
    files : tables of the bounds; without any no table is written
    """
    texts = {"correction.toml": toml(f"{found.status} after: {HEAD_OF_BOUNDS}", data_of_bounds(found))}
    kind = "bound-correction", found.name
    if groups is not None and not all(file.by_column is not None for file in files):
        files = ()
    write = partial(_write_bounds, found, groups, files)
    return write_fit(folder, kind, texts, bound_correction_document(found), write, overwrite)


def _write_bounds(found: BoundCorrection, groups: Groups | None, files: Sequence[TextFile], folder: Path) -> list[str]:
    """Write held-out/ and corrected/, as :func:`_write_runs`, of tables; the names of what ``analyse`` reads."""
    own: dict[int, dict[tuple[str, str], float]] = {}  # factors by bound and group, of each judged run
    for number, label in zip(found.numbers, found.judged, strict=True):
        row = found.fitted.index(label) if label in found.fitted else None
        own[number] = {
            (one.bound.name, one.group): one.factor if row is None else float(one.left_out[row])
            for one in found.factors
        }
    of_all = {(one.bound.name, one.group): one.factor for one in found.factors}

    def change(of_runs: Mapping[int, dict[tuple[str, str], float]] | None, run: int, value: str) -> Factors | None:
        if of_runs is not None and run not in of_runs:
            return None
        place = place_in(groups, value)
        group = "" if groups is None or place < 0 else groups.names[place]
        factors = of_all if of_runs is None else of_runs[run]
        return {bound: (factor**2, 0.0) for (bound, of), factor in factors.items() if of == group}

    made = []
    for name, of_runs in ((HELD_OUT, own), (CORRECTED, None)):
        are_known = len(files) > 1 or any(file.run_column is not None for file in files)
        if not files or (of_runs is not None and not (are_known and found.after.unit == "run")):
            continue  # pieces and rows of one log are not told in its file
        (folder / name).mkdir()
        _restate(folder / name, files, of_runs, partial(change, of_runs))
        made.append(f"{name}/{files[0].path.name}" if len(files) == 1 else name)
    return made


def _write_runs(found: Correction, record: Record, files: Sequence[TextFile], folder: Path) -> list[str]:
    """Write held-out/, each judged run by the factors of others, and corrected/, all runs by the factors of all.

    Returns the names of what ``analyse`` reads: a file, or a folder of trajectories.
    """
    held_out = dict(zip(found.before.record.run_numbers.tolist(), found.used, strict=True))
    groups = record.groups
    is_text = bool(files) and (groups is None or all(file.by_column is not None for file in files))
    runs = record.run_numbers.tolist()
    are_known = len(files) == len(runs) or any(file.run_column is not None for file in files)
    are_runs = record.runs.unit == "run" and are_known  # pieces and rows of one log are not told in its file
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
    change = partial(_change, found.axes, record.groups, of_runs, found.assumed)
    _restate(folder, files, of_runs, change)
    made = [path.name for path in folder.iterdir()]
    return f"{folder.name}/{made[0]}" if len(made) == 1 else folder.name


def _restate(
    folder: Path, files: Sequence[TextFile], of_runs: Mapping[int, object] | None, change: Callable[..., Factors | None]
) -> None:
    """Write files with their statements changed: with ``of_runs`` those of these runs, or that tell runs apart."""
    for file in files:
        if of_runs is None or file.run_column is not None or file.run in of_runs:
            (folder / file.path.name).write_text(file.restated(change), encoding="utf-8")


def _change(
    axes: Sequence[str], groups: Groups | None, of_runs: dict[int, ByGroup], assumed: bool, run: int, value: str
) -> dict[str, tuple[float, float]] | None:
    """Factor and floor of each component of a run by name, at a value of its column; None of a run that is left out.

    Of a covariance that was ``assumed`` to be I they are 0 and its variance, whatever stands in the file.
    """
    if run not in of_runs:
        return None
    factors = of_runs[run][place_in(groups, value)].by_name(axes)
    return {axis: (0.0, factor) for axis, (factor, _) in factors.items()} if assumed else factors


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
    axes = np.array(list(record.errors.axes) or [f"axis {i}" for i in range(record.errors.dof)])
    np.savez(
        path,
        errors=error,
        covariances=np.where(counted[..., None, None], P, np.eye(record.errors.dof)),
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


def page_of(
    said: Document,
    title: str,
    caption: str,
    draw: Callable[[], Drawing],
) -> Document:
    """A document with its picture; its first sentence is the answer at the top of the page."""
    sentence, *further = said.opening
    assert isinstance(sentence, Text)
    opening = tuple(Text(note_sentence(block.text)) if isinstance(block, Text) else block for block in further)
    picture = Figure(title, caption, (draw,))
    return replace(said, answer=sentence.text, opening=opening, chapters=(Chapter("", "", "", (picture,)),))


# --- noise models -----------------------------------------------------------------------------------------------------


def noise_page(model: NoiseModel) -> Document:
    """What the model says, and its picture."""
    caption = (
        "Errors of corrected motions in x and y, in the body's frame at their end, with the ellipse that holds "
        "95 % of them where the covariance is right (the mean of all windows). Below: mean squared error of each axis "
        "over the span (markers) beside the model, which is fitted at the shortest span alone (lines); and the ratio "
        "of true to stated covariance of each judged drive."
    )
    return page_of(noise_document(model), "Errors of motions, growth and ratios", caption, partial(draw_noise, model))


# --- corrections ------------------------------------------------------------------------------------------------------


def correction_page(found: Correction) -> Document:
    """What a correction says, and its pictures."""
    caption = (
        "Ratio of true to stated covariance of each held-out run, as stated and corrected; the factor of each block "
        "with its interval; and the share of held-out errors inside the ellipsoid of each probability."
    )
    title = "Held-out runs, factors and coverage"
    page = page_of(correction_document(found), title, caption, partial(draw_correction, found))
    after = Status(found.status, " after")
    return replace(page, badges=(after,) if found.assumed else (Status(found.before.verdict.status, " before"), after))
