"""A fault in words: what is wrong, by how much, and where."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from consistency.diagnostics.numbers_in_words import TINY, UNCERTAIN, off_by, plain, short
from consistency.diagnostics.questions import DIRECTION, MAIN, STEP
from consistency.diagnostics.records import Answer, Axes, JointScore, Scale, Verdict

NOTABLE = 0.3  # difference of correlations that stands out in one step
VISIBLE = 0.05  # difference of correlations that is worth a word
MOST = 3  # axes that a sentence names with their figures

Faults = Mapping[str, Answer]


def scale_text(v: Verdict, faults: Faults) -> str:
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


def bias_text(v: Verdict, in_steps: bool) -> str:
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


def shape_text(v: Verdict, faults: Faults) -> str:
    assert v.shape is not None
    assert v.axes is not None
    where = "" if "shape" in faults else f" in {v.place(v.shape.step or 1)}"
    text = f"covariance of the wrong shape{where}"
    gap = abs(v.shape.actual - v.shape.stated)
    if v.shape.pair is not None and gap > (VISIBLE if "shape" in faults else NOTABLE):
        a, b = (v.axes.names[i] for i in v.shape.pair)
        return f"{text}: {a} and {b} are correlated {v.shape.actual:+.2f}, stated {v.shape.stated:+.2f}"
    return text if "shape" in faults else f"{text}: axes are wrong by different factors"


def joint_text(joint: JointScore) -> str:
    """What pose and map together say, and which of the two parts stands out, or which landmarks."""
    pose, map_ = (not part.holds(1.0) for part in (joint.pose, joint.map))
    part = "" if pose == map_ else f", mainly {'the pose' if pose else 'the map given the pose'}"
    if joint.chief and not pose:
        labels = ", ".join(str(label) for label in joint.chief[:MOST])
        more = f" and {len(joint.chief) - MOST} more" if len(joint.chief) > MOST else ""
        part += f" (most in landmark{'s' * (len(joint.chief) > 1)} {labels}{more})"
    return f"pose and map together: covariance {off_by(joint.both)}{part}"
