"""Betting on run means: the mean of every factor by numerical integration, and Ville's inequality by drawing.

Counts and means have limits at 5 standard deviations (6e-7 in one direction); seeds are fixed and were not chosen.
"""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest
from scipy import integrate, stats

from consistency.referee.diagnostics import e_process, ever
from consistency.referee.diagnostics.planning import e_process as betting
from consistency.referee.types import Array

SIGMAS = 5.0
STAKES = [("up", stake) for stake in (0.1, 0.25, 0.5, 1.0)] + [("down", stake) for stake in (0.25, 0.5, 1.0, 2.0, 4.0)]


def only(monkeypatch: pytest.MonkeyPatch, side: str, stake: float) -> None:
    """One stake in place of the mixture."""
    monkeypatch.setattr(betting, side.upper(), np.array([stake]))


NODES, WEIGHTS = np.polynomial.legendre.leggauss(60)


def mean_of_a_bet(side: str, n: int, ratio: float = 1.0, kink: float = 1.0) -> float:
    """Expected value after one run of one step, by Gauss-Legendre over the chi distribution of the error's length."""
    ends = [0.0, float(np.sqrt(n * kink / ratio)), float(np.sqrt(n * kink / ratio)) + 9.0]
    mean = 0.0
    for a, b in itertools.pairwise(ends):
        length = 0.5 * (a + b) + 0.5 * (b - a) * NODES
        value = np.array([getattr(e_process(np.array([y]), n), side)[0] for y in ratio * length**2 / n])
        mean += 0.5 * (b - a) * float((WEIGHTS * value * stats.chi(n).pdf(length)).sum())
    return mean


def test_the_stakes_are_these() -> None:
    assert [("up", s) for s in betting.UP] + [("down", s) for s in betting.DOWN] == STAKES


@pytest.mark.parametrize("n", [1, 2, 3, 6])
@pytest.mark.parametrize(("side", "stake"), STAKES)
def test_every_bet_is_fair(monkeypatch: pytest.MonkeyPatch, side: str, stake: float, n: int) -> None:
    """Mean 1 exactly if the covariance is right and the steps of a run are one; below 1 if it errs the other way."""
    only(monkeypatch, side, stake)
    kink = 1.0 + 1.0 / stake
    assert mean_of_a_bet(side, n, kink=kink) == pytest.approx(1.0, abs=1e-8)
    right, wrong = (1.3, 0.7) if side == "up" else (0.7, 1.3)
    assert mean_of_a_bet(side, n, right, kink) > 1.01
    assert mean_of_a_bet(side, n, wrong, kink) < 0.995


@functools.cache
def mean_pay(stake: float, n: int) -> float:
    """Of max(0, 1 - stake (Y - 1)) for Y = chi-square(n) / n."""

    def paid(length: float) -> float:
        return max(0.0, 1.0 - stake * (length**2 / n - 1.0)) * float(stats.chi.pdf(length, n))

    return float(integrate.quad(paid, 0.0, np.sqrt(n * (1.0 + 1.0 / stake)), epsabs=1e-12)[0])


def by_hand(means: Array, dof: Array) -> tuple[list[float], list[float]]:
    """Products and their means in plain numbers."""
    up, down = [1.0] * 4, [1.0] * 5
    all_up, all_down = [], []
    for y, n in zip(means, dof, strict=True):
        for i, stake in enumerate((0.1, 0.25, 0.5, 1.0)):
            up[i] *= 1.0 + stake * (y - 1.0)
        for i, stake in enumerate((0.25, 0.5, 1.0, 2.0, 4.0)):
            down[i] *= 0.98 * max(0.0, 1.0 - stake * (y - 1.0)) / mean_pay(stake, int(n)) + 0.02
        all_up.append(sum(up) / 4)
        all_down.append(sum(down) / 5)
    return all_up, all_down


def test_against_plain_products() -> None:
    """Over runs of unlike dimension, some far from 1."""
    rng = np.random.default_rng(11)
    dof = np.array([1, 3, 2, 3, 6, 1, 1, 2])
    means = np.append(rng.chisquare(dof) / dof, [0.0, 0.3, 7.0])
    dof = np.append(dof, [2, 1, 3])
    bet = e_process(means, dof)
    up, down = by_hand(means, dof)
    assert bet.up == pytest.approx(up, rel=1e-7)
    assert bet.down == pytest.approx(down, rel=1e-7)
    assert bet.both == pytest.approx([(a + b) / 2 for a, b in zip(up, down, strict=True)], rel=1e-7)


def test_one_number_of_degrees_of_freedom_serves_all_runs() -> None:
    means = np.array([0.5, 1.5, 0.8])
    assert e_process(means, 3).down == pytest.approx(e_process(means, np.array([3, 3, 3])).down)
    assert e_process(means, 1).down != pytest.approx(e_process(means, 3).down)


def ever_reaches(rng: np.random.Generator, side: str, ratio: float, n: int, sequences: int, runs: int = 200) -> float:
    """Share of sequences of fully dependent runs that ever reach 20."""
    means = ratio * rng.chisquare(n, (sequences, runs)) / n
    return sum(float(getattr(e_process(y, n), side).max()) >= 20.0 for y in means) / sequences


@pytest.mark.parametrize("n", [1, 3])
def test_ville(n: int) -> None:
    """At most 5 % of sequences of 200 runs ever reach 20, at the worst dependence; 400 sequences."""
    rng = np.random.default_rng(13)
    limit = 0.05 + SIGMAS * np.sqrt(0.05 * 0.95 / 400)
    assert ever_reaches(rng, "both", 1.0, n, 400) <= limit
    assert ever_reaches(rng, "up", 0.9, n, 200) <= 0.05
    assert ever_reaches(rng, "down", 1.1, n, 200) <= 0.05
    assert ever_reaches(rng, "both", 1.6, n, 50) > 0.5
    assert ever_reaches(rng, "both", 0.6, n, 50) > 0.5


def test_ever_is_the_inverse_of_the_largest_value() -> None:
    assert ever(np.array([0.5, 40.0, 0.1])) == pytest.approx(1 / 40)
    assert ever(np.array([0.5, 0.9])) == 1.0
    assert ever(np.empty(0)) == 1.0


def test_what_was_seen_is_not_forgotten() -> None:
    """Evidence against a fault that comes later does not take an earlier finding back."""
    bet = e_process(np.concatenate([np.full(20, 2.0), np.full(200, 0.9)]), 3)
    assert ever(bet.up) < 1e-4
    assert bet.up[-1] < 1.0
    assert len(bet.up) == len(bet.down) == len(bet.both) == 220
    assert np.array_equal(e_process(np.full(20, 2.0), 3).both, bet.both[:20])  # an early value needs no later run


@pytest.mark.parametrize("n", [1, 3])
def test_extreme_runs(n: int) -> None:
    """No error at all, and an error beyond all bounds: no warning, nothing but finite numbers."""
    for means in ([0.0], [0.0] * 400, [1e300], [1e300] * 5, [0.0, 1e300, 1.0], [1e-300] * 50):
        bet = e_process(np.array(means), n)
        for values in (bet.up, bet.down, bet.both):
            assert np.isfinite(values).all()
            assert (values >= 0.0).all()
    assert ever(e_process(np.array([1e300]), n).up) < 1e-290
    assert ever(e_process(np.zeros(40), n).down) < 1e-6


def test_one_run_does_not_end_the_game() -> None:
    """A wild run costs a bet downwards all but a fiftieth of what it had."""
    before, after = e_process(np.append(np.full(30, 0.5), 1e6), 3).down[-2:]
    assert after == pytest.approx(0.02 * before)
    assert e_process(np.concatenate([[1e6], np.full(60, 0.5)]), 3).down[-1] > 20.0


def test_no_run_no_evidence() -> None:
    bet = e_process(np.empty(0), 3)
    assert len(bet.both) == 0
    assert ever(bet.both) == 1.0
