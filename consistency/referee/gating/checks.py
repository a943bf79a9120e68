"""Checks of the input of a gate, with messages that name run and step; checked input goes to the referee."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from consistency.referee.diagnostics import Record, nis_of
from consistency.referee.diagnostics.skipping import Skip, skip_of
from consistency.referee.diagnostics.validity import Validity, classify
from consistency.referee.errors import InputError
from consistency.referee.readers.archive import in_memory, record_of_arrays
from consistency.referee.types import Array, Indices
from consistency.referee.verdicts.sources import Results, source_of


def checked(
    name: str,
    errors: ArrayLike | None = None,
    covariances: ArrayLike | None = None,
    nees: ArrayLike | None = None,
    dof: int | None = None,
    nis: ArrayLike | None = None,
    nis_dof: ArrayLike | None = None,
    innovations: ArrayLike | None = None,
    innovation_covariances: ArrayLike | None = None,
    axes: Sequence[str] | None = None,
    subsets: Mapping[str, Sequence[int]] | None = None,
    optimal_gain: bool = False,
    skip: str | float | Skip | None = None,
) -> Record:
    """One estimator with checked arrays; arguments and errors as :func:`consistency.testing.assert_consistent`."""
    if (errors is None) != (covariances is None):
        there, missing = ("covariances", "errors") if errors is None else ("errors", "covariances")
        raise ValueError(f"{there} without {missing}: give both")
    if errors is not None and nees is not None:
        raise ValueError("give errors and covariances, or nees and dof, not both")
    if nees is not None and dof is None:
        raise ValueError("nees without dof: give dof, the dimension of the error")
    for key, value in (("axes", axes), ("subsets", subsets)):
        if value is not None and errors is None:
            raise ValueError(f"{key} needs errors and covariances: the nees does not know its components")
    record, given = Record(name), {"errors": errors, "covariances": covariances, "nees": nees}
    stated = {key: value for key, value in given.items() if value is not None}
    if stated:
        record = record_of_arrays(stated if nees is None or dof is None else {**stated, "dof": dof}, axes, name)
        if dof is not None and dof != record.dof:
            raise ValueError(f"dof is {dof}, but the errors have {record.dof} components")
    arrays = _innovations(nis, nis_dof, innovations, innovation_covariances, _failed(record))
    if not stated and not arrays:
        raise ValueError("nothing to judge: give errors and covariances, or nees and dof, or nis and nis_dof")
    if not stated and not optimal_gain:
        raise ValueError(
            "innovations alone are judged only with optimal_gain=True: those of any other gain are not white, nor of "
            "the stated size, even if the filter is right"
        )
    try:
        return replace(record, **arrays, optimal_gain=optimal_gain).without_first(skip_of(skip))
    except InputError as error:
        raise ValueError(str(error).removeprefix("--")) from None


def planned_dof(record: Record) -> int:
    """Degrees of freedom that one run is sure to bring: of an error, or else of the innovations of a run."""
    if record.dof or record.nis_dof is None:
        return record.dof
    return max(1, int(record.nis_dof.sum(axis=1).min()))


def of_results(
    results: Results, filter_name: str | None, name: str | None = None, skip: str | float | Skip | None = None
) -> Record:
    """One filter of the bench's own results, with its failed runs.

    Steps whose covariance is rank-deficient are left out, as everywhere in the bench.

    Raises
    ------
    ValueError
        No results, no such filter, or more than one to choose from; ``skip`` leaves nothing.
    """
    if not hasattr(results, "batches"):
        raise ValueError("filter names one in the results of consistency.run_trials; give those in place of errors")
    if filter_name is None:
        if len(results.filters) != 1:
            raise ValueError(f"filter: name one of {', '.join(results.filters)}")
        filter_name = results.filters[0]
    record = source_of(results).record(filter_name).without_first(skip_of(skip))
    return replace(record.errors_alone, name=name or filter_name)


# --- arrays ----------------------------------------------------------------------------------------


def _failed(record: Record) -> Array | None:
    """Steps of runs from their failure on, (runs, steps) of bool; None without errors or NEES."""
    if record.nees is None:
        return None
    gone = np.zeros(record.nees.shape, bool)
    for failure in record.failures:
        gone[failure.run, failure.step - 1 :] = True
    return gone


def _without(gone: Array | None, name: str, value: ArrayLike) -> Array:
    """Floats (runs, steps, ...) of innovations, NaN in steps that are ``gone`` with the errors."""
    array = in_memory(name, value)
    if gone is None:
        return array
    if array.shape[:2] != gone.shape:
        raise ValueError(f"{name} has {array.shape[:2]} runs and steps, the errors have {gone.shape}")
    return np.where(gone.reshape(*gone.shape, *(1,) * (array.ndim - 2)), np.nan, array)


def _covariances(P: Array, name: str, there: Array) -> None:
    """Refuse covariances (runs, steps, m, m) that are none; ``there`` (runs, steps) says which to look at."""
    kind = np.where(there, classify(P), Validity.VALID)
    for fault, what in (
        (Validity.NOT_FINITE, "not finite"),
        (Validity.ASYMMETRIC, "not symmetric"),
        (Validity.INDEFINITE, "not positive definite"),
        (Validity.DEFICIENT, "singular"),
    ):
        _require(kind != fault, f"{name}: {what}")


def _require(good: Any, what: str) -> None:
    """Raise with the first run (from 0) and step (from 1) that is not good, (runs, steps) of bool."""
    if not good.all():
        run, step = (int(i) for i in np.argwhere(~good)[0])
        raise ValueError(f"{what} in run {run}, step {step + 1}")


def _innovations(
    nis: ArrayLike | None, nis_dof: ArrayLike | None, vectors: ArrayLike | None, covariances: ArrayLike | None,
    gone: Array | None,
) -> dict[str, Any]:  # fmt: skip
    """Checked innovations by their names in a record, without the steps that are ``gone``."""
    if (nis is None) != (nis_dof is None):
        raise ValueError("give nis and nis_dof together")
    if (vectors is None) != (covariances is None):
        raise ValueError("give innovations and innovation_covariances together")
    arrays: dict[str, Any] = {}
    if vectors is not None and covariances is not None:
        v, S = _without(gone, "innovations", vectors), in_memory("innovation_covariances", covariances)
        if v.ndim != 3 or 0 in v.shape or S.shape != (*v.shape, v.shape[-1]):
            raise ValueError(
                "innovations and innovation_covariances must have shapes (runs, steps, m) and (runs, steps, m, m), "
                f"got {v.shape} and {S.shape}"
            )
        there: Array = ~np.asarray(np.isnan(v).all(axis=-1))  # a step without a measurement has no innovation
        _require(np.isfinite(v).all(axis=-1) | ~there, "innovations: not finite")
        _covariances(S, "innovation_covariances", there)
        arrays |= {"innovations": v, "innovation_covariances": S}
        if nis is None:
            arrays["nis"], arrays["nis_dof"] = nis_of(v, S)
    if nis is not None and nis_dof is not None:
        arrays |= dict(zip(("nis", "nis_dof"), _nis(_without(gone, "nis", nis), nis_dof, gone), strict=True))
    return arrays


def _nis(nis: Array, nis_dof: ArrayLike, gone: Array | None) -> tuple[Array, Indices]:
    """NIS and its degrees of freedom, (runs, steps), which are 0 where it does not count."""
    if nis.ndim != 2 or 0 in nis.shape:
        raise ValueError(f"nis must have shape (runs, steps), got {nis.shape}")
    dof = in_memory("nis_dof", nis_dof)
    if dof.ndim not in (0, 2) or (dof.ndim == 2 and dof.shape != nis.shape):
        raise ValueError(f"nis_dof must be a number or have the shape of nis, {nis.shape}, got {dof.shape}")
    dof = np.where(False if gone is None else gone, 0.0, np.broadcast_to(dof, nis.shape))
    if not (np.isfinite(dof).all() and (dof >= 0).all() and (dof == np.round(dof)).all()):
        raise ValueError("nis_dof must hold whole numbers, 0 where there was no innovation")
    counts: Indices = dof.astype(np.int64)
    _require(np.isfinite(nis) | (counts == 0), "nis: not finite")
    _require((nis >= 0) | (counts == 0), "nis: negative")
    return nis, counts
