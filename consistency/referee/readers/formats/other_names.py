"""Tables with other names of their columns, which are given those of docs/files.md: all other names stand here."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from consistency.referee.column_names import POSE
from consistency.referee.errors import InputError
from consistency.referee.readers.formats.file_kinds import HEADINGS, PLACES
from consistency.referee.readers.formats.named_columns import (
    DEVIATIONS,
    OWN,
    TRUE,
    VARIANCES,
    clock_of,
    plain_name,
    require_units,
)
from consistency.referee.readers.formats.sheet import TableRows
from consistency.referee.types import Array

COVARIANCES = ("p_{}_{}", "p_{}{}", "p{}_{}", "p{}{}", "cov_{}_{}", "cov_{}{}", "cov{}{}")
SHORT_HEADINGS = ("h", "th", "t")  # in names of a covariance alone
KEYS = ("run", "step", "t")


def with_known_names(sheet: TableRows, axes: Sequence[str]) -> tuple[TableRows, str]:
    """The table with its state and covariance under the names of docs/files.md, where it lacks them, and a note."""
    names = list(sheet.data)
    places = state_places(names, axes, OWN) | covariance_places(names, axes)
    require_units([names[place] for place in places.values()], sheet.path)
    taken = ", ".join(f"{names[place]} as {name}" for name, place in places.items())
    data = sheet.data | {name: sheet.data[names[place]] for name, place in places.items()}
    note = f"{sheet.path}: read {taken}" if taken else ""
    return replace(sheet, data=data), note


def with_clock(sheet: TableRows, required: bool = True) -> TableRows:
    """The table with a column ``t``, s, of a time by another name; itself where it has none, or ``t``.

    Text in the place of a time is refused if it is ``required``, and not looked at otherwise.
    """
    clock = None if "t" in sheet else clock_of([name or "index" for name in sheet.data])
    names = [] if clock is None else [list(sheet.data)[place] for place in clock[0]]
    if clock is None or not (required or all(sheet.data[name].dtype.kind == "f" for name in names)):
        return sheet
    from consistency.referee.readers.clock_units import unit_of

    columns = [sheet.numbers(name) for name in names]
    t = columns[0] / unit_of(columns[0], clock[1]) + sum(columns[1:]) * 1e-9
    return replace(sheet, data=sheet.data | {"t": t})


def true_columns(sheet: TableRows, axes: Sequence[str]) -> TableRows | None:
    """The truth that stands beside the estimates, as ``true_x`` beside ``x``, in rows that have one; None without."""
    names = list(sheet.data)
    places = state_places(names, axes, TRUE)
    if set(places) != set(axes):
        return None
    require_units([names[place] for place in places.values()], sheet.path)
    data = {axis: sheet.numbers(names[places[axis]]) for axis in axes}
    known: Array = ~np.isnan(np.column_stack(list(data.values()))).any(axis=1)
    return replace(sheet, data=data | {key: sheet.data[key] for key in KEYS if key in sheet}).rows(known)


def require_true_columns(sheet: TableRows, axes: Sequence[str]) -> None:
    """Refuse a table in which the truth of only some components stands beside the estimates."""
    places = state_places(list(sheet.data), axes, TRUE)
    missing = [axis for axis in axes if axis not in places]
    if places and missing:
        raise InputError(
            f"{sheet.path}: column 'true_{missing[0]}' is missing; there are: {sheet.columns}; the state is "
            f"{','.join(axes)}: --state names another, and --columns true_{missing[0]}=NAME that column"
        )


def state_places(names: Sequence[str], axes: Sequence[str], spellings: Sequence[str]) -> dict[str, int]:
    """Places of components whose own names are not there, or of the true ones, by spellings such as ``true_{}``."""
    plain, found = [plain_name(name) for name in names], dict[str, int]()
    words: Sequence[Sequence[str]] = PLACES if tuple(axes) == tuple(POSE) else [[plain_name(axis)] for axis in axes]
    for axis, own in zip(axes, words, strict=True):
        if spellings is OWN and axis in names:
            continue
        spelled = [spelling.format(word) for spelling in spellings for word in own]
        there = [plain.index(name) for name in spelled if plain.count(name) == 1]
        found |= {axis: there[0]} if there else {}
    return found


def covariance_places(names: Sequence[str], axes: Sequence[str]) -> dict[str, int]:
    """Places of the columns ``P_a_b`` that are spelled otherwise, or of deviations; none where all variances, or all
    deviations as ``sigma_a``, stand under their own names. Of several spellings that with most columns counts.
    """
    n, short = len(axes), dict(zip(POSE, "xyh", strict=True)) if tuple(axes) == tuple(POSE) else {}
    known = all({f"P_{a}_{a}", f"P_{short.get(a, a) * 2}"} & {*names} for a in axes)
    if known or any({spelling.format(a) for a in axes} <= {*names} for spelling in DEVIATIONS):
        return {}
    plain, best = [plain_name(name) for name in names], dict[str, int]()
    for labels, spelling in itertools.product(_labels(axes), COVARIANCES):
        pairs = {(i, j): spelling.format(labels[i], labels[j]) for i, j in itertools.product(range(n), repeat=2)}
        if len(set(pairs.values())) < n * n:  # as P111 of eleven components, which may be P(1,11) or P(11,1)
            continue
        found = {pair: plain.index(name) for pair, name in pairs.items() if plain.count(name) == 1}
        for i, label in enumerate(labels):
            there = [name for each in VARIANCES if plain.count(name := each.format(label)) == 1]
            found |= {(i, i): plain.index(there[0])} if there and (i, i) not in found else {}
        if all((i, i) in found for i in range(n)) and len(found) > len(best):
            best = {f"P_{axes[i]}_{axes[j]}": place for (i, j), place in found.items()}
    if best:
        return best
    for labels, spelling in itertools.product(_labels(axes), DEVIATIONS):
        there = [spelling.format(label) for label in labels]
        if all(plain.count(name) == 1 for name in there):
            return {f"sigma_{axis}": plain.index(name) for axis, name in zip(axes, there, strict=True)}
    return {}


def _labels(axes: Sequence[str]) -> Iterator[tuple[str, ...]]:
    """Words for the components in names of a covariance: their own, or numbers from 1 or 0 on."""
    own = tuple(plain_name(axis) for axis in axes)
    if own == tuple(POSE):
        yield from ((*own[:2], heading) for heading in (*HEADINGS, *SHORT_HEADINGS))
    else:
        yield own
    yield from (tuple(str(first + i) for i in range(len(axes))) for first in (1, 0))
