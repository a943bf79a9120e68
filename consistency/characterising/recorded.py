"""A log folder to a characterisation: what can be estimated depends on what of the truth is there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from consistency.characterising.characterise import Characterisation, characterise
from consistency.characterising.residuals import residuals_of
from consistency.errors import InputError
from consistency.scenario import PicturedSensor, read_table
from consistency.store.log import SensorFile, read_log


OTHERS = ("motion", "start", "sigma_points")  # tables that a measured sensor keeps from the log


@dataclass(frozen=True)
class Measured:
    """A characterisation and what of the source's file stays as it was."""

    of: Characterisation
    others: Mapping[str, Any]  # tables of sensor.toml beside the sensor itself


def is_log(folder: Path) -> bool:
    """Whether a folder is a recorded log, and not one of images."""
    return (folder / "observations.parquet").exists() or (folder / "controls.parquet").exists()


def characterise_log(folder: Path, grid: tuple[int, int]) -> Measured:
    """The sensor of a log folder.

    Raises
    ------
    InputError
        As :func:`consistency.store.log.read_log`; the sensor measures no disparity; there is no truth to tell from.
    """
    log = read_log(folder)
    file = read_table(folder / "sensor.toml", SensorFile)
    if file.model != "uvd":
        raise InputError(f"{folder}/sensor.toml: key 'model' is '{file.model}'; only a sensor 'uvd' is characterised")
    sensor = PicturedSensor.model_validate(file.model_dump(include=set(PicturedSensor.model_fields)))
    dumped = file.model_dump(exclude_none=True)
    others: dict[str, Any] = {key: value for key, value in dumped.items() if key in OTHERS}
    first = log.trials[0]
    if first.truth is None or first.landmarks is None:
        raise InputError(f"{folder}: no truth")
    data, strange = residuals_of(log.trials, sensor)
    return Measured(characterise(data, sensor, str(folder), strange, grid), others)
