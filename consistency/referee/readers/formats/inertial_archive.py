"""States of an inertial filter in archives: rotation, position and velocity, of the group SE2(3), and two biases."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.geometry.conventions import INERTIAL
from consistency.referee.geometry.lie_groups import state_error
from consistency.referee.readers.formats.rotations import are_rotations, quaternions
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


def extended_errors(path: Path, arrays: Mapping[str, Array], convention: str | None) -> tuple[dict[str, Array], str]:
    """The arrays with ``errors`` (runs, steps, 9 or 15) and ``axes`` in place of the states, and the error in words.

    Parameters
    ----------
    arrays : R (runs, steps, 3, 3), from body to world, p and v (runs, steps, 3), in the world, m and m/s; bg and ba
        (runs, steps, 3), rad/s and m/s^2, both or none; the same of the truth as true_R and so on; ``order``, names of
        the parts as they stand in the covariance, R, p, v, bg, ba by default; one run may lack the first dimension
    convention : ``left`` is Log(est^-1 truth) of SE2(3), ``right`` Log(truth est^-1), ``additive`` a difference;
        ``so3`` and ``so3-body`` are additive but for the rotation
        (:func:`consistency.referee.geometry.lie_groups.state_error`). Biases are differences.

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
