"""A fault in words, each in the same order: what is wrong, by how much, and where."""

from __future__ import annotations

import numpy as np

from consistency.referee.diagnostics.judging.error_parts import VISIBLE
from consistency.referee.diagnostics.verdict.answers import AXIS, DIRECTION, MAIN, STEP
from consistency.referee.diagnostics.verdict.parts import SIDES, TINY, Innovations, Interval, JointScore
from consistency.referee.diagnostics.verdict.verdict import Findings
from consistency.referee.diagnostics.words.numbers import (
    MOST,
    SIDE,
    is_uncertain,
    off_by,
    off_by_factor,
    plural,
    ratio_text,
    short,
    since_text,
)
from consistency.referee.diagnostics.words.unlike_factors import factors_text, names_to_say, unlike_ratios, unlike_text

NOTABLE = 0.3  # difference of correlations that stands out in one step
NAMED_PART = 0.1  # part of a unit vector that a sentence names

# --- the scale ---------------------------------------------------------------------------------------


def scale_text(v: Findings) -> str:
    """Too small or too large a covariance; '' where a correlation of the wrong sign is all that it is."""
    assert v.scale is not None
    assert v.location is not None
    if v.status == "inconsistent" and v.shape is not None and v.shape.alone:
        return ""
    if (MAIN not in v.faults and STEP not in v.faults) or opposite(v):
        return _axes_text(v)
    if v.status == "inconsistent" and v.scale.inflation.value > 1.0 and _wrong(v, -1):
        return _correlation_text(v)
    inflation = v.scale.inflation
    about = ""
    if v.bias is not None and v.bias.inflation_without is not None:
        inflation = v.bias.inflation_without
        about = " about the mean"
    contrary = SIDES.get(v.status, 0) * (inflation.value - 1.0) < 0.0
    if about and contrary:
        return f"covariance{about} {_side(SIDES[v.status])} in some {v.places}"
    if MAIN not in v.faults and (contrary or not (v.location.lasting or v.location.since)):
        return _steps_text(v)
    if contrary:
        ratio = v.scale.mean_anees / v.scale.dof
        return f"covariance {off_by_factor(ratio)} in the mean of all {v.places}"
    size, note = _size_and_note(v, inflation)
    text = f"covariance{about} {size}{since_text(v)}"
    factors = ""
    if not about:
        factors = factors_text(v)
    if factors:
        return f"{text}{_first_visible(v)}{note}; {factors}"
    return f"{text}{_where(v)}{_first_visible(v)}{note}"


def _size_and_note(v: Findings, inflation: Interval) -> tuple[str, str]:
    """The size of the fault, and what is to be known of runs that differ much."""
    size = off_by(inflation)
    if v.runs > 1 and inflation.value > TINY and is_uncertain(inflation):
        if inflation.low <= 1.0:
            size = off_by_factor(inflation.value)
        return f"{size} in the mean", f"; a few {v.unit}s make up that mean"
    if v.runs > 1 and inflation.holds(1.0):
        return size, f"; the interval holds 1 because the {v.unit}s differ more than Gaussian errors would"
    return size, ""


def _where(v: Findings) -> str:
    """The axes that carry the fault; a combination of two, where none of these is wrong by itself."""
    assert v.location is not None
    subset = v.location.subset
    if not subset:
        return ""
    of_axes = v.axes.inflation if v.axes is not None else {}
    if all(of_axes[axis].holds(1.0) for axis in subset.split(", ") if axis in of_axes):
        return f", {combination_text(v)}"
    return f", mainly {subset}"


def combination_text(v: Findings) -> str:
    """The two components whose correlation is least as stated, where no component is shown to be wrong by itself."""
    if v.shape is None or v.shape.pair is None or not v.shape.shown or v.axes is None:
        return "in a combination of axes"
    a, b = (v.axes.names[i] for i in v.shape.pair)
    return f"in a combination of {a} and {b} (correlation {v.shape.actual:+.2f}, stated {v.shape.stated:+.2f})"


def _first_visible(v: Findings) -> str:
    """The step in which a lasting fault is first visible, unless that is the first one that is judged."""
    where = v.location
    assert v.scale is not None
    if where is None or not where.lasting or where.since is not None or where.first_step is None:
        return ""
    if where.first_step <= int(np.argmax(v.scale.alive > 0)) + 1:
        return ""
    return f", first visible in {v.place(where.first_step)}"


def _side(sign: float) -> str:
    if sign > 0:
        return "too small"
    return "too large"


def _steps_text(v: Findings) -> str:
    """Steps above and below the band, each side with their number, the first, and on the verdict's side the largest."""
    assert v.scale is not None
    assert v.location is not None
    ratio = v.scale.anees / v.scale.dof
    (low, high) = v.location.simultaneous.T / v.scale.dof
    own = SIDES.get(v.status, 0)
    signs = [1, -1]
    if own == -1:
        signs = [-1, 1]
    parts: list[str] = []
    for sign in signs:
        steps = np.flatnonzero(ratio > high)
        if sign < 0:
            steps = np.flatnonzero(ratio < low)
        if not len(steps):
            continue
        size = _side(sign)
        if own in (sign, 0):
            worst = max(ratio[steps], key=lambda value: sign * value)
            size = off_by_factor(worst, "up to ")
        total = ""
        if not parts:
            total = f" of {v.scale.judged_steps} {v.places}"
        parts.append(f"{size} in {len(steps)}{total}, first in {v.place(int(steps[0]) + 1)}")
    if not parts:
        return f"covariance wrong in some {v.places}"
    return f"covariance {', and '.join(parts)}"


def opposite(v: Findings) -> bool:
    """Is the verdict about axes that err in opposite directions?"""
    return v.status == "inconsistent" and AXIS in v.faults and bool(_wrong(v, 1)) and bool(_wrong(v, -1))


def _wrong(v: Findings, sign: int) -> dict[str, Interval]:
    """Components wrong to one side beyond doubt, the farthest first; groups where no component is."""
    assert v.axes is not None
    components = []
    groups = []
    for axis, interval in v.axes.inflation.items():
        beyond = interval.low > 1.0
        if sign < 0:
            beyond = interval.high < 1.0
        if beyond and axis in v.axes.names:
            components.append((axis, interval))
        elif beyond:
            groups.append((axis, interval))
    return dict(sorted(components or groups, key=lambda item: -sign * np.log(max(item[1].value, TINY))))


def _axes_text(v: Findings) -> str:
    """The fault shows in an axis, a group or a direction alone, or in opposite axes."""
    assert v.axes is not None
    off: dict[str, Interval] = {}
    if v.status != "conservative":
        off |= _wrong(v, 1)
    if not v.settings.one_sided:
        off |= _wrong(v, -1)
    largest = v.axes.largest
    if largest is not None and DIRECTION in v.faults and not any(i.value >= largest.value for i in off.values()):
        return f"covariance {off_by(largest)} in the direction {_direction_text(v)}"
    if not off:
        return "covariance wrong in an axis"
    return f"covariance {_sizes_in_axes(off)}{since_text(v)}"


def _direction_text(v: Findings) -> str:
    """The worst direction, of errors in stated standard deviations."""
    assert v.axes is not None
    assert v.axes.direction is not None
    u = v.axes.direction
    u = u * np.sign(u[np.argmax(np.abs(u))])
    return " ".join(f"{part:+.2f} {name}" for part, name in zip(u, v.axes.names, strict=True) if abs(part) > NAMED_PART)


def _sizes_in_axes(off: dict[str, Interval]) -> str:
    return ", ".join(f"{off_by(off[axis])} in {axis}" for axis in names_to_say(off))


def _correlation_text(v: Findings) -> str:
    """Axes that are too large, and a direction in which the correlation makes the covariance too small."""
    assert v.scale is not None
    text = f"covariance {_sizes_in_axes(_wrong(v, -1))}"
    if v.shape is None:
        return text
    worst = float(np.linalg.eigvalsh(v.shape.matrix)[-1]) * v.scale.mean_anees / v.scale.dof
    return f"{text}, but {off_by_factor(worst)} in one direction{since_text(v)}"


# --- bias, shape, tails, maps --------------------------------------------------------------------------


def bias_text(v: Findings, in_steps: bool) -> str:
    """Mean error of the axes that have one, or of the chief axis in the step in which it was found."""
    assert v.bias is not None
    rest = ""
    if v.bias.inflation_without is not None and v.status == "biased":
        rest = f"; without the bias the covariance ratio is {ratio_text(v.bias.inflation_without)}"
    if in_steps:
        size = ""
        if v.bias.size is not None:
            size = f" {_sigmas(v.bias.size)} sigma in {v.bias.axis},"
        return f"mean error{size} in {v.place(v.bias.step or 1)}{rest}"
    sure = [(axis, interval) for axis, interval in v.bias.by_axis.items() if not interval.holds(0.0)]
    sure.sort(key=lambda item: -abs(item[1].value))
    named = []
    for axis, interval in sure[:MOST]:
        value, low, high = map(_sigmas, interval)
        named.append(f"{value} sigma [{low}, {high}] in {axis}")
    if not named:
        return f"mean error in a combination of axes{rest}"
    return f"mean error {', '.join(named)}{rest}"


def _sigmas(value: float) -> str:
    if 0.0 < abs(value) < 0.01:
        return f"{value:+.2g}"
    if abs(value) < 100.0:
        return f"{value:+.2f}"
    return f"{value:+.1e}"


def shape_text(v: Findings, scale: str = "") -> str:
    """Two axes whose correlation is shown to be wrong; otherwise the factors of blocks or axes, where these differ.

    '' where the sentence on the ``scale`` has these factors.
    """
    assert v.shape is not None
    assert v.axes is not None
    shape = v.shape
    wrong = "covariance of the wrong shape"
    where = ""
    worth_a_word = VISIBLE
    if "shape" not in v.faults:
        where = f" in {v.place(shape.step or 1)}"
        worth_a_word = NOTABLE
    gap = abs(shape.actual - shape.stated)
    if shape.shown and shape.pair is not None and (gap > worth_a_word or shape.wrong_sign):
        a, b = (v.axes.names[i] for i in shape.pair)
        what = f"{wrong}: correlation"
        if shape.wrong_sign:
            what = "correlation of the wrong sign:"
        text = f"{what} {shape.actual:+.2f}, stated {shape.stated:+.2f}, of {a} and {b}{where}"
        if shape.alone:
            text += "; no axis by itself is wrong"
        return text
    off = list(unlike_ratios(v).values())[:MOST]
    if not off:
        return f"{wrong}{where}"
    if all(off_by(ratio)[SIDE:] in scale for ratio in off):
        return ""
    return f"{wrong}: {unlike_text(v)}"


def tails_text(v: Findings) -> str:
    """The error that stands out, or that runs differ more than they should."""
    if "outliers" not in v.faults:
        return f"the {v.unit}s differ more than Gaussian errors would"
    assert v.tails is not None
    where = v.run_name(v.tails.run)
    if v.steps > 1:
        where += f", {v.place(v.tails.step)}"
    return f"outlier in {where}: {short(v.tails.distance)} sigma from the other {v.unit}s"


def innovation_faults(v: Findings, i: Innovations) -> list[str]:
    """The faults that were found in the innovations."""
    texts = []
    if "innovation scale" in v.faults:
        texts.append(_innovation_scale(v, i))
    if "innovation whiteness" in v.faults:
        texts.append("innovations correlated over steps")
    return texts


def _innovation_scale(v: Findings, i: Innovations) -> str:
    """That innovations are larger or smaller than stated; of outliers which they are, and the size of the rest."""
    far = i.outliers
    if far is None:
        size = "smaller"
        if i.ratio > 1:
            size = "larger"
        return f"innovations {size} than stated (NIS per degree of freedom {short(i.ratio)})"
    are = "are outliers, the largest"
    if far.count == 1:
        are = "is an outlier,"
    where = v.place(far.step)
    if v.runs > 1:
        where = f"{v.run_name(far.run)}, {where}"
    return (
        f"{far.count} of {plural(far.of, 'innovation')} {are} in {where} (NIS {short(far.nis)}, {far.dof} expected); "
        f"NIS per degree of freedom of the rest {far.rest.ratio:.3f}"
    )


def joint_text(v: Findings, joint: JointScore) -> str:
    """What pose and map together say, and which of the two parts stands out, or which landmarks."""
    pose_is_wrong = not joint.pose.holds(1.0)
    map_is_wrong = not joint.map.holds(1.0)
    part = ""
    if pose_is_wrong and not map_is_wrong:
        part = ", mainly the pose"
    elif map_is_wrong and not pose_is_wrong:
        part = ", mainly the map given the pose"
    if joint.chief and not pose_is_wrong:
        part += f" ({_chief_landmarks(joint.chief)})"
    if SIDES.get(v.status, 0) * (joint.both.value - 1.0) < 0.0:
        return f"pose and map together: the {v.unit}s differ more than Gaussian errors would{part}"
    return f"pose and map together: covariance {off_by(joint.both)}{part}"


def _chief_landmarks(chief: tuple[int, ...]) -> str:
    if len(chief) == 1:
        return f"most in landmark {chief[0]}"
    text = f"most in landmarks {', '.join(str(label) for label in chief[:MOST])}"
    if len(chief) > MOST:
        text += f" and {len(chief) - MOST} more"
    return text
