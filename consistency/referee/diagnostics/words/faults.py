"""A fault in words, each in the same order: what is wrong, by how much, and where."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from consistency.referee.diagnostics.verdict.answers import AXIS, DIRECTION, MAIN, STEP
from consistency.referee.diagnostics.judging.fault_location import VISIBLE
from consistency.referee.diagnostics.verdict.parts import TINY, Answer, Innovations, Interval, JointScore, Verdict
from consistency.referee.diagnostics.words.numbers import UNCERTAIN, off_by, off_by_factor, plain, plural, short

NOTABLE = 0.3  # difference of correlations that stands out in one step
MOST = 3  # axes that a sentence names with their figures
SIDES = {"overconfident": 1, "conservative": -1}  # to which the whole errs

Faults = Mapping[str, Answer]


# --- the scale ---------------------------------------------------------------------------------------


def scale_text(v: Verdict, faults: Faults) -> str:
    """Too small or too large a covariance; '' where a correlation of the wrong sign is all that it is."""
    assert v.scale is not None
    assert v.location is not None
    if v.status == "inconsistent" and v.shape is not None and v.shape.alone:
        return ""
    if (MAIN not in faults and STEP not in faults) or opposite(v, faults):
        return _axes_text(v)
    if v.status == "inconsistent" and v.scale.inflation.value > 1.0 and _sure(v, -1):
        return _correlation_text(v)
    where, inflation, about = v.location, v.scale.inflation, ""
    if v.bias is not None and v.bias.inflation_without is not None:
        inflation, about = v.bias.inflation_without, " about the mean"
    contrary = SIDES.get(v.status, 0) * (inflation.value - 1.0) < 0.0
    if about and contrary:
        return f"covariance{about} {_side(SIDES[v.status])} in some {v.places}"
    if MAIN not in faults and (contrary or not where.lasting):
        return _steps_text(v)
    if contrary:
        ratio = v.scale.mean_anees / v.scale.dof
        return f"covariance {off_by_factor(ratio)} in the mean of all {v.places}"
    text = f"covariance{about} {off_by(inflation)}"
    if v.runs > 1 and inflation.value > TINY and not inflation.high < UNCERTAIN * inflation.low:
        text = f"covariance{about} {off_by_factor(inflation.value)}{_since(v)} in the mean, which a few {v.unit}s make"
    elif inflation.holds(1.0) and v.runs > 1:
        text += f"{_since(v)}, an interval that holds 1: the {v.unit}s differ more than Gaussian errors would"
    else:
        text += _since(v)
    if where.subset:
        text += f", mainly {where.subset}"
    first = int(np.argmax(v.scale.alive > 0)) + 1  # judged step
    if where.lasting and where.since is None and where.first_step is not None and where.first_step > first:
        text += f", first visible in step {where.first_step}"
    if not about and v.status == "overconfident" and AXIS in faults and not v.settings.one_sided:
        below = [(a, i) for a, i in _sure(v, -1).items() if v.axes is not None and a in v.axes.names]
        text += "".join(f", but {off_by(i)} in {a}" for a, i in below[:1])  # an axis errs in the other direction
    return text


def _since(v: Verdict) -> str:
    since = v.location.since if v.location is not None else None
    return "" if since is None else f" since step {since}"


def _side(sign: float) -> str:
    return "too small" if sign > 0 else "too large"


def _steps_text(v: Verdict) -> str:
    """Steps above and below the band, each side with their number, the first, and on the verdict's side the largest."""
    assert v.scale is not None
    assert v.location is not None
    ratio, (low, high) = v.scale.anees / v.scale.dof, v.location.simultaneous.T / v.scale.dof
    outside = {1: ratio > high, -1: ratio < low}
    mine = SIDES.get(v.status, 0)
    parts: list[str] = []
    for sign in sorted(outside, key=lambda sign: sign != mine):
        steps = np.flatnonzero(outside[sign])
        if not len(steps):
            continue
        worst = ratio[steps].max() if sign > 0 else ratio[steps].min()
        size = off_by_factor(worst, up_to=True) if sign == mine or not mine else _side(sign)
        total = "" if parts else f" of {v.scale.judged_steps} {v.places}"
        parts.append(f"{size} in {len(steps)}{total}, first in {v.place(int(steps[0]) + 1)}")
    return f"covariance {', and '.join(parts)}" if parts else f"covariance wrong in some {v.places}"


def opposite(v: Verdict, faults: Faults) -> bool:
    """Is the verdict about axes that err in opposite directions?"""
    return v.status == "inconsistent" and AXIS in faults and all(_sure(v, sign) for sign in (1, -1))


def _sure(v: Verdict, sign: int) -> dict[str, Interval]:
    """Components wrong to one side beyond doubt, the farthest first; groups where no component is."""
    assert v.axes is not None
    found = {a: i for a, i in v.axes.inflation.items() if (i.low > 1.0 if sign > 0 else i.high < 1.0)}
    found = {a: i for a, i in found.items() if a in v.axes.names} or found
    return dict(sorted(found.items(), key=lambda item: -sign * np.log(max(item[1].value, TINY))))


def _axes_text(v: Verdict) -> str:
    """The fault shows in an axis, a group or a direction alone, or in opposite axes."""
    assert v.axes is not None
    side = 1 if v.settings.one_sided else SIDES.get(v.status, 0)
    above, below = ([*_sure(v, sign).items()] if side != -sign else [] for sign in (1, -1))
    largest, u = v.axes.largest, v.axes.direction
    if largest is not None and DIRECTION in v.faults and not any(i.value >= largest.value for _, i in above):
        assert u is not None
        u = u * np.sign(u[np.argmax(np.abs(u))])  # of errors in stated standard deviations
        along = (f"{part:+.2f} {name}" for part, name in zip(u, v.axes.names, strict=True) if abs(part) > 0.1)
        return f"covariance {off_by(largest)} in the direction {' '.join(along)}"
    named = (above + below)[:MOST] if not (above and below) else [*above[: MOST - 1], below[0]]
    if not named:
        return "covariance wrong in an axis"
    return f"covariance {', '.join(f'{off_by(i)} in {a}' for a, i in named)}{_since(v)}"


def _correlation_text(v: Verdict) -> str:
    """Axes that are too large, and a direction in which the correlation makes the covariance too small."""
    assert v.scale is not None
    large = ", ".join(f"{off_by(i)} in {a}" for a, i in [*_sure(v, -1).items()][:MOST])
    text = f"covariance {large}"
    if v.shape is None:
        return text
    worst = float(np.linalg.eigvalsh(v.shape.matrix)[-1]) * v.scale.mean_anees / v.scale.dof
    return f"{text}, but {off_by_factor(worst)} in one direction{_since(v)}"


# --- bias, shape, tails, maps --------------------------------------------------------------------------


def bias_text(v: Verdict, in_steps: bool) -> str:
    """Mean error of the axes that have one, or of the chief axis in the step in which it was found."""
    assert v.bias is not None
    rest = ""
    if v.bias.inflation_without is not None and v.status == "biased":
        rest = f"; without the bias the covariance ratio is {plain(v.bias.inflation_without)}"
    if in_steps:
        size = "" if v.bias.size is None else f" {_sigmas(v.bias.size)} sigma in {v.bias.axis},"
        return f"mean error{size} in {v.place(v.bias.step or 1)}{rest}"
    sure = {axis: interval for axis, interval in v.bias.by_axis.items() if not interval.holds(0.0)}
    sure = dict(sorted(sure.items(), key=lambda item: -abs(item[1].value))[:MOST])
    named = [f"{_sigmas(i.value)} sigma [{_sigmas(i.low)}, {_sigmas(i.high)}] in {a}" for a, i in sure.items()]
    return f"mean error {', '.join(named) if named else 'in a combination of axes'}{rest}"


def _sigmas(value: float) -> str:
    return f"{value:+.2f}" if abs(value) < 100.0 else f"{value:+.1e}"


def shape_text(v: Verdict, faults: Faults) -> str:
    """The two axes that are correlated least as stated, where it can be seen."""
    assert v.shape is not None
    assert v.axes is not None
    s, where = v.shape, "" if "shape" in faults else f" in {v.place(v.shape.step or 1)}"
    gap = abs(s.actual - s.stated)
    if s.pair is not None and (gap > (VISIBLE if "shape" in faults else NOTABLE) or s.wrong_sign):
        a, b = (v.axes.names[i] for i in s.pair)
        what = "correlation of the wrong sign:" if s.wrong_sign else "covariance of the wrong shape: correlation"
        alone = "; no axis by itself is wrong" if s.alone else ""
        return f"{what} {s.actual:+.2f}, stated {s.stated:+.2f}, of {a} and {b}{where}{alone}"
    text = f"covariance of the wrong shape{where}"
    return text if "shape" in faults else f"{text}: axes are wrong by different factors"


def tails_text(v: Verdict, faults: Faults) -> str:
    """The error that stands out, or that runs differ more than they should."""
    if "outliers" not in faults:
        return f"heavy tails: the {v.unit}s differ more than Gaussian errors would"
    assert v.tails is not None
    where = f"{v.unit} {v.tails.run}" + f", {v.place(v.tails.step)}" * (v.steps > 1)
    return f"heavy tails: {short(v.tails.distance)} sigma from the other {v.unit}s in {where}"


def innovations_text(v: Verdict, i: Innovations, they: str = "innovations") -> str:
    """That innovations are larger or smaller than stated; of outliers which they are, and the size of the rest."""
    if (far := i.outliers) is None:
        return f"{they} {'larger' if i.ratio > 1 else 'smaller'} than stated"
    are = "is an outlier," if far.count == 1 else "are outliers, the largest"
    where = f"{v.unit} {far.run}, " * (v.runs > 1) + v.place(far.step)
    return (
        f"{far.count} of {plural(far.of, 'innovation')} {are} in {where} (NIS {short(far.nis)}, {far.dof} expected); "
        f"NIS per degree of freedom of the rest {far.rest.ratio:.3f}"
    )


def joint_text(v: Verdict, joint: JointScore) -> str:
    """What pose and map together say, and which of the two parts stands out, or which landmarks."""
    pose, map_ = (not part.holds(1.0) for part in (joint.pose, joint.map))
    part = "" if pose == map_ else f", mainly {'the pose' if pose else 'the map given the pose'}"
    if joint.chief and not pose:
        labels = ", ".join(str(label) for label in joint.chief[:MOST])
        more = f" and {len(joint.chief) - MOST} more" if len(joint.chief) > MOST else ""
        part += f" (most in landmark{'s' * (len(joint.chief) > 1)} {labels}{more})"
    if SIDES.get(v.status, 0) * (joint.both.value - 1.0) < 0.0:
        return f"pose and map together: the {v.unit}s differ more than Gaussian errors would{part}"
    return f"pose and map together: covariance {off_by(joint.both)}{part}"
