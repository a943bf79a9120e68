"""What is said of stated bounds: a sentence to act on, and a line for each bound."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from consistency.referee.diagnostics.number_words import (
    MOST,
    between_text,
    names_in_a_row,
    percent,
    plural,
    ratio_text,
    short,
)
from consistency.referee.diagnostics.verdict import Findings
from consistency.referee.diagnostics.verdict_parts import HAZARD, REGIONS, SIDES, Alerts, BoundScore, Interval

DEPENDENCE = "however their steps depend on each other"
NEVER = 3.0  # of N runs none is outside: rates from 3 / N on are excluded at 95 %, -ln(.05) / N


def factor_text(factor: Interval) -> str:
    """1.52 [1.35, 1.72]; "1.05, at least 0.92" where no upper end is known."""
    if np.isinf(factor.value):
        return f"at least {short(factor.low)}"
    if np.isinf(factor.high):
        return f"{short(factor.value)}, at least {short(factor.low)}"
    if factor.low <= 0.0:
        return f"{short(factor.value)}, at most {short(factor.high)}"
    return ratio_text(factor)


def level_text(level: float) -> str:
    """95 %, with as many digits as the level has."""
    return f"{100.0 * level:.9g} %"


def bounds_sentence(v: Findings) -> str:
    """The bounds at fault, each with its factor; without a fault what is shown, or what no data of this size show."""
    wrong = [score for score in v.bounds if score.status in SIDES]
    if wrong:
        wrong.sort(key=_clearness)
        texts = [_fault(score) for score in wrong[:MOST]]
        if len(wrong) > MOST:
            texts.append(f"and {len(wrong) - MOST} more are wrong")
        return "; ".join(texts)
    judged = [score for score in v.bounds if score.status]
    none = "no fault found"
    if v.status == "failed":
        none = "no other fault found" if v.failures else "no step has a bound and a truth"
    if any(answer.tolerated for answer in v.answers):
        none = "no fault beyond the tolerance"
    open_ = [score for score in judged if score.status != "consistent"]
    runs = plural(v.runs, v.unit)
    if not judged:
        return none
    if not open_:
        where = between_text(judged[0].equivalence)
        return f"{none} in {runs}, and {_subject(judged)} is shown to be {where}: {_factors(judged)}"
    if max(score.fewest for score in open_) > v.runs:
        return f"{none}, but {_too_few(v, open_)}{_advice(v, open_)}"
    do = "does" if v.runs == 1 else "do"
    where = between_text(open_[0].equivalence)
    return f"{none}, but {runs} {do} not show {_subject(open_)} to be {where}: {_factors(open_)}{_advice(v, open_)}"


def deciding(scores: Sequence[BoundScore]) -> BoundScore:
    """The bound at fault that is clearest, or without a fault the one farthest from its level."""
    wrong = [score for score in scores if score.status in SIDES]
    return min(wrong or scores, key=_clearness)


def _clearness(score: BoundScore) -> tuple[float, float]:
    with np.errstate(divide="ignore"):
        return score.p_value, -abs(float(np.log(score.factor.value)))


def lines_of_bounds(v: Findings) -> list[str]:
    """A line for each bound and group, then what missing steps count as."""
    lines = [_line(score, v.unit) for score in v.bounds]
    lines += [_hazard(score, score.alerts, v.unit) for score in v.bounds if score.alerts is not None]
    missing = max((score.missing for score in v.bounds), default=0)
    if missing:
        lines.append(
            f"{plural(missing, 'step')} after the end of {v.unit}s, or of lost ones, count as inside for 'too small' "
            "and as outside for 'too large'; --ends independent declares that ends do not depend on the errors"
        )
    if any(score.group and not score.status for score in v.bounds):
        lines.append(
            "groups are reported and not judged: their column selects on the outcome, or ends may depend on errors"
        )
    return lines


def _fault(score: BoundScore) -> str:
    if score.status == "overconfident":
        text = f"{score.name} is too small for {level_text(score.level)}: it must grow by a factor of "
    else:
        text = f"{score.name} is larger than {level_text(score.level)} takes: it may shrink to a factor of "
    return f"{text}{factor_text(score.factor)}; {_outside(score)}"


def _outside(score: BoundScore) -> str:
    """How often the error is outside, on each side, and what is expected."""
    sides = ""
    if np.isfinite(score.above):
        sides = f" ({percent(score.above)} above, {percent(score.below)} below)"
    expected = f"{100.0 * (1.0 - score.level):.3g} %"
    return f"the error is outside in {percent(score.rate)} of the steps{sides}, {expected} expected"


def _subject(scores: Sequence[BoundScore]) -> str:
    names = [score.name for score in scores[:MOST]]
    if len(scores) > MOST:
        names[-1] = f"{len(scores) - MOST + 1} more"
    return f"the factor by which {names_in_a_row(names)} must grow"


def _factors(scores: Sequence[BoundScore]) -> str:
    return ", ".join(factor_text(score.factor) for score in scores[:MOST])


def _too_few(v: Findings, scores: Sequence[BoundScore]) -> str:
    """What runs too few to show any right bound to be right do show."""
    score = max(scores, key=lambda one: one.fewest)
    return (
        f"{v.runs} {v.unit}s are too few to show that {score.name} holds or is too large: all of fewer than "
        f"{score.fewest} may stay inside a bound of {level_text(score.level)}. Excluded are a factor below "
        f"{short(score.factor.low)}, and an error outside in {percent(score.rate_limit)} of the steps or more"
    )


def _advice(v: Findings, scores: Sequence[BoundScore]) -> str:
    """Runs that show it; '' where runs failed, which no further run mends."""
    needed = [score.equivalence.runs for score in scores]
    if v.status == "failed":
        return ""
    if None in needed:
        return "; no number of runs below a million shows it"
    most = max(each or 0 for each in needed)
    if most <= v.runs:
        return ""
    return f"; {most} {v.unit}s show it of a right bound in {percent(v.settings.power)} of all cases {DEPENDENCE}"


def _hazard(score: BoundScore, alerts: Alerts, unit: str) -> str:
    """How often a bound is hazardously misleading, and what no data of this size can show."""
    runs = plural(score.runs, unit)
    return (
        f"{score.name} is {REGIONS[HAZARD]} at an alert limit of {short(alerts.limit)} in "
        f"{percent(alerts.shares[HAZARD])} of the steps; {percent(alerts.hazard_limit)} or more is excluded. {runs} "
        f"never show a rate below {percent(min(1.0, NEVER / score.runs))} (3 / N), and 1e-7 takes 30 million {unit}s"
    )


def _line(score: BoundScore, unit: str) -> str:
    status = f", {score.status}" if score.status else ""
    return (
        f"{score.name}, {level_text(score.level)}: factor {factor_text(score.factor)}{status}; {_outside(score)}; "
        f"{percent(score.rate_limit)} or more is excluded, by {plural(score.steps, 'step')} of "
        f"{plural(score.runs, unit)}"
    )
