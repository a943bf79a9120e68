"""NumPy archives (.npz): arrays over (runs, steps)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.diagnostics.records.record import Record
from consistency.referee.errors import InputError
from consistency.referee.geometry.conventions import PLANAR
from consistency.referee.readers.formats.archive_arrays import KINDS, Archive, load_arrays, require_layout, swapped
from consistency.referee.readers.formats.sheet import are_dof
from consistency.referee.readers.mix_ups.hints import turns
from consistency.referee.readers.options import Reading
from consistency.referee.readers.places import Places
from consistency.referee.readers.runs_to_record import symmetric
from consistency.referee.readers.truth_matching import Estimator, Poses, at, manifold_of, unstated
from consistency.referee.types import Array, Failure, Indices

OF_ERRORS, OF_POSES, OF_NEES = ("errors", "covariances"), ("estimates", "truth", "covariances"), ("nees", "dof")
PLANAR_POSE = ("x", "y", "heading")
OF_STATES = {"R", "p", "v"}  # of an inertial filter
BY_STEP: dict[str, Any] = {  # n NEES / dof of a step with n, the smallest dof, has the mean n and less spread than n
    "unavailable": ("distribution",),
    "caption": "the NEES of each step counts over its degrees of freedom, and its distribution is not judged",
}
OPTIONAL = {"nis", "nis_dof", "axes", "t", "lengths", "mask", "cross_covariances", "truth_covariances"}


def read_archive(path: Path, r: Reading, poses_alone: bool = False) -> list[Estimator | Record]:
    """The estimator of an archive; its record where it holds NEES.

    ``errors`` (runs, steps, n) with ``covariances`` (runs, steps, n, n); or ``estimates`` and ``truth``, both
    (runs, steps, n), with ``covariances``; or ``nees`` (runs, steps) with ``dof``. One run may lack the first
    dimension. Optional: ``nis`` and ``nis_dof`` (runs, steps), ``axes`` (n,), ``t`` (steps,), and ``lengths``
    (runs,), the number of steps of each run, where they differ, and ``mask`` (runs, steps), true where there is no
    truth, so that the step does not count. With ``--relative`` estimates and truth are planar
    poses, or estimates are motions; ``cross_covariances`` (runs, steps, 3, 3) are those with the step before. States of
    inertial filters have keys of their own (:mod:`consistency.referee.readers.formats.inertial_archive`).

    Parameters
    ----------
    poses_alone : covariances are not looked at
    """
    arrays = load_arrays(path)
    if poses_alone:
        return [_poses_of_arrays(Archive(path, arrays))]
    if not set(arrays) >= OF_STATES:
        return [estimator_of_arrays(path, arrays, r)]
    from consistency.referee.readers.formats.inertial_archive import extended_errors

    errors, definition = extended_errors(path, arrays, r.error)
    one = estimator_of_arrays(path, errors, replace(r, error=None))
    assert isinstance(one, Estimator)
    return [replace(one, convention=r.error or "", definition=definition)]


def steps_of(of: Path | str, run: int, rows: Indices) -> Places:
    """Places of steps of a run in arrays."""
    return Places(lambda row: f"{of}, run {run}, step {row + 1}", rows)


# --- estimators and records --------------------------------------------------------------------------


def estimator_of_arrays(path: Path, arrays: Mapping[str, Array], r: Reading) -> Estimator | Record:
    """The estimator of arrays by key, or its record where they are NEES; ``path`` names it in messages."""
    archive = Archive(path, arrays)
    kind = _kind(archive, r)
    if kind == OF_NEES:
        found = _of_nees(archive)
        assert found.nees is not None
        return replace(found, by=archive.groups(r, found.nees.shape))
    declared = ""
    if kind != OF_NEES:
        require_layout(kind[0], arrays[kind[0]].shape, arrays["covariances"].shape, f"{path}: ")
    if kind == OF_ERRORS:
        truth = archive.array("errors", 3)
        estimates = np.where(np.isfinite(truth), 0.0, np.nan)
    else:
        estimates, truth = archive.estimates_and_truth()
        declared = _convention(archive, r, estimates.shape[-1])
    runs, steps, n = estimates.shape
    shape = (runs, steps, n, n)
    by = archive.groups(r, (runs, steps))
    covariances = archive.matrices("covariances", shape)
    there = archive.known(runs, steps)
    if kind == OF_POSES:
        truth = _finite_truth(path, estimates, truth, there)
    nis, dof = archive.nis((runs, steps))
    of_truth = cross = None
    if "truth_covariances" in archive:
        of_truth = archive.matrices("truth_covariances", shape)
    if "cross_covariances" in archive and r.relative is not None and not r.motions:
        cross = archive.matrices("cross_covariances", shape)
    convention = declared or "vector"
    poses = []
    for one in _runs(archive, estimates, truth, there):
        steps_of_run = (one.run, slice(len(one.t)))
        rows = np.flatnonzero(there[steps_of_run])
        place = one.place.at(rows).__getitem__
        P = np.full((len(one.t), n, n), np.nan)
        P[rows] = symmetric(covariances[one.run, rows], place)
        T = None
        if of_truth is not None:
            T = symmetric(of_truth[one.run, rows], place)
        of_steps = {"nis": nis, "nis_dof": dof, "cross": cross, "by": by}
        own: dict[str, Any] = {key: at(values, steps_of_run) for key, values in of_steps.items()}
        stated = np.ones(len(P), bool)
        manifold = manifold_of(convention)
        own |= {"covariance": P, "stated": stated, "true_covariance": T, "manifold": manifold, "convention": convention}
        poses.append(replace(one, **own))
    axes = archive.axes(n)
    gap = np.where(there[..., None], truth - estimates, np.nan)
    causes = swapped(path.stem, gap)
    if convention == "vector":
        remedy = "wrap it to [-pi, pi]"
        if declared and n == 3:
            remedy = "add --error so2, if these are x, y, heading"
        causes += turns(path.stem, axes, gap, covariances, remedy)
    if r.relative is not None:  # poses, or motions of them
        axes = PLANAR_POSE
    definition = PLANAR.get(declared, "")
    return Estimator(path.stem, path, poses, axes, declared, definition, causes=causes, t=archive.times(steps))


def _kind(archive: Archive, r: Reading) -> tuple[str, ...]:
    """The keys that an archive holds.

    Raises
    ------
    InputError
        It holds none of the kinds, another key beside one, or an option does not go with it.
    """
    path = archive.path
    keys = set(archive.arrays)
    kind = next((needed for needed in (OF_ERRORS, OF_POSES, OF_NEES) if set(needed) <= keys), None)
    if kind is None:
        raise InputError(f"{path}: needs {KINDS}; it holds {', '.join(sorted(keys)) or 'nothing'}")
    unknown = sorted(keys - set(kind) - OPTIONAL)
    if unknown and r.by is None:
        raise InputError(f"{path}: key '{unknown[0]}' does not go with {', '.join(kind)}; needs {KINDS}")
    if r.error is not None and kind != OF_POSES:
        raise InputError(f"--error: {path} holds {kind[0]}, whose convention is settled already")
    if r.relative is not None and kind != OF_POSES:
        raise InputError(f"{path}: --relative needs the keys {', '.join(OF_POSES)}, of poses or motions")
    return kind


def _convention(archive: Archive, r: Reading, n: int) -> str:
    """The error of estimates of n components; "vector" unless another is declared, "so2" of motions over windows."""
    convention = r.error or ("vector" if r.relative is None else "so2")
    if r.error is not None and (convention not in PLANAR or (convention != "vector" and n != 3)):
        raise InputError(f"--error {convention}: here it is 'vector', or so2, left or right for x, y, heading")
    if r.relative is not None and (n != 3 or convention == "vector"):
        raise InputError(f"{archive.path}: --relative needs poses x, y, heading, with --error so2, left or right")
    return convention


def _finite_truth(path: Path, estimates: Array, truth: Array, known: Array) -> Array:
    """The truth, 0 where it is not finite beside a broken estimate.

    Raises
    ------
    InputError
        It is not finite beside an estimate that is.
    """
    finite: Array = np.asarray(np.isfinite(truth).all(axis=-1))
    bad = known & np.isfinite(estimates).all(axis=-1) & ~finite
    if bad.any():
        run, step = np.argwhere(bad)[0]
        where = f"{path}: key 'truth', run {run}, step {step + 1}"
        raise InputError(f"{where}: not finite; 'mask' is true where there is none")
    return truth if finite.all() else np.where(finite[..., None], truth, 0.0)


def _poses_of_arrays(archive: Archive) -> Estimator:
    """Planar poses of an archive with the keys ``estimates`` and ``truth``."""
    path = archive.path
    for key in ("estimates", "truth"):
        if key not in archive:
            raise InputError(f"{path}: key '{key}' is missing; needs estimates and truth, (runs, steps, 3)")
    estimates, truth = archive.estimates_and_truth()
    runs, steps, n = estimates.shape
    if n != 3:
        raise InputError(f"{path}: estimates {estimates.shape} and truth {truth.shape} must both be (runs, steps, 3)")
    there = archive.known(runs, steps) & np.isfinite(truth).all(axis=-1)
    poses = list(_runs(archive, estimates, truth, there))
    return Estimator(path.stem, path, poses, PLANAR_POSE, t=archive.times(steps))


def _runs(archive: Archive, estimates: Array, truth: Array, there: Array) -> Iterator[Poses]:
    """Estimates (runs, steps, n) and their truth where it is ``there``, without covariances, in the plane."""
    path = archive.path
    runs, steps, n = estimates.shape
    clock = archive.times(steps)
    for run, length in enumerate(archive.lengths(runs, steps)):
        t = np.arange(float(length))
        covariance, stated = unstated(length, n)
        beside = Poses(
            place=steps_of(path, run, np.arange(length)),
            t=t,
            estimate=estimates[run, :length],
            covariance=covariance,
            stated=stated,
            true_t=t,
            truth=truth[run, :length],
            manifold="planar",
            convention="left",
            max_dt=0.0,
            run=run,
            name=path.stem if runs == 1 else f"run {run}",
            files=(path, path),
            numbered=True,
            clock=clock[:length],
        )
        known = there[run, :length]
        yield beside if known.all() else beside.beside(np.flatnonzero(known))


def _of_nees(archive: Archive) -> Record:
    """NEES without errors: NaN before the first value is a start known exactly, NaN later a failure."""
    path = archive.path
    nees = archive.array("nees", 2).copy()
    dof = archive.whole_numbers("dof", nees.shape)
    if not (are_dof(dof) & (dof >= 1)).all():
        what = "one whole number of 1 or more, the dimension of the error, or one for each step"
        raise InputError(f"{path}: key 'dof' must be {what}")
    for run, step in np.argwhere(nees < 0):
        raise InputError(f"{path}: key 'nees', run {run}, step {step + 1}: {nees[run, step]:g} is negative")
    runs, steps = nees.shape
    n = int(dof.min())
    by_step = BY_STEP if (dof != dof[0, 0]).any() else {}
    nees *= n / dof
    nis, nis_dof = archive.nis((runs, steps))
    known = archive.known(runs, steps)
    failures = []
    nees[~known] = np.nan
    for run in range(runs):
        finite = np.isfinite(nees[run])
        begun = np.logical_or.accumulate(finite) | ~finite.any()
        broken = np.flatnonzero(begun & known[run] & ~finite)
        if len(broken):
            step = int(broken[0])
            nees[run, step:] = np.nan
            failures.append(Failure(path.stem, run, step + 1, "NEES is not finite"))
    return Record(
        path.stem,
        nees=nees,
        dof=n,
        nis=nis,
        nis_dof=nis_dof,
        failures=tuple(failures),
        axes=archive.axes(n),
        runs=np.arange(runs),
        t=archive.times(steps),
        **by_step,
    )
