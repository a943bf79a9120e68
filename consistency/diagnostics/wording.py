"""What a verdict says in words: a sentence to act on, then what stands behind it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from consistency.diagnostics.coverage import TWO_SIGMA
from consistency.diagnostics.questions import BIAS, DIRECTION, JOINT, JOINT_DISTRIBUTION, MAIN, SCALE, SHAPE, STEP
from consistency.diagnostics.records import Answer, Axes, Equivalence, Interval, JointScore, Scale, Verdict

SPREAD = 20.0  # worst over median run above which a mean says little: that run is named beside it
NOTABLE = 0.3  # difference of correlations that stands out in one step
VISIBLE = 0.05  # difference of correlations that is worth a word
UNCERTAIN = 100.0  # upper over lower end of an interval that says nothing
MUCH = 100_000  # runs; more are no advice
MOST = 3  # axes that a sentence names with their figures
MOST_STEPS = 10_000_000  # of a log; more are no advice
TINY = 1e-12  # ratio of an error that is rounding

Faults = Mapping[str, Answer]


def reasons(v: Verdict) -> list[str]:
    """First the sentence, then the figures."""
    faults = {a.question: a for a in v.answers if a.found and not a.tolerated}
    broken = _failures(v)
    judged = v.scale is not None and v.scale.judged_steps > 0
    lines: list[str] = []
    if judged:
        assert v.scale is not None
        lines = [_sentence(v, faults), *_level(v), *_within_one(v), *_together(v), *_coverage(v)]
    elif v.scale is not None:
        lines = ["no step has a covariance of full rank to judge"]
    elif v.innovations is not None and v.innovations.dof:
        lines = [_without_truth(v, faults)]
    else:
        lines = ["neither truth nor innovations to judge"]
    lines = [lines[0], *broken, *lines[1:]] if faults else [*broken, *lines]
    if v.innovations is not None:
        lines.append(_nis(v))
    if v.answers:
        lines.append(_questions(v, faults))
    lines += _first_steps(v)
    return [f"{v.status}{_since(v, faults)}: {lines[0]}{_without_first(v)}", *lines[1:]]


def short(value: float) -> str:
    """Three digits, as a person says them."""
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
    """Too small by x1.6 [1.4, 1.9]; of a covariance too large, the inverse."""
    ratio, low, high = interval
    if ratio >= 1.0:
        return f"too small by x{plain(interval)}"
    if ratio < TINY:
        return "too large: there is hardly any error"
    return f"too large by x{plain(Interval(1.0 / ratio, 1.0 / high, 1.0 / max(low, TINY)))}"


def plain(interval: Interval) -> str:
    """1.02 [0.87, 1.19]: a ratio that may lie on either side of 1."""
    if interval.value < TINY:
        return f"below {TINY:g}"
    if not interval.high < UNCERTAIN * interval.low:
        return f"{short(interval.value)} (known to no better than a factor of {UNCERTAIN:g})"
    return f"{short(interval.value)} [{short(interval.low)}, {short(interval.high)}]"


def p_text(p: float) -> str:
    """A p value without digits that nobody needs."""
    return f"{p:.2g}" if p >= 1e-6 else "below 1e-6"


def plural(count: int, noun: str) -> str:
    """1 run, 2 runs."""
    return f"{count} {noun}{'s' * (count != 1)}"


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


def _since(v: Verdict, faults: Faults) -> str:
    since = v.location.since if v.location is not None else None
    if not faults or since is None or v.status in ("biased", "heavy-tailed"):  # it is that of the scale
        return ""
    return f" since step {since}"


def _without_first(v: Verdict) -> str:
    return "" if v.skipped is None else f"; without {v.skipped.skip.text} of each {_whole(v)}"


def _whole(v: Verdict) -> str:
    """What steps belong to: a log, where its windows stand as runs."""
    return "run" if v.unit == "run" else "log"


def _first_steps(v: Verdict) -> list[str]:
    """What was left out of the beginning, or might be."""
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


def _sentence(v: Verdict, faults: Faults) -> str:
    if not faults:
        return _no_fault(v)
    parts = []
    if any(q in faults for q in BIAS):
        parts.append(_bias(v, "bias" not in faults))
    if v.status == "heavy-tailed":
        assert v.scale is not None
        parts.append(f"in the mean the covariance ratio is {plain(v.scale.inflation)}")
    elif v.status != "biased":
        parts += [_scale(v, faults)] if any(q in faults for q in SCALE) else []
        parts += [_shape(v, faults)] if any(q in faults for q in SHAPE) else []
    if "outliers" in faults:
        assert v.tails is not None
        where = f"{v.unit} {v.tails.run} lies {short(v.tails.distance)} sigma from the other {v.unit}s"
        where += f" in {v.place(v.tails.step)}" * (v.steps > 1)
        parts.insert(0 if v.status == "heavy-tailed" else len(parts), f"heavy tails: {where}")
    elif v.status == "heavy-tailed":
        parts.insert(0, f"heavy tails: the {v.unit}s differ more than Gaussian errors would")
    if JOINT in faults and v.joint is not None and v.status != "heavy-tailed":
        parts.append(_joint_scale(v.joint))
    if JOINT_DISTRIBUTION in faults and len(faults) == 1:
        parts.append("the NEES of pose and map together does not follow the chi-square distribution")
    if "distribution" in faults and len(faults) == 1:
        parts.append("the NEES does not follow the chi-square distribution")
    if "innovation scale" in faults and v.innovations is not None:
        parts.append(f"innovations {'larger' if v.innovations.ratio > 1 else 'smaller'} than stated")
    if "innovation whiteness" in faults:
        parts.append("innovations correlated over steps")
    if any(q in faults for q in SCALE) and v.status != "heavy-tailed" and _no_bias(v):
        parts.append("no bias found")
    return "; ".join(parts)


def _no_bias(v: Verdict) -> bool:
    """A bias was looked for and not found."""
    return any(a.question in BIAS for a in v.answers) and not set(v.faults) & set(BIAS)


def _no_fault(v: Verdict) -> str:
    assert v.scale is not None
    shown, inflation = v.scale.equivalence, v.scale.inflation
    tolerated = [a.question for a in v.answers if a.tolerated]
    none = "no fault beyond the tolerance" if tolerated else "no fault found"
    size = f"covariance ratio {plain(inflation)}"
    if shown.shown:
        return f"{none} in {plural(v.runs, v.unit)}, and the {size} is shown to be {_within(v, shown)}"
    advice = ""
    if shown.runs is not None and shown.runs <= MUCH:
        advice = f"; {max(shown.runs, v.runs + 1)} such {v.unit}s would probably decide"
    return f"{none}, but {plural(v.runs, v.unit)} {_do(v.runs)} not show the {size} to be {_within(v, shown)}{advice}"


def _within(v: Verdict, shown: Equivalence) -> str:
    if shown.one_sided:
        return f"below {short(shown.factor)}"
    return f"between {short(1.0 / shown.factor)} and {short(shown.factor)}"


def _do(runs: int) -> str:
    return "does" if runs == 1 else "do"


def _scale(v: Verdict, faults: Faults) -> str:
    assert v.scale is not None
    assert v.location is not None
    where, inflation, about = v.location, v.scale.inflation, ""
    if v.bias is not None and v.bias.inflation_without is not None:
        inflation, about = v.bias.inflation_without, " about the mean"
    if MAIN not in faults and STEP not in faults:
        return _one_axis(v)
    if about and v.status != ("overconfident" if inflation.value > 1.0 else "conservative"):
        return f"covariance{about} too {'small' if v.status == 'overconfident' else 'large'} in some {v.places}"
    if not where.lasting and MAIN not in faults:
        count = where.above + where.below
        side = "too small" if where.above else "too large"
        first = "" if where.first_step is None else f", first in {v.place(where.first_step)}"
        return f"covariance {side} in {count} of {v.scale.judged_steps} {v.places}{first}"
    text = f"covariance{about} {off_by(inflation)}"
    if v.runs > 1 and inflation.value > TINY and not inflation.high < UNCERTAIN * inflation.low:
        size = short(max(inflation.value, 1.0 / inflation.value))
        text = f"covariance{about} {_side(inflation.value)} by x{size} in the mean, which a few {v.unit}s make"
    elif inflation.holds(1.0) and v.runs > 1:
        text += f", an interval that holds 1: the {v.unit}s differ more than Gaussian errors would"
    if where.subset:
        text += f", mainly {where.subset}"
    if where.lasting and where.since is None and where.first_step is not None and where.first_step > _first(v.scale):
        text += f", first visible in step {where.first_step}"
    return text


def _first(scale: Scale) -> int:
    """The first judged step."""
    return int(np.argmax(scale.alive > 0)) + 1


def _one_axis(v: Verdict) -> str:
    """The fault shows in an axis, a group or a direction alone."""
    assert v.axes is not None
    one_sided = v.settings.one_sided
    sure = {a: i for a, i in v.axes.inflation.items() if (i.low > 1.0 if one_sided else not i.holds(1.0))}
    sure = {a: i for a, i in sure.items() if a in v.axes.names} or sure
    sure = dict(sorted(sure.items(), key=lambda item: -abs(np.log(max(item[1].value, TINY))))[:MOST])
    largest = v.axes.largest
    if largest is not None and DIRECTION in v.faults and not any(i.value >= largest.value for i in sure.values()):
        return f"covariance {off_by(largest)} in the direction {_direction(v.axes)}"
    return f"covariance of {', '.join(f'{a} {off_by(i)}' for a, i in sure.items()) if sure else 'an axis wrong'}"


def _direction(axes: Axes) -> str:
    """+0.71 x -0.70 y, of errors in stated standard deviations."""
    assert axes.direction is not None
    u = axes.direction * np.sign(axes.direction[np.argmax(np.abs(axes.direction))])
    return " ".join(f"{value:+.2f} {name}" for value, name in zip(u, axes.names, strict=True) if abs(value) > 0.1)


def _side(ratio: float) -> str:
    return "too small" if ratio > 1.0 else "too large"


def _bias(v: Verdict, in_steps: bool) -> str:
    assert v.bias is not None
    rest = ""
    if v.bias.inflation_without is not None and v.status == "biased":
        rest = f"; without the bias the covariance ratio is {plain(v.bias.inflation_without)}"
    if in_steps:
        where = f"in {v.place(v.bias.step or 1)}, mainly {v.bias.axis}"
        return f"{where}{rest}" if v.status == "biased" else f"biased {where}"
    prefix = "" if v.status == "biased" else "biased: "
    sure = {axis: interval for axis, interval in v.bias.by_axis.items() if not interval.holds(0.0)}
    sure = dict(sorted(sure.items(), key=lambda item: -abs(item[1].value))[:MOST])
    named = [f"{a} {_sigmas(i.value)} sigma [{_sigmas(i.low)}, {_sigmas(i.high)}]" for a, i in sure.items()]
    return f"{prefix}{', '.join(named) if named else 'in a combination of axes'}{rest}"


def _sigmas(value: float) -> str:
    return f"{value:+.2f}" if abs(value) < 100.0 else f"{value:+.1e}"


def _shape(v: Verdict, faults: Faults) -> str:
    assert v.shape is not None
    assert v.axes is not None
    where = "" if "shape" in faults else f" in {v.place(v.shape.step or 1)}"
    text = f"covariance of the wrong shape{where}"
    gap = abs(v.shape.actual - v.shape.stated)
    if v.shape.pair is not None and gap > (VISIBLE if "shape" in faults else NOTABLE):
        a, b = (v.axes.names[i] for i in v.shape.pair)
        return f"{text}: {a} and {b} are correlated {v.shape.actual:+.2f}, stated {v.shape.stated:+.2f}"
    return text if "shape" in faults else f"{text}: axes are wrong by different factors"


# --- the figures behind it -----------------------------------------------------------------------------


def _level(v: Verdict) -> list[str]:
    assert v.scale is not None
    assert v.location is not None
    s, (low, high) = v.scale, v.scale.accepted
    text = f"mean NEES {short(s.mean_anees)}, accepted {short(low)} to {short(high)} ({s.dof} expected)"
    if s.worst_run > SPREAD * s.median_run:
        text += f"; {short(s.median_run)} in the median and {short(s.worst_run)} in the worst {v.unit}"
    if s.judged_steps > 1:
        counts = {"above": v.location.above, "below": v.location.below}
        where = [f"{count} {side}" for side, count in counts.items() if count]
        text += f"; {v.places} outside the simultaneous band: {' and '.join(where) if where else 'none'}"
        text += f" of {s.judged_steps}"
    tolerated = [a.question for a in v.answers if a.tolerated]
    lines = [text]
    if tolerated:
        lines.append(
            f"found, but shown to be within the tolerance of x{v.settings.tolerated:g}: {', '.join(tolerated)}"
        )
    return lines


def _within_one(v: Verdict) -> list[str]:
    """How far a single run is off, and what would decide."""
    assert v.scale is not None
    if v.runs != 1 or v.landmarks is not None or v.unit != "run":
        return []
    if (w := v.scale.within) is None:
        return [
            "the log is too short to show how its errors decorrelate; further runs, or a far longer log, would decide"
        ]
    text = (
        f"if errors go on to decorrelate as within this log (over {short(w.correlation)} steps), the covariance ratio "
        f"is {plain(w.ratio)}, reported and not judged"
    )
    if w.steps is None or w.pieces is None or w.steps > MOST_STEPS:
        return [text]
    if w.steps <= v.scale.judged_steps:
        return [f"{text}; cut into {w.pieces} runs, this log would then probably decide"]
    return [f"{text}; a log of {w.steps} steps, cut into {w.pieces} runs, would then probably decide"]


def _joint_scale(joint: JointScore) -> str:
    """What pose and map together say, and which of the two parts stands out, or which landmarks."""
    pose, map_ = (not part.holds(1.0) for part in (joint.pose, joint.map))
    part = "" if pose == map_ else f", mainly {'the pose' if pose else 'the map given the pose'}"
    if joint.chief and not pose:
        labels = ", ".join(str(label) for label in joint.chief[:MOST])
        more = f" and {len(joint.chief) - MOST} more" if len(joint.chief) > MOST else ""
        part += f" (most in landmark{'s' * (len(joint.chief) > 1)} {labels}{more})"
    return f"pose and map together: covariance {off_by(joint.both)}{part}"


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


def _without_truth(v: Verdict, faults: Faults) -> str:
    assert v.innovations is not None
    if not v.innovations.judged:
        return (
            "no truth, and innovations decide nothing unless the filter declares an optimal gain: those of any other "
            "filter are neither white nor of the stated size even if it is right"
        )
    parts = ["no truth: judged by the innovations alone, which cannot see most pose errors"]
    if "innovation scale" in faults:
        parts.append(f"they are {'larger' if v.innovations.ratio > 1 else 'smaller'} than stated")
    if "innovation whiteness" in faults:
        parts.append("they are correlated over steps")
    shown = v.innovations.equivalence
    if not faults and shown is not None:
        is_shown = "is shown to be" if shown.shown else "is not shown to be"
        parts.append(f"their NIS {is_shown} {_within(v, shown)} times its degrees of freedom")
    return "; ".join(parts)


def _nis(v: Verdict) -> str:
    assert v.innovations is not None
    i = v.innovations
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
