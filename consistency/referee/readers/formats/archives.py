"""Archives of arrays by key, (runs, steps, ...).

They are those of NumPy (.npz), HDF5 and MATLAB. States of inertial filters have keys of their own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.diagnostics.groups import on_steps
from consistency.referee.diagnostics.record import Errors, InnovationRecord, Record, Runs, TruthFit, numbered_axes
from consistency.referee.errors import InputError
from consistency.referee.geometry import INERTIAL, PLANAR, state_error
from consistency.referee.parsing import is_file, reading, require_name, require_room
from consistency.referee.readers.formats.members import UNWEIGHTED
from consistency.referee.readers.formats.pose_rows import are_rotations, quaternions
from consistency.referee.readers.formats.sheet import NIS_DOF, are_dof, checked_dof
from consistency.referee.readers.formats.text_blocks import bounded
from consistency.referee.readers.mix_ups.hints import swapped, turns
from consistency.referee.readers.options import GroupOptions, Reading
from consistency.referee.readers.places import Places
from consistency.referee.readers.runs_to_record import symmetric
from consistency.referee.readers.truth_matching import (
    Bounds,
    Estimator,
    Poses,
    StatedError,
    at,
    make_poses,
    manifold_of,
    unstated,
)
from consistency.referee.types import Array, Failure, Indices

OF_ERRORS, OF_POSES, OF_NEES = ("errors", "covariances"), ("estimates", "truth", "covariances"), ("nees", "dof")
OF_MEMBERS, OF_REPEATS = ("members", "truth"), ("estimates", "covariances")
PLANAR_POSE = ("x", "y", "heading")
OF_STATES = {"R", "p", "v"}  # of an inertial filter
BY_STEP = TruthFit(  # n NEES / dof of a step with n, the smallest dof, has the mean n and less spread than n
    unavailable=("distribution",),
    caption="the NEES of each step counts over its degrees of freedom, and its distribution is not judged",
)
OPTIONAL = {"bounds", "nis", "nis_dof", "axes", "t", "lengths", "mask", "cross_covariances", "truth_covariances"}
KINDS = (
    "errors and covariances; or errors and bounds; or estimates, truth and covariances; or members and truth; or nees "
    "and dof"
)
HDF5 = b"MATLAB 7.3"  # begin of a file that SciPy does not read
AXES = {
    "R": ("roll", "pitch", "yaw"),
    "p": ("x", "y", "z"),
    "v": ("vx", "vy", "vz"),
    "bg": ("bgx", "bgy", "bgz"),
    "ba": ("bax", "bay", "baz"),
}  # parts of a state, in their order in the covariance where the key ``order`` names no other
STATE = ("p", "R", "v", "bg", "ba")  # their order in a state
TRUE = "true_"  # before the name of a part


def read_archive(path: Path, r: Reading, poses_alone: bool = False) -> list[Estimator | Record]:
    """The estimator of an archive; its record where it holds NEES.

    ``errors`` (runs, steps, n) with ``covariances`` (runs, steps, n, n); or ``estimates`` and ``truth``, both
    (runs, steps, n), with ``covariances``; or ``members`` (runs, steps, m, n) with ``truth``; or ``nees`` (runs, steps)
    with ``dof``. With ``--truth repeats`` there is no ``truth``. One run may lack the first
    dimension. Optional: ``nis`` and ``nis_dof`` (runs, steps), ``axes`` (n,), ``t`` (steps,), and ``lengths``
    (runs,), the number of steps of each run, where they differ, and ``mask`` (runs, steps), true where there is no
    truth, so that the step does not count. With ``--relative`` estimates and truth are planar
    poses, or estimates are motions; ``cross_covariances`` (runs, steps, 3, 3) are those with the step before. States of
    inertial filters have keys of their own (:func:`extended_errors`).

    Parameters
    ----------
    poses_alone : covariances are not looked at
    """
    arrays = load_arrays(path)
    if poses_alone:
        return [_poses_of_arrays(Archive(path, arrays))]
    if not set(arrays) >= OF_STATES:
        return [estimator_of_arrays(path, arrays, r)]

    errors, definition = extended_errors(path, arrays, r.conventions.error)
    one = estimator_of_arrays(path, errors, r.with_error(None))
    assert isinstance(one, Estimator)
    return [one.with_error(convention=r.conventions.error or "", definition=definition)]


def first_known(repeats: Array) -> Array:
    """A value for each step of repeats (runs, steps, n), (1, steps, n): that of the first run that has one."""
    return np.take_along_axis(repeats, np.argmax(np.isfinite(repeats), axis=0)[None], axis=0)


def steps_of(of: Path | str, run: int, rows: Indices) -> Places:
    """Places of steps of a run in arrays."""
    return Places(lambda row: f"{of}, run {run}, step {row + 1}", rows)


# --- estimators and records --------------------------------------------------------------------------


def estimator_of_arrays(path: Path, arrays: Mapping[str, Array], r: Reading) -> Estimator | Record:
    """The estimator of arrays by key, or its record where they are NEES; ``path`` names it in messages."""
    states = arrays.get("errors", arrays.get("estimates"))
    if r.statement.unstated and "covariances" not in arrays and states is not None:
        arrays = {**arrays, "covariances": np.zeros((*states.shape, *states.shape[-1:]))}
    archive = Archive(path, arrays)
    bounds = sizes = None
    if "bounds" in archive or r.statement.level is not None:
        archive, bounds, sizes = _with_bounds(archive, r)
        arrays = archive.arrays
    kind = _kind(archive, r)
    if kind == OF_NEES:
        found = _of_nees(archive, bool(r.runs.independent))
        assert found.errors.nees is not None
        return replace(found, runs=replace(found.runs, by=archive.groups(r.groups, found.errors.nees.shape)))
    declared = ""
    if kind == OF_MEMBERS:
        return _of_members(archive, r)
    if kind == OF_REPEATS:
        states = archive.array("estimates", 3)
        arrays = {**arrays, "truth": np.nan_to_num(np.broadcast_to(first_known(states), states.shape))}
        archive = Archive(path, arrays)
    require_layout(kind[0], arrays[kind[0]].shape, arrays["covariances"].shape, f"{path}: ")
    if kind == OF_ERRORS:
        truth = archive.array("errors", 3)
        estimates = np.where(np.isfinite(truth), 0.0, np.nan)
    else:
        estimates, truth = archive.estimates_and_truth()
        declared = _convention(archive, r, estimates.shape[-1])
    runs, steps, n = estimates.shape
    shape = (runs, steps, n, n)
    by = archive.groups(r.groups, (runs, steps))
    covariances = archive.matrices("covariances", shape)
    there = archive.known(runs, steps)
    if kind in (OF_POSES, OF_REPEATS):
        truth = _finite_truth(path, estimates, truth, there)
    nis, dof = archive.nis((runs, steps))
    of_truth = cross = None
    if "truth_covariances" in archive:
        of_truth = archive.matrices("truth_covariances", shape)
    if "cross_covariances" in archive and r.runs.relative is not None and not r.runs.motions:
        cross = archive.matrices("cross_covariances", shape)
    convention = declared or "vector"
    poses = []
    for one in _runs(archive, estimates, truth, there):
        steps_of_run = (one.source.run, slice(len(one.own.t)))
        rows = np.flatnonzero(there[steps_of_run])
        place = one.own.place.at(rows).__getitem__
        P = np.full((len(one.own.t), n, n), np.nan)
        P[rows] = symmetric(covariances[one.source.run, rows], place)
        T = None
        if of_truth is not None:
            T = symmetric(of_truth[one.source.run, rows], place)
        of_steps = {"nis": nis, "nis_dof": dof, "cross": cross, "by": by, "bounds": sizes}
        own: dict[str, Any] = {key: at(values, steps_of_run) for key, values in of_steps.items()}
        stated = np.ones(len(P), bool)
        manifold = manifold_of(convention)
        own |= {"covariance": P, "stated": stated, "true_covariance": T, "manifold": manifold, "convention": convention}
        poses.append(one.with_values(**own))
    axes = archive.axes(n)
    gap = np.where(there[..., None], truth - estimates, np.nan)
    causes = swapped(path.stem, gap)
    if convention == "vector" and bounds is None:
        remedy = "wrap it to [-pi, pi]"
        if declared and n == 3:
            remedy = "add --error so2, if these are x, y, heading"
        causes += turns(path.stem, axes, gap, covariances, remedy)
    if r.runs.relative is not None:  # poses, or motions of them
        axes = PLANAR_POSE
    error = StatedError(axes, declared, PLANAR.get(declared, ""), bounds=bounds)
    return Estimator(path.stem, path, poses, error, causes=causes, t=archive.times(steps))


def _with_bounds(archive: Archive, r: Reading) -> tuple[Archive, Bounds | None, Array | None]:
    """The archive with covariances for its bounds, these bounds, and their sizes (runs, steps, bounds, 2)."""
    from consistency.referee.readers.formats import bounds

    where = f"{archive.path}: "
    arrays = dict(archive.arrays)
    if "bounds" not in archive:
        bounds.require_gaussian(str(archive.path), r.statement)
        if "covariances" in archive:
            arrays["covariances"] = archive.require_numbers("covariances") * bounds.covariance_factor(r.statement)
        return replace(archive, arrays=arrays), None, None
    key = next((key for key in ("errors", "estimates") if key in archive), None)
    if key is None or "covariances" in archive:
        raise InputError(f"{where}key 'bounds' goes with errors, or estimates and truth, in place of covariances")
    shape = archive.array(key, 3).shape
    sizes = archive.require_numbers("bounds").astype(float)
    if archive.arrays[key].ndim < 3:  # one run
        sizes = sizes[None]
    stated, values = bounds.stated_in_arrays(where, sizes, archive.axes(shape[-1]), shape, r.statement)
    flat = bounds.covariance_of(stated, values.reshape(-1, *values.shape[2:]), shape[-1])
    arrays["covariances"] = flat.reshape(*shape, shape[-1])
    return replace(archive, arrays=arrays), stated, values


def _kind(archive: Archive, r: Reading) -> tuple[str, ...]:
    """The keys that an archive holds.

    Raises
    ------
    InputError
        It holds none of the kinds, another key beside one, or an option does not go with it.
    """
    path = archive.path
    keys = set(archive.arrays)
    kinds = (OF_ERRORS, OF_REPEATS if r.sources.repeats else OF_POSES, OF_MEMBERS, OF_NEES)
    kind = next((needed for needed in kinds if set(needed) <= keys), None)
    if "weights" in keys:
        raise InputError(f"{path}: key 'weights': {UNWEIGHTED}")
    if kind is None:
        raise InputError(f"{path}: needs {KINDS}; it holds {', '.join(sorted(keys)) or 'nothing'}")
    unknown = sorted(keys - set(kind) - OPTIONAL)
    if unknown and r.groups.by is None:
        raise InputError(f"{path}: key '{unknown[0]}' does not go with {', '.join(kind)}; needs {KINDS}")
    if r.conventions.error is not None and kind not in (OF_POSES, OF_REPEATS):
        raise InputError(f"--error: {path} holds {kind[0]}, whose convention is settled already")
    if r.runs.relative is not None and kind != OF_POSES:
        raise InputError(f"{path}: --relative needs the keys {', '.join(OF_POSES)}, of poses or motions")
    return kind


def _of_members(archive: Archive, r: Reading) -> Estimator:
    """The estimator of members of ensembles, (runs, steps, m, n), whose errors are ranks of the truth among them."""
    from consistency.referee.readers.formats.members import checked_members, of_members

    path = archive.path
    members = archive.array("members", 4, "m")
    truth = archive.array("truth", 3)
    runs, steps, m, n = members.shape
    if truth.shape != (runs, steps, n):
        beside = f"needs {(runs, steps, n)} beside 'members' {members.shape}, (runs, steps, m, n)"
        raise InputError(f"{path}: key 'truth' has shape {truth.shape}, {beside}")
    there = archive.known(runs, steps)

    def place(k: int) -> str:
        return f"{path}: key 'members', run {k // steps}, step {k % steps + 1}"

    means = checked_members(members.reshape(-1, m, n), there.ravel(), place).mean(axis=1).reshape(truth.shape)
    by = archive.groups(r.groups, (runs, steps))
    poses = []
    for one in _runs(archive, means, _finite_truth(path, means, truth, there), there):
        rows = one.source.run, slice(len(one.own.t))
        poses.append(one.with_values(manifold="vector", convention="vector", by=at(by, rows), members=members[rows]))
    return of_members(Estimator(path.stem, path, poses, StatedError(archive.axes(n)), t=archive.times(steps)), r)


def _convention(archive: Archive, r: Reading, n: int) -> str:
    """The error of estimates of n components; "vector" unless another is declared, "so2" of motions over windows."""
    convention = r.conventions.error or ("vector" if r.runs.relative is None else "so2")
    if r.conventions.error is not None and (convention not in PLANAR or (convention != "vector" and n != 3)):
        raise InputError(f"--error {convention}: here it is 'vector', or so2, left or right for x, y, heading")
    if r.runs.relative is not None and (n != 3 or convention == "vector"):
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
    return Estimator(path.stem, path, poses, StatedError(PLANAR_POSE), t=archive.times(steps))


def _runs(archive: Archive, estimates: Array, truth: Array, there: Array) -> Iterator[Poses]:
    """Estimates (runs, steps, n) and their truth where it is ``there``, without covariances, in the plane."""
    path = archive.path
    runs, steps, n = estimates.shape
    clock = archive.times(steps)
    for run, length in enumerate(archive.lengths(runs, steps)):
        t = np.arange(float(length))
        covariance, stated = unstated(length, n)
        beside = make_poses(
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


def _of_nees(archive: Archive, independent: bool) -> Record:
    """NEES without errors: NaN before the first value is a start known exactly, NaN later a failure.

    Of ``independent`` rows any NaN is the failure of its own.
    """
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
    fit = BY_STEP if (dof != dof[0, 0]).any() else TruthFit()
    nees *= n / dof
    nis, nis_dof = archive.nis((runs, steps))
    known = archive.known(runs, steps)
    failures = []
    nees[~known] = np.nan
    for run in range(runs):
        finite = np.isfinite(nees[run])
        begun = np.logical_or.accumulate(finite) | ~finite.any() | independent
        broken = np.flatnonzero(begun & known[run] & ~finite)
        if len(broken) and not independent:
            nees[run, broken[0] :] = np.nan
            broken = broken[:1]
        failures += [Failure(path.stem, run, int(step) + 1, "NEES is not finite") for step in broken]
    return Record(
        path.stem,
        Errors(nees=nees, dof=n, axes=archive.axes(n)),
        InnovationRecord(nis, nis_dof),
        Runs(np.arange(runs), t=archive.times(steps), independent=independent),
        tuple(failures),
        fit=fit,
    )


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
        return load_matlab(path)
    with path.open("rb") as file:
        what = "damaged or cut short" if file.read(2) == b"PK" else "or holds Python objects"
    refusal = f"is not a NumPy archive, {what}; write it with numpy.savez"
    with reading(path, refusal):
        loaded = np.load(path, allow_pickle=False)
    if not hasattr(loaded, "files"):
        raise InputError(f"{path}: is a single array; save with numpy.savez and the keys {keys}")
    with reading(path, refusal), loaded as archive:
        if len(set(archive.files)) < len(archive.files):
            raise ValueError("a key is duplicated")
        require_room(path, sum(member.file_size for member in archive.zip.infolist()))
        return {key: _member(path, archive, key) for key in archive.files}


def _member(path: Path, archive: Any, key: str) -> Array:
    try:
        array: Array = archive[key]
    except ValueError as error:
        if "allow_pickle" not in str(error):
            raise
        what = "holds Python objects, as of runs of different lengths; pad them with NaN and add 'lengths'"
        if key == "members":
            what += "; all steps need equally many members"
        raise InputError(f"{path}: key '{key}' {what}") from None
    return array


# --- arrays by key, checked --------------------------------------------------------------------------


@dataclass(frozen=True)
class Archive:
    """Arrays by key; its methods give them checked, and raise :class:`InputError`."""

    path: Path
    arrays: Mapping[str, Array]

    def __contains__(self, key: str) -> bool:
        return key in self.arrays

    def require_numbers(self, key: str) -> Array:
        """An array of numbers, of any shape."""
        array = self.arrays[key]
        if array.dtype.kind not in "fiu":
            raise InputError(f"{self.path}: key '{key}' holds {array.dtype}, not numbers")
        return array

    def array(self, key: str, dimensions: int, third: str = "n") -> Array:
        """An array of floats; one run without its dimension gets it."""
        array = self.require_numbers(key)
        if array.ndim == dimensions - 1:
            array = array[None]
        if array.ndim != dimensions or not array.size:
            needed = ", ".join(("runs", "steps", third, "n")[:dimensions])
            raise InputError(f"{self.path}: key '{key}' has shape {array.shape}, needs ({needed})")
        return bounded(np.asarray(array, float))

    def matrices(self, key: str, shape: tuple[int, ...]) -> Array:
        """Matrices of one ``shape``, (runs, steps, n, n)."""
        matrices = self.array(key, 4)
        if matrices.shape != shape:
            turned = _turned(matrices.shape, shape)
            raise InputError(f"{self.path}: key '{key}' has shape {matrices.shape}, needs {shape}{turned}")
        return matrices

    def estimates_and_truth(self) -> tuple[Array, Array]:
        """Both (runs, steps, n)."""
        estimates = self.array("estimates", 3)
        truth = self.array("truth", 3)
        if estimates.shape != truth.shape:
            turned = _turned(truth.shape, estimates.shape)
            shapes = f"key 'truth' has shape {truth.shape}, 'estimates' {estimates.shape}"
            raise InputError(f"{self.path}: {shapes}{turned}")
        return estimates, truth

    def whole_numbers(self, key: str, shape: tuple[int, ...]) -> Array:
        """Numbers of one key, as many as ``shape``, or one for all."""
        array = self.require_numbers(key)
        try:
            return np.broadcast_to(bounded(np.asarray(array, float)), shape)
        except ValueError:
            raise InputError(f"{self.path}: key '{key}' must be one number or of shape {shape}") from None

    def lengths(self, runs: int, steps: int) -> list[int]:
        """Steps of each run; those of the array ``lengths`` (runs,) where they differ."""
        if "lengths" not in self:
            return [steps] * runs
        lengths = np.atleast_1d(self.arrays["lengths"])
        are_whole = lengths.shape == (runs,) and lengths.dtype.kind in "iu"
        if not are_whole or lengths.min() < 1 or lengths.max() > steps:
            raise InputError(f"{self.path}: key 'lengths' must be {runs} whole numbers from 1 to {steps}")
        return [int(length) for length in lengths]

    def known(self, runs: int, steps: int) -> Array:
        """Steps that belong to each run and have a truth, (runs, steps) of bool."""
        known = np.arange(steps) < np.array(self.lengths(runs, steps))[:, None]
        mask = self.arrays.get("mask", np.zeros((runs, steps), bool))
        if mask.shape != (runs, steps) or mask.dtype.kind != "b":
            raise InputError(f"{self.path}: key 'mask' must be truth values of shape {(runs, steps)}")
        return np.asarray(known & ~mask)

    def nis(self, shape: tuple[int, int]) -> tuple[Array | None, Array | None]:
        """NIS and its degrees of freedom, (runs, steps); None without any."""
        if "nis" not in self:
            return None, None
        if "nis_dof" not in self:
            raise InputError(f"{self.path}: key 'nis_dof' is missing; {NIS_DOF}")
        nis = self.array("nis", 2)
        if nis.shape != shape:
            raise InputError(f"{self.path}: key 'nis' has shape {nis.shape}, needs {shape}")
        dof = np.where(np.isnan(nis), 0.0, self.whole_numbers("nis_dof", shape))
        steps = shape[1]

        def place(k: int) -> str:
            return f"{self.path}, run {k // steps}, step {k % steps + 1}"

        return nis, checked_dof(nis.ravel(), dof.ravel(), place).reshape(shape)

    def times(self, steps: int) -> Array:
        """Key ``t``, (steps,) in s; NaN without it."""
        if "t" not in self:
            return np.full(steps, np.nan)
        t = self.arrays["t"]
        are_numbers = t.shape == (steps,) and t.dtype.kind in "fiu"
        if not are_numbers or not (np.diff(t) > 0).all():
            raise InputError(f"{self.path}: key 't' must be {steps} increasing numbers, in s")
        return np.asarray(t, float)

    def axes(self, n: int) -> tuple[str, ...]:
        """Names of the n components of the error."""
        if "axes" not in self:
            return numbered_axes(n)
        where = f"{self.path}: key 'axes'"
        axes = tuple(require_name(str(axis), where) for axis in np.atleast_1d(self.arrays["axes"]))
        if len(axes) != n:
            raise InputError(f"{where} names {len(axes)} components, the error has {n}")
        return axes

    def groups(self, options: GroupOptions, shape: tuple[int, ...]) -> Array | None:
        """Cells of the key of ``--by``, (runs, steps); a value for each run stands in all of its steps."""
        by = options.own_column
        if by is None:
            return None
        if by not in self:
            there = ", ".join(sorted(self.arrays))
            raise InputError(f"--by {by}: {self.path} has no such key; it holds {there}")
        try:
            return on_steps(self.arrays[by], shape)
        except ValueError as error:
            raise InputError(f"{self.path}: key '{by}' {error}") from None


def _turned(found: tuple[int, ...], needed: tuple[int, ...]) -> str:
    """What to say where two shapes differ by the order of runs and steps alone."""
    if found != (needed[1], needed[0], *needed[2:]):
        return ""
    return "; runs and steps are swapped in one: the order is (runs, steps, ...), so transpose its first two axes"


def require_layout(key: str, e: tuple[int, ...], P: tuple[int, ...], where: str = "") -> None:
    """Refuse errors or estimates of shape ``e`` beside covariances of shape ``P`` in the layout of another program.

    Raises
    ------
    InputError
        Components come first, a state is a column, or matrices are variances, rows of numbers, or one for all.
    """
    if len(e) < 2 or (*e, e[-1]) == P:
        return
    n = e[-1]
    full = (*e, n)
    remedy = ""
    if (e[0], *e) == P and len(P) > 2:
        remedy = f"components come first: np.moveaxis({key}, 0, -1) and np.moveaxis(covariances, (0, 1), (-2, -1)) " \
                 "put them behind runs and steps"  # fmt: skip
    elif n == 1 and (*e[:-1], e[-2]) == P:
        remedy = f"a state is a column, (n, 1): take {key}[..., 0]"
    elif n > 1 and (*e[:-1], n * n) == P:
        remedy = f"each matrix is a row of {n * n} numbers: covariances.reshape({full})"
    elif e == P:
        remedy = f"variances are covariances[..., None] * np.eye({n})"
        remedy += "" if where else ", standard deviations go into deviations="
    elif len(e) == 3 and e[0] > 1 and P in (full[1:], full[2:]):
        remedy = f"one for all is np.broadcast_to(covariances, {full})"
    if remedy:
        raise InputError(f"{where}{key} has shape {e} and covariances {P}; needed are (runs, steps, n) and "
                         f"(runs, steps, n, n); {remedy}")  # fmt: skip


# --- files of MATLAB ---------------------------------------------------------------------------------


def load_matlab(path: Path) -> dict[str, Array]:
    """Arrays by name. MATLAB drops a last dimension of 1, which a single component has: it is restored."""
    from scipy.io import loadmat, whosmat

    with reading(path), path.open("rb") as file:
        if file.read(len(HDF5)) == HDF5:
            raise InputError(f"{path}: is of MATLAB 7.3; write it with save(..., '-v7')")
    with reading(path):
        sizes = [int(np.prod(shape, dtype=float)) for _, shape, _ in whosmat(path)]
        require_room(path, 8 * sum(sizes))
        arrays = {}
        for key, value in loadmat(path).items():
            if not key.startswith("__"):
                arrays[key] = _array(key, value)
    P = arrays.get("covariances")
    if P is None or P.ndim > 2:
        return arrays
    if P.shape[1] == 1:
        raise InputError(f"{path}: key 'covariances' has shape {P.shape}: one run of one component has (1, steps)")
    arrays["covariances"] = P[..., None, None]
    for key in {"errors", "estimates", "truth"} & set(arrays):
        arrays[key] = arrays[key][..., None]
    return arrays


def _array(key: str, value: object) -> Array:
    """An array of a key; MATLAB has no fewer than two dimensions, no truth values, and texts in a cell."""
    array = np.asarray(value)
    if key in ("t", "lengths"):
        return array.ravel()
    if key == "dof":
        return array.squeeze()
    if key == "mask":
        return np.asarray(array != 0)
    if key == "axes":
        return np.array([str(np.squeeze(each)) for each in array.ravel()])
    return array


def extended_errors(path: Path, arrays: Mapping[str, Array], convention: str | None) -> tuple[dict[str, Array], str]:
    """The arrays with ``errors`` (runs, steps, 9 or 15) and ``axes`` in place of the states, and the error in words.

    Parameters
    ----------
    arrays : R (runs, steps, 3, 3), from body to world, p and v (runs, steps, 3), in the world, m and m/s; bg and ba
        (runs, steps, 3), rad/s and m/s^2, both or none; the same of the truth as true_R and so on; ``order``, names of
        the parts as they stand in the covariance, R, p, v, bg, ba by default; one run may lack the first dimension
    convention : ``left`` is Log(est^-1 truth) of SE2(3), ``right`` Log(truth est^-1), ``additive`` a difference;
        ``so3`` and ``so3-body`` are additive but for the rotation
        (:func:`consistency.referee.geometry.state_error`). Biases are differences.

    Raises
    ------
    InputError
        A part is missing or of another shape, no rotation, or the truth is not finite; or no error is declared.
    """
    if convention not in INERTIAL:
        raise InputError(
            f"{path}: holds states of R, p and v, whose error is not known; add --error {', '.join(INERTIAL)}: left or "
            "right of SE2(3), or differences, the rotation's about axes of the world or of the body or of its vector"
        )
    parts = [part for part in AXES if part in arrays]
    order = _order(path, arrays, parts)
    own = {}
    true = {}
    for part in parts:
        own[part] = _part(path, arrays, part)
        true[part] = _part(path, arrays, TRUE + part)
        shape = own[part].shape
        if shape != true[part].shape or shape[:2] != own["R"].shape[:2]:
            shapes = f"{shape} and {true[part].shape}, beside R {own['R'].shape}"
            raise InputError(f"{path}: keys '{part}' and '{TRUE}{part}' have shapes {shapes}")
        if not np.isfinite(true[part]).all():
            raise InputError(f"{path}: key '{TRUE}{part}' is not finite; leave such steps out")
    states = list(STATE[: len(parts)])
    estimate = _states(path, own, states, "")
    truth = _states(path, true, states, TRUE)
    finite = np.isfinite(estimate).all(axis=-1)
    error = np.full((*finite.shape, 3 * len(states)), np.nan)
    error[finite] = state_error(truth[finite], estimate[finite], convention)
    places = [3 * states.index(part) + i for part in order for i in range(3)]
    rest = {}
    for key, array in arrays.items():
        if key.removeprefix(TRUE) not in (*AXES, "order"):
            rest[key] = array
    rest["errors"] = error[..., places]
    rest["axes"] = np.array([AXES[part] for part in order]).ravel()
    of = "and the difference of the velocity"
    if convention in ("left", "right"):
        of = "with the velocity, of SE2(3)"
    return rest, f"{INERTIAL[convention]}, {of}; in the order {', '.join(order)}"


def _order(path: Path, arrays: Mapping[str, Array], parts: list[str]) -> list[str]:
    """The parts as they stand in the covariance; refused where a part is missing."""
    for bias, other in (("bg", "ba"), ("ba", "bg")):
        if bias in parts and other not in parts:
            raise InputError(f"{path}: key '{other}' is missing; there are two biases or none")
    for part in parts:
        if TRUE + part not in arrays:
            raise InputError(f"{path}: key '{TRUE}{part}' is missing, of the true states")
    order = list(map(str, np.atleast_1d(arrays.get("order", np.array(parts)))))
    if sorted(order) != sorted(parts):
        raise InputError(f"{path}: key 'order' is {', '.join(order)}; must name {', '.join(parts)}, each once")
    return order


def _part(path: Path, arrays: Mapping[str, Array], key: str) -> Array:
    """A part of all states, (runs, steps, 3) or (runs, steps, 3, 3)."""
    tail = (3, 3) if key.endswith("R") else (3,)
    array = np.asarray(arrays[key], float)
    lead = array.ndim - len(tail)
    if array.shape[-len(tail) :] != tail or lead not in (1, 2):
        wanted = ", ".join(map(str, tail))
        raise InputError(f"{path}: key '{key}' has shape {array.shape}, needs (runs, steps, {wanted})")
    return array if lead == 2 else array[None]


def _states(path: Path, parts: Mapping[str, Array], order: list[str], prefix: str) -> Array:
    """States (runs, steps, 4 + 3 k) with quaternions; NaN where a rotation is not finite."""
    R = parts["R"]
    finite = np.isfinite(R).all(axis=(-2, -1))
    if not are_rotations(R[finite]).all():
        raise InputError(f"{path}: key '{prefix}R' holds a matrix that is not a rotation")
    columns = {**parts, "R": quaternions(R)}
    return np.concatenate(list(map(columns.__getitem__, order)), axis=-1)
