"""Whether pieces of a log seem to be independent, and whether runs end because they are lost."""

from __future__ import annotations

import calibration_windows
import numpy as np
import pytest
from scipy import signal, stats

from consistency.referee.diagnostics import Evidence, judge
from consistency.referee.diagnostics.questions.early_ending import early_ends
from consistency.referee.diagnostics.questions.independence import ALIKE, ENOUGH, FEWEST, RATE, SIZES, independence
from consistency.referee.diagnostics.verdict.as_dictionary import flat
from consistency.referee.types import Array

SURE = 1e-5  # false-failure rate of each statistical assertion


def test_the_first_band_by_hand() -> None:
    """Band 1 of 20 values: frequencies 0 and 1 against the others, an F ratio of sums of squares of projections."""
    w = np.linspace(-1.0, 1.5, 20)[:, None] + 0.3 * np.cos(np.arange(20))[:, None]
    k = np.arange(20)
    waves = [np.ones(20), np.cos(2 * np.pi * k / 20), np.sin(2 * np.pi * k / 20)]
    parts = np.array([(wave @ w[:, 0]) ** 2 / (wave @ wave) for wave in waves])
    ratio = (parts.sum() / 3) / ((np.square(w).sum() - parts.sum()) / 17)
    bands = 3  # 1, 2 and 4 of at most 5
    expected = stats.f.sf(ratio, 3, 17) * bands / ((1 - SIZES) * ALIKE)
    found = independence(w)
    assert found.signs <= expected * (1 + 1e-9)  # another band may be clearer
    sizes = np.cbrt(np.square(w[:, 0]))
    sizes -= sizes.mean()
    p = []
    for b in (1, 2, 4):
        low = sum((np.cos(2 * np.pi * j * k / 20) @ sizes) ** 2 + (np.sin(2 * np.pi * j * k / 20) @ sizes) ** 2
                  for j in range(1, b + 1)) / 10  # fmt: skip
        ratio = (low / (2 * b)) / ((np.square(sizes).sum() - low) / (19 - 2 * b))
        p += [stats.f.sf(ratio, 2 * b, 19 - 2 * b) / ALIKE, stats.f.cdf(ratio, 2 * b, 19 - 2 * b) / (1 - ALIKE)]
    assert found.sizes == pytest.approx(min(1.0, min(p) * bands / SIZES))


@pytest.mark.parametrize("count", [20, 31, 200])
def test_independent_pieces_are_doubted_at_the_stated_rate(count: int, rng: np.random.Generator) -> None:
    """400 logs; the rate of 0.5 % is exceeded by chance in 1e-5."""
    doubted = sum(independence(rng.normal(size=(count, 3))).doubtful for _ in range(400))
    assert doubted <= stats.binom.isf(SURE, 400, 0.005)


def test_p_values_of_independent_pieces_are_as_small_as_they_say(rng: np.random.Generator) -> None:
    """600 logs: p is at most .2 in at most a share of .2, and not in hardly any; 1e-5 each."""
    p = np.array([[(one := independence(rng.normal(size=(40, 2)))).sizes, one.signs] for _ in range(600)])
    for column, share in zip(p.T, (SIZES, 1 - SIZES), strict=True):
        small = (column <= 0.2).sum()
        assert stats.binom.ppf(SURE, 600, 0.3 * 0.2 * share) <= small <= stats.binom.isf(SURE, 600, 0.2 * share)


@pytest.mark.parametrize(("memory", "count"), [(0.5, 400), (0.8, 150), (0.95, 150)])
def test_sizes_that_go_on_are_doubted(memory: float, count: int, rng: np.random.Generator) -> None:
    """Missed in fewer than 1e-5: signs are independent, sizes AR."""
    found = independence(calibration_windows.windows_of(rng, count, memory))
    assert found.doubtful
    assert found.of_sizes
    assert found.alike


def test_signs_and_what_takes_turns(rng: np.random.Generator) -> None:
    noise = rng.normal(size=(301, 2))
    back = independence(noise[1:] - noise[:-1])
    assert back.doubtful
    assert not back.alike
    assert not back.of_sizes
    slow = independence(signal.lfilter([1.0], [1.0, -0.9], noise, axis=0))
    assert slow.doubtful
    assert slow.alike
    bias = independence(noise + 1.0)
    assert bias.doubtful
    assert bias.alike
    assert not bias.of_sizes
    turns = independence(noise * np.where(np.arange(301) % 2, 5.0, 1.0)[:, None])
    assert turns.doubtful
    assert turns.of_sizes
    assert not turns.alike


def test_scale_and_gaps_are_no_matter_and_few_are_not_asked(rng: np.random.Generator) -> None:
    w = rng.normal(size=(FEWEST + 1, 3))
    gap = np.insert(w, 5, np.nan, axis=0)
    a, b = independence(w), independence(7.0 * gap)
    assert (a.pieces, b.pieces) == (FEWEST + 1, FEWEST + 1)
    assert b.p_value == pytest.approx(a.p_value)
    assert np.isfinite(independence(w[:FEWEST]).p_value)
    few = independence(w[: FEWEST - 1])
    assert np.isnan(few.p_value)
    assert not few.doubtful
    assert not independence(np.zeros((50, 2))).doubtful
    assert ENOUGH > FEWEST
    assert RATE < 0.005


def test_rows_of_the_calibration(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration_windows, "QUICK_GATES", 3)
    monkeypatch.setattr(calibration_windows, "QUICK_RIGHT", 3)
    rows = calibration_windows.rows(True, 5)
    assert {row["question"] for row in rows} | {row["world"] for row in rows} == set(calibration_windows.ABOUT)
    assert all(row["gates"] == 3 for row in rows)


# --- runs that end early ---------------------------------------------------------------------------------------


def test_early_ends_by_hand() -> None:
    """Two of five runs end in step 1 with ranks 5 and 3, one of three in step 2 with rank 2."""
    nan = np.nan
    nees = np.array([[5.0, nan, nan], [3.0, nan, nan], [1.0, 2.0, nan], [2.0, 1.0, 4.0], [4.0, 3.0, 4.0]])
    found = early_ends(nees)
    assert found.runs == 3
    assert found.above == pytest.approx((3 / 3 + 2 / 3 + 1 / 2) / 3)
    gap, variance = 8 - 6 + 2 - 2, 2 * 3 * 6 / 12 + 1 * 2 * 4 / 12
    assert found.p_value == pytest.approx(stats.norm.sf(gap / np.sqrt(variance)))
    assert not found.lost
    assert early_ends(nees[3:]).runs == 0
    assert early_ends(np.full((3, 4), nan)).runs == 0
    assert np.isnan(early_ends(np.ones((4, 2))).p_value)


def runs(rng: np.random.Generator, number: int, steps: int) -> Array:
    """NEES (number, steps) of errors AR(.9), n = 3."""
    noise = rng.normal(size=(number, steps, 3))
    noise[:, 1:] *= np.sqrt(1.0 - 0.9**2)
    return np.square(signal.lfilter([1.0], [1.0, -0.9], noise, axis=1)).sum(axis=-1)


def test_runs_that_end_lost_are_named_and_others_are_not(rng: np.random.Generator) -> None:
    """100 runs that end where the NEES is beyond its 5 % point, certain but for 1e-5; 60 gates of any lengths."""
    nees = runs(rng, 100, 60)
    ended = np.cumsum(nees > stats.chi2.isf(0.05, 3), axis=1) - (nees > stats.chi2.isf(0.05, 3)) > 0
    verdict = judge(Evidence("f", nees=np.where(ended, np.nan, nees), dof=3))
    assert verdict.ends.lost
    assert "that end early have a larger NEES in their last step than" in verdict.reasons[1]
    assert flat(verdict)["early_ends"]["lost"]
    whole = judge(Evidence("f", nees=nees, dof=3))
    assert whole.ends is None
    assert "early_ends" not in flat(whole)
    lost = 0
    for _ in range(60):
        nees, length = runs(rng, 25, 20), rng.integers(1, 21, 25)
        found = early_ends(np.where(np.arange(20) < length[:, None], nees, np.nan))
        lost += found.lost
    assert lost <= stats.binom.isf(SURE, 60, 2e-3)


def test_ends_with_small_errors_are_no_matter(rng: np.random.Generator) -> None:
    nees = runs(rng, 100, 20)
    nees[np.argsort(nees[:, 9])[:30], 10:] = np.nan
    found = early_ends(nees)
    assert (found.runs, found.lost) == (30, False)
    assert found.above < 0.2
    assert found.p_value > 0.999
