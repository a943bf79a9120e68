"""Faults in words, the chief one first, each in the same order: what is wrong, by how much, and where.

Where is all runs, groups of them, or blocks of the state.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from consistency.referee.diagnostics.error_parts import VISIBLE
from consistency.referee.diagnostics.groups import range_name
from consistency.referee.diagnostics.nees import FEW
from consistency.referee.diagnostics.number_words import (
    MOST,
    SIDE,
    SMALLEST_P,
    first_few,
    is_or_are,
    is_uncertain,
    names_in_a_row,
    off_by,
    off_by_factor,
    p_text,
    plural,
    ratio_text,
    short,
    since_text,
)
from consistency.referee.diagnostics.status import smaller
from consistency.referee.diagnostics.verdict import Findings
from consistency.referee.diagnostics.verdict_parts import (
    ALONE,
    AXIS,
    BIAS,
    DIRECTION,
    GROUP,
    JOINT,
    MAIN,
    SCALE,
    SHAPE,
    SIDES,
    STEP,
    TINY,
    ByGroup,
    ComponentRatios,
    Group,
    Innovations,
    Interval,
    JointScore,
    Scale,
)

NOTABLE = 0.3  # difference of correlations that stands out in one step
NAMED_PART = 0.1  # part of a unit vector that a sentence names
CHIEF_QUESTIONS = {
    "biased": BIAS,
    "heavy-tailed": ["outliers"],
    "overconfident": SCALE,
    "conservative": SCALE,
}  # by statuses
BLOCKS = ("position", "attitude", "velocity")
NEAR = 1.3  # ratio of each axis of a block that is called right: with more, an axis wrong by 1.5 hides in it too often
NARROW = 1.25  # upper over lower end of a ratio that tells such factors from others
CEP = 1.386  # 2 log 2
LEVELS = {
    3.84: "deviations stated at 95 % (1.96 sigma)",
    4.0: "deviations of 2 sigma",
    CEP: "a CEP in place of deviations (the radius of 50 % in the plane, 1.1774 sigma)",
}  # by the factor on a variance, the squares of these multiples
DECLARED = {3.84: "95%", 4.0: "2sigma", CEP: "CEP"}  # by --level
MUCH = 100_000  # runs; more are no advice

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
    if inflation.high == float("inf"):  # more than numbers of few members show
        return size, ""
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
        u = v.axes.direction  # of errors in stated standard deviations
        assert u is not None
        u = u * np.sign(u[np.argmax(np.abs(u))])
        named = [f"{part:+.2f} {name}" for part, name in zip(u, v.axes.names, strict=True) if abs(part) > NAMED_PART]
        return f"covariance {off_by(largest)} in the direction {' '.join(named)}"
    if not off:
        return "covariance wrong in an axis"
    return f"covariance {_sizes_in_axes(off)}{since_text(v)}"


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
        text = f"most in landmarks {', '.join(map(str, joint.chief[:MOST]))}"
        if len(joint.chief) == 1:
            text = f"most in landmark {joint.chief[0]}"
        elif len(joint.chief) > MOST:
            text += f" and {len(joint.chief) - MOST} more"
        part += f" ({text})"
    if SIDES.get(v.status, 0) * (joint.both.value - 1.0) < 0.0:
        return f"pose and map together: the {v.unit}s differ more than Gaussian errors would{part}"
    return f"pose and map together: covariance {off_by(joint.both)}{part}"


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


def ratios_of_blocks(axes: ComponentRatios) -> dict[str, Interval]:
    """Ratio of each block whose axes are alike, and of every other axis by itself."""
    ratios, inside = {}, set()
    for block in BLOCKS:
        members = members_of(axes, block)
        if members and are_alike([axes.inflation[name] for name in (block, *members)]):
            ratios[block] = axes.inflation[block]
            inside.update(members)
    return ratios | {axis: axes.inflation[axis] for axis in axes.names if axis not in inside}


def members_of(axes: ComponentRatios, block: str) -> list[str]:
    """Axes of a block of several; none where the state has no such block."""
    index = axes.groups.get(block, ())
    if block not in BLOCKS or len(index) < 2:
        return []
    return [axes.names[i] for i in index]


def are_alike(intervals: list[Interval]) -> bool:
    """Whether some factor lies in all of the intervals."""
    return max(interval.low for interval in intervals) <= min(interval.high for interval in intervals)


def is_right(v: Findings, name: str, ratio: Interval) -> bool:
    """Whether an axis or block is shown to lie within ``--detect``, and each of its axes may be right and is near 1."""
    assert v.axes is not None
    ratios = [v.axes.inflation[each] for each in (name, *members_of(v.axes, name))]
    are_near = all(each.holds(1.0) and 1.0 / NEAR <= each.value <= NEAR for each in ratios)
    return are_near and 1.0 / v.settings.factor <= ratio.low and ratio.high <= v.settings.factor


def unlike_ratios(v: Findings) -> dict[str, Interval]:
    """Blocks and axes whose ratio is not 1, the farthest first; none where all may be off by one factor.

    Of a conservative covariance those that are too large alone, as nothing in it has to grow. Where that is not a
    fault, those that are too small.
    """
    if v.axes is None:
        return {}
    ratios = ratios_of_blocks(v.axes)
    if are_alike(list(ratios.values())):
        return {}
    off = []
    if not v.settings.one_sided:
        off = [(name, ratio) for name, ratio in ratios.items() if ratio.high < 1.0]
    if v.status != "conservative":
        off += [(name, ratio) for name, ratio in ratios.items() if ratio.low > 1.0]
    return dict(sorted(off, key=lambda item: -abs(np.log(max(item[1].value, TINY)))))


def unlike_text(v: Findings) -> str:
    """Position too small by x2.22 [1.80, 2.81], attitude and velocity right; '' where factors may be the same."""
    off = unlike_ratios(v)
    if not off:
        return ""
    assert v.axes is not None
    texts = []
    side = ""
    for name in names_to_say(off):
        size = off_by(off[name])
        texts.append(f"{name} {size.removeprefix(side).lstrip()}")  # the side once: x too small by ..., y by ...
        side = size[:SIDE]
    others = {name: ratio for name, ratio in ratios_of_blocks(v.axes).items() if name not in off}
    right = [name for name, ratio in others.items() if is_right(v, name, ratio)]
    if len(right) > MOST and len(right) == len(others):
        texts.append("the others right")
    elif 1 <= len(right) <= MOST:
        texts.append(f"{names_in_a_row(right)} right")
    return ", ".join(texts)


def names_to_say(off: dict[str, Interval]) -> list[str]:
    """The first of those that are off, with one of either side."""
    names = list(off)[:MOST]
    contrary = [name for name in off if (off[name].value > 1.0) != (off[names[0]].value > 1.0)]
    if contrary and contrary[0] not in names:
        names[-1] = contrary[0]
    return names


def factors_text(v: Findings) -> str:
    """:func:`unlike_text` where the axes that carry the fault of the scale are among those that it names, or ''."""
    assert v.location is not None
    if v.axes is None:
        return ""
    inside = set()
    for name in unlike_ratios(v):
        inside.update(members_of(v.axes, name) or [name])
    if not inside.issuperset(v.location.subset.split(", ") if v.location.subset else ()):
        return ""
    return unlike_text(v)


def level_causes(found: Findings) -> list[str]:
    """Usual levels whose factor the interval of the ratio holds, if it is narrow and all components agree; or none.

    Other faults make such a ratio, too: about one in 20 of the filters whose covariance is too large by any factor.
    """
    if found.status != "conservative" or found.scale is None:
        return []
    ratio = found.scale.inflation
    if not 0.0 < ratio.high <= NARROW * ratio.low:
        return []
    ratios = [ratio]
    if found.axes is not None:
        ratios += [found.axes.inflation[name] for name in found.axes.names]
    fitting = [of for of in LEVELS if all(each.holds(1.0 / of) for each in ratios)]
    if found.scale.dof != 2:
        fitting = [of for of in fitting if of != CEP]
    if not fitting:
        return []
    words = " or ".join(LEVELS[of] for of in fitting)
    factors = " or ".join(f"{of:g}" for of in fitting)
    options = " or ".join(f"--level {DECLARED[of]} --gaussian" for of in fitting)
    text = f"a covariance that is {factors} times too large would fit {words}; declared by {options}"
    return [f"perhaps a matter of what is stated: {text}"]


def groups_text(by: ByGroup, is_fault: bool) -> str:
    """The worst group where one is at fault, those beside it, and where the covariance is right; or what is shown."""
    if not is_fault:
        return _without_fault(by)
    worst = by.worst
    others = [group for group in by.groups if group.status in SIDES and group is not worst]
    if len(others) == len(by.groups) - 1 > 1 and all(group.status == worst.status for group in others):
        most = max(by.groups, key=lambda group: SIDES[group.status] * group.ratio.value)
        size = off_by(most.ratio)
        factor = size.partition(" by ")[2].replace(" (", ", ").removesuffix(")") or "hardly any error"
        return f"covariance {size[:SIDE]} everywhere, most ({factor}) where {most.name}"
    text = f"covariance {off_by(worst.ratio)} where {worst.name}"
    if len(others) == 1:
        text += f", and {off_by(others[0].ratio)} where {others[0].name}"
    elif others:
        which = f"{len(others)} of the {len(by.groups) - 1} other groups"
        if len(others) == len(by.groups) - 1:
            which = f"all {len(others)} other groups"
        text += f", and wrong in {which} by {by.column}"
    right = _consistent(by)
    if right:
        text += f"; consistent where {right}"
    return text


def right_groups(v: Findings) -> str:
    """What is shown of the groups of the whole, or of each part, where none is at fault."""
    if v.by_group is not None:
        return f"; {_without_fault(v.by_group)}"
    texts = [f"{name}: {_without_fault(part.by_group)}" for name, part in v.parts.items() if part.by_group]
    return "; ".join(["", *first_few(texts)])


def _without_fault(by: ByGroup) -> str:
    """What is shown of the groups where none is at fault, and the one that is farthest."""
    worst = by.worst
    count = len(by.groups)
    if not worst.status:
        return f"groups by {by.column} are reported and not judged"
    right = sum(group.status == "consistent" for group in by.groups)
    if right == count:
        return f"consistent in each of {count} groups by {by.column}"
    if all(_is_of_few(group) for group in by.groups):
        return f"all {count} groups by {by.column} undecided"
    return f"consistent in {right} of {count} groups by {by.column} (farthest {ratio_text(worst.ratio)}, {worst.name})"


def lines_of_groups(by: ByGroup, unit: str) -> list[str]:
    """A line for each group, then what its values leave to be said."""
    lines = []
    if by.outcome:
        lines.append(f"{by.column} {by.outcome}, which selects on the outcome: groups show, they do not convict")
    few = all(_is_of_few(group) for group in by.groups)
    lines += [f"{group.name}: {_figures(group, unit, few)}" for group in by.groups]
    if few:
        lines.append(f"groups by {by.column} are undecided: {plural(by.worst.runs, unit)}{_advice(by.worst, unit)}")
    if by.without:
        lines.append(f"{plural(by.without, 'step')} without a value of {by.column} {is_or_are(by.without)} in no group")
    return lines


def _is_of_few(group: Group) -> bool:
    """Whether a group is undecided in runs that are too few to tell its errors from chance."""
    return group.status == "undecided" and group.runs < FEW


def _figures(group: Group, unit: str, few: bool) -> str:
    """Ratio, verdict and size of a group; of one among ``few`` runs the bare ratio, as the advice stands below all."""
    if few:
        return f"covariance ratio {short(group.ratio.value)}, in {plural(group.steps, 'step')}"
    text = f"covariance ratio {ratio_text(group.ratio)}"
    if group.status:
        text += f", {group.status}"
    if group.status in SIDES:
        text += f" (p {p_text(group.p_value)})"
    text += f", in {plural(group.steps, 'step')} of {plural(group.runs, unit)}"
    if group.status == "undecided":
        text += _advice(group, unit)
    return text


def _advice(group: Group, unit: str) -> str:
    """That a group is in too few runs, and how many would decide."""
    few = ""
    if group.runs < FEW:
        few = f", too few to see how steps depend on each other ({FEW} are needed)"
    runs = group.equivalence.runs
    if runs is None or runs > MUCH:
        return few
    return f"{few}; {max(runs, group.runs + 1)} such {unit}s would probably decide"


def _consistent(by: ByGroup) -> str:
    """The groups where the covariance is shown to be right; neighbouring groups of numbers as one range."""
    names: list[str] = []
    low = high = np.nan
    for group in by.groups:
        if group.status != "consistent":
            continue
        if group.span is None:
            names.append(group.name)
        elif group.span[0] == high:
            high = group.span[1]
            names[-1] = range_name(by.column, low, high)
        else:
            low, high = group.span
            names.append(group.name)
    if len(names) > MOST:
        names = [*names[:MOST], f"in {len(names) - MOST} other groups"]
    return " or ".join(names)
