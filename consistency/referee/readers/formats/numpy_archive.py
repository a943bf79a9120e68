"""NumPy archives (.npz): arrays over (runs, steps)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.diagnostics.records.groups import on_steps
from consistency.referee.diagnostics.records.record import Record, numbered_axes
from consistency.referee.errors import InputError
from consistency.referee.geometry.conventions import PLANAR
from consistency.referee.parsing import is_file, reading, require_name, require_room
from consistency.referee.readers.formats.sheet import are_dof, bounded
from consistency.referee.readers.mix_ups.hints import turns
from consistency.referee.readers.options import Reading
from consistency.referee.readers.places import Places
from consistency.referee.readers.runs_to_record import symmetric
from consistency.referee.readers.truth_matching import Estimator, Poses, at, manifold_of, unstated
from consistency.referee.types import Array, Failure, Indices

KINDS = "errors and covariances; or estimates, truth and covariances; or nees and dof"
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
        return [_of_poses(path, arrays)]
    if not set(arrays) >= OF_STATES:
        return [estimator_of_arrays(path, arrays, r)]
    from consistency.referee.readers.formats.inertial_archive import extended_errors

    errors, definition = extended_errors(path, arrays, r.error)
    one = estimator_of_arrays(path, errors, replace(r, error=None))
    assert isinstance(one, Estimator)
    return [replace(one, convention=r.error or "", definition=definition)]


def estimator_of_arrays(path: Path, arrays: dict[str, Array], r: Reading) -> Estimator | Record:
    """The estimator of arrays by key, or its record where they are NEES; ``path`` names it in messages."""
    kind = next((keys for keys in (OF_ERRORS, OF_POSES, OF_NEES) if set(keys) <= set(arrays)), None)
    if kind is None:
        raise InputError(f"{path}: needs {KINDS}; it holds {', '.join(sorted(arrays)) or 'nothing'}")
    unknown = sorted(set(arrays) - set(kind) - OPTIONAL)
    if unknown and r.by is None:
        raise InputError(f"{path}: key '{unknown[0]}' does not go with {', '.join(kind)}; needs {KINDS}")
    if r.error is not None and kind != OF_POSES:
        raise InputError(f"--error: {path} holds {kind[0]}, whose convention is settled already")
    if r.relative is not None and kind != OF_POSES:
        raise InputError(f"{path}: --relative needs the keys {', '.join(OF_POSES)}, of poses or motions")
    if kind == OF_NEES:
        found = _of_nees(path, arrays)
        assert found.nees is not None
        return replace(found, by=_column(path, arrays, r, found.nees.shape))
    if kind == OF_ERRORS:
        truth, declared = _array(path, arrays, "errors", 3), ""
        estimates = np.where(np.isfinite(truth), 0.0, np.nan)
    else:
        estimates, truth = _both(path, arrays)
        declared = _convention(r, estimates.shape[-1])
        _require_poses(path, estimates, declared, r)
    runs, steps, n = estimates.shape
    by = _column(path, arrays, r, (runs, steps))
    covariances = _matrices(path, arrays, "covariances", (runs, steps, n, n))
    there = _known(path, arrays, runs, steps)
    if kind == OF_POSES:
        truth = _finite_truth(path, estimates, truth, there)
    convention = declared or "vector"
    nis, dof = _nis(path, arrays, (runs, steps))
    of_truth, cross = None, None
    if "truth_covariances" in arrays:
        of_truth = _matrices(path, arrays, "truth_covariances", covariances.shape)
    if "cross_covariances" in arrays and r.relative is not None and not r.motions:
        cross = _matrices(path, arrays, "cross_covariances", covariances.shape)
    clock, axes, poses = step_times(path, arrays, steps), _axes(path, arrays, n), []
    if r.relative is not None:  # poses, or motions of them
        axes = PLANAR_POSE
    for run, length in enumerate(run_lengths(path, arrays, runs, steps)):
        place, known = steps_of(path, run, np.arange(length)), there[run, :length]
        one = _beside(path, place, estimates[run, :length], truth[run, :length], known, clock)
        rows, P, T = np.flatnonzero(known), np.full((length, n, n), np.nan), None
        P[rows] = symmetric(covariances[run, rows], place.at(rows).__getitem__)
        if of_truth is not None:
            T = symmetric(of_truth[run, rows], place.at(rows).__getitem__)
        its = (run, slice(length))
        poses.append(
            replace(
                one, covariance=P, stated=np.ones(length, bool), manifold=manifold_of(convention),
                convention=convention, run=run, true_covariance=T, nis=at(nis, its), nis_dof=at(dof, its),
                cross=at(cross, its), by=at(by, its),
            )
        )  # fmt: skip
    causes = []
    if convention == "vector":
        remedy = "wrap it to [-pi, pi]"
        if declared and n == 3:
            remedy = "add --error so2, if these are x, y, heading"
        gap = np.where(there[..., None], truth - estimates, np.nan)
        causes = turns(path.stem, axes, gap, covariances, remedy)
    definition = PLANAR[declared] if declared else ""
    return Estimator(path.stem, path, poses, axes, declared, definition, causes=causes, t=clock)


def _column(path: Path, arrays: dict[str, Array], r: Reading, shape: tuple[int, ...]) -> Array | None:
    """Cells of the key of ``--by``, (runs, steps); a value for each run stands in all of its steps."""
    if r.by is None or r.by_file is not None:
        return None
    if r.by not in arrays:
        raise InputError(f"--by {r.by}: {path} has no such key; it holds {', '.join(sorted(arrays))}")
    try:
        return on_steps(arrays[r.by], shape)
    except ValueError as error:
        raise InputError(f"{path}: key '{r.by}' {error}") from None


def _of_poses(path: Path, arrays: dict[str, Array]) -> Estimator:
    """Planar poses of an archive with the keys ``estimates`` and ``truth``."""
    if missing := [key for key in ("estimates", "truth") if key not in arrays]:
        raise InputError(f"{path}: key '{missing[0]}' is missing; needs estimates and truth, (runs, steps, 3)")
    estimates, truth = (_array(path, arrays, key, 3) for key in ("estimates", "truth"))
    if estimates.shape != truth.shape or estimates.shape[-1] != 3:
        raise InputError(f"{path}: estimates {estimates.shape} and truth {truth.shape} must both be (runs, steps, 3)")
    runs, steps, _ = estimates.shape
    there = _known(path, arrays, runs, steps) & np.isfinite(truth).all(axis=-1)
    clock, poses = step_times(path, arrays, steps), []
    for run, length in enumerate(run_lengths(path, arrays, runs, steps)):
        place, known = steps_of(path, run, np.arange(length)), there[run, :length]
        one = _beside(path, place, estimates[run, :length], truth[run, :length], known, clock)
        poses.append(replace(one, name=f"run {run}" if runs > 1 else path.stem))
    return Estimator(path.stem, path, poses, PLANAR_POSE, t=clock)


def _beside(path: Path, place: Places, estimate: Array, truth: Array, known: Array, clock: Array) -> Poses:
    """Estimates (T, n) of one run and their truth where it is ``known``, without covariances, in the plane."""
    steps, n = estimate.shape
    t = np.arange(float(steps))
    true_t = t
    if not known.all():
        true_t, truth = t[known], truth[known]
    return Poses(
        place, t, estimate, *unstated(steps, n), true_t, truth, "planar", "left", 0.0, files=(path, path),
        numbered=True, clock=clock[:steps],
    )  # fmt: skip


def _both(path: Path, arrays: dict[str, Array]) -> tuple[Array, Array]:
    """Estimates and truth, (runs, steps, n)."""
    estimates, truth = (_array(path, arrays, key, 3) for key in ("estimates", "truth"))
    if estimates.shape != truth.shape:
        turned = _turned(truth.shape, estimates.shape)
        raise InputError(f"{path}: key 'truth' has shape {truth.shape}, 'estimates' {estimates.shape}{turned}")
    return estimates, truth


def _convention(r: Reading, n: int) -> str:
    """The error of estimates of n components; "vector" unless another is declared, "so2" of motions over windows."""
    convention = r.error or ("vector" if r.relative is None else "so2")
    if r.error is not None and (convention not in PLANAR or (convention != "vector" and n != 3)):
        raise InputError(f"--error {convention}: here it is 'vector', or so2, left or right for x, y, heading")
    return convention


def _require_poses(path: Path, estimates: Array, convention: str, r: Reading) -> None:
    if r.relative is not None and (estimates.shape[-1] != 3 or convention == "vector"):
        raise InputError(f"{path}: --relative needs poses x, y, heading, with --error so2, left or right")


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


def _matrices(path: Path, arrays: dict[str, Array], key: str, shape: Sequence[int]) -> Array:
    """Matrices of a key, of one ``shape``, (runs, steps, n, n)."""
    matrices = _array(path, arrays, key, 4)
    if matrices.shape != tuple(shape):
        turned = _turned(matrices.shape, tuple(shape))
        raise InputError(f"{path}: key '{key}' has shape {matrices.shape}, needs {tuple(shape)}{turned}")
    return matrices


def steps_of(of: Path | str, run: int, rows: Indices) -> Places:
    """Places of steps of a run in arrays."""
    return Places(lambda row: f"{of}, run {run}, step {row + 1}", rows)


def load_arrays(path: Path, keys: str = KINDS) -> dict[str, Array]:
    """All arrays of an archive by key, of any shape; ``keys`` says in messages which it should hold.

    Raises
    ------
    InputError
        The file is missing, or not an archive of arrays.
    """
    if not is_file(path):
        raise InputError(f"{path}: {'is not a file' if path.exists() else 'no such file'}")
    if path.suffix.lower() == ".mat":
        from consistency.referee.readers.formats.matlab_file import load_matlab

        return load_matlab(path)
    with path.open("rb") as file:
        what = "damaged or cut short" if file.read(2) == b"PK" else "or holds Python objects"
    refusal = f"is not a NumPy archive, {what}; write it with numpy.savez"
    with reading(path, refusal), np.load(path, allow_pickle=False) as archive:
        if not hasattr(archive, "files"):
            raise InputError(f"{path}: is a single array; save with numpy.savez and the keys {keys}")
        if len(set(archive.files)) < len(archive.files):
            raise ValueError("a key is duplicated")
        require_room(path, sum(member.file_size for member in archive.zip.infolist()))
        return {key: _numbers(path, archive, key) for key in archive.files}


def _numbers(path: Path, archive: Any, key: str) -> Array:
    try:
        array: Array = archive[key]
    except ValueError as error:
        if "allow_pickle" in str(error):
            what = "holds Python objects, as of runs of different lengths; pad them with NaN and add 'lengths'"
            raise InputError(f"{path}: key '{key}' {what}") from None
        raise
    return array


def _array(path: Path, arrays: dict[str, Array], key: str, dimensions: int) -> Array:
    """An array of floats; one run without its dimension gets it."""
    array = arrays[key]
    names = ("runs", "steps", "n", "n")[:dimensions]
    if array.dtype.kind not in "fiu":
        raise InputError(f"{path}: key '{key}' holds {array.dtype}, not numbers")
    if array.ndim == dimensions - 1:
        array = array[None]
    if array.ndim != dimensions or not array.size:
        raise InputError(f"{path}: key '{key}' has shape {array.shape}, needs ({', '.join(names)})")
    return bounded(np.asarray(array, float))


def whole_numbers(path: Path, arrays: dict[str, Array], key: str, shape: tuple[int, ...]) -> Array:
    """Numbers of one key, as many as ``shape``, or one for all; raises InputError."""
    array = arrays[key]
    if array.dtype.kind not in "fiu":
        raise InputError(f"{path}: key '{key}' holds {array.dtype}, not numbers")
    try:
        return np.broadcast_to(bounded(np.asarray(array, float)), shape)
    except ValueError:
        raise InputError(f"{path}: key '{key}' must be one number or of shape {shape}") from None


def run_lengths(path: Path, arrays: dict[str, Array], runs: int, steps: int) -> list[int]:
    """Steps of each run; those of the array ``lengths`` (runs,) where they differ."""
    if "lengths" not in arrays:
        return [steps] * runs
    lengths = np.atleast_1d(arrays["lengths"])
    if lengths.shape != (runs,) or lengths.dtype.kind not in "iu" or ((lengths < 1) | (lengths > steps)).any():
        raise InputError(f"{path}: key 'lengths' must be {runs} whole numbers from 1 to {steps}")
    return [int(length) for length in lengths]


def _known(path: Path, arrays: dict[str, Array], runs: int, steps: int) -> Array:
    """Steps that belong to each run and have a truth, (runs, steps) of bool."""
    known = np.arange(steps) < np.array(run_lengths(path, arrays, runs, steps))[:, None]
    mask = arrays.get("mask", np.zeros((runs, steps), bool))
    if mask.shape != (runs, steps) or mask.dtype.kind != "b":
        raise InputError(f"{path}: key 'mask' must be truth values of shape {(runs, steps)}")
    return np.asarray(known & ~mask)


def _nis(path: Path, arrays: dict[str, Array], shape: tuple[int, int]) -> tuple[Array | None, Array | None]:
    if "nis" not in arrays:
        return None, None
    if "nis_dof" not in arrays:
        raise InputError(f"{path}: key 'nis_dof' is missing; it is the number of measurements in each nis")
    nis = _array(path, arrays, "nis", 2)
    if nis.shape != shape:
        raise InputError(f"{path}: key 'nis' has shape {nis.shape}, needs {shape}")
    dof = whole_numbers(path, arrays, "nis_dof", shape)
    known = np.isfinite(nis)
    if (nis < 0).any() or np.isinf(nis).any() or not are_dof(dof[known]).all():
        raise InputError(
            f"{path}: keys 'nis', 'nis_dof': nis must be 0 or more, nis_dof whole numbers from 0 to below 2^31"
        )
    return nis, np.where(known, dof, 0.0)


def _turned(found: tuple[int, ...], needed: tuple[int, ...]) -> str:
    """What to say where two shapes differ by the order of runs and steps alone."""
    if found != (needed[1], needed[0], *needed[2:]):
        return ""
    return "; runs and steps are swapped in one: the order is (runs, steps, ...), so transpose its first two axes"


def step_times(path: Path, arrays: dict[str, Array], steps: int) -> Array:
    """Key ``t``, (steps,) in s; NaN without it."""
    if "t" not in arrays:
        return np.full(steps, np.nan)
    t = arrays["t"]
    if t.shape != (steps,) or t.dtype.kind not in "fiu" or not (np.diff(t) > 0).all():
        raise InputError(f"{path}: key 't' must be {steps} increasing numbers, in s")
    return np.asarray(t, float)


def _axes(path: Path, arrays: dict[str, Array], n: int) -> tuple[str, ...]:
    if "axes" not in arrays:
        return numbered_axes(n)
    axes = tuple(require_name(str(axis), f"{path}: key 'axes'") for axis in np.atleast_1d(arrays["axes"]))
    if len(axes) != n:
        raise InputError(f"{path}: key 'axes' names {len(axes)} components, the error has {n}")
    return axes


def _of_nees(path: Path, arrays: dict[str, Array]) -> Record:
    """NEES without errors: NaN before the first value is a start known exactly, NaN later a failure."""
    nees = _array(path, arrays, "nees", 2).copy()
    dof = whole_numbers(path, arrays, "dof", nees.shape)
    if not (are_dof(dof) & (dof >= 1)).all():
        what = "one whole number of 1 or more, the dimension of the error, or one for each step"
        raise InputError(f"{path}: key 'dof' must be {what}")
    if (nees < 0).any():
        run, step = np.argwhere(nees < 0)[0]
        raise InputError(f"{path}: key 'nees', run {run}, step {step + 1}: {nees[run, step]:g} is negative")
    runs, steps = nees.shape
    n, by_step = int(dof.min()), BY_STEP if (dof != dof[0, 0]).any() else {}
    nees *= n / dof
    nis, nis_dof = _nis(path, arrays, (runs, steps))
    failures = []
    known = _known(path, arrays, runs, steps)
    nees[~known] = np.nan
    for run in range(runs):
        finite = np.isfinite(nees[run])
        first = int(np.argmax(finite)) if finite.any() else 0
        broken = np.flatnonzero((known[run] & ~finite)[first:])
        if len(broken):
            step = first + int(broken[0])
            nees[run, step:] = np.nan
            failures.append(Failure(path.stem, run, step + 1, "NEES is not finite"))
    axes = _axes(path, arrays, n)
    t = step_times(path, arrays, steps)
    return Record(
        path.stem, nees=nees, dof=n, nis=nis, nis_dof=nis_dof, failures=tuple(failures), axes=axes,
        runs=np.arange(runs), t=t, **by_step,
    )  # fmt: skip
