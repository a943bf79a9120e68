"""The sentence of a verdict with faults: those that questions found, the chief one first."""

from __future__ import annotations

from collections.abc import Collection

from consistency.referee.diagnostics.judging.status import smaller
from consistency.referee.diagnostics.verdict.answers import ALONE, BIAS, GROUP, JOINT, SCALE, SHAPE
from consistency.referee.diagnostics.verdict.parts import Scale
from consistency.referee.diagnostics.verdict.verdict import Findings
from consistency.referee.diagnostics.words.faults import (
    bias_text,
    innovation_faults,
    joint_text,
    opposite,
    scale_text,
    shape_text,
    tails_text,
)
from consistency.referee.diagnostics.words.groups import groups_text
from consistency.referee.diagnostics.words.numbers import SMALLEST_P, ratio_text

CHIEF_QUESTIONS = {
    "biased": BIAS,
    "heavy-tailed": ["outliers"],
    "overconfident": SCALE,
    "conservative": SCALE,
}  # by statuses


def fault_sentence(v: Findings, s: Scale) -> str:
    """The sentence where a question found a fault."""
    faults = set(v.faults)
    of_scale = faults.intersection(SCALE)
    of_bias = faults.intersection(BIAS)
    is_asked = any(answer.question in BIAS for answer in v.answers)
    found: list[tuple[str, Collection[str]]] = []  # sentences, with the questions that they answer
    contrary = v.status == "inconsistent" and smaller(v.faults, s) and JOINT not in v.faults
    if v.status == "heavy-tailed" or "outliers" in v.faults or (contrary and not opposite(v)):
        found.append((tails_text(v), ["outliers"]))
    if of_bias:
        found.append((bias_text(v, "bias" not in v.faults), BIAS))
    scale = ""
    if of_scale and v.status not in ("biased", "heavy-tailed"):
        scale = scale_text(v)
        found.append((scale, SCALE))
    if faults.intersection(SHAPE) and v.status not in ("biased", "heavy-tailed"):
        found.append((shape_text(v, scale), SHAPE))
    if JOINT in v.faults and v.joint is not None and v.status != "heavy-tailed":
        found.append((joint_text(v, v.joint), [JOINT]))
    found.sort(key=lambda one: _rank(v, one[1]))
    parts = [text for text, _ in found]
    if v.status == "heavy-tailed":
        parts.append(f"in the mean the covariance ratio is {ratio_text(s.inflation)}")
    if v.by_group is not None:
        parts.append(groups_text(v.by_group, GROUP in v.faults))
    if len(v.faults) == 1:
        parts += [ALONE[question] for question in v.faults if question in ALONE]
    if v.innovations is not None:
        parts += innovation_faults(v, v.innovations)
    if (of_scale or GROUP in v.faults) and not of_bias and v.status != "heavy-tailed" and is_asked:
        parts.append("no bias found")
    return "; ".join(part for part in parts if part)


def _rank(v: Findings, questions: Collection[str]) -> tuple[bool, float, int]:
    """Order of a fault in the sentence: what the status says, then by p value, the size before what else is wrong."""
    p = min((a.adjusted for a in v.answers if a.question in questions and a.question in v.faults), default=1.0)
    order = (SCALE, BIAS, SHAPE)
    return questions != CHIEF_QUESTIONS.get(v.status), max(p, SMALLEST_P), [*order, questions].index(questions)
