"""Numbers formatted for sentences."""

from __future__ import annotations

from consistency.referee.diagnostics.verdict.parts import TINY, Interval

UNCERTAIN = 100.0  # upper over lower end of an interval that says nothing


def short(value: float) -> str:
    """A positive number with two or three digits, for a sentence."""
    return (
        f"{value:.2g}"
        if value < 0.1
        else f"{value:.1e}"
        if value >= 1e4
        else f"{value:.0f}"
        if value >= 100
        else f"{value:.1f}"
        if value >= 10
        else f"{value:.2f}"
    )


def off_by(interval: Interval) -> str:
    """Too small by x1.6 [1.4, 1.9]; of a covariance too large the inverse, and the ratio as tables have it."""
    ratio, low, high = interval
    if ratio >= 1.0:
        return f"too small by x{plain(interval)}"
    if ratio < TINY:
        return "too large: there is hardly any error"
    return f"too large by x{plain(Interval(1.0 / ratio, 1.0 / high, 1.0 / max(low, TINY)))} (ratio {short(ratio)})"


def off_by_factor(ratio: float, up_to: bool = False) -> str:
    """Too small by x1.6; too large by x1.6 (ratio 0.62)."""
    text = f" by {'up to ' * up_to}x{short(max(ratio, 1.0 / max(ratio, TINY)))}"
    return f"too small{text}" if ratio > 1.0 else f"too large{text} (ratio {short(ratio)})"


def plain(interval: Interval) -> str:
    """1.02 [0.87, 1.19]: a ratio that may lie on either side of 1."""
    if interval.value < TINY:
        return f"below {TINY:g}"
    if not interval.high < UNCERTAIN * interval.low:
        return f"{short(interval.value)} (known to no better than a factor of {UNCERTAIN:g})"
    return f"{short(interval.value)} [{short(interval.low)}, {short(interval.high)}]"


def p_text(p: float) -> str:
    """A p value without superfluous digits."""
    return f"{p:.2g}" if p >= 1e-6 else "below 1e-6"


def plural(count: int, noun: str) -> str:
    """1 run, 2 runs."""
    return f"{count} {noun}{'s' * (count != 1)}"


def percent(share: float, digits: int = 2) -> str:
    """5.8 %, of a share."""
    return f"{100.0 * share:.{digits}g} %" if share < 0.995 else "100 %"
