"""A fitted noise model in sentences, a table and numbers for programs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from consistency.referee.defaults import DETECT
from consistency.referee.diagnostics.verdict.as_dictionary import plain
from consistency.referee.diagnostics.words.numbers import plural, short
from consistency.referee.document.blocks import Block, Cell, Column, Document, Quantity, Table, Text, table
from consistency.referee.fit_covariance.covariance_ratios import DECIDE, HALF, IN_TURN, JudgedSpan, Ratio, shown
from consistency.referee.fit_covariance.mean_differences import TERMS, MotionDependence
from consistency.referee.fit_covariance.motion_windows import ENOUGH, span_of
from consistency.referee.fit_covariance.noise_model import NoiseModel
from consistency.referee.fit_covariance.second_estimator import SHARED
from consistency.referee.fit_covariance.systematic_errors import NEIGHBOURS, STRONG, Mean, MeanFit

RATIO = ("value", "low", "high", "spread", "drives", "windows", "status")  # of a ratio, as programs have it
EVIDENCE = ("low", "high", "free", "instruments", "turns", "strength", "lasts", "is_open")  # of a mean, the same
MARK = {"consistent": "", "undecided": " ?", "overconfident": " overconfident", "conservative": " conservative"}
WRONG = ("overconfident", "conservative")


def model_sentence(model: NoiseModel) -> str:
    """Span, status, ratio with its interval, and on how many drives it rests."""
    word = model.status
    if word == "consistent":
        word = f"consistent within x{DETECT:g}"
    parts = [f"at {_text(model.span)} {word}: held-out ratio {shown(model.ratio)}", _basis(model), *_reasons(model)]
    return "; ".join(parts)


def _text(span: str) -> str:
    return span_of(span).text


def _basis(model: NoiseModel) -> str:
    judged, windows = model.ratio.drives, plural(model.ratio.windows, "window")
    if model.held_out == HALF:
        halves = "half" if judged == 1 else "halves"
        return f"fitted on the first {halves} of {plural(judged, 'drive')}, judged on the second ({windows})"
    if model.held_out == IN_TURN:
        return f"{plural(judged, 'drive')}, each judged by the fit of the others ({windows})"
    return f"fitted on {plural(len(model.fitted_drives), 'drive')}, judged on {judged} ({windows})"


def _reasons(model: NoiseModel) -> Iterator[str]:
    """Reasons for a status that the ratio does not tell."""
    ratio, at_span = model.ratio, model.spans[0]
    if model.held_out == HALF and model.status == "undecided":
        yield "halves of a drive show nothing about a new one; give drives that are not fitted"
    elif ratio.drives < ENOUGH and ratio.windows < DECIDE:
        yield f"too few to decide, which takes {ENOUGH} drives or {DECIDE} windows"
    if model.second is not None and model.second.is_shared.any():
        worst = int(np.argmax(model.second.correlation))
        yield (
            f"errors in {model.noise.axes[worst]} correlate {model.second.correlation[worst]:.2f} with those of the "
            "second estimator: they are the truth's, or the calibration's"
        )
    for each in model.lasting:
        if each.decides and at_span.status == "consistent":
            yield (
                f"{each.term} differs between drives and makes up {each.share:.0%} of the variance of an axis, so that "
                "new drives may have another covariance"
            )
    wrong, unknown = [], []
    for name, axis in zip(model.noise.axes, at_span.axes, strict=True):
        if axis.status in WRONG:
            wrong.append(f"{name} {axis.status}")
        elif axis.status == "undecided" and axis.drives:
            unknown.append(name)
    if wrong:
        yield ", ".join(wrong)
    if unknown and ratio.status == "consistent":
        yield f"undecided: {', '.join(unknown)}"
    if model.by_motion is not None and model.by_motion.is_found:
        yield dependence(model.by_motion, model.noise.mean.slip != 0.0)


def dependence(found: MotionDependence, is_corrected: bool) -> str:
    """A mean error that depends on the motion, and what to do about it."""
    unit, motions = ("rad", "turns") if found.by == "turn" else ("m", "ways")
    *values, last = (f"x{value:.3g}" for value in found.values)
    edges = (f"{edge:.2g} {unit}" for edge in found.edges)
    bins = [f"{value} for {motions} up to {edge}" for value, edge in zip(values, edges, strict=True)]
    offer = ""
    if (found.scale, found.by) == (TERMS[0], "turn") and not is_corrected:
        offer = "correct the way by the turn with --by-turn, or "
    return (
        f"{found.scale} depends on the {found.by}: {', '.join(bins)}, {last} beyond; that is {found.share:.0%} of the "
        f"variance of {found.axis}: {offer}state that spread in the covariance (add the square of {found.reach:.2g} "
        f"{_unit(found.axis)} to the variance of {found.axis})"
    )


def _unit(axis: str) -> str:
    return "m" if axis in "xyz" else "rad"


def noise_document(model: NoiseModel) -> Document:
    """Sentence, corrections, table over axes and spans, and limits; numbers as data."""
    opening: list[Block] = [Text(f"{model.name}: {model_sentence(model)}")]
    if corrected := correction(model):
        opening.append(Text(corrected))
    opening.append(_table(model))
    opening += map(Text, noise_lines(model))
    return Document(
        f"{model.name}: noise of motions over {_text(model.span)}", "", (), tuple(opening), data_of_model(model)
    )


def correction(model: NoiseModel) -> str:
    """What is corrected before the covariance holds; empty where nothing is."""
    mean, fit = model.noise.mean, model.noise.mean_fit
    parts = []
    if mean.slip:
        parts.append(f"{mean.slip:+.3g} m of way a rad of turn")
    if fit is not None and fit.free.any():
        shown = [f"way x{mean.way:.4g}", f"turn x{mean.turn:.4g}"]
        shown += [f"{name} {each:+.3g} rad/m" for name, each in zip(_drifts(mean), mean.drift, strict=True)]
        parts.append(", ".join(np.array(shown)[fit.free]))
    return f"correct first: {', then '.join(parts)}" if parts else ""


def _drifts(mean: Mean) -> tuple[str, ...]:
    return ("heading",) if len(mean.drift) == 1 else ("roll", "pitch", "yaw")


def _of_mean(fit: MeanFit) -> Iterator[str]:
    """What is not corrected, and whether the scale of turns depends on whose noise it is."""
    names = ["way x", "turn x", *(f"{each} " for each in _drifts(fit.mean))]
    left = []
    for name, low, high, is_free in zip(names, fit.low, fit.high, fit.free, strict=True):
        if not is_free:
            left.append(f"{name}[{low:.3g}, {high:.3g}]")
    if left:
        yield f"not corrected, as the interval holds none: {', '.join(left)}"
    forward, backward = (f"x{short(each)}" for each in fit.turns)
    sides = f"{forward} if the robot's motion errs about the odometry, {backward} if the odometry errs about the motion"
    if fit.instruments == NEIGHBOURS:
        found = (
            f"the scale of turns is that by the motion of neighbouring windows (F {short(fit.strength)}), not {sides}"
        )
        if fit.turns[1] > fit.high[1]:
            found += "; the true side errs, too, as of slip, or of a truth that drifts or jitters: --second tells which"
        yield found
    elif fit.is_open:
        yield f"whose noise it is cannot be told: the scale of turns is {sides}; {_why_open(fit)}"


def _why_open(fit: MeanFit) -> str:
    if fit.strength < STRONG:
        return f"neighbouring windows are weak instruments (F {short(fit.strength)}, below {STRONG:g})"
    if fit.lasts:
        return "errors outlast a window, so that neighbouring windows are not instruments"
    return "neighbouring windows tell less than these"


def _table(model: NoiseModel) -> Table:
    numbers = [Column(head, number=True) for head in ("per m^.5", "per rad^.5", "at least")]
    first, *longer = (_text(each.span) for each in model.spans)
    columns = (Column("axis"), *numbers, Column(f"held-out {first}"), *map(Column, longer))
    rows: list[tuple[Cell, ...]] = []
    for i, axis in enumerate(model.noise.axes):
        variances = model.per_m[i].value, model.per_rad[i].value, model.noise.floor[i]
        sigmas = [f"{np.sqrt(value):.2g} {_unit(axis)}" for value in variances]
        rows.append((axis, *sigmas, *(_cell(each.axes[i]) for each in model.spans)))
    rows.append(("all", "", "", "", *(_cell(each.whole) for each in model.spans)))
    label = "Noise of each axis, and ratios of true to stated covariance over spans"
    return table(columns, rows, label, style="plain")


def _cell(ratio: Ratio) -> Cell:
    if not np.isfinite(ratio.low):
        return Quantity(ratio.value)
    return shown(ratio) + MARK[ratio.status]


def noise_lines(model: NoiseModel) -> Iterator[str]:
    """Limits of the model, what was left out, and what the referee says of the judged motions."""
    yield "; ".join(_limits_of_use(model))
    if model.noise.factor != 1.0:
        yield f"cautious: all covariances are raised x{model.noise.factor:.3g}, so that a new drive rarely has more"
    if shift := model.drives[0].shift:
        yield (f"clocks: {shift:.3g} s are added to the timestamps of the estimates, for which the motions agree best")
    if model.second is not None:
        yield _of_second(model)
    if model.noise.mean_fit is not None:
        yield from _of_mean(model.noise.mean_fit)
    yield from model.warnings
    yield f"analyse counts each judged motion as a run, though those of a drive depend: {model.verdict.reasons[0]}"


def _limits_of_use(model: NoiseModel) -> Iterator[str]:
    unshown = [each.span for each in model.spans[1:] if each.whole.status != "consistent"]
    yield f"not shown for {_text(unshown[0])} and more" if unshown else f"shown for {_text(model.span)} alone"
    if np.isfinite(model.ratio.spread):
        low, high = model.ratio.reach
        yield f"a new drive: {low:.2g} to {high:.2g}"
    else:
        yield "a new drive: not known from one"
    yield f"jumps cut: {model.counts['jumps']}"
    for key, why in (("still", "without motion"), ("long", "with rows or truth missing")):
        if number := model.counts[key]:
            yield f"left out {why}: {number}"


def _of_second(model: NoiseModel) -> str:
    second, axes = model.second, model.noise.axes
    assert second is not None
    shown = ", ".join(f"{axis} {each:.2f}" for axis, each in zip(axes, second.correlation, strict=True))
    found = f"correlation with errors of the second estimator: {shown}; above {SHARED:g} they are the truth's"
    if second.is_rough.any():
        found += f"; it errs too much to tell in {', '.join(np.array(axes)[second.is_rough])}"
    return found


def data_of_model(model: NoiseModel) -> dict[str, Any]:
    """Everything as plain data, as noise.toml and --json have it."""
    noise, mean, fit, second = model.noise, model.noise.mean, model.noise.mean_fit, model.second
    found: dict[str, Any] = plain({
        "name": model.name,
        "status": model.status,
        "sentence": model_sentence(model),
        "span": model.span,
        "axes": noise.axes,
        "fitted_drives": model.fitted_drives,
        "judged_drives": model.judged_drives,
        "held_out": model.held_out,
        "counts": model.counts,
        "mean": {
            "way": mean.way,
            "turn": mean.turn,
            "drift_rad_per_m": mean.drift,
            "slip_m_per_rad": mean.slip,
            **{key: getattr(fit, key) for key in EVIDENCE if fit is not None},
        },
        "noise": {
            "variance_per_m": noise.per_m,
            "variance_per_rad": noise.per_rad,
            "floor": noise.floor,
            "factor": noise.factor,
            "per_m_interval": model.per_m,
            "per_rad_interval": model.per_rad,
        },
        "by_motion": vars(model.by_motion) if model.by_motion is not None else None,
        "growth": model.growth.power,
        "warnings": model.warnings,
        "second_correlation": second.correlation if second is not None else None,
        "second_size": second.size if second is not None else None,
        "spans": [_data_of_span(each, noise.axes) for each in model.spans],
        "referee": model.verdict.statistics,
    })  # fmt: skip
    return found


def _data_of_span(span: JudgedSpan, axes: tuple[str, ...]) -> dict[str, Any]:
    found: dict[str, Any] = {"span": span.span}
    for name, ratio in zip(("whole", *axes), (span.whole, *span.axes), strict=True):
        found[name] = {key: getattr(ratio, key) for key in RATIO}
    found["by_drive"] = span.by_drive[:, 0]
    return found
