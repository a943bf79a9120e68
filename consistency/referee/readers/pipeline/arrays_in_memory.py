"""Arrays in memory as a record, checked as those of an archive are."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from consistency.referee.diagnostics.number_words import is_or_are
from consistency.referee.diagnostics.record import Record, each_alone
from consistency.referee.diagnostics.whitening import diagonal
from consistency.referee.errors import InputError
from consistency.referee.parsing import require_name
from consistency.referee.readers.formats.archives import estimator_of_arrays, first_known, require_layout
from consistency.referee.readers.options import REPEATS, Reading
from consistency.referee.readers.pipeline.records import records_of
from consistency.referee.readers.truth_matching import Estimator
from consistency.referee.types import Array, Indices


def record_of_statement(
    errors: ArrayLike | None,
    stated: Mapping[str, ArrayLike],
    members: ArrayLike | None,
    truth: ArrayLike | str | None,
    axes: Sequence[str] | None,
    name: str,
    independent: bool,
    reading: Reading,
) -> Record:
    """Errors beside what is ``stated`` of them, members with their truth, or repeats, as a record.

    Raises
    ------
    InputError
        Arguments that do not go together, and as :func:`record_of_arrays`.
    """
    given: dict[str, ArrayLike]
    if members is not None:
        if truth is None or isinstance(truth, str) or errors is not None or stated:
            raise InputError("members: need truth=, (runs, steps, n), beside them, and nothing else")
        given = {"members": members, "truth": truth}
    elif truth is None:
        given = {"errors": cast(ArrayLike, errors), **stated}
    elif isinstance(truth, str) and truth == REPEATS and stated and errors is not None:
        given = {"estimates": errors, **stated}
    else:
        raise InputError("truth: goes with members=; or is 'repeats', beside estimates with covariances")
    return record_of_arrays(given, axes, name, independent, reading)


def record_of_arrays(
    given: Mapping[str, ArrayLike],
    axes: Sequence[str] | None,
    name: str,
    independent: bool = False,
    reading: Reading | None = None,
) -> Record:
    """Arrays in memory as a record, like those of an archive; see :func:`consistency.judge`.

    Parameters
    ----------
    given : errors or estimates with covariances or deviations, or members with truth, or nees with dof; estimates are
        repeats of the same true values. Steps that are masked in a masked array of any
        of them have no truth and do not count
    independent : rows are runs, which the record has as steps of one run: :func:`rows_as_runs` makes runs of them
    reading : level of bounds, and what is declared of them

    Raises
    ------
    InputError
        Shapes that do not fit, a step that is masked in part, a covariance that is not symmetric, a step that is not
        finite in any run.
    """
    first = next(iter(given))
    are_repeats = first == "estimates"
    reading = (reading or Reading()).with_options(independent=(independent and not are_repeats) or None)
    arrays = {key: in_memory(key, value) for key, value in given.items()}
    if independent:
        if arrays[first].ndim == 3 and first == "errors":  # of runs whose steps are independent, too
            arrays = {key: array.reshape(-1, *array.shape[2:]) for key, array in arrays.items()}
        if first != "members":  # whose shapes are compared below
            _require_rows(first, {key: array.shape for key, array in arrays.items()})
        arrays = {key: np.expand_dims(array, 1 if are_repeats else 0) for key, array in arrays.items()}
    if first in ("errors", "estimates") and "covariances" in arrays:
        require_layout(first, arrays[first].shape, arrays["covariances"].shape)
    shape = arrays[first].shape
    wanted = ["runs", "steps"]
    if first == "members":
        wanted.append("m")
    if first != "nees":
        wanted.append("n")
    if len(shape) != len(wanted) or 0 in shape:
        text = f"{first} has shape {shape}, needs ({', '.join(wanted)})"
        if len(shape) == len(wanted) - 1:
            names = [key for key in given if key != "dof"]
            one = "[None] and ".join(names)
            row = "[:, None] and ".join(names)
            text += (
                f": {one}[None] {is_or_are(len(names))} one run of many steps; {row}[:, None], or independent=True of "
                "cs.judge, says that each row is a run of its own, which the steps of a log are not"
            )
        raise InputError(text)
    if are_repeats:
        own = arrays.pop(first)
        arrays = {"errors": first_known(own) - own, **arrays}  # from any one value: what all share is lost
    sigma = arrays.pop("deviations", None)
    if sigma is not None:
        if sigma.shape != shape:
            raise InputError(f"deviations has shape {sigma.shape}, needs that of {first}, {shape}")
        arrays["covariances"] = diagonal(sigma)
    mask = np.zeros(shape[:2], bool)
    try:
        for key, value in given.items():
            mask |= masked_steps(key, value, shape[:2])
    except InputError as error:
        raise InputError(str(error).replace("run 0, step", "row") if independent else str(error)) from None
    for key, array in arrays.items():
        if array.ndim < 2 or array.shape[:2] != shape[:2]:  # shapes that do not fit are refused below
            continue
        there = np.isfinite(array).reshape(*array.shape[:2], -1).all(axis=-1)
        never = ~(there | mask).any(axis=0)
        if never.any() and not independent:
            step = int(np.argmax(never)) + 1
            if sigma is not None and key == "covariances":
                key = "deviations"
            raise InputError(f"{key}, step {step}: not finite in any run; a run that failed has NaN from there on")
    if mask.any():
        arrays["mask"] = mask
    if axes is not None:
        arrays["axes"] = np.asarray(axes, str)
    try:
        record = estimator_of_arrays(Path("arrays"), arrays, reading)
        if isinstance(record, Estimator):
            (record,) = records_of(record, reading)
        if sigma is not None and not record.errors.bounded:
            record = each_alone(record)
        if reading.statement.ensemble is not None or are_repeats:
            from consistency.referee.diagnostics.normal_numbers import of_ensemble, of_repeats

            if are_repeats:
                record = of_repeats(record)
            if reading.statement.ensemble is not None:
                record = of_ensemble(record, reading.statement.ensemble)
    except InputError as error:
        raise InputError(_in_python(str(error), sigma is not None)) from None
    failures = tuple(replace(failure, filter=name) for failure in record.failures)
    return replace(record, name=require_name(name, "name"), failures=failures)


def _in_python(message: str, deviations: bool) -> str:
    """A message on an archive as one on arguments: "key 'nees'" is nees."""
    text = re.sub(r"(?:arrays: )?key '(\w+)'", r"\1", message)
    return re.sub(r"\bcovariances?\b", "deviations", text) if deviations else text


def _require_rows(first: str, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Refuse errors or estimates and what is stated of them, each row a run, if their shapes do not fit."""
    shape = shapes[first]
    if len(shape) != 2 or 0 in shape:
        text = f"{first} has shape {shape}, needs (N, n) with independent=True"
        if len(shape) == 1:
            stated = "covariances[:, None, None] of its variances"
            if "deviations" in shapes:
                stated = "deviations[:, None]"
            text += f"; one component is {first}[:, None] and {stated}"
        raise InputError(text)
    for key, own in shapes.items():
        needs = (*shape, shape[1]) if key.endswith("covariances") else shape
        if own == needs or (key == "bounds" and own == shape[:1]):
            continue
        remedy = ""
        if own == needs[1:]:
            remedy = f"; one for all rows is np.broadcast_to({key}, {needs})"
        elif own == shape:
            remedy = f"; variances are {key}[:, :, None] * np.eye({shape[1]}), standard deviations go into deviations="
        raise InputError(f"{key} has shape {own}, needs {needs} beside {first} of shape {shape}{remedy}")


def masked_steps(key: str, value: ArrayLike, shape: tuple[int, ...]) -> Indices:
    """Steps that a masked array leaves out, (runs, steps); none of any other array.

    Raises
    ------
    InputError
        A step is masked in part: it could not count with the components that are known alone.
    """
    if not np.ma.is_masked(value) or np.size(value) % math.prod(shape):  # shapes that do not fit are refused later
        return np.zeros(shape, bool)
    masked = np.ma.getmaskarray(np.ma.asarray(value)).reshape(*shape, -1)
    some = masked.any(axis=-1)
    partly = some & ~masked.all(axis=-1)
    if partly.any():
        run, step = np.argwhere(partly)[0]
        raise InputError(
            f"{key}, run {run}, step {step + 1}: {masked[run, step].sum()} of {masked.shape[-1]} numbers are masked; "
            "mask all of a step without a value, and judge components that are known in other steps than the rest by "
            "themselves, each group in arrays of its own"
        )
    return np.asarray(some)


def in_memory(key: str, value: ArrayLike) -> Array:
    """Floats; raises InputError with the name of the argument."""
    try:
        return np.asarray(value, float)
    except (TypeError, ValueError):
        raise InputError(f"{key}: not an array of numbers with as many steps in each run; pad runs with NaN") from None
