"""BLAS as kernels call it, against SciPy; and the covariance of which only one half is kept."""

import os
import subprocess
import sys
import textwrap

import numpy as np
import pytest
import scipy.linalg

from consistency.bench.filters.kernel import linalg
from consistency.bench.filters.kernel.update_steps import add_gram_to_state, gather_rows

SIZES = [(1, 1), (3, 7), (36, 174), (50, 9)]


def padded(A):
    """A view of A inside a larger array of NaN, as kernels use their work arrays."""
    large = np.full((A.shape[0] + 2, A.shape[1] + 3), np.nan)
    large[: A.shape[0], : A.shape[1]] = A
    return large[: A.shape[0], : A.shape[1]]


def upper(A):
    """The same with NaN below the diagonal."""
    out = padded(A)
    out[np.tril_indices(len(A), -1)] = np.nan
    return out


def surroundings_untouched(A):
    return bool(np.isnan(A.base[A.shape[0] :]).all() and np.isnan(A.base[:, A.shape[1] :]).all())  # type: ignore[union-attr]


@pytest.mark.parametrize("m, n", SIZES)
def test_every_routine_against_scipy(m, n, rng):
    B, A = rng.normal(size=(m, n)), rng.normal(size=(m, m + 3))
    S = A @ A.T + 0.1 * np.eye(m)
    root = scipy.linalg.cholesky(S)
    U = upper(S)
    assert linalg.upper_cholesky(U)
    assert np.allclose(np.triu(U), root, rtol=1e-12, atol=1e-12)
    for solve, trans in ((linalg.solve_upper, 0), (linalg.solve_transposed, 1)):
        X = padded(B)
        solve(U, X)
        assert np.allclose(X, scipy.linalg.solve_triangular(root, B, trans=trans), rtol=1e-9, atol=1e-9)
        assert surroundings_untouched(X)
    symmetric = rng.normal(size=(n, n))
    C = upper(symmetric)
    linalg.add_gram(-0.7, padded(B), C)
    assert np.allclose(np.triu(C), np.triu(symmetric - 0.7 * B.T @ B), rtol=1e-12, atol=1e-12)
    assert np.isnan(C[np.tril_indices(n, -1)]).all()
    D = padded(np.full((n, m + 3), np.inf))  # what was there does not matter
    linalg.product_of_transposed(padded(B), padded(A), D)
    assert np.allclose(D, B.T @ A, rtol=1e-12, atol=1e-12)
    assert surroundings_untouched(D)
    x, y = rng.normal(size=n), rng.normal(size=(m, 5))
    z = x.copy()
    linalg.add_transposed_times(padded(B), y[:, 2], z)
    assert np.allclose(z, x + B.T @ y[:, 2], rtol=1e-12, atol=1e-12)


def test_an_indefinite_matrix_has_no_root(rng):
    S = np.eye(5)
    S[3, 3] = -1.0
    assert not linalg.upper_cholesky(upper(S))


def test_rows_of_half_a_covariance(rng):
    A = rng.normal(size=(18, 18))
    P = upper(A @ A.T)
    P[:3, :3] = (A @ A.T)[:3, :3]
    rows = np.full((12, 20), np.nan)
    gather_rows(P, 18, 3, np.array([9, 3, 15]), 3, rows)
    assert np.array_equal(rows[:, :18], (A @ A.T)[np.r_[0:3, 9:12, 3:6, 15:18]])
    W = rng.normal(size=(4, 18))
    add_gram_to_state(-1.0, W, P, 18)
    after = A @ A.T - W.T @ W
    assert np.allclose(np.triu(P), np.triu(after), rtol=1e-12, atol=1e-12)
    assert np.array_equal(P[:3, :3], P[:3, :3].T)


KERNEL = """
import numpy as np
from consistency.bench.filters.kernel import linalg
from consistency.bench.filters.compiler.jit import Kernel

def root_of(A):
    return linalg.upper_cholesky(A)

root = Kernel(root_of)

A = 4.0 * np.eye(3)
assert root(A) and A[2, 2] == 2.0
print(root.loaded)
"""


def test_a_kernel_on_disk_finds_blas_in_another_process(tmp_path):
    """Addresses differ from process to process; names do not."""
    script = tmp_path / "cached_kernel.py"
    script.write_text(textwrap.dedent(KERNEL), encoding="utf-8")
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    hits = [
        subprocess.run([sys.executable, script], env=environment, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    ]
    assert [int(text) for text in hits] == [0, 1]
