"""The sentence of a verdict with faults: those that questions found, the chief one first."""

from __future__ import annotations

from collections.abc import Collection

from consistency.referee.diagnostics.judging.status import smaller
from consistency.referee.diagnostics.verdict.answers import ALONE, BIAS, GROUP, JOINT, SCALE, SHAPE
from consistency.referee.diagnostics.verdict.parts import Scale
from consistency.referee.diagnostics.verdict.verdict import Faults, Findings
from consistency.referee.diagnostics.words.faults import (
    MOST,
    bias_text,
    innovations_text,
    joint_text,
    opposite,
    scale_text,
    shape_text,
    tails_text,
)
from consistency.referee.diagnostics.words.groups import groups_text
from consistency.referee.diagnostics.words.numbers import SMALLEST_P, ratio_text


def fault_sentence(v: Findings, s: Scale, faults: Faults) -> str:
    """The sentence where a question found a fault."""
    if v.parts:
        return _faults_of_parts(v)
    of_scale, of_bias = _any_of(SCALE, faults), _any_of(BIAS, faults)
    is_asked = _any_of(BIAS, [answer.question for answer in v.answers])
    found: list[tuple[str, Collection[str]]] = []  # sentences, with the questions that they answer
    contrary = v.status == "inconsistent" and smaller(v.faults, s) and JOINT not in faults
    if v.status == "heavy-tailed" or "outliers" in faults or (contrary and not opposite(v, faults)):
        found.append((tails_text(v, faults), ["outliers"]))
    if of_bias:
        found.append((bias_text(v, "bias" not in faults), BIAS))
    scale = ""
    if of_scale and v.status not in ("biased", "heavy-tailed"):
        scale = scale_text(v, faults)
        found.append((scale, SCALE))
    if _any_of(SHAPE, faults) and v.status not in ("biased", "heavy-tailed"):
        found.append((shape_text(v, faults, scale), SHAPE))
    if JOINT in faults and v.joint is not None and v.status != "heavy-tailed":
        found.append((joint_text(v, v.joint), [JOINT]))
    found.sort(key=lambda one: _rank(v, faults, one[1]))
    parts = [text for text, _ in found]
    if v.status == "heavy-tailed":
        parts.append(f"in the mean the covariance ratio is {ratio_text(s.inflation)}")
    if v.by_group is not None:
        parts.append(groups_text(v.by_group, GROUP in faults))
    if len(faults) == 1:
        parts += [ALONE[question] for question in faults if question in ALONE]
    if "innovation scale" in faults and v.innovations is not None:
        parts.append(innovations_text(v, v.innovations))
    if "innovation whiteness" in faults:
        parts.append("innovations correlated over steps")
    if (of_scale or GROUP in faults) and not of_bias and v.status != "heavy-tailed" and is_asked:
        parts.append("no bias found")
    return "; ".join(part for part in parts if part)


def _rank(v: Findings, faults: Faults, questions: Collection[str]) -> tuple[bool, float, int]:
    """Order of a fault in the sentence: what the status says, then by p value, the size before what else is wrong."""
    named = {"biased": BIAS, "heavy-tailed": ["outliers"]}.get(v.status, ())
    p = min((faults[question].adjusted for question in questions if question in faults), default=1.0)
    order = (SCALE, BIAS, SHAPE)
    return questions is not named and questions != named, max(p, SMALLEST_P), [*order, questions].index(questions)


def _any_of(questions: Collection[str], asked: Collection[str]) -> bool:
    return any(question in asked for question in questions)


def _faults_of_parts(v: Findings) -> str:
    texts = []
    for name, part in v.parts.items():
        if part.faults:
            sentence = part.reasons[0].removeprefix(f"{part.status}: ").removesuffix("; no bias found")
            texts.append(f"{name}: {sentence}")
    if len(texts) > MOST:
        texts = [*texts[:MOST], f"and {len(texts) - MOST} more"]
    return "; ".join(texts)
