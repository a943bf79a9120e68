"""Covariances of poses in space as rows of text hold them: matrices, triangles, deviations; blocks in any order."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from consistency.referee.diagnostics.records.large_arrays import diagonal
from consistency.referee.errors import InputError
from consistency.referee.geometry.conventions import INERTIAL, SPATIAL
from consistency.referee.readers.clock_units import nothing_near
from consistency.referee.readers.formats.columns import is_numbered
from consistency.referee.readers.formats.file_head import head_of
from consistency.referee.readers.formats.pose_rows import DEVIATIONS, FULL, POSE_NUMBERS, SPLIT, TRIANGLE
from consistency.referee.readers.formats.text_blocks import Lines, read_numbers
from consistency.referee.readers.options import Reading
from consistency.referee.readers.places import refuse
from consistency.referee.readers.runs_to_record import symmetric
from consistency.referee.readers.truth_matching import associate
from consistency.referee.types import Array, Indices

ORDERS = ("translation-rotation", "rotation-translation")
BLOCKS = ("p", "R", "v", "bg", "ba")  # three components each, in the order of a state
BOTH = 2 * FULL  # and a cross-covariance with the line before


def components_in(numbers: int) -> int | None:
    """Components of a covariance of which a row holds n^2 numbers, the upper triangle, or n deviations."""
    return next((n for n in DEVIATIONS if numbers in (n, n * n, n * (n + 1) // 2)), None)


def components_of(lines: Lines) -> int:
    """Components whose covariance or deviations stand behind the poses; those of a pose where none do."""
    return components_in(lines.values.shape[1] - POSE_NUMBERS) or 6


def covariances_in(lines: Lines, order: str) -> Array | None:
    """Covariances (N, n, n), translation first, that stand behind the poses; None without any."""
    numbers = lines.values[:, POSE_NUMBERS:]
    if not numbers.shape[1]:
        return None
    if lines.values.shape[1] != SPLIT:
        return _matrices(numbers, order)
    out = np.zeros((len(numbers), 6, 6))  # two triangles: rotation, then position
    out[:, 3:, 3:] = _from_triangle(numbers[:, :6], 3)
    out[:, :3, :3] = _from_triangle(numbers[:, 6:], 3)
    return out


def matrices_of(source: Lines, order: str) -> Array:
    """Covariances (N, 6, 6), translation first, of the lines of a file of covariances."""
    return _matrices(source.values[:, 1 : 1 + FULL], order)


def _matrices(numbers: Array, order: str) -> Array:
    """Covariances (N, n, n), translation first, of numbers in the order of a file."""
    many = numbers.shape[1]
    n = components_in(many)
    assert n is not None
    places = covariance_order(n, order)
    if many == n:
        return diagonal(numbers[:, places])
    P = numbers.reshape(-1, n, n) if many == n * n else _from_triangle(numbers, n)
    if order == ORDERS[0]:
        return P
    return np.asarray(P[:, places][:, :, places])


def _from_triangle(numbers: Array, n: int) -> Array:
    out = np.empty((len(numbers), n, n))
    i, j = np.triu_indices(n)
    out[:, i, j] = out[:, j, i] = numbers
    return out


# --- the order of blocks -----------------------------------------------------------------------------


def covariance_order(n: int, order: str) -> list[int]:
    """Places of x, y, z, the rotation and n - 6 more among components in an order."""
    there = BLOCKS[: n // 3]
    blocks = [block for block in blocks_in(n, order) if block in there]
    return [3 * blocks.index(block) + i for block in there for i in range(3)]


def blocks_in(n: int, order: str) -> list[str]:
    """Blocks of a covariance (n, n) in an order, which may leave out the last ones."""
    names = {ORDERS[0]: "p,R", ORDERS[1]: "R,p"}.get(order, order).split(",")
    return [*names, *(block for block in BLOCKS[: n // 3] if block not in names)]


def order_note(path: Path | str, n: int, r: Reading) -> str:
    """The order of the blocks: where it is declared, or where no names of columns tell that of three or more.

    Raises
    ------
    InputError
        The declared order does not go with n components.
    """
    order = r.covariance_order
    blocks = blocks_in(n, order or ORDERS[0])
    there = BLOCKS[: n // 3]
    if sorted(blocks) != sorted(there):
        which = f"the blocks {','.join(there)} of {path} in their order, such as {','.join(reversed(there))}"
        names = "(p position, R rotation, v velocity, bg, ba biases)"
        raise InputError(f"--covariance-order {order}: must be {' or '.join(ORDERS)}, or {which} {names}")
    if order is None:
        head = None if n == 6 else head_of(Path(path), r.columns)
        if n == 6 or (head is not None and not any(map(is_numbered, head.names))):
            return ""
    return f"{path}: the covariance is read in the order {', '.join(blocks)}; --covariance-order declares another one"


def require_error(own: Lines, error: str | None) -> None:
    """Refuse covariances of states whose error is not declared, and an error of states for poses alone."""
    n = components_of(own)
    if n > 6 and error is None:
        what = f"{own.path}: holds a covariance of poses with their velocity, whose error is not known"
        raise InputError(f"{what}; add --error {', '.join(INERTIAL)} ('guess' is for poses alone)")
    if n == 6:
        require_spatial(error, SPATIAL)


def require_spatial(error: str | None, known: dict[str, str]) -> None:
    """Refuse an error that poses in space do not have."""
    if error not in (None, *known):
        raise InputError(f"--error {error}: for a trajectory in space it is one of {', '.join(SPATIAL)}")


# --- files of their own ------------------------------------------------------------------------------


def read_covariances(path: Path) -> Lines:
    """A file of covariances: t, then 36 numbers row by row, or the 21 of the upper triangle.

    72 numbers are the 36 and the cross-covariance E e_before e' with the line before, row by row.
    """
    layout = f"t and {FULL} numbers, or t and {TRIANGLE}, or t and {BOTH}"
    return read_numbers(path, (1 + TRIANGLE, 1 + FULL, 1 + BOTH), layout)


def nearest_rows(own: Lines, other: Lines, tolerance: float) -> tuple[Indices, Indices]:
    """Rows (k,) of some lines, and those of a file of covariances that are near in time."""
    rows, match = associate(own.t, other.t, tolerance)
    if not len(rows):
        raise nothing_near((own.path, other.path), own.t, other.t, tolerance, "estimate", "covariance")
    return rows, match


def from_file(lines: Lines, path: Path, order: str, tolerance: float) -> Array:
    """Covariances (N, 6, 6) of lines from a file of their own; NaN where it has none near in time."""
    source = read_covariances(path)
    rows, picked = nearest_rows(lines, source, tolerance)
    return on_rows(len(lines.t), rows, matrices_of(source, order)[picked], source, picked)


def on_rows(count: int, rows: Indices, P: Array, source: Lines, picked: Indices) -> Array:
    """Covariances (count, n, n) with ``P`` (k, n, n) in some rows, symmetric, and NaN in the others."""
    out = np.full((count, *P.shape[1:]), np.nan)
    out[rows] = symmetric(P, lambda row: source.place(int(picked[row])), one_triangle=True)
    return out


def cross_covariances(own: Lines, source: Lines, rows: Indices, picked: Indices, order: str) -> Array:
    """Cross-covariances with the line before, on the rows of ``own``, (N, 6, 6)."""
    what = "but the cross-covariance of the next line is with this one; give each line its pose"
    gap = np.diff(picked) != 1
    refuse(gap, lambda row: source.place(int(picked[row]) + 1), f"no pose of {own.path} has this time, {what}")
    out = np.full((len(own.t), 6, 6), np.nan)
    out[rows] = _matrices(source.values[picked, 1 + FULL :], order)
    return out
