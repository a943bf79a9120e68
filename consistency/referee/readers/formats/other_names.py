"""Tables with other names of their columns, which are given those of docs/files.md: all other names stand here."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from consistency.referee.column_names import POSE
from consistency.referee.readers.formats import named_columns as known
from consistency.referee.readers.formats.file_kinds import HEADINGS, PLACES
from consistency.referee.readers.formats.named_columns import clock_of, only_places, plain_names, spelled
from consistency.referee.readers.formats.sheet import TableRows

COVARIANCES = ("p_{}_{}", "p_{}{}", "p{}_{}", "p{}{}", "cov_{}_{}", "cov_{}{}", "cov{}{}")
SHORT_HEADINGS = ("h", "th", "t")  # in names of a covariance alone
KEYS = ("run", "step", "t")


def with_known_names(sheet: TableRows, axes: Sequence[str]) -> tuple[TableRows, str]:
    """The table with its state and covariance under the names of docs/files.md, where it lacks them, and a note."""
    names = list(sheet.data)
    places = state_places(names, axes, known.OWN) | covariance_places(names, axes)
    data = dict(sheet.data)
    taken = []
    for name, place in places.items():
        known.require_units([names[place]], sheet.path)
        data[name] = sheet.data[names[place]]
        taken.append(f"{names[place]} as {name}")
    note = f"{sheet.path}: read {', '.join(taken)}" if taken else ""
    return replace(sheet, data=data), note


def with_clock(sheet: TableRows, required: bool = True) -> TableRows:
    """The table with a column ``t``, s, of a time by another name; itself where it has none, or ``t``.

    Text in the place of a time is refused if it is ``required``, and not looked at otherwise.
    """
    clock = None
    if "t" not in sheet:
        clock = clock_of([name or "index" for name in sheet.data])
    if clock is None:
        return sheet
    names = list(sheet.data)
    columns = [sheet.data[names[place]] for place in clock[0]]
    if not required and any(column.dtype.kind != "f" for column in columns):
        return sheet
    from consistency.referee.readers.clock_units import unit_of

    first, *nanoseconds = (sheet.numbers(names[place]) for place in clock[0])
    t = first / unit_of(first, clock[1]) + sum(nanoseconds) * 1e-9
    return replace(sheet, data=sheet.data | {"t": t})


def true_columns(sheet: TableRows, axes: Sequence[str]) -> TableRows | None:
    """The truth that stands beside the estimates, as ``true_x`` beside ``x``, in rows that have one; None without."""
    names = list(sheet.data)
    places = state_places(names, axes, known.TRUE)
    if set(places) != set(axes):
        return None
    columns = [names[places[axis]] for axis in axes]
    known.require_units(columns, sheet.path)
    values = sheet.matrix(columns)
    data = dict(zip(axes, values.T, strict=True))
    for key in KEYS:
        if key in sheet:
            data[key] = sheet.data[key]
    complete = np.asarray(~np.isnan(values).any(axis=1))
    return replace(sheet, data=data).rows(complete)


def missing_truth(sheet: TableRows, axes: Sequence[str]) -> str:
    """What a table lacks in which the truth of only some components stands beside the estimates; '' of others."""
    places = state_places(list(sheet.data), axes, known.TRUE)
    missing = [axis for axis in axes if axis not in places]
    if not places or not missing:
        return ""
    return (
        f"column 'true_{missing[0]}' is missing; there are: {sheet.columns}; the state is {','.join(axes)}: --state "
        f"names another, and --columns true_{missing[0]}=NAME that column"
    )


def state_places(names: Sequence[str], axes: Sequence[str], spellings: Sequence[str]) -> dict[str, int]:
    """Places of components whose own names are not there, or of the true ones, by spellings such as ``true_{}``."""
    once = only_places(plain_names(names))
    is_pose = tuple(axes) == tuple(POSE)
    found = {}
    for i, axis in enumerate(axes):
        if spellings is known.OWN and axis in names:
            continue
        words = PLACES[i] if is_pose else (known.plain_name(axis),)
        for spelling, word in itertools.product(spellings, words):
            if spelling.format(word) in once:
                found[axis] = once[spelling.format(word)]
                break
    return found


def covariance_places(names: Sequence[str], axes: Sequence[str]) -> dict[str, int]:
    """Places of the columns ``P_a_b`` that are spelled otherwise, or of deviations; none where all variances, or all
    deviations as ``sigma_a``, stand under their own names. Of several spellings that with most columns counts.
    """
    if _has_own_names({*names}, axes):
        return {}
    once = only_places(plain_names(names))
    labels = _labels(axes)
    best: dict[tuple[int, int], int] = {}
    for words, spelling in itertools.product(labels, COVARIANCES):
        found = _entries(once, words, spelling)
        if len(found) > len(best):
            best = found
    if best:
        return {f"P_{axes[i]}_{axes[j]}": place for (i, j), place in best.items()}
    for words, spelling in itertools.product(labels, known.DEVIATIONS):
        there = spelled(spelling, words)
        if set(there) <= set(once):
            return {f"sigma_{axis}": once[name] for axis, name in zip(axes, there, strict=True)}
    return {}


def _has_own_names(names: set[str], axes: Sequence[str]) -> bool:
    """Whether all variances, or all deviations, stand under the names of docs/files.md."""
    if any(set(spelled(spelling, axes)) <= names for spelling in known.DEVIATIONS):
        return True
    is_pose = tuple(axes) == tuple(POSE)
    for axis in axes:
        short = "h" if is_pose and axis == "heading" else axis
        if not {f"P_{axis}_{axis}", f"P_{short}{short}"} & names:
            return False
    return True


def _entries(once: Mapping[str, int], words: Sequence[str], spelling: str) -> dict[tuple[int, int], int]:
    """Places of the entries of a covariance by row and column; none without all of its diagonal.

    Also none where two entries have one name, as P111 of eleven components, which may be P(1,11) or P(11,1).
    """
    names = {}
    for i, j in itertools.product(range(len(words)), repeat=2):
        names[i, j] = spelling.format(words[i], words[j])
    if len(set(names.values())) < len(names):
        return {}
    found = {pair: once[name] for pair, name in names.items() if name in once}
    for i, word in enumerate(words):
        for spelling in known.VARIANCES:
            name = spelling.format(word)
            if (i, i) not in found and name in once:
                found[i, i] = once[name]
        if (i, i) not in found:
            return {}
    return found


def _labels(axes: Sequence[str]) -> list[tuple[str, ...]]:
    """Words for the components in names of a covariance: their own, or numbers from 1 or 0 on."""
    labels = [tuple(plain_names(axes))]
    if labels[0] == tuple(POSE):
        labels = [("x", "y", heading) for heading in (*HEADINGS, *SHORT_HEADINGS)]
    for first in (1, 0):
        labels.append(tuple(map(str, range(first, first + len(axes)))))
    return labels
