"""YAML files of cameras: plain ones (EuRoC), and those of OpenCV's FileStorage, which are not quite YAML."""

from __future__ import annotations

import re
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.extras import MissingPackageError, remedy
from consistency.referee.parsing import HUGE, read_text, reading
from consistency.referee.types import Array
from consistency.stereo.visual_odometry.cameras.input_errors import opencv

UNREADABLE = "cannot be read as YAML"
LARGEST = 2**20  # bytes of a calibration
DEEPEST = 100  # brackets in brackets
_STACKED = re.compile(rf"(?:[-?:] ){{{DEEPEST}}}")  # lists in lists on one line
SIGNATURE = "%YAML"  # how a file of FileStorage begins: %YAML:1.0 up to OpenCV 4, %YAML 1.2 since
MATRIX = {"rows", "cols", "dt", "data"}  # keys of a matrix in it


def read_yaml(path: Path) -> dict[str, Any]:
    """The keys of a YAML file, by OpenCV where FileStorage has written it.

    Values are numbers, text, lists, tables and, of FileStorage, arrays.

    Raises
    ------
    InputError
        PyYAML or OpenCV is not installed, or the file is not YAML with keys.
    """
    text = read_text(path, UNREADABLE, LARGEST)
    with reading(path, UNREADABLE):
        _require_shallow(text)
    data = _stored(path, text) if text.startswith(SIGNATURE) else _plain(path, text)
    if not isinstance(data, dict):
        raise InputError(f"{path}: holds no 'key: value' lines")
    return {str(key): value for key, value in data.items()}


def _require_shallow(text: str) -> None:
    """Refuse what parsers would be slow at, or call themselves too often for."""
    depth = max(accumulate((char in "[{") - (char in "]}") for char in text), default=0)
    if depth > DEEPEST or _STACKED.search(text):
        raise RecursionError


def _plain(path: Path, text: str) -> Any:
    try:
        import yaml
    except ImportError:
        raise MissingPackageError(f"{path}: YAML needs {remedy('vision', package='pyyaml')}") from None
    with reading(path, UNREADABLE):
        if any(isinstance(token, yaml.AliasToken) for token in yaml.scan(text)):
            raise ValueError("aliases (*name) are not followed; write their values")  # a few lines hold 10^9 of them
        return yaml.load(text, Loader=_once(yaml))


def _once(yaml: Any) -> Any:
    """PyYAML's safe loader, which refuses a key that is duplicated."""

    class Once(yaml.SafeLoader):  # type: ignore[misc]
        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            keys = [self.construct_object(key, deep=True) for key, _ in node.value]
            if twice := [key for key in keys if keys.count(key) > 1]:
                raise ValueError(f"key '{twice[0]}' is duplicated")
            return super().construct_mapping(node, deep)

    return Once


def _stored(path: Path, text: str) -> Any:
    cv2 = opencv()
    with reading(path, UNREADABLE):
        try:
            # the text and not the path, which OpenCV cannot open on Windows where it is not ASCII
            storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
            return _value(cv2, storage.root())
        except SystemError as error:  # from the constructor, with OpenCV's as its cause
            raise error.__cause__ or error from None


def _value(cv2: Any, node: Any) -> Any:
    """Numbers, text, list, dict or array of a node; None for an empty node."""
    if node.isMap():
        if set(node.keys()) >= MATRIX:
            try:
                return node.mat()
            except cv2.error:
                return {}  # a table without numbers, which is refused when they are asked for
        return {key: _value(cv2, node.getNode(key)) for key in node.keys()}  # noqa: SIM118, no dict
    if node.isSeq():
        return [_value(cv2, node.at(i)) for i in range(node.size())]
    if node.isInt() or node.isReal():
        return node.real()
    return node.string() if node.isString() else None


def read_matrix(path: Path, key: str, value: Any) -> Array:
    """Numbers of one key: a number, a list, an array, or a table with rows, cols and data."""
    shape: tuple[int, ...] | None = None
    try:
        if isinstance(value, dict):
            shape = (int(value["rows"]), int(value["cols"]))
            value = value["data"]
        numbers = np.asarray(value, dtype=object).ravel().astype(float)
        numbers = numbers if shape is None else numbers.reshape(shape)
    except (KeyError, TypeError, ValueError, OverflowError):
        raise InputError(f"{path}: key '{key}': must be numbers, or a matrix with rows, cols and data") from None
    if not (np.abs(numbers) < HUGE).all():
        raise InputError(f"{path}: key '{key}': holds a number that is not finite")
    return np.asarray(numbers)
