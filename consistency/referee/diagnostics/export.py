"""A verdict for programs, terminals and notebooks: one flat dictionary, a short text, a short table."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from consistency.referee.diagnostics.wording import p_text, percent, plain, plural, question_text, short
from consistency.referee.geometry.conventions import ADDITIVE, PLANAR

if TYPE_CHECKING:
    from consistency.referee.diagnostics.records import Equivalence, Interval, MapScore, RejectionScore, Verdict, Within


def flat(v: Verdict) -> dict[str, Any]:
    """Every number of a verdict by name; parts that could not be computed are left out."""
    s: dict[str, Any] = {
        "runs": v.runs, "steps": v.steps, "unit": v.unit, "false_alarm": v.settings.false_alarm,
        "confidence": 1.0 - v.settings.false_alarm, "detect": v.settings.detect, "power": v.settings.power,
        "tolerance": v.settings.tolerance, "allow": v.settings.allow,
        "failures": [[f.run, f.step, f.reason] for f in v.failures],
        "answers": [vars(a) for a in v.answers], "p_value": v.p_value, "left_out_steps": list(v.left_out_steps),
    }  # fmt: skip
    of_errors = (_scale, _lost, _location, _axes, _bias, _shape, _tails)
    for part in (*of_errors, _innovations, _accuracy, _map, _joint, _rejection):
        s |= part(v)
    if v.ends is not None:
        s["early_ends"] = vars(v.ends) | {"lost": v.ends.lost}
    if v.skipped is not None:
        s |= {"skip": v.skipped.skip.option, "skipped_steps": v.skipped.steps, "skipped_runs": v.skipped.empty}
    if v.convention is not None or v.notes:
        s |= {"convention": v.convention, "align": v.align, "notes": list(v.notes)}
    if v.world is not None:
        s["world"] = {"status": v.world.status, "reasons": v.world.reasons, "statistics": flat(v.world)}
    return s


def _scale(v: Verdict) -> dict[str, Any]:
    if (s := v.scale) is None:
        return {}
    return {
        "dof": s.dof, "anees": s.anees, "alive": s.alive, "band": s.band, "judged_steps": s.judged_steps,
        "mean_anees": s.mean_anees, "acceptance": s.accepted, "effective_dof": s.effective_dof,
        "ratio": s.inflation.value, "ratio_interval": tuple(s.inflation[1:]), "detectable": s.detectable,
        "median_run": s.median_run, "worst_run": s.worst_run, "share_inside": s.share_inside,
        "equivalence": _equivalence(s.equivalence), "within": _within(s.within),
    }  # fmt: skip


def _lost(v: Verdict) -> dict[str, Any]:
    if (lost := v.lost) is None:
        return {}
    return {
        "lost": {
            "asked": v.settings.lost, "count": lost.count, "runs": lost.runs, "bound": lost.bound, "upper": lost.upper,
            "level": lost.level, "needed": lost.needed,
        }
    }  # fmt: skip


def _within(w: Within | None) -> dict[str, Any] | None:
    if w is None:
        return None
    return {
        "ratio": w.ratio.value, "ratio_interval": tuple(w.ratio[1:]), "correlation_steps": w.correlation,
        "effective_dof": w.effective_dof, "deciding_steps": w.steps, "deciding_pieces": w.pieces,
    }  # fmt: skip


def _equivalence(e: Equivalence | None) -> dict[str, Any] | None:
    return None if e is None else vars(e) | {"shown": e.shown}


def _location(v: Verdict) -> dict[str, Any]:
    if (where := v.location) is None:
        return {}
    return {
        "simultaneous": where.simultaneous, "steps_above": where.above, "steps_below": where.below,
        "first_outside": where.first_outside, "first_step": where.first_step, "since": where.since,
        "lasting": where.lasting, "subset": where.subset,
        "until": None if where.until is None else where.until.step,
    }  # fmt: skip


def _axes(v: Verdict) -> dict[str, Any]:
    if (a := v.axes) is None:
        return {}
    s: dict[str, Any] = {
        "axes": a.names, "groups": {key: list(index) for key, index in a.groups.items()},
        "of_axes": {key: tuple(interval) for key, interval in a.inflation.items()},
        "impossible": [list(pair) for pair in v.impossible],
    }  # fmt: skip
    if (worst := v.worst_axis) is not None:
        s |= {"worst_axis": worst[0], "worst_axis_ratio": tuple(worst[1])}
    if a.largest is not None:
        s |= {"largest": tuple(a.largest), "largest_direction": a.direction}
    return s


def _bias(v: Verdict) -> dict[str, Any]:
    if (b := v.bias) is None:
        return {}
    s: dict[str, Any] = {"bias": {axis: tuple(interval) for axis, interval in b.by_axis.items()}, "bias_step": b.step}
    if b.inflation_without is not None:
        s |= {"ratio_without_bias": tuple(b.inflation_without), "bias_axis": b.axis, "bias_in_step": b.size}
    return s


def _shape(v: Verdict) -> dict[str, Any]:
    if (s := v.shape) is None:
        return {}
    correlation = [*(s.pair or (None, None)), s.actual, s.stated]
    return {
        "shape": s.matrix, "shape_step": s.step, "correlation": correlation, "correlation_wrong_sign": s.wrong_sign,
    }  # fmt: skip


def _tails(v: Verdict) -> dict[str, Any]:
    if (t := v.tails) is None:
        return {}
    return {
        "outlier": {"run": t.run, "step": t.step, "distance": t.distance}, "pit": t.pit,
        "pit_half_width": t.half_width,
    }  # fmt: skip


def _innovations(v: Verdict) -> dict[str, Any]:
    if (i := v.innovations) is None:
        return {}
    return {
        "nis_ratio": i.ratio, "nis_interval": list(i.interval), "nis_dof": i.dof, "nis_judged": i.judged,
        "autocorrelation": i.autocorrelation, "autocorrelation_bound": i.bound,
        "nis_equivalence": _equivalence(i.equivalence),
    }  # fmt: skip


def _accuracy(v: Verdict) -> dict[str, Any]:
    if (a := v.accuracy) is None:
        return {}
    return {
        "coverage": a.coverage, "coverage_one_step": a.coverage_one_step, "coverage_interval": a.coverage_interval,
        "rmse": a.rmse, "rmse_position": a.rmse_position, "rmse_heading": a.rmse_heading, "nci": a.nci,
        "inclination": a.inclination,
    }  # fmt: skip


def _map(v: Verdict) -> dict[str, Any]:
    if (m := v.map) is None:
        return {}
    s: dict[str, Any] = {
        "map_ratio": m.ratio.value, "map_ratio_interval": tuple(m.ratio[1:]), "map_runs": m.runs,
        "map_landmarks": m.landmarks, "map_left_out": m.left_out,
    }  # fmt: skip
    if m.verdict is not None:
        s["map"] = {"status": m.verdict.status, "reasons": m.verdict.reasons, "statistics": flat(m.verdict)}
    return s


def _rejection(v: Verdict) -> dict[str, Any]:
    if (r := v.rejection) is None:
        return {}
    return {
        "rejected": r.rejected, "offered": r.offered, "spurious": r.spurious,
        "rejection_precision": tuple(r.precision), "rejection_recall": tuple(r.recall),
        "rejection_false_alarms": tuple(r.false_alarms),
    }  # fmt: skip


def _joint(v: Verdict) -> dict[str, Any]:
    s: dict[str, Any] = {} if v.landmarks is None else {"landmarks": list(v.landmarks)}
    if (j := v.joint) is None:
        return s
    return s | {
        "joint_ratio": j.both.value, "joint_ratio_interval": tuple(j.both[1:]), "joint_pose": tuple(j.pose),
        "joint_map": tuple(j.map), "joint_runs": j.runs, "joint_dof": j.dof,
        "joint_chief": list(j.chief), "joint_not_definite": list(j.not_definite),
    }  # fmt: skip


# --- for people --------------------------------------------------------------------------------------


def figures(v: Verdict) -> list[tuple[str, str]]:
    """The numbers that matter, with their names."""
    size = f" of {plural(v.steps, v.places[:-1])}" if v.unit == "run" else ""
    rows = [("evidence", f"{plural(v.runs, v.unit)}{size}")]
    if v.scale is not None and v.scale.judged_steps:
        s, shown = v.scale, v.scale.equivalence
        low, high = s.accepted
        rows.append(("mean NEES", f"{short(s.mean_anees)} ({s.dof} expected, {short(low)} to {short(high)} accepted)"))
        value, low, high = s.inflation
        rows.append(("covariance ratio", f"{short(value)} [{short(low)}, {short(high)}], truth over stated"))
        if (worst := v.worst_axis) is not None:
            rows.append(("worst axis", f"{worst[0]}, {plain(worst[1])}"))
        if s.within is not None:
            rows.append(("within the log", f"{plain(s.within.ratio)}, if errors decorrelate as within it"))
        ends = f"[{short(1 / shown.factor)}, {short(shown.factor)}]"
        rows.append(("shown inside", f"{ends}: {'yes' if shown.shown else 'no'} (p {p_text(shown.p_value)})"))
        if v.lost is not None:
            rows.append((f"lost {v.unit}s", f"{v.lost.count} of {v.lost.runs}, at most {percent(v.lost.upper)} of all"))
    if v.accuracy is not None and v.axes is not None:
        inside = (f"{axis} {100 * c:.1f} %" for axis, c in zip(v.axes.names, v.accuracy.coverage, strict=True))
        rows.append(("2-sigma coverage", ", ".join(inside)))
    if v.innovations is not None and np.isfinite(v.innovations.ratio):
        judged = "" if v.innovations.judged else ", not judged"
        rows.append(("NIS / dof", f"{v.innovations.ratio:.3f}{judged}"))
    if v.joint is not None and v.joint.runs:
        value, low, high = v.joint.both
        rows.append(("pose and map", f"NEES / dof {short(value)} [{short(low)}, {short(high)}]"))
    if v.world is not None:
        rows.insert(0, ("error", f"{v.convention}: {PLANAR[v.convention or ADDITIVE]}"))
        rows.append(("in the world", _in_world(v.world)))
    if v.map is not None:
        rows.append(("map NEES / 3", f"{map_text(v.map)}, after the last step{_map_status(v.map)}"))
    if v.rejection is not None:
        rows.append(("rejected", rejection_text(v.rejection)))
    rows.append((f"failed {v.unit}s", f"{len({f.run for f in v.failures})} of {v.runs}"))
    faults = [
        f"{question_text(v, a.question)} (p {p_text(a.adjusted)})" for a in v.answers if a.found and not a.tolerated
    ]
    rows.append(("faults", f"{', '.join(faults) or 'none'} of {plural(len(v.answers), 'question')}"))
    return rows


def _in_world(v: Verdict) -> str:
    mean = f", mean NEES {short(v.scale.mean_anees)}" if v.scale is not None and v.scale.judged_steps else ""
    return f"{v.status}{mean} (additive error, '{ADDITIVE}')"


def _map_status(m: MapScore) -> str:
    return "; not judged" if m.verdict is None else f"; the map is {m.verdict.reasons[0]}"


def map_text(m: MapScore) -> str:
    """Mean NEES over 3 of the landmarks in maps, with its interval."""
    left_out = f" ({m.left_out} of {m.left_out + m.landmarks} landmarks left out)" if m.left_out else ""
    if not m.landmarks:
        return f"-{left_out}"
    value, low, high = m.ratio
    return f"{short(value)} [{short(low)}, {short(high)}]{left_out}"


def rejection_text(r: RejectionScore) -> str:
    """What a guard rejected, and where spurious observations are known precision and recall."""
    rejected = f"{r.rejected} of {r.offered} observations"
    if not r.spurious:
        return f"{rejected} ({_percent(r.false_alarms)})"
    return (
        f"{rejected}, {r.spurious} of them spurious: precision {_percent(r.precision)}, recall {_percent(r.recall)}, "
        f"right ones rejected {_percent(r.false_alarms)}"
    )


def _percent(share: Interval) -> str:
    value, low, high = (f"{100 * end:.3g}" for end in share)
    return f"{value if value != 'nan' else '-'} [{low}, {high}] %"


def text(v: Verdict) -> str:
    """The sentence and a short table."""
    rows = figures(v)
    width = max(len(name) for name, _ in rows)
    return "\n".join([f"{v.filter} is {v.reasons[0]}", *(f"  {name:<{width}}  {value}" for name, value in rows)])


def html(v: Verdict) -> str:
    """Summary of a verdict as an HTML table, for a notebook."""
    return f"<div><p><strong>{escape(v.filter)}</strong> is {escape(v.reasons[0])}</p>{html_table(figures(v))}</div>"


def html_table(rows: Sequence[tuple[str, str]]) -> str:
    """Names and values as an HTML table, for a notebook."""
    cells = "".join(
        f'<tr><th style="text-align:left">{escape(name)}</th><td style="text-align:left">{escape(value)}</td></tr>'
        for name, value in rows
    )
    return f"<table>{cells}</table>"
