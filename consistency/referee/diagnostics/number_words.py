"""Numbers formatted for sentences."""

from __future__ import annotations

from collections.abc import Sequence

from consistency.referee.diagnostics.verdict import Findings
from consistency.referee.diagnostics.verdict_parts import TINY, Equivalence, Interval

UNCERTAIN = 100.0  # upper over lower end of an interval that says nothing
SIDE = len("too small")  # or "too large", with which :func:`off_by` begins
MOST = 3  # axes, blocks, groups or parts that a sentence names
SMALLEST_P = 1e-6  # below, digits of a p value say nothing


def short(value: float) -> str:
    """A positive number with two or three digits, for a sentence."""
    if value < 0.1:
        return f"{value:.2g}"
    if value >= 1e4:
        return f"{value:.1e}"
    if value >= 100:
        return f"{value:.0f}"
    if value >= 10:
        return f"{value:.1f}"
    return f"{value:.2f}"


def off_by(interval: Interval) -> str:
    """Too small by x1.6 [1.4, 1.9]; of a covariance too large the inverse, and the ratio as tables have it."""
    ratio, low, high = interval
    if is_uncertain(interval) and low > 1.0:
        return f"too small by at least x{short(low)}"
    if ratio >= 1.0:
        return f"too small by x{ratio_text(interval)}"
    if ratio < TINY:
        return "too large: there is hardly any error"
    return f"too large by x{ratio_text(Interval(1.0 / ratio, 1.0 / high, 1.0 / max(low, TINY)))} (ratio {short(ratio)})"


def off_by_factor(ratio: float, up_to: str = "") -> str:
    """Too small by x1.6; too large by x1.6 (ratio 0.62). ``up_to`` stands before the factor."""
    if ratio > 1.0:
        return f"too small by {up_to}x{short(ratio)}"
    factor = max(ratio, 1.0 / max(ratio, TINY))
    return f"too large by {up_to}x{short(factor)} (ratio {short(ratio)})"


def ratio_text(interval: Interval) -> str:
    """1.02 [0.87, 1.19]: a ratio that may lie on either side of 1."""
    if interval.value < TINY:
        return f"below {TINY:g}"
    if is_uncertain(interval) and interval.low > 1.0:
        return f"at least {short(interval.low)}"
    if is_uncertain(interval):
        return f"{short(interval.value)} (known to no better than a factor of {UNCERTAIN:g})"
    return f"{short(interval.value)} [{short(interval.low)}, {short(interval.high)}]"


def is_uncertain(interval: Interval) -> bool:
    """Whether an interval is so wide that it says nothing, or only that a ratio is above its lower end."""
    return not interval.high < UNCERTAIN * interval.low


def since_text(v: Findings) -> str:
    """Where a fault is that begins late: " since step 21", or " in steps 21 to 40" where it ends; '' otherwise."""
    where = v.location
    if where is None or where.since is None:
        return ""
    if where.until is None:
        return f" since {v.place(where.since)}"
    return f" in {v.place(where.since, where.until.step)}"


def between_text(shown: Equivalence) -> str:
    """Where a ratio is shown to be, or should be: "between 0.67 and 1.50", or "below 1.50"."""
    if shown.one_sided:
        return f"below {short(shown.factor)}"
    return f"between {short(1.0 / shown.factor)} and {short(shown.factor)}"


def p_text(p: float) -> str:
    """A p value without superfluous digits."""
    if p >= SMALLEST_P:
        return f"{p:.2g}"
    return "below 1e-6"


def plural(count: int, noun: str) -> str:
    """1 run, 2 runs."""
    if count == 1:
        return f"{count} {noun}"
    return f"{count} {noun}s"


def is_or_are(count: float) -> str:
    """The verb beside a number of things."""
    if count == 1:
        return "is"
    return "are"


def names_in_a_row(names: Sequence[str]) -> str:
    """A, b and c; '' without any."""
    if len(names) < 2:
        return "".join(names)
    return f"{', '.join(names[:-1])} and {names[-1]}"


def first_few(texts: Sequence[str]) -> list[str]:
    """The first of the texts, and then how many more there are."""
    if len(texts) <= MOST:
        return list(texts)
    return [*texts[:MOST], f"and {len(texts) - MOST} more"]


def with_subject(name: str, sentence: str) -> str:
    """The sentence of a verdict on something of that name: "ekf is consistent: ...", or "ekf failed: ..."."""
    if sentence.startswith("failed"):
        return f"{name} {sentence}"
    return f"{name} is {sentence}"


def percent(share: float, digits: int = 2) -> str:
    """5.8 %, of a share."""
    if share < 0.995:
        return f"{100.0 * share:.{digits}g} %"
    return "100 %"
