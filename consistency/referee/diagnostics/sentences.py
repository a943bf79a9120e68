"""A verdict in words: a sentence to act on, then the figures behind it. How one fault is said is in ``fault_words``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from consistency.referee.diagnostics.nees import TWO_SIGMA
from consistency.referee.diagnostics.number_of_runs import FEWEST_PLANNED
from consistency.referee.diagnostics.number_words import (
    between_text,
    first_few,
    is_or_are,
    is_uncertain,
    p_text,
    percent,
    plural,
    ratio_text,
    short,
    since_text,
)
from consistency.referee.diagnostics.record import Record
from consistency.referee.diagnostics.sample import ATTITUDE, POSITION
from consistency.referee.diagnostics.status import axis_at_fault
from consistency.referee.diagnostics.verdict import UNKNOWN_ENDS, ConventionResult, Findings, Verdict
from consistency.referee.diagnostics.verdict_parts import (
    SCALE,
    ByGroup,
    Equivalence,
    Innovations,
    Interval,
    Location,
    Scale,
    Settings,
)

SPREAD = 20.0  # worst over median run above which a mean says little: that run is named beside it
MUCH = 100_000  # runs; more are not advice
MOST_STEPS = 10_000_000  # of a log; more are not advice
FEWEST = 8  # runs; fewer true starts may be near each other by chance
SAME = 0.1  # of the stated variance of the position, which that of true starts drawn from it exceeds
LESS = 0.5  # of the median of all steps, that the NEES of the first one is at most
ROUNDING = 1e-9  # of the extent of a path
MEMORYLESS = 1.5  # steps, over which errors decorrelate whose rows may be independent


def reasons(v: Findings) -> list[str]:
    """First the sentence, then the figures."""
    sentence, figures = _sentence_and_figures(v)
    failures = _failures(v)
    lines = [*failures, sentence, *figures]
    if v.faults:
        lines = ["; ".join([sentence, *failures]), *figures]
    if v.innovations is not None:
        lines.append(_nis(v.innovations))
    lines += [*details(v), *_first_steps(v)]
    first = lines[0]
    if v.later:
        first = f"no fault found; an all-clear takes a look at all questions with {FEWEST_PLANNED} {v.unit}s or more"
    elif v.unshown:
        first = _unshown_sentence(v)
    elif v.skipped is not None:
        first += f"; without {v.skipped.skip.text} of each {_whole(v)}"
    return [f"{v.status}: {first}", *lines[1:]]


def _faults_of_parts(v: Findings) -> str:
    texts = []
    for name, part in v.parts.items():
        if not part.faults:
            continue
        part = replace(part, failures=())  # which are those of the whole
        begins_late = part.location is not None and part.location.since is not None
        if v.axes is not None and name in v.axes.names and part.scale is not None and not begins_late:
            # the whole states a ratio of that axis, too, with intervals that hold at once
            part = replace(part, scale=replace(part.scale, inflation=v.axes.inflation[name]))
        sentence = reasons(part)[0].removeprefix(f"{part.status}: ").removesuffix("; no bias found")
        texts.append(f"{name}: {sentence}")
    return "; ".join(first_few(texts))


def details(v: Findings) -> list[str]:
    """Figures that a first reading leaves out: credibility indices, and p values of the questions."""
    lines = []
    if v.accuracy is not None and np.isfinite(v.accuracy.nci):
        lines.append(
            f"noncredibility index {v.accuracy.nci:.1f} dB, inclination {v.accuracy.inclination:+.1f} dB (0 if right)"
        )
    if not v.answers:
        return lines
    text = f"{plural(len(v.answers), 'question')} at a false-alarm rate of {v.settings.false_alarm:.3g}"
    if len(v.answers) > 1:
        text += " together"
    if not v.faults:
        least = min(v.answers, key=lambda answer: answer.adjusted)
        nearest = f"{question_text(v, least.question)} (corrected p {p_text(least.adjusted)})"
        return [*lines, f"{text}; nearest to a fault: {nearest}"]
    found = []
    for answer in v.answers:
        if answer.question in v.faults:
            found.append(f"{question_text(v, answer.question)} (p {p_text(answer.adjusted)})")
    return [*lines, f"{text}; found: {', '.join(found)}"]


def _sentence_and_figures(v: Findings) -> tuple[str, list[str]]:
    """The sentence on errors, or without truth on innovations, and the figures behind it."""
    if v.bounds:
        from consistency.referee.diagnostics.bound_words import bounds_sentence, lines_of_bounds

        return bounds_sentence(v), lines_of_bounds(v)
    if v.scale is not None and v.scale.judged_steps:
        figures = [*_truth(v), *_early_ends(v), *_levels(v, v.scale), *_single_log(v, v.scale), *_together(v)]
        figures += _coverage(v)
        if v.faults and v.parts:
            return _faults_of_parts(v), figures
        if v.faults:
            from consistency.referee.diagnostics.fault_words import fault_sentence

            return fault_sentence(v, v.scale), figures
        return _no_fault(v, v.scale), figures
    if v.scale is not None:
        return "no step has a covariance of full rank to judge", []
    if v.innovations is not None and v.innovations.dof:
        return _without_truth(v, v.innovations), []
    return "neither truth nor innovations to judge", []


# --- the sentence ------------------------------------------------------------------------------------


def _failures(v: Findings) -> list[str]:
    lines = []
    if v.failures:
        first = v.failures[0]
        count = len({failure.run for failure in v.failures})
        runs = v.runs
        where = f"{v.unit} {first.run}"
        if v.landmarks is not None:  # of a map, which failed runs do not have
            runs += count
            where += f" in step {first.step}"
        elif v.unit == "run" and first.step > 1:  # without any estimate its step may be unknown
            where += f" in {v.place(first.step)}"
        lines.append(f"{count} of {runs} {v.unit}s failed, first {where}: {first.reason}")
    if v.impossible:
        row, step = v.impossible[0]
        count = len({run for run, _ in v.impossible})
        have = "have"
        if count == 1:
            have = "has"
        lines.append(
            f"{count} of {v.runs} {v.unit}s {have} an infinite error or a covariance with a "
            f"negative variance, first {v.run_name(row)} in {v.place(step)}; those {v.places} are left out"
        )
    if v.joint is not None and v.joint.not_definite:
        lines.append(
            f"the joint covariance of pose and map is not positive definite in {len(v.joint.not_definite)} of {v.runs} "
            f"runs, first run {v.joint.not_definite[0]}"
        )
    return lines


def _whole(v: Findings) -> str:
    """Noun for the whole that steps belong to: a run, or a log whose windows are runs."""
    if v.unit == "run":
        return "run"
    return "log"


def _first_steps(v: Findings) -> list[str]:
    """Steps left out of the beginning, or that might be."""
    if v.skipped is not None:
        gone = ""
        if v.skipped.empty:
            gone = f"; nothing is left of {plural(v.skipped.empty, 'run')}"
        are = is_or_are(v.skipped.skip.size)
        return [
            f"{v.skipped.skip.text} of each {_whole(v)} {are} left out as "
            f"asked{gone}; a number that was chosen on these data voids the false-alarm rate: choose it beforehand, or "
            "on other data"
        ]
    if v.location is None or v.location.until is None:
        return []
    until = v.location.until
    if v.location.since is not None:
        where = v.place(v.location.since, until.step)
        return [f"the fault is in {where} only; in the others the covariance ratio is {ratio_text(until.late)}"]
    where = "the first step"
    if until.step > 1:
        where = f"the first {until.step} steps"
    text = (
        f"the fault is in {where} only, where the covariance ratio is {short(until.early)}; after that it is "
        f"{ratio_text(until.late)}"
    )
    if v.scale is not None and 2 * until.step <= len(v.scale.alive):
        text += (
            f". If the start is not meant to count, state --skip {until.step} (skip={until.step} in a gate) and judge "
            "other runs by it"
        )
    return [text]


def _no_fault(v: Findings, s: Scale) -> str:
    """Whether the ratio is shown to be right, with that of the worst axis; and what share of lost runs stays open."""
    shown = s.equivalence
    runs = plural(v.runs, v.unit)
    none = "no fault found"
    size = f"covariance ratio {_ratio_of_test(s.inflation, shown)}"
    axis = ""
    if v.status == "failed":
        none = "no other fault found"
    if any(answer.tolerated for answer in v.answers):
        none = "no fault beyond the tolerance"
    if v.parts:
        size = "covariance ratio of every part"
    worst = axis_at_fault(v.worst_axis)
    if worst is not None:
        axis = f" (worst axis: {worst[0]}, {ratio_text(worst[1])})"
    if v.by_group is not None or v.parts:
        from consistency.referee.diagnostics.fault_words import right_groups

        axis += right_groups(v)
    if shown.shown:
        return f"{none} in {runs}, and the {size} is shown to be {between_text(shown)}{axis}{_lost(v)}"
    do = "do"
    if v.runs == 1:
        do = "does"
    return f"{none}, but {runs} {do} not show the {size} to be {between_text(shown)}{axis}{_advice(v, shown)}"


def _ratio_of_test(ratio: Interval, shown: Equivalence) -> str:
    """The ratio, with the interval of the two tests that show where it is."""
    if shown.interval is None:
        return ratio_text(ratio)
    low, high = shown.interval
    if np.isinf(high):
        return f"{short(ratio.value)} (known to be above {short(low)} only)"
    if shown.one_sided:
        return f"{short(ratio.value)} (below {short(high)} at a confidence of {percent(1.0 - shown.level)})"
    return f"{short(ratio.value)} ({percent(1.0 - 2.0 * shown.level)} interval {short(low)} to {short(high)})"


def _advice(v: Findings, shown: Equivalence) -> str:
    """The number of runs that would probably decide; '' where runs failed, which no further run mends."""
    if v.status == "failed" or shown.runs is None or shown.runs > MUCH:
        return ""
    needed = max(shown.runs, v.runs + 1)
    if v.lost is not None and v.settings.lost is not None and v.lost.needed is not None:
        needed = max(needed, v.lost.needed)
    return f"; {needed} such {v.unit}s would probably decide"


def _lost(v: Findings) -> str:
    """Lost runs, and the share of them that is shown or not excluded."""
    if v.lost is None or not _has_lost(v):
        return ""
    lost = v.lost
    asked = v.settings.lost
    unit = v.unit
    some = ""
    if lost.count:
        some = f"{plural(lost.count, unit)} of {lost.runs} {is_or_are(lost.count)} lost"
    if asked is not None and lost.upper <= asked:
        which = some or f"none of {lost.runs} is"
        return f"; lost {unit}s are shown to be at most {percent(asked)} of all ({which})"
    text = ";"
    if some:
        text = f"; {some}, and"
    elif asked is not None:
        text = ", but"
    if asked is None:
        digits, may = 2, "be lost or have a wrong covariance"
    else:
        digits, may = 3, "be lost"
    text += f" up to {percent(lost.upper, digits)} of {unit}s may still {may}"
    if asked is None:
        return text
    text += f", and {percent(asked)} is asked for"
    if lost.needed is not None:
        text += f"; {lost.needed} {unit}s would show it, if no further one is lost"
    return text


def _has_lost(v: Findings) -> bool:
    """Whether lost runs are worth a word: an estimate of one step cannot get lost, unless a share is asked for."""
    return v.steps > 1 or v.unit != "run" or v.settings.lost is not None or bool(v.failures)


# --- the figures behind it -----------------------------------------------------------------------------


def _level(v: Findings, s: Scale, location: Location) -> str:
    low, high = s.accepted
    text = f"mean NEES {short(s.mean_anees)}, accepted {short(low)} to {short(high)} ({s.dof} expected)"
    if s.worst_run > SPREAD * s.median_run:
        text += f"; {short(s.median_run)} in the median and {short(s.worst_run)} in the worst {v.unit}"
    if s.judged_steps > 1:
        where = []
        if location.steps_above:
            where.append(f"{location.steps_above} above")
        if location.steps_below:
            where.append(f"{location.steps_below} below")
        outside = " and ".join(where) or "none"
        text += f"; {v.places} outside the simultaneous band: {outside} of {s.judged_steps}"
    return text


def _levels(v: Findings, s: Scale) -> list[str]:
    """The mean NEES, the worst axis and lost runs; of parts whose cross terms are not stated also that of each part."""
    lines = []
    if v.parts:
        ratio = short(s.mean_anees / s.dof)
        lines.append(
            f"cross terms of {', '.join(v.parts)} are not stated: each is judged by itself, and the mean NEES over the "
            f"{s.dof} components, {ratio} (1 expected under any correlation), is not judged"
        )
    elif v.location is not None:
        lines.append(_level(v, s, v.location))
    if not v.faults:
        lines += _two_intervals(s, v.unit)
    worst = axis_at_fault(v.worst_axis)
    if v.faults and worst is not None:
        lines.append(_ratios(v, s, *worst))
    elif v.worst_axis is not None and not set(SCALE).isdisjoint(v.faults):
        from consistency.referee.diagnostics.fault_words import combination_text

        lines.append(f"no single axis is shown wrong; the error is {combination_text(v)}")
    lines += _groups(v.by_group, v.unit)
    if v.lost is not None and _has_lost(v) and (v.lost.count or v.settings.lost is not None):
        lines.append(
            f"lost {v.unit}s: {v.lost.count} of {v.lost.runs} failed or have a mean NEES above {short(v.lost.bound)}; "
            f"at most {percent(v.lost.upper)} of all at a confidence of {v.lost.level:g}"
        )
    tolerated = [answer.question for answer in v.answers if answer.tolerated]
    if tolerated:
        factor = f"{v.settings.tolerated:g}"
        lines.append(f"found, but shown to be within the tolerance of x{factor}: {', '.join(tolerated)}")
    for name, part in v.parts.items():
        if part.scale is not None and part.location is not None:
            lines.append(f"{name}: {_level(part, part.scale, part.location)}")
        lines += [f"{name}: {line}" for line in _groups(part.by_group, v.unit)]
    return lines


def _ratios(v: Findings, s: Scale, worst: str, of_worst: Interval) -> str:
    """Ratio of variances of the worst axis, of position and attitude of a pose, and of all axes since the fault began.

    The step in which a fault begins depends on the false-alarm rate; the ratio over all steps does not.
    """
    text = f"covariance ratio of the worst axis{since_text(v)}: {worst}, {ratio_text(of_worst)}"
    assert v.axes is not None
    blocks = {
        block: [name for name in v.axes.names if name in members]
        for block, members in (("position", POSITION), ("attitude", ATTITUDE))
    }
    for block, own in blocks.items() if all(blocks.values()) else ():
        ratio = v.axes.inflation.get(block if len(own) > 1 else own[0])
        if ratio is not None and own != [worst]:
            text += f"; {block} {ratio_text(ratio)}"
    text += f"; all axes {ratio_text(s.inflation)}, in sigmas x{short(float(np.sqrt(s.inflation.value)))}"
    if v.location is not None and v.location.since is not None:
        text += f"; over all {v.places} {short(s.mean_anees / s.dof)}"
    return text


def _two_intervals(s: Scale, unit: str) -> list[str]:
    """That the interval of the tests is not that of the ratio, where it is the wider one at the lower level."""
    tests = s.equivalence.interval
    if tests is None or s.equivalence.one_sided or not s.inflation.high > 0.0:
        return []
    low, high = s.inflation[1:]
    if (tests[0] >= low and tests[1] <= high) or is_uncertain(s.inflation):
        return []
    return [
        f"95 % interval {short(low)} to {short(high)} by the spread between these {unit}s; that of the two tests is "
        "wider where it also holds if the covariance is right in some runs only"
    ]


def _groups(by: ByGroup | None, unit: str) -> list[str]:
    if by is None:
        return []
    from consistency.referee.diagnostics.fault_words import lines_of_groups

    return lines_of_groups(by, unit)


def _truth(v: Findings) -> list[str]:
    """What errors of the truth leave to be said, and what to declare."""
    truth = v.truth
    if truth is None:
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


def _early_ends(v: Findings) -> list[str]:
    """That runs seem to end because the filter is lost."""
    if v.ends is None or not v.ends.lost:
        return []
    return [
        f"{plural(v.ends.runs, v.unit)} that end early have a larger NEES in their last step than "
        f"{100 * v.ends.above:.0f} % of the {v.unit}s that continue (p {p_text(v.ends.p_value)}): if they end because "
        "they are lost, no rate holds; write a row of NaN where a filter breaks down, so that it counts as failed"
    ]


def _single_log(v: Findings, s: Scale) -> list[str]:
    """Ratio of a single run, and the data that would decide."""
    if v.runs != 1 or v.landmarks is not None or v.unit != "run":
        return []
    undecided = v.status == "undecided"
    if s.within is None and not undecided:
        return []
    if s.within is None:
        return [
            "the log is too short to show how its errors decorrelate; further runs, or a far longer log, would decide"
        ]
    w, steps = s.within, s.judged_steps
    text = (
        f"if errors go on to decorrelate as within this log (over {short(w.correlation)} steps), the covariance ratio "
        f"is {ratio_text(w.ratio)}, reported and not judged"
    )
    if not undecided or w.steps is None or w.pieces is None or w.steps > MOST_STEPS:
        return [text]
    if w.steps <= steps and w.correlation < MEMORYLESS:
        text += "; if rows do not depend on each other, as images or detections, --independent makes each a run"
    if w.steps <= steps:
        return [f"{text}; cut into {w.pieces} runs, this log would then probably decide"]
    return [f"{text}; a log of {w.steps} steps, cut into {w.pieces} runs, would then probably decide"]


def _together(v: Findings) -> list[str]:
    if v.landmarks is None:
        return []
    if v.joint is None or not v.joint.runs:
        return ["the joint covariance of pose and map was not kept: each landmark is judged by itself"]
    j = v.joint
    return [
        f"NEES of pose and map together over its degrees of freedom {ratio_text(j.both)}: of the pose "
        f"{ratio_text(j.pose)}, of the map given the pose {ratio_text(j.map)}"
    ]


def _coverage(v: Findings) -> list[str]:
    if v.accuracy is None or v.axes is None:
        return []
    known = []
    for axis, share in zip(v.axes.names, v.accuracy.coverage, strict=True):
        if np.isfinite(share):
            known.append(f"{axis} {100 * share:.1f} %")
    if not known:
        return []
    return [f"2-sigma coverage {', '.join(known)} ({100 * TWO_SIGMA:.1f} % expected)"]


def _without_truth(v: Findings, i: Innovations) -> str:
    if not i.judged:
        return (
            "no truth, and innovations decide nothing unless the filter declares an optimal gain: those of any other "
            "filter are neither white nor of the stated size even if it is right"
        )
    parts = []
    shown = i.equivalence
    if v.faults:
        from consistency.referee.diagnostics.fault_words import innovation_faults

        parts += innovation_faults(v, i)
    elif shown is not None:
        is_shown = "but their NIS per degree of freedom {} is not shown to be"
        if shown.shown:
            is_shown = "and their NIS per degree of freedom {} is shown to be"
        ratio = _ratio_of_test(Interval(i.ratio, *UNKNOWN_ENDS), shown)
        parts.append(f"no fault found in the innovations, {is_shown.format(ratio)} {between_text(shown)}")
        if v.settings.lost is not None:
            parts.append("they cannot show what share of runs is lost")
    return "; ".join([*parts, "no truth: most pose errors cannot be seen"])


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


def question_text(v: Findings, question: str) -> str:
    """A question as it is called: of a map, "in some landmark" in the place of "in some step"."""
    if v.landmarks is None:
        return question
    return question.replace("some step", "some landmark")


# --- where nothing is decided ----------------------------------------------------------------------------


def _unshown_sentence(v: Findings) -> str:
    """Why nothing can be shown, and the ratio that would be judged."""
    assert v.scale is not None
    provided = " if they are"
    if v.truth is not None:
        provided = ""
    ratio = f"the covariance ratio would be {ratio_text(v.scale.inflation)}{provided}, reported and not judged"
    return f"{v.unshown}; {ratio}"


def other_ways(status: str, record: Record) -> list[str]:
    """What else would decide on a single log of poses."""
    is_log = (
        len(record.run_numbers) == 1 and record.origin.window is None and record.fit.align and record.errors.convention
    )
    if status != "undecided" or not is_log or not ATTITUDE & set(record.errors.axes):
        return []
    return [
        "--relative 10s (or steps, or metres) makes many windows of one log, if the file has motions with covariances, "
        "or poses with cross-covariances (docs/files.md)"
    ]


def sentences_of_conventions(
    found: Mapping[str, ConventionResult], verdicts: Mapping[str, Verdict], settings: Settings
) -> list[str]:
    """Which conventions of the error are not rejected, and the sentence of each."""
    left = []
    gone = []
    for kind, result in found.items():
        if result.possible:
            left.append(f"{kind} (covariance ratio {ratio_text(result.ratio)})")
        else:
            gone.append(kind)
    rate = percent(settings.false_alarm)
    if left:
        text = f"no error is declared; not rejected at a rate of {rate}: {', '.join(left)}"
        if gone:
            text += f"; rejected: {', '.join(gone)}"
        text += ". The filter's documentation says which it is; declare it with --error"
    else:
        text = f"no error is declared, and at a rate of {rate} each all are rejected: {', '.join(found)}"
    lines = [f"undecided: {text}"]
    for kind, verdict in verdicts.items():
        lines.append(f"if the error is {kind}: {verdict.reasons[0]}")
    return lines


def same_truth(record: Record, found: Findings) -> list[str]:
    """That all runs have the same true path or start, where the covariance is too large in the first judged step.

    There it has to be worse than in most: a covariance that is too large throughout is so for another reason.
    """
    where = found.location
    if record.origin.path is None or where is None or not where.steps_below or len(record.origin.path) < FEWEST:
        return []
    assert record.errors.nees is not None
    assert found.scale is not None
    step = int(np.argmax(found.scale.alive > 0))
    anees = found.scale.anees
    is_below = bool(anees[step] < min(where.simultaneous[step, 0], LESS * float(np.nanmedian(anees))))
    if not is_below or not set(found.faults) & set(SCALE):
        return []
    true = record.origin.path[:, :, 0]
    apart = np.abs(true - true[:1])
    if np.nanmax(apart) <= ROUNDING * max(float(np.nanmax(np.abs(true))), 1.0):
        return [
            "all runs have the same true path: draw its start from the first covariance, which allows for others, and "
            "the rest from the filter's model"
        ]
    counted = np.isfinite(record.errors.nees[:, step])
    index = [i for i, axis in enumerate(record.errors.axes) if axis in POSITION]
    stated = np.asarray(record.errors.covariance)[counted, step][:, index, index].mean(axis=0).sum()
    if np.nanvar(true[counted, step], axis=0).sum() < SAME * stated:
        return [
            "all runs have the same true start, which the covariance does not know: draw it from the first covariance"
        ]
    return []
