"""NumPy archives (.npz): arrays over (runs, steps)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from consistency.referee.diagnostics import Evidence, Record
from consistency.referee.diagnostics.records.large_arrays import diagonal
from consistency.referee.diagnostics.records.record import each_alone, numbered_axes
from consistency.referee.errors import InputError
from consistency.referee.geometry.conventions import PLANAR, planar_error
from consistency.referee.parsing import is_file, reading, require_name, require_room
from consistency.referee.readers.formats.sheet import are_dof, bounded
from consistency.referee.readers.heading_units import require_radians
from consistency.referee.readers.mix_ups.hints import hints, turns
from consistency.referee.readers.options import Reading
from consistency.referee.readers.places import Places
from consistency.referee.readers.runs_to_record import Track, assemble, symmetric
from consistency.referee.readers.truth_matching import Manifold, NamedPoses, Poses
from consistency.referee.types import Array, Failure, Indices

if TYPE_CHECKING:
    from consistency.referee.readers.windows import Relative

KINDS = "errors and covariances; or estimates, truth and covariances; or nees and dof"
NEEDED = (("errors", "covariances"), ("estimates", "truth", "covariances"), ("nees", "dof"))
OF_STATES = {"R", "p", "v"}  # of an inertial filter
BY_STEP: dict[str, Any] = {  # n NEES / dof of a step with n, the smallest dof, has the mean n and less spread than n
    "unavailable": ("distribution",),
    "caption": "the NEES of each step counts over its degrees of freedom, and its distribution is not judged",
}
OPTIONAL = {"nis", "nis_dof", "axes", "t", "lengths", "mask", "cross_covariances", "truth_covariances"}


def read_archive(path: Path, r: Reading, relative: Relative | None = None) -> list[Evidence]:
    """The recording of an archive.

    ``errors`` (runs, steps, n) with ``covariances`` (runs, steps, n, n); or ``estimates`` and ``truth``, both
    (runs, steps, n), with ``covariances``; or ``nees`` (runs, steps) with ``dof``. One run may lack the first
    dimension. Optional: ``nis`` and ``nis_dof`` (runs, steps), ``axes`` (n,), ``t`` (steps,), and ``lengths``
    (runs,), the number of steps of each run, where they differ, and ``mask`` (runs, steps), true where there is no
    truth, so that the step does not count. With ``relative`` estimates and truth are planar
    poses, or estimates are motions; ``cross_covariances`` (runs, steps, 3, 3) are those with the step before. States of
    inertial filters have keys of their own (:mod:`consistency.referee.readers.formats.inertial_archive`).
    """
    arrays = load_arrays(path)
    if not set(arrays) >= OF_STATES:
        return [_of_arrays(path, arrays, r.error, relative)]
    from consistency.referee.readers.formats.inertial_archive import extended_errors

    errors, note = extended_errors(path, arrays, r.error)
    record = _of_arrays(path, errors, relative=relative)
    return [replace(record, convention=r.error or "", notes=(note, *record.notes))]


def record_of_arrays(
    given: Mapping[str, ArrayLike], axes: Sequence[str] | None, name: str, independent: bool = False
) -> Record:
    """Arrays in memory as a record, like those of an archive; see :func:`consistency.judge`.

    Parameters
    ----------
    given : errors with covariances or deviations, or nees with dof; steps that are masked in a masked array of any
        of them have no truth and do not count

    Raises
    ------
    InputError
        Shapes that do not fit, a step that is masked in part, a covariance that is not symmetric, a step that is not
        finite in any run.
    """
    first = next(iter(given))
    arrays = {key: in_memory(key, value) for key, value in given.items()}
    if independent:
        _require_rows({key: array.shape for key, array in arrays.items()})
        arrays = {key: array[:, None] for key, array in arrays.items()}
    shape, wanted = arrays[first].shape, ("runs", "steps", "n")[: 3 if first == "errors" else 2]
    if len(shape) != len(wanted) or 0 in shape:
        text = f"{first} has shape {shape}, needs ({', '.join(wanted)})"
        if len(shape) == len(wanted) - 1:
            one, row = (" and ".join(f"{key}{at}" for key in given if key != "dof") for at in ("[None]", "[:, None]"))
            text += f": {one} {'are' if 'and' in one else 'is'} one run of many steps; {row}, or independent=True of "
            text += "cs.judge, says that each row is a run of its own, which the steps of a log are not"
        raise InputError(text)
    sigma = arrays.pop("deviations", None)
    if sigma is not None:
        if sigma.shape != shape:
            raise InputError(f"deviations has shape {sigma.shape}, needs that of errors, {shape}")
        arrays["covariances"] = diagonal(sigma)
    mask = np.zeros(shape[:2], bool)
    for key, value in given.items():
        mask |= masked_steps(key, value, shape[:2])
    for key, array in arrays.items():
        if array.ndim < 2 or array.shape[:2] != shape[:2]:  # shapes that do not fit are refused below
            continue
        there = np.isfinite(array).reshape(*array.shape[:2], -1).all(axis=-1)
        never = ~(there | mask).any(axis=0)
        if never.any():
            step = int(np.argmax(never)) + 1
            raise InputError(f"{key}, step {step}: not finite in any run; a run that failed has NaN from there on")
    if mask.any():
        arrays["mask"] = mask
    arrays |= {} if axes is None else {"axes": np.asarray(axes, str)}
    record = _of_arrays(Path("arrays"), arrays)
    record = record if sigma is None else each_alone(record)
    failures = tuple(replace(failure, filter=name) for failure in record.failures)
    return replace(record, name=require_name(name, "name"), failures=failures)


def _require_rows(shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Refuse errors and what is stated of them, each row a run, if their shapes do not fit."""
    shape = shapes["errors"]
    if len(shape) != 2 or 0 in shape:
        text = f"errors has shape {shape}, needs (N, n) with independent=True"
        if len(shape) == 1:
            stated = "deviations[:, None]" if "deviations" in shapes else "covariances[:, None, None] of its variances"
            text += f"; one component is errors[:, None] and {stated}"
        raise InputError(text)
    for key, own in shapes.items():
        needs = (*shape, shape[1]) if key.endswith("covariances") else shape
        if own == needs:
            continue
        remedy = ""
        if own == needs[1:]:
            remedy = f"; one for all rows is np.broadcast_to({key}, {needs})"
        elif own == shape:
            remedy = f"; variances are {key}[:, :, None] * np.eye({shape[1]}), standard deviations go into deviations="
        raise InputError(f"{key} has shape {own}, needs {needs} beside errors of shape {shape}{remedy}")


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


def _of_arrays(
    path: Path, arrays: dict[str, Array], convention: str | None = None, relative: Relative | None = None
) -> Record:
    """The record of arrays by key; ``path`` names it in messages."""
    kind = next((keys for keys in NEEDED if set(keys) <= set(arrays)), None)
    if kind is None:
        raise InputError(f"{path}: needs {KINDS}; it holds {', '.join(sorted(arrays)) or 'nothing'}")
    unknown = sorted(set(arrays) - set(kind) - OPTIONAL)
    if unknown:
        raise InputError(f"{path}: key '{unknown[0]}' does not go with {', '.join(kind)}; needs {KINDS}")
    if convention is not None and kind != NEEDED[1]:
        raise InputError(f"--error: {path} holds {kind[0]}, whose convention is settled already")
    if relative is not None and kind != NEEDED[1]:
        raise InputError(f"{path}: --relative needs the keys {', '.join(NEEDED[1])}, of poses or motions")
    if kind == NEEDED[2]:
        return _of_nees(path, arrays)
    covariances = _array(path, arrays, "covariances", 4)
    if kind == NEEDED[0]:
        error, error_kind = _array(path, arrays, "errors", 3), ""
        estimates, truth = np.zeros_like(error), error
    else:
        estimates, truth = (_array(path, arrays, key, 3) for key in ("estimates", "truth"))
        if estimates.shape != truth.shape:
            turned = _turned(truth.shape, estimates.shape)
            raise InputError(f"{path}: key 'truth' has shape {truth.shape}, 'estimates' {estimates.shape}{turned}")
        error_kind = convention or "vector"
        n = estimates.shape[-1]
        if error_kind not in PLANAR or (error_kind != "vector" and n != 3):
            raise InputError(f"--error {error_kind}: here it is 'vector', or so2, left or right for x, y, heading")
        known = _known(path, arrays, *truth.shape[:2])
        truth = np.where(known[..., None], truth, np.nan)
        bad = known & np.isfinite(estimates).all(axis=-1) & ~np.isfinite(truth).all(axis=-1)
        if bad.any():
            run, step = np.argwhere(bad)[0]
            where = f"{path}: key 'truth', run {run}, step {step + 1}"
            raise InputError(f"{where}: not finite; 'mask' is true where there is none")
        if relative is not None:
            return _relative(path, arrays, estimates, truth, covariances, convention or "so2", relative)
        error = planar_error(truth, estimates, error_kind) if n == 3 else truth - estimates
    runs, steps, n = error.shape
    if covariances.shape != (runs, steps, n, n):
        shape = runs, steps, n, n
        turned = _turned(covariances.shape, shape)
        raise InputError(f"{path}: key 'covariances' has shape {covariances.shape}, needs {shape}{turned}")
    known = _known(path, arrays, runs, steps)
    nis, dof = _nis(path, arrays, (runs, steps))
    given = error_kind or "vector"
    of_truth = None
    if "truth_covariances" in arrays:
        of_truth = _array(path, arrays, "truth_covariances", 4)
        if of_truth.shape != covariances.shape:
            raise InputError(f"{path}: key 'truth_covariances' has shape {of_truth.shape}, needs {covariances.shape}")
    tracks, poses = [], []
    for run, steps_of_run in enumerate(known):
        k = np.flatnonzero(steps_of_run)
        place = steps_of(path, run, k)
        P = symmetric(covariances[run, k], place.__getitem__)
        poses.append(_poses(place, estimates[run, k], P, truth[run, k], given))
        own_nis, own_dof = (None if values is None else values[run, k] for values in (nis, dof))
        T = None if of_truth is None else symmetric(of_truth[run, k], place.__getitem__)
        tracks.append(Track(run, k, place, error[run, k], P, own_nis, own_dof, truth_covariance=T))
    axes = _axes(path, arrays, n)
    require_radians(str(path), poses)
    notes = [f"error convention {error_kind}: {PLANAR[error_kind]}"] if error_kind else []
    causes = hints(path.stem, axes, poses)
    if given == "vector":
        remedy = "add --error so2, if these are x, y, heading" if error_kind and n == 3 else "wrap it to [-pi, pi]"
        causes += turns(path.stem, axes, error, covariances, remedy)
    t = step_times(path, arrays, steps)
    record = assemble(path.stem, tracks, t, axes, str(path), error_kind, [*notes, *causes])
    return replace(record, causes=tuple(causes))


def steps_of(of: Path | str, run: int, rows: Indices) -> Places:
    return Places(lambda row: f"{of}, run {run}, step {row + 1}", rows)


def _poses(place: Places, estimate: Array, covariance: Array, truth: Array, convention: str) -> Poses:
    """Estimates (T, n) of one run beside their truth, NaN where it is not known."""
    t, known = np.arange(len(estimate), dtype=float), np.isfinite(truth).all(axis=-1)
    manifold: Manifold = "vector" if convention == "vector" else "planar"
    stated = np.ones(len(t), bool)
    return Poses(place, t, estimate, covariance, stated, t[known], truth[known], manifold, convention, 0.0)


def archive_poses(path: Path, r: Reading) -> Iterator[NamedPoses]:
    """Planar poses of each run of an archive with the keys ``estimates`` and ``truth``."""
    arrays = load_arrays(path)
    if missing := [key for key in ("estimates", "truth") if key not in arrays]:
        raise InputError(f"{path}: key '{missing[0]}' is missing; needs estimates and truth, (runs, steps, 3)")
    estimates, truth = (_array(path, arrays, key, 3) for key in ("estimates", "truth"))
    if estimates.shape != truth.shape or estimates.shape[-1] != 3:
        raise InputError(f"{path}: estimates {estimates.shape} and truth {truth.shape} must both be (runs, steps, 3)")
    runs, steps, _ = estimates.shape
    clock, there = step_times(path, arrays, steps), _known(path, arrays, runs, steps)
    for run, length in enumerate(run_lengths(path, arrays, runs, steps)):
        place = steps_of(path, run, np.arange(length))
        true, step = truth[run, :length], np.arange(length, dtype=float)
        known = there[run, :length] & np.isfinite(true).all(axis=-1)
        poses = Poses.bare(place, step, estimates[run, :length], step[known], true[known], "planar", 0.0)
        yield NamedPoses(f"run {run}" if runs > 1 else path.stem, poses, clock[:length])


def _relative(
    path: Path, arrays: dict[str, Array], estimates: Array, truth: Array, covariances: Array, convention: str,
    relative: Relative,
) -> Evidence:  # fmt: skip
    """Motions over windows of planar poses, or of motions."""
    from consistency.referee.readers.relative_motions import Stretch, relative_recording

    runs, steps, n = estimates.shape
    if n != 3 or convention == "vector":
        raise InputError(f"{path}: --relative needs poses x, y, heading, with --error so2, left or right")
    shape = (runs, steps, n, n)
    cross = None
    if "cross_covariances" in arrays and not relative.motions:
        cross = _array(path, arrays, "cross_covariances", 4)
    for key, matrices in (("covariances", covariances), ("cross_covariances", cross)):
        if matrices is not None and matrices.shape != shape:
            raise InputError(f"{path}: key '{key}' has shape {matrices.shape}, needs {shape}")
    t, stretches = step_times(path, arrays, steps), []
    for run, length in enumerate(run_lengths(path, arrays, runs, steps)):
        place = steps_of(path, run, np.arange(length))
        P = symmetric(covariances[run, :length], place.__getitem__)
        known = np.flatnonzero(np.isfinite(truth[run, :length]).all(axis=-1))
        own = None if cross is None else cross[run, :length]
        stretches.append(
            Stretch(
                run, str(path), place, t[:length], estimates[run, :length], P, own, known, truth[run, known], convention
            )
        )
    return relative_recording(path.stem, str(path), stretches, ("x", "y", "heading"), range(3), relative)


def load_arrays(path: Path, keys: str = KINDS) -> dict[str, Array]:
    """All arrays of an archive by key, of any shape; ``keys`` says in messages which it should hold.

    Raises
    ------
    InputError
        The file is missing, or not an archive of arrays.
    """
    if not is_file(path):
        raise InputError(f"{path}: {'is no file' if path.exists() else 'no such file'}")
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
            raise ValueError("a key is there twice")
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


def _of_nees(path: Path, arrays: dict[str, Array]) -> Evidence:
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
    return Evidence(
        path.stem, nees=nees, dof=n, nis=nis, nis_dof=nis_dof, failures=tuple(failures), axes=axes,
        runs=np.arange(runs), t=t, **by_step,
    )  # fmt: skip
