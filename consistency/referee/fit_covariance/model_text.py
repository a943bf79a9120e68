"""A fitted noise model in sentences, a table and numbers for programs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from consistency.referee.defaults import DETECT
from consistency.referee.diagnostics.verdict.as_dictionary import plain
from consistency.referee.diagnostics.words.numbers import plural, short
from consistency.referee.document.blocks import Cell, Column, Document, Quantity, Table, Text, table
from consistency.referee.fit_covariance.covariance_ratios import DECIDE, HALF, Ratio
from consistency.referee.fit_covariance.mean_by_motion import ByMotion
from consistency.referee.fit_covariance.motion_windows import ENOUGH, span_of
from consistency.referee.fit_covariance.noise_model import NoiseModel
from consistency.referee.fit_covariance.persistence import SHARED, Second
from consistency.referee.fit_covariance.systematic_errors import NEIGHBOURS, STRONG, Mean, MeanFit

RATIO = ("value", "low", "high", "spread", "drives", "windows", "status")  # of a ratio, as programs have it
EVIDENCE = ("low", "high", "free", "instruments", "turns", "strength", "lasts", "is_open")  # of a mean, the same
MARK = {"consistent": "", "undecided": " ?", "overconfident": " overconfident", "conservative": " conservative"}


def sentence(model: NoiseModel) -> str:
    """Span, status, ratio with its interval, and on how many drives it rests."""
    r = model.ratio
    word = f"consistent within x{DETECT:g}" if model.status == "consistent" else model.status
    shown = f"{short(r.value)} [{short(r.low)}, {short(r.high)}]" if np.isfinite(r.low) else short(r.value)
    return f"at {_text(model.span)} {word}: held-out ratio {shown}; {_basis(model)}{_why(model)}"


def _text(span: str) -> str:
    return span_of(span).text


def _basis(model: NoiseModel) -> str:
    r, windows = model.ratio, plural(model.ratio.windows, "window")
    if model.held_out == HALF:
        of = plural(r.drives, "drive")
        return f"fitted on the first {'half' if r.drives == 1 else 'halves'} of {of}, judged on the second ({windows})"
    if model.held_out == "in turn":
        return f"{plural(r.drives, 'drive')}, each judged by the fit of the others ({windows})"
    return f"fitted on {plural(len(model.fitted_drives), 'drive')}, judged on {r.drives} ({windows})"


def _why(model: NoiseModel) -> str:
    """Reasons for a status that the ratio does not tell."""
    r, parts = model.ratio, []
    if model.held_out == HALF and model.status == "undecided":
        parts.append("halves of a drive show nothing about a new one; give drives that are not fitted")
    elif r.drives < ENOUGH and r.windows < DECIDE:
        parts.append(f"too few to decide, which takes {ENOUGH} drives or {DECIDE} windows")
    if model.second is not None and model.second.is_shared.any():
        worst = int(np.argmax(model.second.correlation))
        parts.append(
            f"errors in {model.noise.axes[worst]} correlate {model.second.correlation[worst]:.2f} with those of the "
            "second estimator: they are the truth's, or the calibration's"
        )
    if model.spans[0].status == "consistent":
        parts += [
            f"{each.term} differs between drives and makes up {each.share:.0%} of the variance of an axis, so that new "
            "drives may have another covariance"
            for each in model.lasting if each.decides
        ]  # fmt: skip
    axes = list(zip(model.noise.axes, model.spans[0].axes, strict=True))
    open_axes = [a for a, axis in axes if axis.status == "undecided" and axis.drives]
    found = [f"{a} {axis.status}" for a, axis in axes if axis.status in ("overconfident", "conservative")]
    if found:
        parts.append(", ".join(found))
    if open_axes and r.status == "consistent":
        parts.append(f"undecided: {', '.join(open_axes)}")
    if model.by_motion is not None and model.by_motion.is_found:
        parts.append(dependence(model.by_motion, bool(model.noise.mean.slip)))
    return "".join(f"; {part}" for part in parts)


def dependence(found: ByMotion, is_corrected: bool) -> str:
    """A mean error that depends on the motion, and what to do about it."""
    unit, what = ("rad", "turns") if found.by == "turn" else ("m", "ways")
    *rest, last = [f"x{value:.3g}" for value in found.values]
    bins = [f"{value} for {what} up to {edge:.2g} {unit}" for value, edge in zip(rest, found.edges, strict=True)]
    size = f"{found.reach:.2g} {'m' if found.axis in 'xyz' else 'rad'}"
    offer = (
        f"correct the way by the turn with --by-turn, which takes {found.gain:.0%} of the squared error of positions "
        "out of motions that it is not fitted to, or " * (found.gain > 0 and not is_corrected)
    )
    return (
        f"{found.scale} depends on the {found.by}: {', '.join(bins)}, {last} beyond; that is {found.share:.0%} of the "
        f"variance of {found.axis}: {offer}state that spread in the covariance (add the square of {size} to the "
        f"variance of {found.axis})"
    )


def noise_document(model: NoiseModel) -> Document:
    """Sentence, corrections, table over axes and spans, and limits; numbers as data."""
    return Document(
        f"{model.name}: noise of motions over {_text(model.span)}",
        "",
        (),
        (
            Text(f"{model.name}: {sentence(model)}"), *([Text(correction(model))] if correction(model) else []),
            _table(model), *(Text(line) for line in noise_lines(model)),
        ),
        data(model),
    )  # fmt: skip


def correction(model: NoiseModel) -> str:
    """What is corrected before the covariance holds; empty where nothing is."""
    mean, fit = model.noise.mean, model.noise.mean_fit
    if fit is None or not (fit.free.any() or mean.slip):
        return ""
    shown = [f"way x{mean.way:.4g}", f"turn x{mean.turn:.4g}"]
    shown += [f"{name} {each:+.3g} rad/m" for name, each in zip(_drifts(mean), mean.drift, strict=True)]
    parts = [f"{mean.slip:+.3g} m of way a rad of turn"] * (mean.slip != 0.0) + [", ".join(np.array(shown)[fit.free])]
    return f"correct first: {', then '.join(part for part in parts if part)}"


def _drifts(mean: Mean) -> tuple[str, ...]:
    return ("heading",) if len(mean.drift) == 1 else ("roll", "pitch", "yaw")


def _of_mean(fit: MeanFit) -> list[str]:
    """What is not corrected, and whether the scale of turns depends on whose noise it is."""
    names = ["way x", "turn x", *(f"{each} " for each in _drifts(fit.mean))]
    parts = zip(names, fit.low, fit.high, fit.free, strict=True)
    left = [f"{name}[{low:.3g}, {high:.3g}]" for name, low, high, is_free in parts if not is_free]
    found = [f"not corrected, as the interval holds none: {', '.join(left)}"] if left else []
    forward, backward = (f"x{short(each)}" for each in fit.turns)
    sides = f"{forward} if the robot's motion errs about the odometry, {backward} if the odometry errs about the motion"
    if fit.instruments == NEIGHBOURS:
        text = (
            f"the scale of turns is that by the motion of neighbouring windows (F {short(fit.strength)}), not {sides}"
        )
        if fit.turns[1] > fit.high[1]:
            text += "; the true side errs, too, as of slip, or of a truth that drifts or jitters: --second tells which"
        found.append(text)
    elif fit.is_open:
        why = "neighbouring windows tell less than these"
        if fit.strength < STRONG:
            why = f"neighbouring windows are weak instruments (F {short(fit.strength)}, below {STRONG:g})"
        elif fit.lasts:
            why = "errors outlast a window, so that neighbouring windows are no instruments"
        found.append(f"whose noise it is cannot be told: the scale of turns is {sides}; {why}")
    return found


def _table(model: NoiseModel) -> Table:
    heads = [
        Column("axis"),
        Column("per m^.5", number=True),
        Column("per rad^.5", number=True),
        Column("at least", number=True),
    ]
    heads += [
        Column(f"held-out {_text(each.span)}" if i == 0 else _text(each.span)) for i, each in enumerate(model.spans)
    ]
    rows: list[tuple[Cell, ...]] = []
    for i, axis in enumerate(model.noise.axes):
        unit = "m" if axis in "xyz" else "rad"
        sizes = [f"{np.sqrt(each[i].value):.2g} {unit}" for each in (model.per_m, model.per_rad)]
        sizes.append(f"{np.sqrt(model.noise.floor[i]):.2g} {unit}")
        rows.append((axis, *sizes, *(_cell(each.axes[i]) for each in model.spans)))
    rows.append(("all", "", "", "", *(_cell(each.whole) for each in model.spans)))
    label = "Noise of each axis, and ratios of true to stated covariance over spans"
    return table(tuple(heads), rows, label, style="plain")


def _cell(ratio: Ratio) -> Cell:
    if not np.isfinite(ratio.low):
        return Quantity(ratio.value)
    return f"{short(ratio.value)} [{short(ratio.low)}, {short(ratio.high)}]{MARK[ratio.status]}"


def noise_lines(model: NoiseModel) -> list[str]:
    """Limits of the model, what was left out, and what the referee says of the judged motions."""
    out, r = [], model.ratio
    limit = next((each.span for each in model.spans[1:] if each.whole.status != "consistent"), None)
    parts = [f"not shown for {_text(limit)} and more"] if limit else [f"shown for {_text(model.span)} alone"]
    if np.isfinite(r.spread):
        low, high = r.reach
        parts.append(f"a new drive: {low:.2g} to {high:.2g}")
    else:
        parts.append("a new drive: not known from one")
    counts = model.counts
    parts.append(f"jumps cut: {counts['jumps']}")
    for key, why in (("still", "without motion"), ("long", "with rows or truth missing")):
        if counts[key]:
            parts.append(f"left out {why}: {counts[key]}")
    out.append("; ".join(parts))
    if model.noise.factor != 1.0:
        out.append(
            f"cautious: all covariances are raised x{model.noise.factor:.3g}, so that a new drive seldom has more"
        )
    if model.drives[0].shift:
        out.append(
            f"clocks: {model.drives[0].shift:.3g} s are added to the timestamps of the estimates, for which the "
            "motions agree best"
        )
    if model.second is not None:
        out.append(_of_second(model.second, model.noise.axes))
    if model.noise.mean_fit is not None:
        out += _of_mean(model.noise.mean_fit)
    out += model.warnings
    out.append(
        f"analyse counts each judged motion as a run, though those of a drive depend: {model.verdict.reasons[0]}"
    )
    return out


def _of_second(second: Second, axes: Sequence[str]) -> str:
    shown = ", ".join(f"{axis} {each:.2f}" for axis, each in zip(axes, second.correlation, strict=True))
    rough = ", ".join(np.array(axes)[second.is_rough])
    text = f"correlation with errors of the second estimator: {shown}; above {SHARED:g} they are the truth's"
    return text + (f"; it errs too much to tell in {rough}" if rough else "")


def data(model: NoiseModel) -> dict[str, Any]:
    """Everything as plain data, as noise.toml and --json have it."""
    n, m, second = model.noise, model.noise.mean, model.second
    spans = [
        {
            "span": each.span,
            **{
                axis: {key: getattr(ratio, key) for key in RATIO}
                for axis, ratio in zip(("whole", *n.axes), (each.whole, *each.axes), strict=True)
            },
            "by_drive": each.by_drive[:, 0],
        }
        for each in model.spans
    ]
    evidence = {key: getattr(n.mean_fit, key) for key in EVIDENCE if n.mean_fit is not None}
    found: dict[str, Any] = plain({
        "name": model.name, "status": model.status, "sentence": sentence(model), "span": model.span, "axes": n.axes,
        "fitted_drives": model.fitted_drives, "judged_drives": model.judged_drives, "held_out": model.held_out,
        "counts": dict(model.counts),
        "mean": {"way": m.way, "turn": m.turn, "drift_rad_per_m": m.drift, "slip_m_per_rad": m.slip, **evidence},
        "noise": {
            "variance_per_m": n.per_m, "variance_per_rad": n.per_rad, "floor": n.floor, "factor": n.factor,
            "per_m_interval": model.per_m, "per_rad_interval": model.per_rad,
        },
        "by_motion": None if model.by_motion is None else vars(model.by_motion),
        "growth": model.growth.power, "warnings": model.warnings,
        "second_correlation": None if second is None else second.correlation,
        "second_size": None if second is None else second.size, "spans": spans, "referee": model.verdict.statistics,
    })  # fmt: skip
    return found
