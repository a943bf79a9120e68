"""The parts of a verdict for programs: flat dictionaries of every number, and what JSON can hold."""

from __future__ import annotations

from typing import Any

import numpy as np

from consistency.referee.diagnostics.records.skipped_start import Skipped
from consistency.referee.diagnostics.verdict.parts import (
    Bias,
    ByGroup,
    EarlyEnds,
    Equivalence,
    Innovations,
    JointScore,
    Location,
    Lost,
    RejectionScore,
    Scale,
    Shape,
    Tails,
    TruthShare,
    Within,
)

Numbers = dict[str, Any]


def scale_numbers(scale: Scale) -> Numbers:
    return {
        "dof": scale.dof,
        "anees": scale.anees,
        "alive": scale.alive,
        "band": scale.band,
        "judged_steps": scale.judged_steps,
        "mean_anees": scale.mean_anees,
        "acceptance": scale.accepted,
        "effective_dof": scale.effective_dof,
        "ratio": scale.inflation.value,
        "ratio_interval": tuple(scale.inflation[1:]),
        "detectable": scale.detectable,
        "median_run": scale.median_run,
        "worst_run": scale.worst_run,
        "share_inside": scale.share_inside,
        "equivalence": equivalence_numbers(scale.equivalence),
        "within": _of_within(scale.within),
    }


def _of_within(within: Within | None) -> Numbers | None:
    if within is None:
        return None
    return {
        "ratio": within.ratio.value,
        "ratio_interval": tuple(within.ratio[1:]),
        "correlation_steps": within.correlation,
        "effective_dof": within.effective_dof,
        "deciding_steps": within.steps,
        "deciding_pieces": within.pieces,
    }


def equivalence_numbers(equivalence: Equivalence | None) -> Numbers | None:
    if equivalence is None:
        return None
    return vars(equivalence) | {"shown": equivalence.shown}


def lost_numbers(asked: float | None, lost: Lost) -> Numbers:
    return {"lost": {"asked": asked} | vars(lost)}


def location_numbers(location: Location) -> Numbers:
    until = None
    if location.until is not None:
        until = location.until.step
    return vars(location) | {"until": until}


def bias_numbers(bias: Bias) -> Numbers:
    by_axis = {axis: tuple(interval) for axis, interval in bias.by_axis.items()}
    numbers: Numbers = {"bias": by_axis, "bias_step": bias.step}
    if bias.inflation_without is not None:
        numbers["ratio_without_bias"] = tuple(bias.inflation_without)
        numbers["bias_axis"] = bias.axis
        numbers["bias_in_step"] = bias.size
    return numbers


def shape_numbers(shape: Shape) -> Numbers:
    a, b = shape.pair or (None, None)
    return {
        "shape": shape.matrix,
        "shape_step": shape.step,
        "correlation": [a, b, shape.actual, shape.stated],
        "correlation_wrong_sign": shape.wrong_sign,
    }


def tails_numbers(tails: Tails) -> Numbers:
    outlier = {"run": tails.run, "step": tails.step, "distance": tails.distance}
    return {"outlier": outlier, "pit": tails.pit, "pit_half_width": tails.half_width}


def innovations_numbers(innovations: Innovations) -> Numbers:
    numbers = {
        "nis_ratio": innovations.ratio,
        "nis_interval": list(innovations.interval),
        "nis_dof": innovations.dof,
        "nis_judged": innovations.judged,
        "autocorrelation": innovations.autocorrelation,
        "autocorrelation_bound": innovations.bound,
        "nis_equivalence": equivalence_numbers(innovations.equivalence),
    }
    if innovations.outliers is not None:
        numbers["nis_outliers"] = vars(innovations.outliers) | {"rest": innovations.outliers.rest.ratio}
    return numbers


def joint_numbers(joint: JointScore) -> Numbers:
    return {
        "joint_ratio": joint.both.value,
        "joint_ratio_interval": tuple(joint.both[1:]),
        "joint_pose": tuple(joint.pose),
        "joint_map": tuple(joint.map),
        "joint_runs": joint.runs,
        "joint_dof": joint.dof,
        "joint_chief": list(joint.chief),
        "joint_not_definite": list(joint.not_definite),
    }


def rejection_numbers(rejection: RejectionScore) -> Numbers:
    return {
        "rejected": rejection.rejected,
        "offered": rejection.offered,
        "spurious": rejection.spurious,
        "rejection_precision": tuple(rejection.precision),
        "rejection_recall": tuple(rejection.recall),
        "rejection_false_alarms": tuple(rejection.false_alarms),
    }


def ends_numbers(ends: EarlyEnds) -> Numbers:
    return {"early_ends": vars(ends) | {"lost": ends.lost}}


def skipped_numbers(skipped: Skipped) -> Numbers:
    return {"skip": skipped.skip.option, "skipped_steps": skipped.steps, "skipped_runs": skipped.empty}


def truth_numbers(truth: TruthShare) -> Numbers:
    return {
        "truth_share": truth.share,
        "truth_share_of_axes": dict(truth.by_axis),
        "truth_errors": truth.errors,
        "truth_shared": truth.shared,
    }


def group_numbers(by: ByGroup) -> Numbers:
    groups = [
        {
            "name": group.name,
            "status": group.status,
            "runs": group.runs,
            "steps": group.steps,
            "ratio": group.ratio.value,
            "ratio_interval": tuple(group.ratio[1:]),
            "p_value": group.p_value,
            "equivalence": equivalence_numbers(group.equivalence),
        }
        for group in by.groups
    ]
    return {"by": {"column": by.column, "groups": groups, "outcome": by.outcome, "without": by.without}}


def plain(value: Any) -> Any:
    """Verdicts as dictionaries, arrays as lists, not finite numbers as None: what JSON can hold."""
    if hasattr(value, "as_dictionary"):
        return plain(value.as_dictionary())
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
