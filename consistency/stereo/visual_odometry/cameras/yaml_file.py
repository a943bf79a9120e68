"""YAML files of cameras: plain ones (EuRoC), and those of OpenCV's FileStorage, which are not quite YAML."""

from __future__ import annotations

import re
from dataclasses import dataclass
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


@dataclass(frozen=True)
class YamlKeys:
    """Keys of a YAML file, or of a table in it; errors name file and key.

    Values are numbers, text, lists, tables and, of FileStorage, arrays.
    """

    path: Path
    values: dict[str, Any]
    outer: str = ""  # names of the tables around these keys, each with a point behind it

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def table(self, key: str) -> YamlKeys:
        """The keys below a key."""
        value = self.values.get(key)
        if not isinstance(value, dict):
            raise InputError(f"{self.path}: key '{self.outer}{key}' is missing, or holds no keys of its own")
        return YamlKeys(self.path, value, f"{self.outer}{key}.")

    def matrix(self, key: str) -> Array:
        """Numbers of a key: a number, a list, an array, or a table with rows, cols and data."""
        value = self.values.get(key)
        where = f"{self.path}: key '{self.outer}{key}'"
        try:
            if isinstance(value, dict):
                shape = int(value["rows"]), int(value["cols"])
                numbers = _floats(value["data"]).reshape(shape)
            else:
                numbers = _floats(value)
        except (KeyError, TypeError, ValueError, OverflowError):
            raise InputError(f"{where}: must be numbers, or a matrix with rows, cols and data") from None
        if not (np.abs(numbers) < HUGE).all():
            raise InputError(f"{where}: holds a number that is not finite")
        return numbers

    def numbers(self, key: str, count: int) -> Array:
        """The ``count`` numbers of a key, (count,)."""
        numbers = self.matrix(key).ravel()
        if numbers.size != count:
            raise InputError(f"{self.path}: key '{self.outer}{key}': has {numbers.size} numbers, not {count}")
        return numbers

    def number(self, key: str) -> float:
        """The only number of a key."""
        return float(self.numbers(key, 1)[0])


def _floats(value: Any) -> Array:
    return np.asarray(value, dtype=object).ravel().astype(float)


def read_yaml(path: Path) -> YamlKeys:
    """The keys of a YAML file, by OpenCV where FileStorage has written it.

    Raises
    ------
    InputError
        PyYAML or OpenCV is not installed, or the file is not YAML with keys.
    """
    text = read_text(path, UNREADABLE, LARGEST)
    with reading(path, UNREADABLE):
        _require_shallow(text)
    parse = _plain
    if text.startswith(SIGNATURE):
        parse = _stored
    data = parse(path, text)
    if not isinstance(data, dict):
        raise InputError(f"{path}: holds no 'key: value' lines")
    return YamlKeys(path, {str(key): value for key, value in data.items()})


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
    if node.isString():
        return node.string()
    return None
