"""What can be judged as a covariance, in any unit and in any number of rows."""

from __future__ import annotations

import numpy as np
import pytest

from consistency.referee.diagnostics.records.large_arrays import FEWER as ROWS
from consistency.referee.diagnostics.records.validity import (  # fmt: skip
    DEFICIENT,
    EXACT,
    NEGATIVE,
    ROUNDED,
    Tolerance,
    Validity,
    asymmetric,
    classify,
    negative,
)
from consistency.referee.types import Array

FULL = np.array([[2.0, 0.9, 0.1], [0.9, 1.0, 0.2], [0.1, 0.2, 0.5]])
NAN, INF = np.diag([1.0, np.nan, 1.0]), np.diag([1.0, np.inf, 1.0])


def correlated(rho: float, twist: float = 0.0) -> Array:
    """Two components; the smallest eigenvalue of the correlation matrix is 1 - rho."""
    return np.array([[1.0, rho + twist, 0.0], [rho, 1.0, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("units", [(1.0, 1.0, 1.0), (1e-9, 1.0, 1e6)])
@pytest.mark.parametrize(
    ("matrix", "tolerance", "kind"),
    [
        (FULL, EXACT, Validity.VALID),
        (np.diag([1.0, 0.0, 1.0]), EXACT, Validity.DEFICIENT),
        (np.zeros((3, 3)), EXACT, Validity.DEFICIENT),
        (correlated(1.0), EXACT, Validity.DEFICIENT),
        (correlated(1.0 - 2.0 * DEFICIENT), EXACT, Validity.VALID),
        (correlated(1.0 - 0.5 * DEFICIENT), EXACT, Validity.DEFICIENT),
        (correlated(1.0 + 0.5 * DEFICIENT), EXACT, Validity.DEFICIENT),
        (correlated(1.0 + 2.0 * DEFICIENT), EXACT, Validity.INDEFINITE),
        (correlated(1.0 + 9e-5), ROUNDED, Validity.DEFICIENT),
        (correlated(1.0 + 1.1e-4), ROUNDED, Validity.INDEFINITE),
        (correlated(2.0), ROUNDED, Validity.INDEFINITE),
        (np.diag([1.0, -1.0, 1.0]), ROUNDED, Validity.INDEFINITE),
        (NAN, EXACT, Validity.NOT_FINITE),
        (INF, ROUNDED, Validity.NOT_FINITE),
    ],
)  # fmt: skip
def test_kinds_in_any_unit(units: tuple[float, ...], matrix: Array, tolerance: Tolerance, kind: Validity) -> None:
    assert classify(matrix * np.outer(units, units), tolerance) == kind


def test_a_variance_of_zero_with_a_covariance_is_indefinite() -> None:
    P = np.diag([1.0, 0.0, 1.0])
    P[0, 1] = P[1, 0] = 0.1
    assert classify(P) == Validity.INDEFINITE


@pytest.mark.parametrize(("tolerance", "within"), [(EXACT, 1e-8), (ROUNDED, 1e-6)])
def test_asymmetry_is_relative_to_the_largest_entry(tolerance: Tolerance, within: float) -> None:
    both = 1e6 * np.stack([correlated(0.5, 0.9 * within), correlated(0.5, 1.1 * within)])
    assert asymmetric(both, tolerance).tolist() == [False, True]
    assert classify(both, tolerance).tolist() == [Validity.VALID, Validity.ASYMMETRIC]
    assert asymmetric(np.stack([NAN, INF])).tolist() == [False, False]


def test_a_stack_keeps_its_shape_and_is_worked_on_in_pieces() -> None:
    stack = np.broadcast_to(FULL, (2, ROWS, 3, 3)).copy()
    stack[1, 7] = NAN
    kinds = classify(stack)
    assert kinds.shape == (2, ROWS)
    assert np.argwhere(kinds != Validity.VALID).tolist() == [[1, 7]]
    assert classify(stack[:0]).shape == (0, ROWS)


def test_negative_is_more_lenient_than_indefinite() -> None:
    lost, wrong = np.diag([1.0, -0.5 * NEGATIVE, 1.0]), np.diag([1.0, -2.0 * NEGATIVE, 1.0])
    assert negative(np.stack([FULL, lost, wrong])).tolist() == [False, False, True]
    assert classify(lost) == Validity.INDEFINITE
    assert negative(np.empty((0, 3, 3))).shape == (0,)


def test_only_files_have_a_variance_below_which_there_is_none() -> None:
    """A clock error in seconds has such variances; arrays state them to all digits."""
    small = 1e-13**2 * FULL
    assert classify(small, EXACT) == Validity.VALID
    assert classify(small, ROUNDED) == Validity.DEFICIENT
