"""Columns by names of the user's own: which name here stands for which in a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path

from consistency.referee.errors import InputError
from consistency.referee.readers.formats import named_columns as known
from consistency.referee.readers.formats.named_columns import clock_of, plain_name, plain_names, unit_in
from consistency.referee.readers.places import listed

Columns = Mapping[str, str]  # names of columns here, and those in a file
FAMILIES = (known.POSITIONS, known.QUATERNIONS, *known.MOVING)


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
        places = _places(names, old)
        if not places:
            what = f"has no column '{old}', which is to be read as '{name}'"
            raise InputError(f"{where}: {what}; there are: {listed(names, 12)}")
        for place, rest in places.items():
            known.require_units([names[place]], where)
            new[place] = _with_unit(name.replace("*", rest), names[place])
    taken = set(chain.from_iterable(map(_alike, new.values())))
    out = []
    for place, name in enumerate(names):
        if place not in new and _plays(name, taken):
            name = f"{name} not used"
        out.append(new.get(place, name))
    for name in new.values():
        if out.count(name) > 1:
            raise InputError(f"{where}: two columns are named '{name}'")
    return out


def _places(names: Sequence[str], old: str) -> dict[int, str]:
    """Places of the columns of a name, or of all that a ``*`` stands for, with what stands in its place."""
    if "*" not in old:
        if old in names:
            return {names.index(old): ""}
        plain = plain_names(names)
        return {plain.index(plain_name(old)): ""} if plain_name(old) in plain else {}
    before, _, after = old.partition("*")
    found = {}
    for place, name in enumerate(names):
        if name.startswith(before) and name.endswith(after) and len(name) > len(before + after):
            found[place] = name[len(before) : len(name) - len(after)]
    return found


def _with_unit(name: str, old: str) -> str:
    """A name of a time with the unit that the file states, if it states none itself."""
    unit = unit_in(old)
    if clock_of([name]) is None or unit_in(name) is not None or unit is None:
        return name
    words = {value: word for word, value in reversed(known.UNITS.items())}
    return f"{name}_{words[unit]}"


def _alike(name: str) -> list[str]:
    """All spellings of the part that a column plays."""
    if clock_of([name]) is not None:
        return [*known.CLOCKS, *chain.from_iterable(known.HALVES)]
    plain = plain_name(name)
    words = [plain]
    for family in FAMILIES:
        for part in "xyzw":
            same = [spelling.format(part) for spelling in family]
            if plain in same:
                words += same
    return words


def _plays(name: str, words: set[str]) -> bool:
    """Whether a column has one of some spellings: with a unit, in a longer name, or in an estimate's name."""
    plain = plain_name(name)
    own = {plain, known.without_unit(plain), known.stem_of(name, known.OWN[1:]) or plain}
    ends = tuple(f"_{word}" for word in words if "_" in word)
    return bool(own & words) or plain.endswith(ends)
