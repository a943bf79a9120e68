"""A verdict for programs: one flat dictionary, and what JSON can hold."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from consistency.referee.diagnostics.verdict.parts import Equivalence
    from consistency.referee.diagnostics.verdict.verdict import Verdict


def flat(v: Verdict) -> dict[str, Any]:
    """Every number of a verdict by name; parts that could not be computed are left out."""
    s: dict[str, Any] = {
        "runs": v.runs, "steps": v.steps, "unit": v.unit, "false_alarm": v.settings.false_alarm,
        "confidence": 1.0 - v.settings.false_alarm, "detect": v.settings.detect, "power": v.settings.power,
        "tolerance": v.settings.tolerance, "allow": v.settings.allow,
        "failures": [[f.run, f.step, f.reason] for f in v.failures],
        "answers": [vars(a) for a in v.answers], "p_value": v.p_value, "left_out_steps": list(v.left_out_steps),
    }  # fmt: skip
    s |= _of_errors(v)
    if (i := v.innovations) is not None:
        s |= {
            "nis_ratio": i.ratio, "nis_interval": list(i.interval), "nis_dof": i.dof, "nis_judged": i.judged,
            "autocorrelation": i.autocorrelation, "autocorrelation_bound": i.bound,
            "nis_equivalence": _equivalence(i.equivalence),
        }  # fmt: skip
        if i.outliers is not None:
            s["nis_outliers"] = vars(i.outliers) | {"rest": i.outliers.rest.ratio}
    if (a := v.accuracy) is not None:
        s |= {
            "coverage": a.coverage, "coverage_one_step": a.coverage_one_step,
            "coverage_interval": a.coverage_interval, "rmse": a.rmse, "rmse_position": a.rmse_position,
            "rmse_heading": a.rmse_heading, "nci": a.nci, "inclination": a.inclination,
        }  # fmt: skip
    if (m := v.map) is not None:
        s |= {
            "map_ratio": m.ratio.value, "map_ratio_interval": tuple(m.ratio[1:]), "map_runs": m.runs,
            "map_landmarks": m.landmarks, "map_left_out": m.left_out,
        }  # fmt: skip
        if m.verdict is not None:
            s["map"] = whole(m.verdict)
    if v.landmarks is not None:
        s["landmarks"] = list(v.landmarks)
    if (j := v.joint) is not None:
        s |= {
            "joint_ratio": j.both.value, "joint_ratio_interval": tuple(j.both[1:]), "joint_pose": tuple(j.pose),
            "joint_map": tuple(j.map), "joint_runs": j.runs, "joint_dof": j.dof,
            "joint_chief": list(j.chief), "joint_not_definite": list(j.not_definite),
        }  # fmt: skip
    if (r := v.rejection) is not None:
        s |= {
            "rejected": r.rejected, "offered": r.offered, "spurious": r.spurious,
            "rejection_precision": tuple(r.precision), "rejection_recall": tuple(r.recall),
            "rejection_false_alarms": tuple(r.false_alarms),
        }  # fmt: skip
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
        s["world"] = whole(v.world)
    return s


def _of_errors(v: Verdict) -> dict[str, Any]:
    """Size and place of the errors, and their components."""
    s: dict[str, Any] = {}
    if (scale := v.scale) is not None:
        s |= {
            "dof": scale.dof, "anees": scale.anees, "alive": scale.alive, "band": scale.band,
            "judged_steps": scale.judged_steps, "mean_anees": scale.mean_anees, "acceptance": scale.accepted,
            "effective_dof": scale.effective_dof, "ratio": scale.inflation.value,
            "ratio_interval": tuple(scale.inflation[1:]), "detectable": scale.detectable,
            "median_run": scale.median_run, "worst_run": scale.worst_run, "share_inside": scale.share_inside,
            "equivalence": _equivalence(scale.equivalence), "within": (w := scale.within) and {
                "ratio": w.ratio.value, "ratio_interval": tuple(w.ratio[1:]), "correlation_steps": w.correlation,
                "effective_dof": w.effective_dof, "deciding_steps": w.steps, "deciding_pieces": w.pieces,
            },
        }  # fmt: skip
    if (lost := v.lost) is not None:
        s["lost"] = {
            "asked": v.settings.lost, "count": lost.count, "runs": lost.runs, "bound": lost.bound, "upper": lost.upper,
            "level": lost.level, "needed": lost.needed,
        }  # fmt: skip
    if (where := v.location) is not None:
        s |= {
            "simultaneous": where.simultaneous, "steps_above": where.above, "steps_below": where.below,
            "first_outside": where.first_outside, "first_step": where.first_step, "since": where.since,
            "lasting": where.lasting, "subset": where.subset,
            "until": None if where.until is None else where.until.step,
        }  # fmt: skip
    if (axes := v.axes) is not None:
        s |= {
            "axes": axes.names, "groups": {key: list(index) for key, index in axes.groups.items()},
            "of_axes": {key: tuple(interval) for key, interval in axes.inflation.items()},
            "impossible": [list(pair) for pair in v.impossible],
        }  # fmt: skip
        for key, axis in (("worst_axis", v.worst_axis), ("axis", v.axis)):
            if axis is not None:
                s |= {key: axis[0], f"{key}_ratio": tuple(axis[1])}
        if axes.largest is not None:
            s |= {"largest": tuple(axes.largest), "largest_direction": axes.direction}
    if (b := v.bias) is not None:
        s |= {"bias": {axis: tuple(interval) for axis, interval in b.by_axis.items()}, "bias_step": b.step}
        if b.inflation_without is not None:
            s |= {"ratio_without_bias": tuple(b.inflation_without), "bias_axis": b.axis, "bias_in_step": b.size}
    if (shape := v.shape) is not None:
        s |= {
            "shape": shape.matrix, "shape_step": shape.step,
            "correlation": [*(shape.pair or (None, None)), shape.actual, shape.stated],
            "correlation_wrong_sign": shape.wrong_sign,
        }  # fmt: skip
    if (t := v.tails) is not None:
        s |= {
            "outlier": {"run": t.run, "step": t.step, "distance": t.distance}, "pit": t.pit,
            "pit_half_width": t.half_width,
        }  # fmt: skip
    return s


def whole(v: Verdict) -> dict[str, Any]:
    """Status, reasons and statistics."""
    return {"status": v.status, "reasons": v.reasons, "statistics": flat(v)}


def _equivalence(e: Equivalence | None) -> dict[str, Any] | None:
    return None if e is None else vars(e) | {"shown": e.shown}


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
