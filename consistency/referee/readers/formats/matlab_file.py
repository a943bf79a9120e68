"""Arrays of MATLAB's files (.mat, up to version 7) under the keys of a NumPy archive."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.parsing import reading, require_room
from consistency.referee.types import Array

HDF5 = b"MATLAB 7.3"  # begin of a file that SciPy does not read
VECTORS = ("t", "dof", "lengths", "axes")  # which MATLAB gives a second dimension


def load_matlab(path: Path) -> dict[str, Array]:
    """Arrays by name. MATLAB drops a last dimension of 1, which a single component has: it is restored.

    Raises
    ------
    InputError
        The file cannot be read, or does not tell whether its rows are runs or steps.
    """
    from scipy.io import loadmat, whosmat

    with reading(path), path.open("rb") as file:
        if file.read(len(HDF5)) == HDF5:
            raise InputError(f"{path}: is of MATLAB 7.3; write it with save(..., '-v7')")
    with reading(path):
        require_room(path, sum(8 * int(np.prod(shape, dtype=float)) for _, shape, _ in whosmat(path)))
        arrays: dict[str, Array] = loadmat(path, chars_as_strings=True)
        arrays = {key: np.asarray(value) for key, value in arrays.items() if not key.startswith("__")}
    for key in {*VECTORS} & {*arrays}:
        arrays[key] = np.array([np.ravel(each)[0] if np.size(each) == 1 else each for each in arrays[key].ravel()])
    if "dof" in arrays and arrays["dof"].size == 1:
        arrays["dof"] = arrays["dof"][0]
    if "mask" in arrays:
        arrays["mask"] = arrays["mask"] != 0
    P = arrays.get("covariances")
    if P is not None and P.ndim == 2 and P.shape[1] == 1:
        raise InputError(f"{path}: key 'covariances' has shape {P.shape}: one run of one component has (1, steps)")
    if P is not None and P.ndim == 2:
        of_steps = [key for key in ("errors", "estimates", "truth") if arrays.get(key, P[:0]).shape == P.shape]
        arrays |= {key: arrays[key][..., None] for key in of_steps} | {"covariances": P[..., None, None]}
    return arrays
