"""The NIS of a table: its own column under any spelling, or innovations beside their variances."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.readers.formats.columns import Entries, entries_of
from consistency.referee.readers.formats.sheet import DOF_NEEDED, NIS_DOF, TableRows, are_dof
from consistency.referee.readers.formats.spellings import places_of, stem_of
from consistency.referee.readers.places import refuse
from consistency.referee.types import Array

NIS = ("nis", "normalized_innovation_squared", "normalised_innovation_squared")
DOF = ("nis_dof", "dof_nis", "innovation_dof", "dof", "df")
WORDS = ("innovation", "innov")
VALUES = ("innovation_{}", "{}_innovation", "innov_{}", "{}_innov")
STATED = {  # squared or not: words of a statement
    True: ("variance", "var", "covariance", "cov"),
    False: ("std", "sigma", "sd", "stddev"),
}
MATRICES = ("s_{}_{}", "s{}{}", *(f"{word}_{kind}_{{}}_{{}}" for word in WORDS for kind in STATED[True][2:]))
OTHER = {*STATED[True], *STATED[False], "dof", "ratio", "squared", "norm", "test", "t", "time"}  # than innovations


def with_nis(sheet: TableRows, dof: int | None = None, required: bool = True) -> tuple[TableRows, str]:
    """The table with columns ``nis`` and ``nis_dof``, and a note on what they were read as.

    The NIS of innovations (N, m) follows from their covariances, or from variances, whose components are then taken as
    independent. A component without a number, or with an innovation and a variance of 0, has no measurement.

    Parameters
    ----------
    dof : degrees of freedom of each NIS, of a table that does not state them
    required : refuse a NIS whose degrees of freedom are not stated; otherwise such a table stays as it is

    Raises
    ------
    InputError
        Degrees of freedom are missing, stated twice or not a number of measurements; a variance is not positive.
    """
    if dof is not None and (dof < 1 or not are_dof(np.array(float(dof)))):
        raise InputError(f"--dof {dof}: must be {DOF_NEEDED.replace('0', '1', 1)}, {NIS_DOF}")
    names = list(sheet.data)
    places = places_of(names)
    nis = "nis" if "nis" in sheet else _first(names, places, NIS)
    if nis is None:
        return _with_innovations(sheet, places, dof)
    degrees = "nis_dof" if "nis_dof" in sheet else _first(names, places, DOF[: 3 if "nees" in places else None])
    if degrees is not None and dof is not None:
        raise InputError(f"--dof {dof}: {sheet.path} has a column '{degrees}' of them")
    if degrees is None and dof is None:
        if required:
            raise InputError(f"{sheet.path}: column 'nis_dof' is missing beside '{nis}'; {NIS_DOF}; --dof N is one for "
                             "all rows")  # fmt: skip
        return sheet, ""
    if degrees is None:
        of_rows = np.where(np.isnan(sheet.numbers(nis)), 0.0, float(dof or 0))
        return replace(sheet, data=sheet.data | {"nis": sheet.data[nis], "nis_dof": of_rows}), ""
    taken = [f"{name} as {known}" for name, known in ((nis, "nis"), (degrees, "nis_dof")) if name != known]
    data = sheet.data | {"nis": sheet.data[nis], "nis_dof": sheet.data[degrees]}
    return replace(sheet, data=data), f"{sheet.path}: read {', '.join(taken)}" if taken else ""


def has_nis(names: Sequence[str]) -> bool:
    """Whether a table has a column of the NIS, or of innovations."""
    places = places_of(names)
    return any(word in places for word in NIS) or bool(_innovations(places))


def _first(names: Sequence[str], places: Mapping[str, int], words: Sequence[str]) -> str | None:
    return next((names[places[word]] for word in words if word in places), None)


def _with_innovations(sheet: TableRows, places: Mapping[str, int], dof: int | None) -> tuple[TableRows, str]:
    names = list(sheet.data)
    labels = _innovations(places)
    stated = next(_covariances(names, places, list(labels)), None) if labels else None
    if stated is None:
        return sheet, ""
    if dof is not None:
        raise InputError(f"--dof {dof}: {sheet.path} has innovations, whose number it is already")
    m = len(labels)
    v = sheet.matrix(names[place] for place in labels.values())
    columns = [names[place] for place in stated.places.values()]
    numbers = sheet.matrix(columns)
    if len(stated.places) == m:
        variance = numbers if stated.squared else np.square(numbers)
        nis, degrees = _of_variances(sheet, v, variance)
        alone = ", whose components are taken as independent" if m > 1 else ""
    else:
        S = np.empty((len(v), m, m))
        for (i, j), column in zip(stated.places, numbers.T, strict=True):
            S[:, i, j] = column
            if (j, i) not in stated.places:
                S[:, j, i] = column
        from consistency.referee.diagnostics.questions.innovations import nis_of

        nis, degrees = nis_of(v, S)
        alone = ""
        refuse(np.isfinite(v).all(axis=1) & np.isnan(nis), sheet.place, "the innovation covariance is not positive "
               "definite")  # fmt: skip
    kind = "covariances" if stated.squared else "standard deviations"
    of = f"the NIS is that of {', '.join(names[place] for place in labels.values())}"
    data = sheet.data | {"nis": nis, "nis_dof": degrees.astype(float)}
    return replace(sheet, data=data), f"{sheet.path}: {of} with the {kind} {', '.join(columns)}{alone}"


def _of_variances(sheet: TableRows, v: Array, variance: Array) -> tuple[Array, Array]:
    measured = np.isfinite(v) & np.isfinite(variance) & ~((variance == 0) & (v == 0))
    refuse((measured & (variance <= 0)).any(axis=1), sheet.place, "the variance of an innovation is not positive")
    ratio = np.where(measured, np.square(v), 0.0) / np.where(measured, variance, 1.0)
    degrees = measured.sum(axis=1)
    return np.where(degrees > 0, ratio.sum(axis=1), np.nan), degrees


def _innovations(places: Mapping[str, int]) -> dict[str, int]:
    """Places of innovations by the names of their components, "" of one that has none."""
    for word in WORDS:
        if word in places:
            return {"": places[word]}
    for spelling in VALUES:
        found = {stem: place for name, place in places.items() if (stem := stem_of(name, [spelling]))}
        found = {stem: place for stem, place in found.items() if not OTHER & set(stem.split("_"))}
        if found:
            return found
    return {}


def _covariances(names: Sequence[str], places: Mapping[str, int], labels: list[str]) -> Iterator[Entries]:
    """Covariances of innovations, then variances, then standard deviations, as far as all are there."""
    m = len(labels)
    for words in (labels, *([str(i + first) for i in range(m)] for first in (1, 0))):
        for spelling in MATRICES:
            found = entries_of(places, words, spelling)
            if Entries(found).in_order(m) and (m == 1 or len(found) > m):
                yield Entries(found)
    capital = {name: place for name, place in places.items() if names[place].startswith("S")}
    variances = [_joined(["s", label]) for label in labels]
    if set(variances) <= set(capital):
        yield Entries({(i, i): capital[name] for i, name in enumerate(variances)})
    for squared, kinds in STATED.items():
        for word in WORDS:
            for kind in kinds:
                for order in ("{w} {k} {l}", "{w} {l} {k}", "{l} {w} {k}", "{k} {w} {l}", "{k} {l} {w}"):
                    there = [_joined(order.format(w=word, k=kind, l=label).split(" ")) for label in labels]
                    if set(there) <= set(places):
                        of = {(i, i): places[name] for i, name in enumerate(there)}
                        yield Entries(of, squared=squared)


def _joined(parts: Sequence[str]) -> str:
    return re.sub("_+", "_", "_".join(parts)).strip("_")
