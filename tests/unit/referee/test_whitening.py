"""Whitening of many components by LAPACK, against that of few by entry and against its definition."""

from importlib import import_module

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

whitening = import_module("consistency.referee.diagnostics.whitening")
n = 5


@pytest.fixture
def given(monkeypatch):
    rng = np.random.default_rng(3)
    monkeypatch.setattr(whitening, "NUMBERS", 4 * n * n)  # several blocks, of four matrices
    A = rng.normal(size=(3, 7, n, n))
    return rng.normal(size=(3, 7, n)), A @ np.swapaxes(A, -1, -2) + 0.1 * np.eye(n)


def both(monkeypatch, e, P):
    found = []
    for large in (n + 1, n):
        monkeypatch.setattr(whitening, "LARGE", large)
        found.append(whitening.whiten(e, P))
    return found[0], found[1]


def test_by_matrix_and_by_entry_agree(monkeypatch, given):
    e, P = given
    for matrices in (P, np.ascontiguousarray(P[0, 0])):
        by_entry, by_matrix = both(monkeypatch, e, matrices)
        assert_allclose(by_matrix, by_entry, rtol=1e-10, atol=1e-12)
    one_by_entry, one = both(monkeypatch, e[0, 0], P[0, 0])
    assert one.shape == (n,)
    assert_allclose(one, one_by_entry, rtol=1e-10, atol=1e-12)
    assert_allclose(np.linalg.cholesky(P[0, 0]) @ one, e[0, 0], rtol=1e-10, atol=1e-12)


def test_missing_and_indefinite_matrices_are_nan_and_no_others(monkeypatch, given):
    e, P = (np.array(part) for part in given)
    e[0, 1, 2], P[0, 3, 1, 1], P[1, 2, 0, 0], P[2, 6] = np.nan, np.nan, -1.0, 0.0
    bad = np.zeros((3, 7), bool)
    bad[[0, 0, 1, 2], [1, 3, 2, 6]] = True
    kept = e.copy()
    by_entry, by_matrix = both(monkeypatch, e, P)
    assert (np.isnan(by_matrix).all(axis=-1) == bad).all()
    assert np.isfinite(by_matrix[~bad]).all()
    assert_allclose(by_matrix, by_entry, rtol=1e-10, atol=1e-12)
    assert_array_equal(e, kept)
