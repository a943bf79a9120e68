"""States of an inertial filter in archives: rotation, position and velocity, of the group SE2(3), and two biases."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.errors import InputError
from consistency.referee.geometry.conventions import INERTIAL
from consistency.referee.geometry.groups import state_error
from consistency.referee.types import Array

AXES = {
    "R": ("roll", "pitch", "yaw"),
    "p": ("x", "y", "z"),
    "v": ("vx", "vy", "vz"),
    "bg": ("bgx", "bgy", "bgz"),
    "ba": ("bax", "bay", "baz"),
}  # parts of a state, in their order in the covariance where the key ``order`` names no other
STATE = ("p", "R", "v", "bg", "ba")  # their order in a state
TRUE = "true_"  # before the name of a part
ROTATION = 1e-3  # largest entry of R R' - I


def extended_errors(path: Path, arrays: Mapping[str, Array], convention: str | None) -> tuple[dict[str, Array], str]:
    """The arrays with ``errors`` (runs, steps, 9 or 15) and ``axes`` in place of the states, and the error in words.

    Parameters
    ----------
    arrays : R (runs, steps, 3, 3), from body to world, p and v (runs, steps, 3), in the world, m and m/s; bg and ba
        (runs, steps, 3), rad/s and m/s^2, both or none; the same of the truth as true_R and so on; ``order``, names of
        the parts as they stand in the covariance, R, p, v, bg, ba by default; one run may lack the first dimension
    convention : ``left`` is Log(est^-1 truth) of SE2(3), ``right`` Log(truth est^-1), ``additive`` a difference;
        ``so3`` and ``so3-body`` are additive but for the rotation
        (:func:`consistency.referee.geometry.groups.state_error`). Biases are differences.

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
    own, true = ({part: _part(path, arrays, f"{prefix}{part}") for part in parts} for prefix in ("", TRUE))
    for part in parts:
        if own[part].shape != true[part].shape or own[part].shape[:2] != own["R"].shape[:2]:
            shapes = f"{own[part].shape} and {true[part].shape}"
            beside = f"keys '{part}' and '{TRUE}{part}' have shapes {shapes}"
            raise InputError(f"{path}: {beside}, beside R {own['R'].shape}")
        if not np.isfinite(true[part]).all():
            raise InputError(f"{path}: key '{TRUE}{part}' is not finite; leave such steps out")
    own["R"], true["R"] = _quaternions(path, "R", own["R"]), _quaternions(path, f"{TRUE}R", true["R"])
    states = [part for part in STATE if part in parts]
    estimate, truth = (np.concatenate([side[part] for part in states], axis=-1) for side in (own, true))
    finite = np.isfinite(estimate).all(axis=-1)
    error = np.full((*finite.shape, 3 * len(states)), np.nan)
    error[finite] = state_error(truth[finite], estimate[finite], convention)
    errors = dict(zip(states, np.split(error, len(states), axis=-1), strict=True))
    rest = {key: array for key, array in arrays.items() if key.removeprefix(TRUE) not in (*AXES, "order")}
    axes = [axis for part in order for axis in AXES[part]]
    rest |= {"errors": np.concatenate([errors[part] for part in order], axis=-1), "axes": np.array(axes)}
    of = "and the difference of the velocity"
    if convention in ("left", "right"):
        of = "with the velocity, of SE2(3)"
    return rest, f"{INERTIAL[convention]}, {of}; in the order {', '.join(order)}"


def _order(path: Path, arrays: Mapping[str, Array], parts: list[str]) -> list[str]:
    if ("bg" in parts) != ("ba" in parts):
        raise InputError(f"{path}: key '{'ba' if 'bg' in parts else 'bg'}' is missing; there are two biases or none")
    if missing := [f"{TRUE}{part}" for part in parts if f"{TRUE}{part}" not in arrays]:
        raise InputError(f"{path}: key '{missing[0]}' is missing, of the true states")
    order = [str(part) for part in np.atleast_1d(arrays.get("order", np.array(parts)))]
    if sorted(order) != sorted(parts):
        raise InputError(f"{path}: key 'order' is {', '.join(order)}; must name {', '.join(parts)}, each once")
    return order


def _part(path: Path, arrays: Mapping[str, Array], key: str) -> Array:
    tail = (3, 3) if key.endswith("R") else (3,)
    array = np.asarray(arrays[key], float)
    if array.shape[-len(tail) :] != tail or array.ndim not in (len(tail) + 1, len(tail) + 2):
        wanted = ", ".join(map(str, ("runs", "steps", *tail)))
        raise InputError(f"{path}: key '{key}' has shape {array.shape}, needs ({wanted})")
    return array if array.ndim == len(tail) + 2 else array[None]


def _quaternions(path: Path, key: str, R: Array) -> Array:
    """Quaternions (runs, steps, 4) of rotations; NaN where they are not finite."""
    finite = np.isfinite(R).all(axis=(-2, -1))
    off = np.abs(R[finite] @ np.swapaxes(R[finite], -1, -2) - np.eye(3)).max(axis=(-2, -1))
    if (off > ROTATION).any() or (np.linalg.det(R[finite]) < 0).any():
        raise InputError(f"{path}: key '{key}' holds a matrix that is not a rotation")
    out = np.full((*R.shape[:2], 4), np.nan)
    if finite.any():
        out[finite] = Rotation.from_matrix(R[finite]).as_quat()
    return out
