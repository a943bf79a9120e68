"""YAML files of cameras: plain ones (EuRoC), and those of OpenCV's FileStorage, which are not quite YAML."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from consistency.errors import InputError
from consistency.types import Array


def read_yaml(path: Path) -> dict[str, Any]:
    """The keys of a YAML file.

    The first line ``%YAML:1.0`` of OpenCV is not YAML and left out; matrices (``!!opencv-matrix``) are tables.

    Raises
    ------
    InputError
        PyYAML is not installed, or the file is not YAML with keys.
    """
    try:
        yaml: Any = importlib.import_module("yaml")
    except ImportError:
        raise InputError(f"{path}: YAML needs PyYAML: pip install 'filter-consistency[vision]'") from None
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        text = "\n".join("" if line.startswith("%YAML") else line for line in lines)
        data = yaml.safe_load(text.replace("!!opencv-matrix", ""))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        first = " ".join(str(error).split())
        raise InputError(f"{path}: cannot be read as YAML ({first})") from None
    if not isinstance(data, dict):
        raise InputError(f"{path}: holds no 'key: value' lines")
    return {str(key): value for key, value in data.items()}


def matrix(path: Path, key: str, value: Any) -> Array:
    """Numbers of one key: a number, a list, or a table with rows, cols and data."""
    shape: tuple[int, ...] | None = None
    try:
        if isinstance(value, dict):
            shape = (int(value["rows"]), int(value["cols"]))
            value = value["data"]
        numbers = np.asarray(value, dtype=object).ravel().astype(float)
        numbers = numbers if shape is None else numbers.reshape(shape)
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{path}: key '{key}': must be numbers, or a matrix with rows, cols and data") from None
    if not np.isfinite(numbers).all():
        raise InputError(f"{path}: key '{key}': holds a number that is not finite")
    return np.asarray(numbers)
