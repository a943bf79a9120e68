"""Rates of words and of bets that a fast test cannot state: up to 500 draws a row, as many as the promise speaks of.

Random numbers are fresh in every run (the seed is printed when a test fails). Limits are binomial at 1e-5: 50
assertions, together under 1 false failure in 2,000 runs of this file.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from draws import autoregression, errs_at_most, fully_dependent, independent, slow_axis, verdict_on

from consistency.referee.diagnostics import e_process, largest_direction
from consistency.referee.types import Array

pytestmark = pytest.mark.slow

DRAWS, STEPS = 500, 100


# --- heavy tails -------------------------------------------------------------------------------------------


def student(dof: int) -> Callable[[np.random.Generator, tuple[int, ...]], Array]:
    return lambda rng, shape: rng.standard_t(dof, shape) * np.sqrt((dof - 2) / dof)


def laplace(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    return rng.laplace(0.0, np.sqrt(0.5), shape)


KINDS = {"t5": student(5), "t10": student(10), "Laplace": laplace}


@pytest.mark.parametrize("runs", [21, 61, 100])
@pytest.mark.parametrize("steps_differ", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_heavy_tails_are_no_wrong_scale(fresh: np.random.Generator, kind: str, steps_differ: bool, runs: int) -> None:
    """A right covariance is headlined overconfident or conservative in at most 5 %."""

    def headlined() -> bool:
        error = KINDS[kind](fresh, (runs, STEPS if steps_differ else 1, 3))
        error = np.broadcast_to(error, (runs, STEPS, 3)).copy()
        return verdict_on(error).status in ("overconfident", "conservative")

    assert errs_at_most(0.05, DRAWS, headlined)


# --- where and since when ----------------------------------------------------------------------------------


@pytest.mark.parametrize("runs", [21, 61, 100, 301])
def test_a_uniform_fault_names_neither_axis_nor_beginning(fresh: np.random.Generator, runs: int) -> None:
    """x1.2 with AR(.95): each in at most 5 %."""

    def named() -> tuple[bool, bool]:
        verdict = verdict_on(np.sqrt(1.2) * autoregression(fresh, runs, STEPS, 3))
        return verdict.subset is not None, " since step" in verdict.reasons[0]

    assert errs_at_most(0.05, DRAWS, named)


def test_an_axis_and_a_beginning_are_named(fresh: np.random.Generator) -> None:
    """x1.5 in an axis, and from half way, with AR(.95) and 61 runs: 90 %."""

    def missed() -> tuple[bool, bool]:
        one, late = autoregression(fresh, 61, STEPS, 3), autoregression(fresh, 61, STEPS, 3)
        one[..., 1] *= np.sqrt(1.5)
        late[:, STEPS // 2 :] *= np.sqrt(1.5)
        text = verdict_on(one).reasons[0]
        is_named = "mainly axis 1" in text or "in axis 1" in text
        return not is_named, " since step" not in verdict_on(late).reasons[0]

    assert errs_at_most(0.1, DRAWS, missed)


# --- directions and bets -----------------------------------------------------------------------------------


@pytest.mark.parametrize("runs", [21, 50, 100])
@pytest.mark.parametrize("n", [2, 6])
@pytest.mark.parametrize("world", [fully_dependent, autoregression, slow_axis, independent])
def test_no_direction_is_found_in_a_right_filter(
    fresh: np.random.Generator, world: Callable[..., Array], n: int, runs: int
) -> None:
    """2,000 draws at 5 %; Student's t leaves up to a tenth more (5.5 %)."""
    assert errs_at_most(0.055, 2000, lambda: largest_direction(world(fresh, runs, 20, n)).p_value <= 0.05)


@pytest.mark.parametrize("n", [1, 3])
def test_ville(fresh: np.random.Generator, n: int) -> None:
    """Of 20,000 sequences of 200 fully dependent runs at most 5 % ever reach 20; each side too."""
    reached = []

    def reaches() -> Array:
        bet = e_process(fresh.chisquare(n, 200) / n, n)
        reached.append(np.array([bet.up.max(), bet.down.max(), bet.both.max()]) >= 20.0)
        return reached[-1]

    assert errs_at_most(0.05, 20_000, reaches)
    assert np.mean(reached, axis=0).min() >= 0.005  # a game that nobody ever wins finds nothing
