"""The distribution functions are those of ``scipy.stats``, which no verdict loads."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from scipy import stats

from consistency.referee.diagnostics.questions import early_ending
from consistency.referee.diagnostics.statistics import distributions as laws

DOF = np.array([1.0, 2.0, 2.5, 3.0, 6.0, 15.0, 1e3, 1e5])[:, None]
TAILS = np.concatenate([10.0 ** np.linspace(-14, 0, 60), 1.0 - 10.0 ** np.linspace(-14, -1, 30), [0.0, 0.5, np.nan]])
VALUES = np.concatenate([np.geomspace(1e-6, 1e4, 80), [-1.0, 0.0, np.inf, np.nan]])


@pytest.mark.parametrize("name", ["cdf", "sf"])
def test_chi_square_and_student(name: str) -> None:
    for ours, theirs, x in ((laws.chi2, stats.chi2, VALUES), (laws.t, stats.t, np.append(VALUES, -VALUES))):
        np.testing.assert_array_equal(getattr(ours, name)(x, DOF), getattr(theirs, name)(x, DOF))


@pytest.mark.parametrize("name", ["ppf", "isf"])
def test_quantiles(name: str) -> None:
    for ours, theirs in ((laws.chi2, stats.chi2), (laws.t, stats.t)):
        np.testing.assert_array_equal(getattr(ours, name)(TAILS, DOF), getattr(theirs, name)(TAILS, DOF))


def test_no_degrees_of_freedom() -> None:
    assert np.isnan([laws.chi2.sf(1.0, 0.0), laws.chi2.isf(0.5, -1.0), laws.t.sf(1.0, 0.0)]).all()


def test_beta(monkeypatch: pytest.MonkeyPatch) -> None:
    x = np.linspace(0.0, 1.0, 50)
    right = stats.beta.sf(x, 1.5, DOF / 2)
    np.testing.assert_allclose(laws.beta.sf(x, 1.5, DOF / 2), right, rtol=1e-12)
    monkeypatch.delattr("scipy.special.betaincc", raising=False)  # as before SciPy 1.11
    np.testing.assert_allclose(laws.beta.sf(x, 1.5, DOF / 2), right, rtol=1e-9, atol=1e-300)


@pytest.mark.parametrize("N", [1, 2, 3, 7, 20, 59, 100, 140, 141, 5000])
def test_kolmogorov(N: int) -> None:
    for distance in (0.5 / N, *np.linspace(0.25, 3.0, 23) / np.sqrt(N), 1.0):
        assert laws.kolmogorov.sf(distance, N) == pytest.approx(stats.kstwo.sf(distance, N), rel=1e-9, abs=1e-13)
    for p in (1e-5, 1e-3, 0.05, 0.3, 0.9):
        assert laws.kolmogorov.isf(p, N) == pytest.approx(stats.kstwo.isf(p, N), rel=1e-9)
    assert np.isnan(laws.kolmogorov.sf(float("nan"), N))


def test_a_gate_does_not_load_scipy_stats() -> None:
    gate = (
        "import sys, numpy as np; from consistency.testing import assert_consistent; "
        "rng = np.random.default_rng(1); e = rng.standard_normal((50, 20, 3)); "
        "assert_consistent(e, np.broadcast_to(np.eye(3), (50, 20, 3, 3)), false_alarm=1e-9); "
        "assert 'scipy.stats' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", gate], check=True)


def test_ranks_share_the_mean_of_equal_values() -> None:
    values = np.random.default_rng(2).integers(0, 9, 40).astype(float)
    np.testing.assert_array_equal(early_ending._ranks(values), stats.rankdata(values))
