"""A verdict for programs: one flat dictionary, and what JSON can hold."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from consistency.referee.diagnostics.verdict.parts import Equivalence, Verdict, Within


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
    if v.guesses:
        s["guesses"] = {kind: guess._asdict() for kind, guess in v.guesses.items()}
    if v.truth is not None:
        s |= {
            "truth_share": v.truth.share, "truth_share_of_axes": dict(v.truth.by_axis), "truth_errors": v.truth.errors,
            "truth_shared": v.truth.shared,
        }  # fmt: skip
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
    if v.axis is not None:
        s |= {"axis": v.axis[0], "axis_ratio": tuple(v.axis[1])}
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


def plain(value: Any) -> Any:
    """Arrays as lists, not finite numbers as None: what JSON can hold."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    return None if isinstance(value, float) and not np.isfinite(value) else value
