"""A verdict does not depend on the blocks it is worked out in, and needs little more memory than its arrays."""

import tracemalloc

import numpy as np
import pytest
from referee import judge

from consistency.referee.diagnostics import whitening
from consistency.referee.types import Failure

RUNS, STEPS = 61, 23


def sample(rng, runs, steps, bias=0.0):
    """Errors with about the stated covariance, (runs, steps, 3), and an NIS."""
    A = np.eye(3) + 0.3 * rng.standard_normal((runs, steps, 3, 3))
    P = A @ np.swapaxes(A, -1, -2)
    error = np.einsum("...ij,...j->...i", np.linalg.cholesky(P), 1.3 * rng.standard_normal((runs, steps, 3)) + bias)
    nis_dof = rng.integers(1, 9, (runs, steps))
    return {"error": error, "covariance": P, "nis": rng.chisquare(nis_dof), "nis_dof": nis_dof}


def equal(a, b, where=""):
    """The same figures to rounding."""
    assert type(a) is type(b), where
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            equal(a[key], b[key], f"{where} {key}")
    elif isinstance(a, list | tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            equal(x, y, where)
    elif isinstance(a, float | np.ndarray):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-300, err_msg=where)
    else:
        assert a == b, where


def verdicts(arrays, **options):
    return [judge("f", **arrays, **options), judge("f", **arrays, allow="conservative", **options)]


@pytest.mark.parametrize("bias", [0.0, 0.4])
@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("size", [1, 40, 100_000])
def test_blocks_do_not_change_the_verdict(rng, monkeypatch, bias, gaps, size):
    arrays = sample(rng, RUNS, STEPS, bias)
    failures = ()
    if gaps:
        failures = (Failure("f", 3, 1, "x"), Failure("f", 40, 12, "x"))
        for failure in failures:
            for name in ("error", "covariance", "nis"):
                arrays[name][failure.run, failure.step - 1 :] = np.nan
    whole = verdicts(arrays, failures=failures)
    before = {name: array.copy() for name, array in arrays.items()}
    monkeypatch.setattr(whitening, "ROWS", size)
    monkeypatch.setattr(whitening, "FEWER", size)
    for a, b in zip(whole, verdicts(arrays, failures=failures), strict=True):
        assert (a.status, a.reasons) == (b.status, b.reasons)
        equal(a.statistics, b.statistics)
    assert all(np.array_equal(before[name], array, equal_nan=True) for name, array in arrays.items())


def test_what_is_left_out_by_name_counts_nowhere(rng):
    """Errors of a step without NEES: any other value there gives the same verdict."""
    arrays = sample(rng, RUNS, STEPS)
    nees = np.full((RUNS, STEPS), np.nan)
    nees[:, 1:] = 1.0  # which steps count; the values are worked out from the errors
    a = judge("f", **arrays, nees=nees)
    arrays["error"][:, 0] *= 1e3
    equal(a.statistics, judge("f", **arrays, nees=nees).statistics)
    arrays["error"][:, 1] *= 1e3
    assert judge("f", **arrays, nees=nees).statistic > 10 * a.statistic, "negative control"


def test_a_verdict_needs_less_memory_than_its_arrays_hold(rng, monkeypatch):
    """Error, covariance, NIS and its degrees of freedom are 112 bytes a run and step."""
    arrays = sample(rng, 400, 100)
    judge("f", **arrays)  # loads modules, which are not measured
    peaks = []
    for rows in (1000, 10**9):  # the second is the negative control
        monkeypatch.setattr(whitening, "ROWS", rows)
        monkeypatch.setattr(whitening, "FEWER", rows)
        tracemalloc.start()
        try:
            assert judge("f", **arrays).status == "overconfident"
            peaks.append(tracemalloc.get_traced_memory()[1] / (400 * 100))
        finally:
            tracemalloc.stop()
    assert peaks[0] < 112.0 < peaks[1]


@pytest.mark.parametrize("count, each", [(0, 5), (1, 5), (10, 0), (10, 3), (10, 10**9)])
def test_slices_cover_everything_once(monkeypatch, count, each):
    monkeypatch.setattr(whitening, "ROWS", 7)
    slices = list(whitening.block_slices(count, each))
    assert slices
    assert [k for here in slices for k in range(count)[here]] == list(range(count))
