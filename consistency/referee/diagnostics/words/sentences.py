"""A verdict in words: a sentence to act on, then the figures behind it."""

from __future__ import annotations

import numpy as np

from consistency.referee.diagnostics.statistics.accuracy import TWO_SIGMA
from consistency.referee.diagnostics.verdict.answers import ALONE, BIAS, JOINT, SCALE, SHAPE
from consistency.referee.diagnostics.verdict.parts import Equivalence, Innovations, Location, Scale, Verdict
from consistency.referee.diagnostics.words.faults import (
    MOST,
    Faults,
    bias_text,
    innovations_text,
    joint_text,
    opposite,
    scale_text,
    shape_text,
    tails_text,
)
from consistency.referee.diagnostics.judging.status import smaller
from consistency.referee.diagnostics.words.numbers import UNCERTAIN, off_by, p_text, percent, plain, plural, short

__all__ = ["UNCERTAIN", "off_by", "p_text", "percent", "plain", "plural", "question_text", "reasons", "short"]

SPREAD = 20.0  # worst over median run above which a mean says little: that run is named beside it
MUCH = 100_000  # runs; more are no advice
MOST_STEPS = 10_000_000  # of a log; more are no advice


def reasons(v: Verdict) -> list[str]:
    """First the sentence, then the figures."""
    faults = {a.question: a for a in v.answers if a.found and not a.tolerated}
    broken = _failures(v)
    lines: list[str] = []
    if (s := v.scale) is not None and s.judged_steps:
        about = [*_truth(v), *_early_ends(v), *_levels(v, s), *_within_one(v, s), *_together(v), *_coverage(v)]
        lines = [_sentence(v, s, faults) if faults else _no_fault(v, s), *about]
    elif s is not None:
        lines = ["no step has a covariance of full rank to judge"]
    elif v.innovations is not None and v.innovations.dof:
        lines = [_without_truth(v, v.innovations, faults)]
    else:
        lines = ["neither truth nor innovations to judge"]
    lines = [lines[0], *broken, *lines[1:]] if faults else [*broken, *lines]
    if v.innovations is not None:
        lines.append(_nis(v.innovations))
    if v.answers:
        lines.append(_questions(v, faults))
    lines += _first_steps(v)
    first = "" if v.skipped is None else f"; without {v.skipped.skip.text} of each {_whole(v)}"
    return [f"{v.status}: {lines[0]}{first}", *lines[1:]]


# --- the sentence ------------------------------------------------------------------------------------


def _failures(v: Verdict) -> list[str]:
    lines = []
    if v.failures:
        first, count = v.failures[0], len({f.run for f in v.failures})
        where = f"{v.unit} {first.run}" + f" in step {first.step}" * (v.unit == "run")
        lines.append(f"{count} of {v.runs} {v.unit}s failed, first {where}: {first.reason}")
    if v.impossible:
        row, step = v.impossible[0]
        count = len({r for r, _ in v.impossible})
        lines.append(
            f"{count} of {v.runs} {v.unit}s {'has' if count == 1 else 'have'} an infinite error or a covariance with a "
            f"negative variance, first {v.unit} {row} in {v.place(step)}; those {v.places} are left out"
        )
    if v.joint is not None and v.joint.not_definite:
        lines.append(
            f"the joint covariance of pose and map is not positive definite in {len(v.joint.not_definite)} of {v.runs} "
            f"runs, first run {v.joint.not_definite[0]}"
        )
    return lines


def _whole(v: Verdict) -> str:
    """Noun for the whole that steps belong to: a run, or a log whose windows are runs."""
    return "run" if v.unit == "run" else "log"


def _first_steps(v: Verdict) -> list[str]:
    """Steps left out of the beginning, or that might be."""
    if v.skipped is not None:
        gone = f"; nothing is left of {plural(v.skipped.empty, 'run')}" if v.skipped.empty else ""
        return [
            f"{v.skipped.skip.text} of each {_whole(v)} {'is' if v.skipped.skip.size == 1 else 'are'} left out as "
            f"asked{gone}; a number that was chosen on these data voids the false-alarm rate: choose it beforehand, or "
            "on other data"
        ]
    until = None if v.location is None else v.location.until
    if until is None:
        return []
    where = "the first step" if until.step == 1 else f"the first {until.step} steps"
    return [
        f"the fault is in {where} only, where the covariance ratio is {short(until.early)}; after that it is "
        f"{plain(until.late)}. If the start is not meant to count, state --skip {until.step} (skip={until.step} in a "
        "gate) and judge other runs by it"
    ]


def _sentence(v: Verdict, s: Scale, faults: Faults) -> str:
    if v.parts:
        named = [(name, part) for name, part in v.parts.items() if part.faults]
        texts = [
            f"{name}: {part.reasons[0].removeprefix(f'{part.status}: ').removesuffix('; no bias found')}"
            for name, part in named[:MOST]
        ]
        return "; ".join(texts + [f"and {len(named) - MOST} more"] * (len(named) > MOST))
    parts = []
    if any(q in faults for q in BIAS):
        parts.append(bias_text(v, "bias" not in faults))
    if v.status == "heavy-tailed":
        parts.append(f"in the mean the covariance ratio is {plain(s.inflation)}")
    elif v.status != "biased":
        parts += [scale_text(v, faults)] if any(q in faults for q in SCALE) else []
        parts += [shape_text(v, faults)] if any(q in faults for q in SHAPE) else []
    contrary = v.status == "inconsistent" and smaller(v) and JOINT not in faults and not opposite(v, faults)
    if "outliers" in faults or v.status == "heavy-tailed" or contrary:
        parts.insert(0 if v.status == "heavy-tailed" else len(parts), tails_text(v, faults))
    if JOINT in faults and v.joint is not None and v.status != "heavy-tailed":
        parts.append(joint_text(v, v.joint))
    parts += [ALONE[q] for q in faults if q in ALONE and len(faults) == 1]
    if "innovation scale" in faults and v.innovations is not None:
        parts.append(innovations_text(v, v.innovations))
    if "innovation whiteness" in faults:
        parts.append("innovations correlated over steps")
    sought = any(a.question in BIAS for a in v.answers) and not set(v.faults) & set(BIAS)
    if any(q in faults for q in SCALE) and v.status != "heavy-tailed" and sought:
        parts.append("no bias found")
    return "; ".join(part for part in parts if part)


def _no_fault(v: Verdict, s: Scale) -> str:
    """Whether the ratio is shown to be right, with that of the worst axis; and what share of lost runs stays open."""
    shown, runs = s.equivalence, plural(v.runs, v.unit)
    tolerated = [a.question for a in v.answers if a.tolerated]
    none = "no fault beyond the tolerance" if tolerated else "no fault found"
    size = "covariance ratio of every part" if v.parts else f"covariance ratio {plain(s.inflation)}"
    axis = "" if (worst := v.worst_axis) is None else f" (worst axis: {worst[0]}, {plain(worst[1])})"
    if shown.shown:
        return f"{none} in {runs}, and the {size} is shown to be {_within(shown)}{axis}{_lost(v)}"
    advice, asked = "", 0 if v.lost is None or v.settings.lost is None else v.lost.needed or 0
    if shown.runs is not None and shown.runs <= MUCH:
        advice = f"; {max(shown.runs, v.runs + 1, asked)} such {v.unit}s would probably decide"
    do = "does" if v.runs == 1 else "do"
    return f"{none}, but {runs} {do} not show the {size} to be {_within(shown)}{axis}{advice}"


def _lost(v: Verdict) -> str:
    """Lost runs, and the share of them that is shown or not excluded."""
    if (lost := v.lost) is None:
        return ""
    asked, unit, runs = v.settings.lost, v.unit, plural(v.runs, v.unit)
    some = f"{plural(lost.count, unit)} of {lost.runs} {'is' if lost.count == 1 else 'are'} lost" if lost.count else ""
    if asked is not None and lost.upper <= asked:
        return f"; lost {unit}s are shown to be at most {percent(asked)} of all ({some or f'none of {lost.runs} is'})"
    found = f"; {some}, and" if some else ";" if asked is None else ", but"
    upper = percent(lost.upper, 2 if asked is None else 3)
    text = f"{found} lost {unit}s of up to {upper} cannot be excluded with {runs}"
    if asked is None:
        return text
    more = "" if lost.needed is None else f"; {lost.needed} {unit}s would, if no further one is lost"
    return f"{text}, and {percent(asked)} is asked for{more}"


def _within(shown: Equivalence) -> str:
    if shown.one_sided:
        return f"below {short(shown.factor)}"
    return f"between {short(1.0 / shown.factor)} and {short(shown.factor)}"


# --- the figures behind it -----------------------------------------------------------------------------


def _level(v: Verdict, s: Scale, location: Location) -> str:
    low, high = s.accepted
    text = f"mean NEES {short(s.mean_anees)}, accepted {short(low)} to {short(high)} ({s.dof} expected)"
    if s.worst_run > SPREAD * s.median_run:
        text += f"; {short(s.median_run)} in the median and {short(s.worst_run)} in the worst {v.unit}"
    if s.judged_steps > 1:
        counts = {"above": location.above, "below": location.below}
        where = [f"{count} {side}" for side, count in counts.items() if count]
        text += f"; {v.places} outside the simultaneous band: {' and '.join(where) if where else 'none'}"
        text += f" of {s.judged_steps}"
    return text


def _levels(v: Verdict, s: Scale) -> list[str]:
    """The mean NEES, the worst axis and lost runs; of parts whose cross terms are not stated also that of each part."""
    lines, each = [], []
    if v.location is not None:
        lines = [_level(v, s, v.location)]
    if v.parts:
        ratio = short(s.mean_anees / s.dof)
        lines = [
            f"cross terms of {', '.join(v.parts)} are not stated: each is judged by itself, and the mean NEES over the "
            f"{s.dof} components, {ratio} (1 expected under any correlation), is not judged"
        ]
        known = [(name, p, p.scale, p.location) for name, p in v.parts.items()]
        each = [f"{name}: {_level(part, scale, at)}" for name, part, scale, at in known if scale and at]
    if v.faults and (worst := v.worst_axis) is not None:
        lines.append(f"covariance ratio of the worst axis: {worst[0]}, {plain(worst[1])}; of all {plain(s.inflation)}")
    if v.lost is not None and (v.lost.count or v.settings.lost is not None):
        lines.append(
            f"lost {v.unit}s: {v.lost.count} of {v.lost.runs} failed or have a mean NEES above {short(v.lost.bound)}; "
            f"at most {percent(v.lost.upper)} of all at a confidence of {v.lost.level:g}"
        )
    if tolerated := [a.question for a in v.answers if a.tolerated]:
        factor = f"{v.settings.tolerated:g}"
        lines.append(f"found, but shown to be within the tolerance of x{factor}: {', '.join(tolerated)}")
    return lines + each


def _truth(v: Verdict) -> list[str]:
    """What errors of the truth leave to be said, and what to declare."""
    if (truth := v.truth) is None:
        return []
    shares = ", ".join(f"{axis} {percent(share)}" for axis, share in truth.by_axis.items())
    text = (
        f"the truth has a covariance of its own, {percent(truth.share)} of the sum of both ({shares}); covariance "
        "ratios are of the estimate alone"
    )
    if truth.shared:
        return [f"{text}; the estimator has fused the truth (--truth-shared): only what holds however both go together"]
    if truth.errors is None:
        return [
            f"{text}; its errors are not declared to be independent, per-run or common (--truth-errors), so only what "
            "holds however they depend on each other is said"
        ]
    return [f"{text}; its errors are declared {truth.errors}"]


def _early_ends(v: Verdict) -> list[str]:
    """That runs seem to end because the filter is lost."""
    if v.ends is None or not v.ends.lost:
        return []
    return [
        f"{plural(v.ends.runs, v.unit)} that end early have a larger NEES in their last step than "
        f"{100 * v.ends.above:.0f} % of the {v.unit}s that go on (p {p_text(v.ends.p_value)}): if they end because "
        "they are lost, no rate holds; write a row of NaN where a filter breaks down, so that it counts as failed"
    ]


def _within_one(v: Verdict, s: Scale) -> list[str]:
    """Ratio of a single run, and the data that would decide."""
    if v.runs != 1 or v.landmarks is not None or v.unit != "run":
        return []
    if (w := s.within) is None:
        return [
            "the log is too short to show how its errors decorrelate; further runs, or a far longer log, would decide"
        ]
    text = (
        f"if errors go on to decorrelate as within this log (over {short(w.correlation)} steps), the covariance ratio "
        f"is {plain(w.ratio)}, reported and not judged"
    )
    if w.steps is None or w.pieces is None or w.steps > MOST_STEPS:
        return [text]
    if w.steps <= s.judged_steps:
        return [f"{text}; cut into {w.pieces} runs, this log would then probably decide"]
    return [f"{text}; a log of {w.steps} steps, cut into {w.pieces} runs, would then probably decide"]


def _together(v: Verdict) -> list[str]:
    if v.landmarks is None:
        return []
    if v.joint is None or not v.joint.runs:
        return ["the joint covariance of pose and map was not kept: each landmark is judged by itself"]
    j = v.joint
    return [
        f"NEES of pose and map together over its degrees of freedom {plain(j.both)}: of the pose {plain(j.pose)}, "
        f"of the map given the pose {plain(j.map)}"
    ]


def _coverage(v: Verdict) -> list[str]:
    if v.accuracy is None or v.axes is None:
        return []
    known = [(axis, c) for axis, c in zip(v.axes.names, v.accuracy.coverage, strict=True) if np.isfinite(c)]
    if not known:
        return []
    covered = ", ".join(f"{axis} {100 * c:.1f} %" for axis, c in known)
    text = f"2-sigma coverage {covered} ({100 * TWO_SIGMA:.1f} % expected)"
    if np.isfinite(v.accuracy.nci):
        text += f"; noncredibility index {v.accuracy.nci:.1f} dB, inclination {v.accuracy.inclination:+.1f} dB"
    return [text]


def _without_truth(v: Verdict, i: Innovations, faults: Faults) -> str:
    if not i.judged:
        return (
            "no truth, and innovations decide nothing unless the filter declares an optimal gain: those of any other "
            "filter are neither white nor of the stated size even if it is right"
        )
    parts = ["no truth: judged by the innovations alone, which cannot see most pose errors"]
    if "innovation scale" in faults:
        parts.append(innovations_text(v, i, "they are"))
    if "innovation whiteness" in faults:
        parts.append("they are correlated over steps")
    shown = i.equivalence
    if not faults and shown is not None:
        is_shown = "is shown to be" if shown.shown else "is not shown to be"
        parts.append(f"their NIS {is_shown} {_within(shown)} times its degrees of freedom")
        if v.settings.lost is not None:
            parts.append("they cannot show what share of runs is lost")
    return "; ".join(parts)


def _nis(i: Innovations) -> str:
    if not np.isfinite(i.ratio):
        return "no NIS: the filter reports no innovations"
    text = f"NIS per degree of freedom {i.ratio:.3f}"
    if not i.judged:
        return f"{text}, reported and not judged: no optimal gain is declared"
    text += f" ({i.interval[0]:.3f} to {i.interval[1]:.3f} expected)"
    if len(i.autocorrelation):
        text += f", autocorrelation {i.autocorrelation[0]:+.3f} at lag 1 (within {i.bound:.3f} expected)"
    return text


def _questions(v: Verdict, faults: Faults) -> str:
    count, rate = len(v.answers), v.settings.false_alarm
    text = f"{plural(count, 'question')} at a false-alarm rate of {rate:.3g}{' together' if count > 1 else ''}"
    if not faults:
        least = min(v.answers, key=lambda a: a.adjusted)
        return f"{text}; nearest to a fault: {question_text(v, least.question)} (corrected p {p_text(least.adjusted)})"
    found = (f"{question_text(v, q)} (p {p_text(a.adjusted)})" for q, a in faults.items())
    return f"{text}; found: {', '.join(found)}"


def question_text(v: Verdict, question: str) -> str:
    """A question as it is called: of a map, "in some landmark" in the place of "in some step"."""
    return question if v.landmarks is None else question.replace("some step", "some landmark")
