"""Members of ensembles, beside the truth that they are exchangeable with, and repeats of the same true values."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from consistency.referee.diagnostics.normal_numbers import SEED, TOGETHER, is_joint
from consistency.referee.diagnostics.number_words import plural
from consistency.referee.diagnostics.whitening import all_finite
from consistency.referee.errors import InputError
from consistency.referee.readers.formats.sheet import TableRows
from consistency.referee.readers.options import Reading
from consistency.referee.readers.truth_matching import ALONE, Estimator
from consistency.referee.types import Array

WEIGHTS = ("w", "weight", "weights")  # names of columns
UNWEIGHTED = (
    "ranks among weighted members are not uniform (3 % of those of a right filter lie beyond its 1 %); draw members of "
    "equal weight from all particles, far fewer than are effective, and give these"
)


def checked_members(members: Array, known: Array, place: Callable[[int], str]) -> Array:
    """Members (k, m, n), NaN in all of them where a step has none.

    Raises
    ------
    InputError
        Some members of a step that is ``known`` (k,) are not finite, and others are.
    """
    finite = all_finite(members)
    whole = all_finite(members.reshape(len(members), -1))
    partly = np.flatnonzero(known & finite.any(axis=-1) & ~whole)
    if len(partly):
        row = int(partly[0])
        which = f"member {np.argmin(finite[row]) + 1} of {members.shape[1]} is not finite"
        remedy = "all steps need equally many members; NaN in all of them says that the filter failed"
        raise InputError(f"{place(row)}: {which}; {remedy}")
    return np.where(whole[:, None, None], members, np.nan)


def of_members(e: Estimator, r: Reading) -> Estimator:
    """An estimator whose runs have members, with the numbers of their ranks as components: each is judged alone.

    Raises
    ------
    InputError
        An option does not go with members.
    """
    r.refuse("members", {
        "ensemble": ", which is for their mean and covariance alone", "relative": "", "align": "", "axes": "",
        "truth_covariance": ": ranks have no covariance that it could be added to",
    })  # fmt: skip
    first = e.runs[0].own.members
    assert first is not None
    m, n = first.shape[1:]
    if m < 2:
        raise InputError(f"{e.path}: members: a rank beside 1 member does not show its size; give 2 or more, better 20")
    axes = tuple(e.error.axes)
    notes = [
        f"{e.said}: errors are normal numbers at the rank of the truth among {plural(m, 'member')}, random within it "
        f"(seed {SEED}); ratios are those of the covariance of Gaussian errors"
    ]
    if is_joint(m, n):
        axes += (TOGETHER,)
        notes.append(f"{e.said}: '{TOGETHER}' is the rank of the distance from the mean of truth and members")
    elif n > 1:
        notes.append(f"{e.said}: {m} members of {n} components say nothing of all components together; m > n would")
    runs = []
    for p in e.runs:
        covariance = np.broadcast_to(np.eye(len(axes)), (len(p.own.t), len(axes), len(axes)))
        runs.append(p.with_values(covariance=covariance, stated=np.ones(len(p.own.t), bool)))
    return replace(e, runs=runs).with_error(axes=axes, stated=ALONE).with_notes(*notes)


# --- tables ------------------------------------------------------------------------------------------


def member_columns(sheet: TableRows, names: Mapping[str, str]) -> Array:
    """Members of each component in columns that begin alike, (N, m, n).

    Parameters
    ----------
    names : ``{"x": "e*"}``

    Raises
    ------
    InputError
        No column begins so, components have members of unlike number, or some members of a row are empty.
    """
    weights = next((column for column in sheet.data if column in WEIGHTS and column not in names), None)
    if weights is not None:
        raise InputError(f"{sheet.path}: column '{weights}' beside --members: {UNWEIGHTED}; leave the column out then")
    found = {}
    for axis, pattern in names.items():
        begin = pattern.rstrip("*")
        found[axis] = [column for column in sheet.data if column.startswith(begin) and column not in names]
        if not found[axis]:
            raise InputError(
                f"{sheet.path}: --members {axis}={pattern}: no column begins so; there are: {sheet.columns}"
            )
    counts = {axis: len(columns) for axis, columns in found.items()}
    if len(set(counts.values())) > 1:
        several = ", ".join(f"{axis} {count}" for axis, count in counts.items())
        raise InputError(f"{sheet.path}: --members: components have members of unlike number: {several}")
    members = np.stack([sheet.matrix(columns) for columns in found.values()], axis=-1)
    return checked_members(members, np.ones(len(sheet), bool), sheet.place)


def with_means(sheet: TableRows, names: Mapping[str, str]) -> TableRows:
    """The table with the mean of its members as the estimate of each component."""
    means = member_columns(sheet, names).mean(axis=1)
    return replace(sheet, data=sheet.data | dict(zip(names, means.T, strict=True)))


def beside_first_run(sheet: TableRows, axes: Sequence[str]) -> tuple[TableRows, TableRows]:
    """A table of repeats, and the rows of its first run, which stand for the truth of all.

    Without a column ``run`` each row is a repeat of its own.
    """
    data = dict(sheet.data)
    if "run" not in data:
        data["run"] = np.arange(float(len(sheet)))
        data["step"] = np.ones(len(sheet))
    sheet = replace(sheet, data=data)
    runs = sheet.numbers("run", whole=True)
    keys = {key: data[key] for key in ("step", "t", *axes) if key in data}
    return sheet, replace(sheet, data=keys).rows(runs == runs.min())
