"""Tables of a TOML file as frozen records: units at the end of a key, and complaints that name file, key and remedy."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import ErrorDetails

from consistency.referee.errors import InputError
from consistency.referee.parsing import HUGE, one_line, read_toml, reading

T = TypeVar("T", bound="Table")
# units that a key may carry at its end: by key, and sigma's by the sensor's model
UNITS = {
    **dict.fromkeys(("heading", "sigma_omega", "turn_rate", "rotation"), "_deg"),
    **dict.fromkeys(("f", "image", "principal_point", "disparity"), "_px"),
    **dict.fromkeys(("start", "radius", "length", "width", "corner_radius", "turn_radius", "points"), "_m"),
    **dict.fromkeys(("x", "y", "z", "position", "range", "B", "centre", "rings"), "_m"),
    "dt": "_s",
}
SHOWN = 4  # complaints in a message
LIST_OF_KINDS = "effects"  # a list of tables, each of the kind that its key 'kind' names
SIGMA_UNITS = {"uvd": "_px", "xyz": "_m", "linear": "_m", "relative-xy": "_m", "range-bearing": ""}  # m and rad
Positive = Annotated[float, Field(gt=0, le=HUGE, allow_inf_nan=False, strict=True)]
NonNegative = Annotated[float, Field(ge=0, le=HUGE, allow_inf_nan=False, strict=True)]
Finite = Annotated[float, Field(ge=-HUGE, le=HUGE, allow_inf_nan=False, strict=True)]
Rate = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False, strict=True)]
Count = Annotated[int, Field(gt=0, le=2**31 - 1, strict=True)]
Triple = tuple[Finite, Finite, Finite]
Sigmas = Annotated[tuple[Positive, ...], Field(min_length=2, max_length=3)]
Interval = tuple[Finite, Finite]


def _scaled(value: Any, factor: float) -> Any:
    if isinstance(value, list | tuple):
        return [_scaled(item, factor) for item in value]
    return value * factor if isinstance(value, int | float) and factor != 1.0 else value


class Table(BaseModel):
    """A table of the file: unknown keys are refused, a key may end in its unit (``heading_deg``, ``f_px``…)."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    units: ClassVar[dict[str, str]] = {}  # of this table's own keys, beside UNITS
    not_in_file: ClassVar[frozenset[str]] = frozenset()  # fields that are not key of the file

    @model_validator(mode="before")
    @classmethod
    def _units(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        out: dict[str, Any] = {}
        for key, value in data.items():
            stem, _, unit = key.rpartition("_")
            of_sigma = SIGMA_UNITS.get(str(data.get("model")), f"_{unit}")
            wanted = cls.units.get(stem) or (of_sigma if stem == "sigma" else UNITS.get(stem))
            bare, factor = key, 1.0
            if key not in cls.model_fields and stem in cls.model_fields and f"_{unit}" == wanted:
                bare = stem
                if unit == "deg":
                    factor = np.pi / 180.0
            if bare in out:
                raise ValueError(f"key '{bare}' is given twice, with and without its unit")
            out[bare] = _scaled(value, factor)
        return out

    @classmethod
    def kinds(cls) -> list[type[Table]]:
        """Tables that may stand in the place of this one, told apart by a tag of their own."""
        return []


def read_table(path: Path, model: type[T], **extra: Any) -> T:
    """Read and validate one TOML file, raising :class:`InputError` that names file, key and remedy."""
    data = read_toml(path)
    if taken := sorted(set(data) & set(extra)):
        raise InputError(f"{path}: key '{taken[0]}': not allowed here, it follows from the file's name")
    with reading(path, "holds what cannot be used"):
        try:
            return model.model_validate(data | extra)
        except ValidationError as error:
            raise InputError(f"{path}: {explain(error, model)}") from None


def explain(error: ValueError, model: type[Table]) -> str:
    """Complaints of pydantic in one line: key, what is wrong, what is allowed; unknown keys first."""
    if not isinstance(error, ValidationError):
        return str(error)
    complaints = sorted(error.errors(), key=lambda complaint: complaint["type"] != "extra_forbidden")
    texts = list(dict.fromkeys(_complaint(complaint, model) for complaint in complaints))
    more = f" (and {len(texts) - SHOWN} more)" if len(texts) > SHOWN else ""
    return "; ".join(texts[:SHOWN]) + more


def _complaint(first: ErrorDetails, model: type[Table]) -> str:
    """One complaint."""
    keys = [one_line(key, 60) for key in _keys(first["loc"])]
    if first["type"].startswith("union_tag"):
        keys.append(first["ctx"]["discriminator"].strip("'"))
    where = f"key '{'.'.join(keys)}': " if keys else ""
    if first["type"] == "extra_forbidden":
        allowed = _allowed(model, [str(part) for part in first["loc"][:-1]])
        text = f"unknown key; allowed here: {', '.join(allowed)}"
    elif first["type"] in ("missing", "union_tag_not_found"):
        text = "missing; it must be given"
    elif first["type"] == "union_tag_invalid":
        text = f"'{first['ctx'].get('tag', '')}' is not one of {first['ctx']['expected_tags']}"
    else:
        text = first["msg"].removeprefix("Value error, ")
        if first["type"] != "value_error":
            text += f" (got {shown(first['input'])})"
    return where + text


def shown(value: Any) -> str:
    """A value for a message: on one line, and not all of a long one."""
    try:
        return one_line(repr(value))
    except ValueError:  # Python spells out no whole number of thousands of digits
        return "a number too long to show"


def _keys(location: tuple[int | str, ...]) -> list[str]:
    """Keys of the file at a location of pydantic, which inserts the tag of a tagged union: no key of the file."""
    tags = {"circle", "rounded-rectangle", "figure-of-eight", "corridor", "waypoints", "uniform", "listed"}
    tags |= {"circular", "annular", "xyz", "uvd", "linear", "relative-xy", "range-bearing"}
    behind = {i + 2 for i, part in enumerate(location) if part == LIST_OF_KINDS}  # LIST, index, tag
    return [str(part) for i, part in enumerate(location) if part not in tags and i not in behind]


def _allowed(model: type[Table], path: list[str]) -> list[str]:
    """Keys of the table at ``path``, following tagged unions by their tag."""
    current: list[type[Table]] = [model]
    for part in path:
        if part in current[0].model_fields:
            current = _tables(current[0].model_fields[part].annotation)
        else:
            current = [table for table in current if f"'{part}'" in str(table.model_fields)] or current
    return [name for name in current[0].model_fields if name not in current[0].not_in_file]


def _tables(annotation: Any) -> list[type[Table]]:
    if isinstance(annotation, type) and issubclass(annotation, Table):
        return [annotation, *annotation.kinds()]
    return [table for part in getattr(annotation, "__args__", ()) for table in _tables(part)]
