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
    arrays: dict[str, Any] = {"axes": () if axes is None else tuple(axes)}
    if (errors is None) != (covariances is None):
        there, missing = ("covariances", "errors") if errors is None else ("errors", "covariances")
        raise ValueError(f"{there} without {missing}: give both")
    if errors is not None and nees is not None:
        raise ValueError("give errors and covariances, or nees and dof, not both")
    if errors is not None and covariances is not None:
        arrays["error"], arrays["covariance"] = pair(errors, covariances)
        n = arrays["error"].shape[-1]
        if dof is not None and dof != n:
            raise ValueError(f"dof is {dof}, but the errors have {n} components")
        arrays["dof"] = n
    elif nees is not None:
        if dof is None:
            raise ValueError("nees without dof: give dof, the dimension of the error")
        if dof < 1:
            raise ValueError(f"dof must be at least 1, got {dof}")
        arrays |= {"nees": values("nees", nees), "dof": dof}
        for key, value in (("axes", axes), ("subsets", subsets)):
            if value is not None:
                raise ValueError(f"{key} needs errors and covariances: the nees does not know its components")
    arrays |= _innovations(nis, nis_dof, innovations, innovation_covariances)
    first = next((arrays[key] for key in ("error", "nees", "nis") if key in arrays), None)
    if first is None:
        raise ValueError("nothing to judge: give errors and covariances, or nees and dof, or nis and nis_dof")
    for key in ("nis", "innovations"):
        if key in arrays and arrays[key].shape[:2] != first.shape[:2]:
            raise ValueError(f"{key} has {arrays[key].shape[:2]} runs and steps, the errors have {first.shape[:2]}")
    if "dof" not in arrays and not optimal_gain:
        raise ValueError(
            "innovations alone are judged only with optimal_gain=True: those of any other gain are not white, nor of "
            "the stated size, even if the filter is right"
        )
    try:
        return Record(name, **arrays, optimal_gain=optimal_gain).without_first(skip_of(skip))
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


def pair(errors: ArrayLike, covariances: ArrayLike, name: str = "errors", of: str = "covariances") -> tuple[Any, Any]:
    """Errors (runs, steps, n) and covariances (runs, steps, n, n) that can be judged.

    Raises
    ------
    ValueError
        Shapes do not fit; a value is not finite, a covariance not symmetric or not positive definite: named by
        run (from 0) and step (from 1).
    """
    e, P = array(name, errors), array(of, covariances)
    if e.ndim != 3 or 0 in e.shape:
        hint = "; of a single step: errors[:, None, :]" if e.ndim == 2 else ""
        raise ValueError(f"{name} must have shape (runs, steps, n), got {e.shape}{hint}")
    if P.shape != (*e.shape, e.shape[-1]):
        raise ValueError(f"{of} must have shape {(*e.shape, e.shape[-1])} to fit {name} {e.shape}, got {P.shape}")
    require(np.isfinite(e).all(axis=-1), f"{name}: not finite")
    covariance(P, of)
    return e, P


def covariance(P: Array, name: str, there: Array | None = None) -> None:
    """Refuse covariances (runs, steps, n, n) that are none; ``there`` (runs, steps) says which to look at."""
    there = np.ones(P.shape[:2], bool) if there is None else there
    kind = np.where(there, classify(P), Validity.VALID)
    for fault, what in (
        (Validity.NOT_FINITE, "not finite"),
        (Validity.ASYMMETRIC, "not symmetric"),
        (Validity.INDEFINITE, "not positive definite"),
        (Validity.DEFICIENT, "singular; leave out steps in which a component is known exactly"),
    ):
        require(kind != fault, f"{name}: {what}")


def values(name: str, value: ArrayLike, there: Array | None = None) -> Array:
    """Squared norms (runs, steps): finite and not negative, where ``there``."""
    v = array(name, value)
    if v.ndim != 2 or 0 in v.shape:
        raise ValueError(f"{name} must have shape (runs, steps), got {v.shape}")
    there = np.ones(v.shape, bool) if there is None else there
    require(np.isfinite(v) | ~there, f"{name}: not finite")
    require((v >= 0) | ~there, f"{name}: negative")
    return v


def array(name: str, value: ArrayLike) -> Array:
    """Floats, or a ValueError with the name of the argument."""
    try:
        return np.asarray(value, float)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: not an array of numbers with as many steps in each run") from None


def require(good: Any, what: str) -> None:
    """Raise with the first run (from 0) and step (from 1) that is not good, (runs, steps) of bool."""
    if not good.all():
        run, step = (int(i) for i in np.argwhere(~good)[0])
        raise ValueError(f"{what} in run {run}, step {step + 1}")


def _innovations(
    nis: ArrayLike | None, nis_dof: ArrayLike | None, vectors: ArrayLike | None, covariances: ArrayLike | None
) -> dict[str, Any]:
    if (nis is None) != (nis_dof is None):
        raise ValueError("give nis and nis_dof together")
    if (vectors is None) != (covariances is None):
        raise ValueError("give innovations and innovation_covariances together")
    arrays: dict[str, Any] = {}
    if vectors is not None and covariances is not None:
        v, S = array("innovations", vectors), array("innovation_covariances", covariances)
        if v.ndim != 3 or 0 in v.shape or S.shape != (*v.shape, v.shape[-1]):
            raise ValueError(
                "innovations and innovation_covariances must have shapes (runs, steps, m) and (runs, steps, m, m), "
                f"got {v.shape} and {S.shape}"
            )
        there: Array = ~np.asarray(np.isnan(v).all(axis=-1))  # a step without a measurement has no innovation
        require(np.isfinite(v).all(axis=-1) | ~there, "innovations: not finite")
        covariance(S, "innovation_covariances", there)
        arrays |= {"innovations": v, "innovation_covariances": S}
        if nis is None:
            arrays["nis"], arrays["nis_dof"] = nis_of(v, S)
    if nis is not None and nis_dof is not None:
        dof = array("nis_dof", nis_dof)
        shape = np.shape(nis)
        if dof.ndim not in (0, 2) or (dof.ndim == 2 and dof.shape != shape):
            raise ValueError(f"nis_dof must be a number or have the shape of nis, {shape}, got {dof.shape}")
        dof = np.broadcast_to(dof, shape)
        if not (np.isfinite(dof).all() and (dof >= 0).all() and (dof == np.round(dof)).all()):
            raise ValueError("nis_dof must hold whole numbers, 0 where there was no innovation")
        counts: Indices = dof.astype(np.int64)
        arrays |= {"nis": values("nis", nis, counts > 0), "nis_dof": counts}
    return arrays
