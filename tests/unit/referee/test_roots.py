"""Roots are those of ``scipy.optimize.brentq`` to the bit, so that no digit depends on which of both is called."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import optimize, special

from consistency.referee.diagnostics.roots import brent

FUNCTIONS: dict[str, Callable[[float, float], float]] = {
    "exponential": lambda x, a: float(np.exp(a * x)) - 2.0,
    "cubic": lambda x, a: x**3 + a * x + 0.3,
    "tail": lambda x, a: float(special.ndtr(x) - special.ndtr(a)),
    "steep": lambda x, a: float(np.tanh(20.0 * (x - a))) + 0.2,
    "jump": lambda x, a: float(x > a) - 0.5,
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_bits_are_those_of_scipy(name: str) -> None:
    rng, found = np.random.default_rng(1), 0
    for _ in range(200):
        a, low, high = rng.normal(), -8.0 * rng.random(), 8.0 * rng.random()
        tolerances = (10.0 ** -rng.integers(4, 16), 10.0 ** -rng.integers(4, 15))

        def f(x: float, a: float = a) -> float:
            return FUNCTIONS[name](x, a)

        if np.sign(f(low)) == np.sign(f(high)):
            continue
        found += 1
        assert brent(f, low, high) == optimize.brentq(f, low, high)
        assert brent(f, low, high, *tolerances) == optimize.brentq(f, low, high, xtol=tolerances[0], rtol=tolerances[1])
    assert found


def test_a_root_at_an_end_is_that_end() -> None:
    assert brent(lambda x: x, 0.0, 1.0) == 0.0
    assert brent(lambda x: x - 1.0, 0.0, 1.0) == 1.0


def test_a_bracket_without_a_change_of_sign_is_refused() -> None:
    with pytest.raises(ValueError, match="same sign"):
        brent(lambda x: x * x + 1.0, -1.0, 1.0)


def test_a_function_that_never_settles_is_refused() -> None:
    with pytest.raises(ArithmeticError, match="100 steps"):
        brent(lambda x: -1.0 if x < 1e-300 else 1.0, 0.0, 1e300, 1e-320, 0.0)
