"""Arrays of an archive by key, (runs, steps, ...), and their checks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.diagnostics.records.groups_by_column import on_steps
from consistency.referee.diagnostics.records.record import numbered_axes
from consistency.referee.errors import InputError
from consistency.referee.parsing import is_file, reading, require_name, require_room
from consistency.referee.readers.formats.sheet import NIS_DOF, checked_dof
from consistency.referee.readers.formats.text_blocks import bounded
from consistency.referee.readers.options import Reading
from consistency.referee.types import Array

FEWEST = 10  # runs and steps from which on swapped arrays are looked for
ENOUGH = 200  # errors, whose correlation then is known to 0.07 where they are independent
ALIKE = 0.5  # correlation from run to run
UNLIKE = 0.2  # of it, from step to step
KINDS = "errors and covariances; or estimates, truth and covariances; or nees and dof"


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

    def array(self, key: str, dimensions: int) -> Array:
        """An array of floats; one run without its dimension gets it."""
        array = self.require_numbers(key)
        if array.ndim == dimensions - 1:
            array = array[None]
        if array.ndim != dimensions or not array.size:
            needed = ", ".join(("runs", "steps", "n", "n")[:dimensions])
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

    def groups(self, r: Reading, shape: tuple[int, ...]) -> Array | None:
        """Cells of the key of ``--by``, (runs, steps); a value for each run stands in all of its steps."""
        if r.by is None or r.by_file is not None:
            return None
        if r.by not in self:
            there = ", ".join(sorted(self.arrays))
            raise InputError(f"--by {r.by}: {self.path} has no such key; it holds {there}")
        try:
            return on_steps(self.arrays[r.by], shape)
        except ValueError as error:
            raise InputError(f"{self.path}: key '{r.by}' {error}") from None


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


def swapped(name: str, errors: Array) -> list[str]:
    """A hint where errors (runs, steps, n) correlate from run to run, and not from step to step; none elsewhere."""
    runs, steps, _ = errors.shape
    if runs < FEWEST or steps < FEWEST or runs * steps < ENOUGH:
        return []
    e = np.where(np.isfinite(errors), errors, 0.0)
    of_runs, of_steps = (_lag(e - e.mean(axis=axis, keepdims=True), axis) for axis in (0, 1))
    if of_runs < ALIKE or abs(of_steps) > UNLIKE * of_runs:
        return []
    return [
        f"{name}: errors correlate by {of_runs:.2f} from one run to the next and by {of_steps:.2f} from one step to "
        "the next, as in arrays (steps, runs, n); the order is (runs, steps, n): np.swapaxes(array, 0, 1) of each"
    ]


def _lag(e: Array, axis: int) -> float:
    """Mean correlation of errors (runs, steps, n) with their neighbours along an axis, over components."""
    e = np.moveaxis(e, axis, 0)
    size = np.square(e).mean(axis=(0, 1))
    together = (e[1:] * e[:-1]).mean(axis=(0, 1))
    return float(np.mean(together / np.where(size > 0, size, 1.0)))


# --- files of MATLAB ---------------------------------------------------------------------------------


HDF5 = b"MATLAB 7.3"  # begin of a file that SciPy does not read


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
