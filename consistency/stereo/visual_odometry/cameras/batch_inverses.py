"""Inverses of many small symmetric matrices at once."""

from __future__ import annotations

import numpy as np

from consistency.referee.types import Array


def symmetric_inverses(C: Array) -> tuple[Array, Array]:
    """Inverses (..., m, m) of symmetric matrices, and which of them are positive definite (...).

    What stands for the inverse of one that is not means nothing. Three rows go by cofactors, which takes a third of
    the time of LAPACK's calls for each matrix.
    """
    if C.shape[-1] != 3:
        one = np.eye(C.shape[-1])
        finite = np.asarray(np.isfinite(C).all(axis=(-2, -1)))
        definite = finite & (np.linalg.eigvalsh(np.where(finite[..., None, None], C, one))[..., 0] > 0.0)
        return np.linalg.inv(np.where(definite[..., None, None], C, one)), definite
    a, b, c, d, e, f = (C[..., i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    out = np.empty_like(C)
    out[..., 0, 0] = d * f - e * e
    out[..., 0, 1] = out[..., 1, 0] = c * e - b * f
    out[..., 0, 2] = out[..., 2, 0] = b * e - c * d
    out[..., 1, 1] = a * f - c * c
    out[..., 1, 2] = out[..., 2, 1] = b * c - a * e
    out[..., 2, 2] = minor = a * d - b * b
    det = a * out[..., 0, 0] + b * out[..., 0, 1] + c * out[..., 0, 2]
    definite = (a > 0.0) & (minor > 0.0) & (det > 0.0)
    out /= np.where(definite, det, 1.0)[..., None, None]
    return out, definite
