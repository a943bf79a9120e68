"""Recorded logs: a folder of controls, observations, what the filter believes, and the truth where known."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv as pa_csv

from consistency.bench.scenario import (
    Belief,
    BelievedMotion,
    BelievedSensor,
    Finite,
    GuardSettings,
    PicturedSensor,
    SigmaPoints,
    Table,
    read_table,
    toml_text,
)
from consistency.bench.scenario.toml_tables import SIGMA_UNITS
from consistency.bench.store.parquet import (
    check_column,
    column_kinds,
    controls_table,
    observations_table,
    read_parquet,
    require_table,
    stacked_table,
    truth_columns,
    write_tables,
    write_texts,
)
from consistency.bench.types import Trial
from consistency.referee.column_names import COLUMNS, POSE
from consistency.referee.errors import InputError
from consistency.referee.parsing import is_file, reading, require_room
from consistency.referee.types import Array, Indices

FORMATS = ("parquet", "csv")
DAMAGED = "cannot be read as CSV; needs a header, and in each row as many numbers, with commas between them"


def require_format(form: str) -> None:
    """Refuse a form of tables that is none of ``FORMATS``."""
    if form not in FORMATS:
        raise InputError(f"--format {form}: must be {' or '.join(FORMATS)}")


def table_file(folder: Path, name: str) -> Path:
    """Where a table of a log is, or would be: NAME.parquet, or NAME.csv where that is there.

    Raises
    ------
    InputError
        Both are there.
    """
    paths = [folder / f"{name}.{form}" for form in FORMATS]
    existing = [path for path in paths if path.exists()]
    if len(existing) > 1:
        raise InputError(f"{folder}: holds {existing[0].name} and {existing[1].name}; take one of them away")
    return existing[0] if existing else paths[0]


def read_table_file(folder: Path, name: str, also: Sequence[str] = ()) -> pd.DataFrame:
    """One table of numbers, checked: its columns and those in ``also``, types, no NaN where none is allowed.

    Raises
    ------
    InputError
        The file is missing, damaged, lacks a column or holds what the column may not.
    """
    path = table_file(folder, name)
    if path.suffix == ".parquet":
        require_table(folder, name, also)
        return read_parquet(folder, name)
    if not is_file(path):
        raise InputError(f"{path}: is not a file")
    with reading(path, DAMAGED), path.open(encoding="utf-8-sig") as file:
        column_names = [name.strip('"') for name in file.readline(2**16).strip().split(",")]
    needed_columns = dict.fromkeys((*COLUMNS[name], *also))
    if missing_columns := [column for column in needed_columns if column not in column_names]:
        raise InputError(f"{path}: column '{missing_columns[0]}' is missing; needed: {', '.join(needed_columns)}")
    if repeated_columns := [column for column in column_names if column_names.count(column) > 1]:
        raise InputError(f"{path}: column '{repeated_columns[0]}' is duplicated")
    column_types = column_kinds(name, column_names)
    with reading(path, DAMAGED):
        numbers = dict.fromkeys(column_types, pa.float64())
        convert = pa_csv.ConvertOptions(include_columns=list(column_types), column_types=numbers)
        csv_table = pa_csv.read_csv(path, convert_options=convert)
        require_room(path, csv_table.nbytes)
        table: pd.DataFrame = csv_table.to_pandas()
    for column, kind in column_types.items():
        check_column(path, table[column], kind)
    return table.astype(column_types)


STRAY = 0.05  # share of pixels that gross errors may put outside the image; other units put more there
View = tuple[tuple[int, int], tuple[float, float]]  # image (width, height) and principal point (column, row), px


class Start(Table):
    """Pose at step 0, known exactly."""

    x: Finite
    y: Finite
    heading: Finite


class SensorFile(PicturedSensor):
    """``sensor.toml``: the sensor, its mount and noise, and the noise of the odometry, as believed."""

    motion: BelievedMotion | None = None  # a log needs it; what is measured of a camera alone has none
    start: Start | None = None
    sigma_points: SigmaPoints = SigmaPoints()
    guard: GuardSettings | None = None


@dataclass(frozen=True)
class Log:
    """A log folder in memory."""

    name: str
    trials: list[Trial]
    belief: Belief
    landmarks: pd.DataFrame | None
    sha256: dict[str, str] = field(default_factory=dict)  # of the files, for the manifest of what is made of them
    screening: dict[str, Any] | None = None  # gate and counts, where landmarks restart off the common motion


def read_log(folder: str | Path) -> Log:
    """Read a log folder.

    ``controls``, ``observations`` (.parquet or .csv) and ``sensor.toml`` are needed, ``truth`` and ``landmarks``
    (likewise) are optional. A folder of ``consistency simulate`` is a log.

    Raises
    ------
    InputError
        A file is missing, damaged, or holds what a filter cannot use; names file, column and row.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"--log {folder}: no such folder")
    path = folder / "sensor.toml"
    if not path.is_file():
        raise InputError(
            f"{path}: missing; 'consistency frontend' makes a log of images, 'consistency simulate' one of a scenario"
        )
    sensor = read_table(path, SensorFile)
    if sensor.motion is None:
        raise InputError(f"{path}: key 'motion': missing; give sigma_v and sigma_omega of the odometry")
    belief = Belief(motion=sensor.motion, sensor=sensor.belief(), sigma_points=sensor.sigma_points, guard=sensor.guard)
    controls, observations = read_table_file(folder, "controls"), _observations(folder, sensor)
    truth, landmarks = _optional_table(folder, "truth"), _optional_table(folder, "landmarks")
    _check(folder, controls, observations, belief)
    _check_pixels(folder, observations, sensor)
    start_pose = np.array([sensor.start.x, sensor.start.y, sensor.start.heading]) if sensor.start else None
    names = _names(folder, observations, landmarks)
    positions = _positions(folder, landmarks, names, belief)
    of_controls, of_observations = _by_run(controls), _by_run(observations)
    of_truth = None if truth is None else _by_run(truth)
    trials = []
    for run in sorted({int(run) for run in controls["run"]}):
        path_of_run = None if of_truth is None else of_truth(run)
        rows = of_controls(run), of_observations(run)
        trials.append(_trial(folder, run, *rows, names, path_of_run, start_pose, positions))
    csv_files = [file for file in folder.glob("*.csv") if file.stem in COLUMNS]
    files = [path, *sorted([*folder.glob("*.parquet"), *csv_files])]
    with reading(folder):
        digests = {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in files}
    return Log(str(folder), trials, belief, landmarks, digests)


def write_log(
    folder: Path,
    trials: list[Trial],
    belief: Belief,
    landmarks: pd.DataFrame | None,
    manifest: dict[str, object],
    overwrite: bool = False,
    view: View | None = None,
    files: Mapping[str, str] = MappingProxyType({}),
    form: str = "parquet",
) -> None:
    """Write trials as a log folder, whole or not at all.

    ``view`` is image size and principal point in px, ``files`` are other texts by name, ``form`` is one of ``FORMATS``.

    Raises
    ------
    InputError
        Another ``form``; the folder is there already or cannot be written.
    """
    require_format(form)
    tables = {"controls": controls_table(trials), "observations": observations_table(trials)}
    if trials[0].truth is not None:
        parts = [("", truth_columns(t, t.truth)) for t in trials if t.truth is not None]
        tables["truth"] = stacked_table("truth", parts)
    if landmarks is not None:
        tables["landmarks"] = landmarks
    texts = {"sensor.toml": _sensor_file(belief, trials[0].start, view), **files}

    def contents(at: Path) -> None:
        write_texts(at, texts)
        if form == "csv":
            for name, table in tables.items():
                table.to_csv(at / f"{name}.csv", index=False)

    write_tables(folder, tables if form == "parquet" else {}, manifest, contents, overwrite)


def sensor_text(folder: Path, belief: Belief) -> str:
    """``sensor.toml`` of a log folder as text, with the noises of ``belief`` in the place of its own.

    Raises
    ------
    InputError
        The file is missing or damaged.
    """
    sensor = read_table(folder / "sensor.toml", SensorFile)
    changed = sensor.model_copy(update={"motion": belief.motion, "sigma": belief.sensor.sigma})
    return toml_text(changed.model_dump(mode="json", exclude_none=True))


def sensor_keys(sensor: BelievedSensor) -> dict[str, Any]:
    """Keys of ``sensor.toml`` that say what a sensor is believed to be."""
    keys = sensor.model_dump(mode="json", exclude_none=True)
    return {"model": keys.pop("model"), f"sigma{SIGMA_UNITS[sensor.model]}": keys.pop("sigma"), **keys}


def _sensor_file(belief: Belief, start: Array, view: View | None) -> str:
    keys = sensor_keys(belief.sensor)
    if view is not None:
        keys |= {"image": view[0], "principal_point": view[1]}
    keys |= {"motion": belief.motion.model_dump(), "start": dict(zip(POSE, map(float, start), strict=True))}
    keys["sigma_points"] = belief.sigma_points.model_dump()
    if belief.guard is not None:
        keys["guard"] = belief.guard.model_dump(exclude_none=True)
    return toml_text(keys)


def _optional_table(folder: Path, name: str) -> pd.DataFrame | None:
    return read_table_file(folder, name) if table_file(folder, name).exists() else None


def _observations(folder: Path, sensor: SensorFile) -> pd.DataFrame:
    """``observations.parquet`` with as many values in a row as the sensor measures."""
    values = [f"z{i}" for i in range(sensor.size)]
    table = read_table_file(folder, "observations", values[2:])
    return table if sensor.size == 3 else table.drop(columns="z2", errors="ignore")


def _check(folder: Path, controls: pd.DataFrame, observations: pd.DataFrame, belief: Belief) -> None:
    path = table_file(folder, "controls")
    if controls.empty:
        raise InputError(f"{path}: holds no control; at least one step is needed")
    for run, part in controls.groupby("run"):
        if not np.array_equal(np.sort(part["step"]), np.arange(1, len(part) + 1)):
            raise InputError(f"{path}: column 'step' of run {run} must count 1, 2, … without gap or repetition")
    _refuse(path, controls["dt"] <= 0, "column 'dt', row {}: must be positive")
    path = table_file(folder, "observations")
    if observations.empty:
        raise InputError(f"{path}: holds no observation; no landmark was ever in view")
    repeated = observations.duplicated(["run", "step", "landmark"])
    _refuse(path, repeated, "row {}: this landmark is duplicated in one step")
    control_steps = pd.MultiIndex.from_frame(controls[["run", "step"]])
    without_control = ~pd.MultiIndex.from_frame(observations[["run", "step"]]).isin(control_steps)
    _refuse(path, without_control, f"row {{}}: {table_file(folder, 'controls').name} has no such run and step")
    if belief.sensor.model == "uvd":
        _refuse(path, observations["z2"] <= 0, "column 'z2', row {}: a disparity must be positive")


def _refuse(path: Path, bad: pd.Series[bool] | Array, text: str) -> None:
    """Refuse rows that are ``bad``; ``text`` takes the number of the first."""
    if bad.any():
        raise InputError(f"{path}: {text.format(int(np.flatnonzero(bad)[0]))}")


def _check_pixels(folder: Path, observations: pd.DataFrame, sensor: SensorFile) -> None:
    """Pixels must be relative to the principal point: with it they must fall into the image."""
    if sensor.model != "uvd" or sensor.image is None:
        return
    sides = zip(("z0", "z1"), sensor.centre, sensor.image, sensor.sigma, strict=False)
    for column, principal, image_size, sigma in sides:
        pixel = observations[column].to_numpy() + principal
        outside = (pixel < -6 * sigma) | (pixel > image_size + 6 * sigma)
        if outside.mean() > STRAY:
            row = int(np.flatnonzero(outside)[0])
            pixel_value = observations[column].iloc[row]
            raise InputError(
                f"{table_file(folder, 'observations')}: column '{column}', row {row}: {pixel_value:.1f} px "
                "is outside the image of sensor.toml; u and v must be relative to the principal point"
            )


class _Names(NamedTuple):
    """Numbers in the files: those of landmarks, sorted, and those of things that are not landmarks, sorted."""

    landmarks: Indices
    things: Indices

    def ids(self, numbers: pd.Series[int]) -> Indices:
        """Place (N,) of each of N numbers in the one list and then the other; -1 where it is in neither."""
        return pd.Index(np.concatenate(self)).get_indexer(pd.Index(numbers)).astype(np.int64)


def _names(folder: Path, observations: pd.DataFrame, landmarks: pd.DataFrame | None) -> _Names:
    """Which of the numbers in ``observations.parquet`` are landmarks, by ``source`` and ``landmarks.parquet``."""
    labels = np.unique(observations["landmark"])
    if "source" not in observations:
        return _Names(labels, labels[:0])
    wrong_numbers = (observations["source"] < -1) | (observations["landmark"] < 0)
    _refuse(
        table_file(folder, "observations"), wrong_numbers,
        "row {}: beside a column 'source' landmarks are numbered from 0, and a source is one of them or -1",
    )  # fmt: skip
    sources = np.unique(observations["source"])
    sources = sources[sources >= 0]
    known_landmarks = sources
    if landmarks is not None:
        known_landmarks = np.concatenate([sources, landmarks["landmark"]])
    real = np.union1d(sources, np.intersect1d(labels, known_landmarks))
    return _Names(real, np.setdiff1d(labels, real))


def _positions(folder: Path, landmarks: pd.DataFrame | None, names: _Names, belief: Belief) -> Array | None:
    if belief.sensor.model == "linear" and len(names.things):
        raise InputError(
            f"{table_file(folder, 'observations')}: column 'landmark': {names.things[0]} is not a landmark, and a "
            "linear world needs one that it is linearised about"
        )
    path, labels = table_file(folder, "landmarks"), names.landmarks
    if landmarks is None:
        if belief.sensor.model == "linear":
            raise InputError(f"{path}: missing; a linear world needs the landmarks it is linearised about")
        return None
    known_positions = landmarks.set_index("landmark")[["x", "y", "z"]]
    if known_positions.index.has_duplicates:
        raise InputError(f"{path}: column 'landmark': every landmark may be listed once")
    if missing := sorted(set(labels) - set(known_positions.index)):
        raise InputError(f"{path}: landmark {missing[0]} of observations.parquet is not there")
    return known_positions.loc[list(labels)].to_numpy(float)


def _by_run(table: pd.DataFrame) -> Callable[[int], pd.DataFrame]:
    """The rows of each run, in order of the steps; those of a step as they stand."""
    places = table.groupby("run").indices
    return lambda run: table.iloc[places.get(run, [])].sort_values("step", kind="stable")


def _trial(
    folder: Path,
    run: int,
    controls: pd.DataFrame,
    rows: pd.DataFrame,
    names: _Names,
    truth: pd.DataFrame | None,
    start: Array | None,
    positions: Array | None,
) -> Trial:
    """A trial of its rows of the tables, in order of the steps."""
    steps, true_path = len(controls), None
    if truth is not None:
        if not np.array_equal(truth["step"], np.arange(steps + 1)):
            raise InputError(f"{table_file(folder, 'truth')}: run {run} must have the steps 0 to {steps}, each once")
        true_path = truth[POSE].to_numpy(float)
    if start is None:
        start = np.zeros(3) if true_path is None else true_path[0]
    return Trial(
        run,
        start,
        controls[["dt", "v", "omega"]].to_numpy(float),
        np.searchsorted(rows["step"], np.arange(1, steps + 2)),
        names.ids(rows["landmark"]),
        rows[[name for name in ("z0", "z1", "z2") if name in rows]].to_numpy(float),
        len(names.landmarks) + len(names.things),
        true_path,
        positions,
        names.ids(rows["source"]) if "source" in rows else None,
        np.concatenate(names).astype(np.int64),
    )
