"""Roots of functions of one number, to the bit as :func:`scipy.optimize.brentq` gives them.

Loading ``scipy.optimize`` takes a quarter of the time of ``consistency analyse`` on a small file.
"""

from __future__ import annotations

from collections.abc import Callable

RELATIVE = 4.0 * 2.0**-52  # least relative tolerance
MOST = 100  # steps


def brent(
    f: Callable[[float], float], low: float, high: float, absolute: float = 2e-12, relative: float = RELATIVE
) -> float:
    """The root of ``f`` between ``low`` and ``high``, where its signs are opposite, by Brent's method (1973, ch. 4).

    Each step is one of the secant, or of an inverse parabola, where that is short, and halves the bracket otherwise.

    Raises
    ------
    ValueError
        ``f`` has the same sign at both ends.
    ArithmeticError
        The bracket is not small enough after ``MOST`` steps.
    """
    before, now = low, high
    f_before, f_now = f(before), f(now)
    if f_before == 0.0:
        return before
    if f_now == 0.0:
        return now
    if (f_before < 0.0) == (f_now < 0.0):
        raise ValueError("the function has the same sign at both ends")
    other = f_other = step = last = 0.0  # the end of the bracket across the root; this step and the one before
    for _ in range(MOST):
        if f_before != 0.0 and f_now != 0.0 and (f_before < 0.0) != (f_now < 0.0):
            other, f_other = before, f_before
            step = last = now - before
        if abs(f_other) < abs(f_now):
            before, now, other = now, other, now
            f_before, f_now, f_other = f_now, f_other, f_now
        tolerance = (absolute + relative * abs(now)) / 2.0
        half = (other - now) / 2.0
        if f_now == 0.0 or abs(half) < tolerance:
            return now
        trial = half
        if abs(last) > tolerance and abs(f_now) < abs(f_before):
            if before == other:
                trial = -f_now * (now - before) / (f_now - f_before)
            else:
                a, b = (f_before - f_now) / (before - now), (f_other - f_now) / (other - now)
                trial = -f_now * (f_other * b - f_before * a) / (b * a * (f_other - f_before))
            is_short = 2.0 * abs(trial) < min(abs(last), 3.0 * abs(half) - tolerance)
            last, step = (step, trial) if is_short else (half, half)
        else:
            last = step = half
        before, f_before = now, f_now
        now += step if abs(step) > tolerance else tolerance if half > 0.0 else -tolerance
        f_now = f(now)
    raise ArithmeticError(f"no root within {absolute:g} after {MOST} steps")
