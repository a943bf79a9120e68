"""The direction in which errors are largest: eigenvectors by hand, and what it finds that the mean NEES does not.

Seeds are fixed and were not chosen; counts have limits at 1e-5.
"""

import numpy as np
import pytest
from draws import autoregression, fully_dependent, independent, slow_axis, verdict_on
from scipy import stats

from consistency.diagnostics import largest_direction, ratio_interval
from consistency.referee.diagnostics.scale import RunMeans

SURE = 1e-5


def by_hand(w):
    """p value, the mean square of each run along the direction of the other half, and the direction of all."""
    moments = []
    for run in w:
        rows = run[np.isfinite(run).all(axis=1)]
        if len(rows):
            moments.append(sum(np.outer(row, row) for row in rows) / len(rows))

    def direction(chosen):
        values, vectors = np.linalg.eig(sum(chosen) / len(chosen))
        return np.real(vectors[:, np.argmax(np.real(values))])

    even, odd = direction(moments[1::2]), direction(moments[0::2])  # directions for runs 0, 2, ... and 1, 3, ...
    along = np.array([u @ M @ u for M, u in zip(moments, [even, odd] * len(moments), strict=False)])
    counts = np.isfinite(w).all(axis=2).sum(axis=1)
    p = min(RunMeans(along[half], counts[half], 1).find().above for half in (slice(0, None, 2), slice(1, None, 2)))
    return min(1.0, 2.0 * p), along, direction(moments)


@pytest.mark.parametrize("runs", [2, 3, 11, 38, 61])
@pytest.mark.parametrize("n", [2, 3])
def test_by_hand(runs, n):
    rng = np.random.default_rng(41)
    w = independent(rng, runs, 7, n) @ rng.standard_normal((n, n))
    w[0, 3:] = np.nan
    result = largest_direction(w)
    p, along, u = by_hand(w)
    assert result.p_value == pytest.approx(p, rel=1e-9)
    assert result.ratio == pytest.approx(tuple(ratio_interval(along)), rel=1e-9)
    assert abs(result.direction @ u) == pytest.approx(1.0)
    assert np.linalg.norm(result.direction) == pytest.approx(1.0)


def test_halves_of_fewer_than_twenty_runs_are_exact():
    """Chi-square with one degree of freedom a run, of both halves; Bonferroni."""
    w = independent(np.random.default_rng(42), 14, 5, 2) * 1.2
    _, along, _ = by_hand(w)
    expected = 2 * min(stats.chi2.sf(along[k::2].sum(), 7) for k in (0, 1))
    assert largest_direction(w).p_value == pytest.approx(min(expected, 1.0), rel=1e-9)


def test_a_run_without_a_value_has_no_part():
    w = independent(np.random.default_rng(43), 13, 5, 3)
    with_gaps = np.insert(w, [0, 4, 9], np.nan, axis=0)
    assert largest_direction(with_gaps).p_value == pytest.approx(largest_direction(w).p_value)


def test_where_it_cannot_be_asked():
    rng = np.random.default_rng(44)
    for w in (independent(rng, 30, 5, 1), independent(rng, 1, 5, 3), np.full((4, 5, 3), np.nan)):
        result = largest_direction(w)
        assert np.isnan(result.p_value)
        assert result.direction.shape == (w.shape[-1],)
        assert np.isnan(result.ratio).all()


@pytest.mark.parametrize("world", [fully_dependent, autoregression, slow_axis])
@pytest.mark.parametrize("n", [2, 6])
def test_a_right_filter_is_not_found(world, n):
    """100 draws of 50 runs at 5 %."""
    rng = np.random.default_rng(46)
    found = sum(largest_direction(world(rng, 50, 10, n)).p_value <= 0.05 for _ in range(100))
    assert found <= stats.binom.isf(SURE, 100, 0.05)


# --- in a verdict that allows what is conservative ----------------------------------------------------------


def correlated(w, correlation=0.8):
    """The first two components correlated; variances stay 1."""
    w = w.copy()
    w[..., 1] = correlation * w[..., 0] + np.sqrt(1.0 - correlation**2) * w[..., 1]
    return w


def oblique(w):
    """x1.6 in a direction between the axes, the rest x0.7."""
    u = 0.5 ** np.arange(w.shape[-1])
    u /= np.linalg.norm(u)
    along = w @ u
    return np.sqrt(0.7) * w + (np.sqrt(1.6) - np.sqrt(0.7)) * along[..., None] * u


FAULTS = [(correlated, 2), (correlated, 3), (oblique, 6)]


@pytest.mark.parametrize("world", [independent, autoregression])
@pytest.mark.parametrize("fault, n", FAULTS)
def test_an_oblique_fault_is_found(fault, n, world):
    """100 runs, allow="conservative"; missed in 2 % at most, so that five draws have 8 in 10^5 to miss four."""
    rng = np.random.default_rng(48)
    draws = [verdict_on(fault(world(rng, 100, 60, n)), allow="conservative") for _ in range(5)]
    found = [v for v in draws if "scale in some direction" in v.faults]
    assert len(found) >= 4
    assert not any("too large" in v.reasons[0] for v in found)
    if fault is correlated:
        assert {v.status for v in found} == {"overconfident"}
        assert any("in the direction" in v.reasons[0] for v in found)


def test_the_sentence_names_the_direction():
    w = correlated(independent(np.random.default_rng(49), 100, 20, 3), 0.8)
    verdict = verdict_on(w, allow="conservative")
    assert "covariance too small by x1." in verdict.reasons[0]
    assert "in the direction +0.7" in verdict.reasons[0]
    assert "axis 2" not in verdict.reasons[0]
    s = verdict.statistics
    assert s["largest"][0] == pytest.approx(1.8, rel=0.1)
    assert s["largest"][1] < s["largest"][0] < s["largest"][2]
    assert np.abs(s["largest_direction"][:2]) == pytest.approx(np.full(2, np.sqrt(0.5)), abs=0.05)


def test_it_is_asked_only_where_too_large_is_allowed():
    w = independent(np.random.default_rng(50), 40, 5, 3)
    asked = {a.question for a in verdict_on(w, allow="conservative").answers}
    assert "scale in some direction" in asked
    assert not {"shape", "shape in some step", "distribution"} & asked
    assert "scale in some direction" not in {a.question for a in verdict_on(w).answers}
