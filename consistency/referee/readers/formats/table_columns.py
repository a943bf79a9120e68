"""Columns of a table by their meaning: under the names of docs/files.md, in order, and as arrays."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from consistency.referee.column_names import OWN_COVARIANCE, POSE
from consistency.referee.diagnostics.number_words import plural
from consistency.referee.errors import InputError
from consistency.referee.readers.clocks import time_unit
from consistency.referee.readers.formats.columns import (
    HEADINGS,
    OWN,
    QUATERNIONS,
    TRUE,
    Clock,
    Entries,
    clock_of,
    covariance_columns,
    entries_of,
    entry_name,
    is_pose,
    naming,
    places_of,
    require_units,
    run_column,
    state_columns,
    stem_of,
)
from consistency.referee.readers.formats.file_kinds import fields_of
from consistency.referee.readers.formats.sheet import DOF_NEEDED, NIS_DOF, TableRows, are_dof, checked_dof
from consistency.referee.readers.formats.text_blocks import FileRows, blocks
from consistency.referee.readers.options import GroupOptions
from consistency.referee.readers.places import exact, listed, refuse
from consistency.referee.readers.runs_to_record import symmetric
from consistency.referee.readers.truth_matching import Poses
from consistency.referee.types import Array, Indices

KEYS = ("run", "step", "t")
ANGLES = {*HEADINGS, "roll", "pitch", "phi", "course", "azimuth", "bearing"}  # words in names of components
LEAST_APART = 0.75  # of a turn: less may be an error

# --- names -------------------------------------------------------------------------------------------


def with_known_names(sheet: TableRows, axes: Sequence[str]) -> tuple[TableRows, str]:
    """The table with its state under the names of docs/files.md, and a note on columns that have other names."""
    names = list(sheet.data)
    entries = covariance_columns(names, axes)
    data = dict(sheet.data)
    read_as = {}
    for axis, place in state_columns(names, axes, OWN).items():
        if names[place] != axis:
            data[axis] = sheet.data[names[place]]
            read_as[axis] = names[place]
    if entries.renamed:
        for (i, j), place in entries.places.items():
            known = f"sigma_{axes[i]}"
            if entries.squared:
                known = f"P_{axes[i]}_{axes[j]}"
            read_as[known] = names[place]
    require_units(read_as.values(), sheet.path)
    note = ""
    if read_as:
        taken = ", ".join(f"{name} as {known}" for known, name in read_as.items())
        note = f"{sheet.path}: read {taken}"
    return replace(sheet, data=data), note


def true_columns(sheet: TableRows, axes: Sequence[str]) -> TableRows | None:
    """The truth that stands beside the estimates, as ``true_x`` beside ``x``, in rows that have one; None without."""
    names = list(sheet.data)
    places = state_columns(names, axes, TRUE)
    if set(places) != set(axes):
        return None
    columns = [names[places[axis]] for axis in axes]
    require_units(columns, sheet.path)
    values = sheet.matrix(columns)
    data = dict(zip(axes, values.T, strict=True))
    for key in sheet.among(KEYS):
        data[key] = sheet.data[key]
    complete = np.asarray(~np.isnan(values).any(axis=1))
    return replace(sheet, data=data).rows(complete)


def missing_truth(sheet: TableRows, axes: Sequence[str]) -> str:
    """What a table lacks in which the truth of only some components stands beside the estimates; "" of others."""
    places = state_columns(list(sheet.data), axes, TRUE)
    missing = [axis for axis in axes if axis not in places]
    if not places or not missing:
        return ""
    return (
        f"column 'true_{missing[0]}' is missing; there are: {sheet.columns}; the state is {','.join(axes)}: --state "
        f"names another, and --columns true_{missing[0]}=NAME that column"
    )


def require_columns(sheet: TableRows, axes: Sequence[str]) -> None:
    """Refuse a table that lacks a column of the state."""
    for axis in axes:
        if axis in sheet:
            continue
        hint = ""
        if is_pose(axes):
            hint = " (poses in space have x, y, z, qx, qy, qz, qw); name other states with --state a,b,c"
        what = f"column '{axis}' is missing; there are: {sheet.columns}"
        raise InputError(f"{sheet.path}: {what}; {naming(axis)}{hint}")


def stated_state(names: Sequence[str]) -> list[str]:
    """The state that a covariance of columns ``P_a_b`` names, where each a is a column; none of poses."""
    pairs = [name for name in names if name.startswith("P_")]
    axes = [found[1] for name in pairs if (found := re.fullmatch(r"P_(.+)_\1", name))]
    known = {f"P_{a}_{b}" for a, b in itertools.product(axes, repeat=2)}
    is_whole = set(pairs) <= known and len(state_columns(names, axes, OWN)) == len(axes)
    has_pose = len(state_columns(names, POSE, OWN)) == len(POSE)
    turns = any(spelling.format("w") in places_of(names) for spelling in QUATERNIONS)
    return axes if is_whole and not has_pose and not turns else []


def states_any(sheet: TableRows, entries: Entries, n: int) -> bool:
    """Whether a table states variances or deviations of all n components, of which one is above 0."""
    names = list(sheet.data)
    columns = [names[entries.places[i, i]] for i in range(n) if (i, i) in entries.places]
    return len(columns) == n and bool((sheet.matrix(columns) > 0).any())


# --- rows without a number or a time -----------------------------------------------------------------


def paired_by_name(
    sheet: TableRows, truth: TableRows | None, axes: Sequence[str]
) -> tuple[TableRows, TableRows | None, str]:
    """Estimates and truth whose rows a text such as the name of an image pairs, each row a run, and a note.

    They stay as they are where one has a step or a time, or no text is there once for each row.
    """
    both = [sheet] if truth is None else [sheet, truth]
    if any("step" in each or clock_of(list(each.data)) is not None for each in both):
        return sheet, truth, ""
    if truth is None and true_columns(sheet, axes) is None:
        if not {"run", "step"} & set(sheet.data):
            sheet = replace(sheet, data=sheet.data | {"step": np.arange(1.0, len(sheet) + 1)})
        return sheet, truth, ""
    for name, cells in sheet.data.items():
        of_one = sheet.texts("filter").tolist() if "filter" in sheet else [""] * len(sheet)
        own = list(map(str, cells))
        if cells.dtype.kind == "f" or name in ("filter", *axes) or len(set(zip(of_one, own, strict=True))) < len(own):
            continue
        note = f"{sheet.path}: rows are paired by '{name}', and each is a run of its own"
        numbers = {text: float(k) for k, text in enumerate(dict.fromkeys(own))}
        if truth is None:
            return _numbered(sheet, name, numbers), None, note
        if name not in truth or len(set(truth.texts(name))) < len(truth):
            continue
        there = np.isin(own, truth.texts(name).astype(str))
        if not there.any():
            raise InputError(f"{truth.path}: no '{name}' of {sheet.path} is in it, whose first is '{own[0]}'")
        if not there.all():
            missing = [text for text, found in zip(own, there, strict=True) if not found]
            note += f"; {len(missing)} have no truth and are left out ({listed(missing)})"
        true = truth.rows(np.isin(truth.texts(name).astype(str), own))
        return _numbered(sheet.rows(there), name, numbers), _numbered(true, name, numbers), note
    return sheet, truth, ""


def _numbered(sheet: TableRows, name: str, numbers: Mapping[str, float]) -> TableRows:
    runs = np.array([numbers[text] for text in sheet.texts(name)])
    return replace(sheet, data=sheet.data | {"run": runs, "step": np.ones(len(runs))})


# --- times and order ---------------------------------------------------------------------------------


def with_clock(sheet: TableRows, required: bool = True) -> TableRows:
    """The table with a column ``t``, s, of a time by another name; itself where it has none, or ``t``.

    Text in the place of a time is refused if it is ``required``, and not looked at otherwise.
    """
    if "t" in sheet:
        return sheet
    names = list(sheet.data)
    clock = clock_of([name or "index" for name in names])
    if clock is None:
        return sheet
    columns = [names[place] for place in clock.places]
    if not required and any(sheet.data[name].dtype.kind != "f" for name in columns):
        return sheet
    t, _ = times_of(sheet, clock, list(map(sheet.numbers, columns)))
    return replace(sheet, data=sheet.data | {"t": t})


def times_of(rows: FileRows, clock: Clock, columns: Sequence[Array]) -> tuple[Array, int]:
    """Times in s, each the number nearest to what the file says, and how many of its units are a second.

    A double does not hold the nanoseconds since 1970, so that they are read again from a text, as whole numbers.
    """
    unit = 10**9
    rough = columns[0] + columns[-1] / unit
    if len(columns) == 1:
        unit = time_unit(columns[0], clock.unit)
        rough = columns[0] / unit
    if unit < 10**9 or rows.unit != "line" or (np.diff(rows.line) <= 0).any():
        return rough, unit
    wanted = iter(rows.line.tolist())
    row = next(wanted, None)
    t = []
    try:
        for block in blocks(rows.path):
            for number, line in block.lines():
                if number == row:
                    cells = fields_of(line)
                    *seconds, nanoseconds = (int(cells[place]) for place in clock.places)
                    t.append((sum(seconds) * unit + nanoseconds) / unit)
                    row = next(wanted, None)
    except (ValueError, IndexError, OverflowError):
        return rough, unit
    return np.array(t), unit


def row_order(sheet: TableRows, runs: Array, key: str) -> Indices:
    """Rows (N,) by run and then by ``key`` (step or t); ``runs`` (N,) has the run of each row.

    Timestamps must be in order: a jump back is another run or another clock.

    Raises
    ------
    InputError
        A step or a timestamp is duplicated, or a timestamp is less than the one before.
    """
    values = sheet.numbers(key, finite=True, whole=key == "step")
    order = np.lexsort((values, runs))
    if key == "t":
        order = np.argsort(runs, kind="stable")
    is_stuck = (np.diff(runs[order]) == 0) & (np.diff(values[order]) <= 0)
    stuck = np.flatnonzero(is_stuck)
    if not len(stuck):
        return order
    before, row = order[stuck[0] : stuck[0] + 2]
    of = ""
    hint = "; several runs need a column 'run'"
    if named := run_column(list(sheet.data)):
        hint += f"; '{named}' may be it: --columns run={named}"
    if "run" in sheet:
        of = f" of run {runs[row]}"
        hint = ""
        if "filter" not in sheet:
            hint = "; several estimators need a column 'filter'"
    what = "is less than the one before"
    if values[before] == values[row]:
        what = "is duplicated"
    raise InputError(f"{sheet.place(row)}: {key} {exact(values[row])}{of} {what}{hint}")


def by_run(sheet: TableRows, key: str) -> tuple[TableRows, Array]:
    """The rows in the order of :func:`row_order`, and the run of each, (N,): 0 without a column ``run``."""
    runs = np.zeros(len(sheet), int)
    if "run" in sheet:
        runs = sheet.numbers("run", whole=True).astype(int)
    order = row_order(sheet, runs, key)
    return sheet.rows(order), runs[order]


# --- angles ------------------------------------------------------------------------------------------


def without_turns(runs: Sequence[Poses], axes: Sequence[str]) -> tuple[list[Poses], str]:
    """Vectors whose angles do not jump by a whole turn, nor differ by one from the truth, and a note where they did.

    A component is an angle by its name: ``yaw``, ``roll_deg``, ``att_pitch``. It is in radians if no value exceeds a
    turn of these, and in degrees otherwise; values beyond 360 are taken to count turns and stay.
    """
    angles = [i for i, axis in enumerate(axes) if ANGLES & set(axis.lower().split("_"))]
    found = list(runs)
    changed = []
    for i in angles:
        size = max(
            np.nanmax(np.abs(values[:, i]), initial=0.0) for p in runs for values in (p.own.estimate, p.true.values)
        )
        turn = 2.0 * np.pi if size <= 2.0 * np.pi + 1e-6 else 360.0
        rows = 0
        for k, p in enumerate(found if size <= 360.0 else ()):
            rows += int((np.abs(_apart(p, p.true.values[:, i], i)) > LEAST_APART * turn).sum())
            found[k] = _on_one_turn(p, i, turn)
        if rows:
            changed.append(f"{axes[i]} ({plural(rows, 'row')})")
    if not changed:
        return found, ""
    what = f"angles that differ from the truth by a whole turn are turned back: {', '.join(changed)}"
    return found, f"{what}; --error vector leaves them"


def _on_one_turn(p: Poses, i: int, turn: float) -> Poses:
    """The run with one angle on the turn of its truth; the same arrays where nothing changes."""
    column = np.unwrap(p.true.values[:, i], period=turn)
    if (column != p.true.values[:, i]).any():
        truth = p.true.values.copy()
        truth[:, i] = column
        p = p.with_values(truth=truth)
    apart = _apart(p, column, i)
    turns = np.where(np.abs(apart) > LEAST_APART * turn, np.round(apart / turn), 0.0)
    if turns.any():
        estimate = p.own.estimate.copy()
        estimate[:, i] += turn * turns
        p = p.with_values(estimate=estimate)
    return p


def _apart(p: Poses, column: Array, i: int) -> Array:
    """One component of the truth, interpolated, less that of the estimate, (N,)."""
    return np.asarray(np.interp(p.own.t, p.true.t, column) - p.own.estimate[:, i])


# --- covariances and innovations ------------------------------------------------------------------------


def stated_covariance(sheet: TableRows, axes: Sequence[str], entries: Entries) -> Array:
    """(N, n, n) from the upper triangle; a lower triangle beside it must agree."""
    require_columns(sheet, axes)
    names = list(sheet.data)
    n = len(axes)
    out = np.empty((len(sheet), n, n))
    for i, j in itertools.combinations_with_replacement(range(n), 2):
        there = [entries.places[pair] for pair in ((i, j), (j, i)) if pair in entries.places]
        if not there:
            missing = entry_name(axes, i, j)
            what = f"column '{missing}' is missing; the covariance of {', '.join(axes)} needs its upper triangle"
            advice = f"{naming(missing)}; --state a,b judges fewer components"
            raise InputError(f"{sheet.path}: {what}, zeros included; {advice}")
        out[:, i, j] = sheet.numbers(names[there[0]])
        out[:, j, i] = sheet.numbers(names[there[-1]])
    return symmetric(out, sheet.place)


def stated_deviations(sheet: TableRows, entries: Entries) -> Array:
    """Standard deviations (N, n) of a table without cross terms, of columns of these or of variances."""
    names = list(sheet.data)
    values = sheet.matrix(names[place] for place in entries.places.values())
    if entries.squared:
        values = np.sign(values) * np.sqrt(np.abs(values))
    return np.asarray(values)


def own_covariance(sheet: TableRows) -> Array | None:
    """Covariances (N, 3, 3) of a filter's own error, of columns own_P_*; None without them."""
    if not sheet.has(*OWN_COVARIANCE) or any(sheet.empty(name).all() for name in OWN_COVARIANCE):
        return None
    out = np.empty((len(sheet), 3, 3))
    for name, (i, j) in OWN_COVARIANCE.items():
        out[:, i, j] = out[:, j, i] = sheet.numbers(name)
    return out


def stated_cross_covariances(sheet: TableRows) -> Array | None:
    """Cross-covariances with the row before, columns C_xx, C_xy, C_xh, C_yx, ..., (N, 3, 3); None without any."""
    columns = []
    missing = []
    for a, b in itertools.product(POSE, repeat=2):
        short = f"C_{a[0]}{b[0]}"
        there = sheet.among([short, f"C_{a}_{b}"])
        columns += there[:1]
        if not there:
            missing.append(short)
    if not columns:
        return None
    if missing:
        what = f"column '{missing[0]}' is missing; a cross-covariance is not a symmetric matrix"
        raise InputError(f"{sheet.path}: {what}")
    return sheet.matrix(columns).reshape(-1, 3, 3)


def own_column(sheet: TableRows, options: GroupOptions) -> Array | None:
    """Cells of the column of ``--by``, (N,); None where it is of another file, or not asked for."""
    by = options.own_column
    if by is None:
        return None
    if by not in sheet:
        hint = "a table with t or run and the column goes with --by-file"
        raise InputError(f"--by {by}: {sheet.path} has no such column; there are: {sheet.columns}; {hint}")
    return sheet.data[by]


def nis_columns(sheet: TableRows) -> tuple[Array | None, Array | None]:
    """NIS and its degrees of freedom, (N,) each; None without a column ``nis``."""
    if "nis" not in sheet:
        return None, None
    if "nis_dof" not in sheet:
        raise InputError(f"{sheet.path}: column 'nis_dof' is missing; {NIS_DOF}; --dof N is one for all rows")
    nis = sheet.numbers("nis")
    dof = np.where(np.isnan(nis), 0.0, sheet.numbers("nis_dof"))
    return nis, checked_dof(nis, dof, sheet.place)


# --- the NIS, by its own column or by innovations beside their variances ------------------------------

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
        from consistency.referee.diagnostics.whiteness import nis_of

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
