"""Small linear algebra of the kernels, callable from Python too."""

from __future__ import annotations

from typing import Any

import numpy as np

from consistency.bench.models.jitable import jitable

DEFICIENT = 1e-12  # pivot of a correlation matrix below which a direction carries no uncertainty
ROUNDING = 1e-24  # variance (m^2, rad^2) that rounding alone leaves behind where none is


@jitable
def semidefinite_cholesky(A: Any, C: Any) -> bool:
    """C (n, n) <- lower root with C C' = A (n, n), positive semidefinite; the column of a zero pivot is zero.

    The start of a trial is known exactly, so the first covariances are singular. Returns False for an A that is
    indefinite or not finite.
    """
    n = A.shape[0]
    for j in range(n):
        pivot = A[j, j]
        for k in range(j):
            pivot -= C[j, k] * C[j, k]
        if not pivot >= -DEFICIENT * abs(A[j, j]):
            return False
        C[j, j] = np.sqrt(pivot) if pivot > DEFICIENT * A[j, j] else 0.0
        for i in range(j + 1, n):
            C[j, i] = 0.0
            if C[j, j] == 0.0:
                C[i, j] = 0.0
            else:
                rest = A[i, j]
                for k in range(j):
                    rest -= C[i, k] * C[j, k]
                C[i, j] = rest / C[j, j]
    return True


@jitable
def definiteness(P: Any) -> int:
    """1 where P (n, n) is positive definite, 0 rank-deficient, -1 indefinite or not finite, judged on correlations."""
    return definiteness_with(P, np.empty(P.shape))


@jitable
def definiteness_with(P: Any, C: Any) -> int:
    """:func:`definiteness` of P (n, n), with ``C`` (n, n) as its workspace."""
    n = P.shape[0]
    deficient = False
    for j in range(n):
        if not (P[j, j] >= 0.0 and P[j, j] < np.inf):
            return -1
        pivot = P[j, j]
        for k in range(j):
            pivot -= C[j, k] * C[j, k]
        if not pivot >= -DEFICIENT * P[j, j]:
            return -1
        if pivot <= DEFICIENT * P[j, j] or P[j, j] <= ROUNDING:
            deficient = True
            for i in range(j, n):
                C[i, j] = 0.0
            continue
        C[j, j] = np.sqrt(pivot)
        for i in range(j + 1, n):
            rest = P[i, j]
            for k in range(j):
                rest -= C[i, k] * C[j, k]
            C[i, j] = rest / C[j, j]
    return 0 if deficient else 1
