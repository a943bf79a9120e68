"""Arrays of MATLAB's files (.mat, up to version 7) under the keys of a NumPy archive."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.parsing import reading, require_room
from consistency.referee.types import Array

HDF5 = b"MATLAB 7.3"  # begin of a file that SciPy does not read


def load_matlab(path: Path) -> dict[str, Array]:
    """Arrays by name. MATLAB drops a last dimension of 1, which a single component has: it is restored."""
    from scipy.io import loadmat, whosmat

    with reading(path), path.open("rb") as file:
        if file.read(len(HDF5)) == HDF5:
            raise InputError(f"{path}: is of MATLAB 7.3; write it with save(..., '-v7')")
    with reading(path):
        require_room(path, sum(8 * int(np.prod(shape, dtype=float)) for _, shape, _ in whosmat(path)))
        arrays = {key: _array(key, value) for key, value in loadmat(path).items() if not key.startswith("__")}
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
