"""Columns by names of the user's own: which name here stands for which in a file."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from consistency.referee.errors import InputError
from consistency.referee.readers.formats.named_columns import (
    CLOCKS,
    HALVES,
    MOVING,
    OWN,
    POSITIONS,
    QUATERNIONS,
    UNITS,
    clock_of,
    plain_name,
    require_units,
    stem_of,
    unit_in,
)
from consistency.referee.readers.places import listed

Columns = Mapping[str, str]  # names of columns here, and those in a file


def renamed(names: Sequence[str], columns: Columns | None, where: Path) -> list[str]:
    """Names of columns, with those of ``columns`` in place of the file's own.

    A column that is not named there, but would play the same part, is hidden behind another name. A name here with a
    ``*`` stands for all columns that begin or end alike. A time keeps the unit that its name in the file states.

    Raises
    ------
    InputError
        A column is not there, or two get the same name.
    """
    new: dict[int, str] = {}
    for name, old in (columns or {}).items():
        places = _spelled(names, old)
        if not places:
            raise InputError(
                f"{where}: has no column '{old}', which is to be read as '{name}'; there are: {listed(names, 12)}"
            )
        require_units([names[place] for place in places], where)
        for place, rest in places.items():
            new[place] = _with_unit(name.replace("*", rest), names[place])
    taken = [word for name in new.values() for word in _alike(name)]
    hidden = [f"{name} not used" if _plays(name, taken) else name for name in names]
    out = [new.get(place, hidden[place]) for place in range(len(names))]
    if twice := [name for name in new.values() if out.count(name) > 1]:
        raise InputError(f"{where}: two columns are named '{twice[0]}'")
    return out


def _spelled(names: Sequence[str], old: str) -> dict[int, str]:
    """Places of the columns of a name, or of all that a ``*`` stands for, with what stands in its place."""
    if "*" not in old:
        exact = [i for i, name in enumerate(names) if name == old]
        alike = [i for i, name in enumerate(names) if plain_name(name) == plain_name(old)]
        return dict.fromkeys((exact or alike)[:1], "")
    before, _, after = old.partition("*")
    long = len(before) + len(after)
    return {
        i: name[len(before) : len(name) - len(after)]
        for i, name in enumerate(names)
        if name.startswith(before) and name.endswith(after) and len(name) > long
    }


def _with_unit(name: str, old: str) -> str:
    """A name of a time with the unit that the file states, if it states none itself."""
    if clock_of([name]) is None or unit_in(name) is not None:
        return name
    unit = unit_in(old)
    return f"{name}_{next(word for word, each in UNITS.items() if each == unit)}" if unit else name


def _alike(name: str) -> list[str]:
    """All spellings of the part that a column plays."""
    if clock_of([name]) is not None:
        return [*CLOCKS, *(half for pair in HALVES for half in pair)]
    plain = plain_name(name)
    words = [[each.format(part) for each in family] for family in (POSITIONS, QUATERNIONS, *MOVING) for part in "xyzw"]
    return [plain, *(word for spelled in words if plain in spelled for word in spelled)]


def _plays(name: str, words: Sequence[str]) -> bool:
    """Whether a column has one of some spellings: with a unit, in a longer name, or in an estimate's name."""
    plain = plain_name(name)
    bare = re.sub(rf"_({'|'.join(UNITS)})$", "", plain)
    stem = stem_of(name, OWN[1:]) or plain
    inner = tuple(f"_{word}" for word in words if "_" in word)
    return bool({plain, bare, stem} & {*words}) or plain.endswith(inner)
