"""The verdict on one filter, from its errors over independent runs."""

from __future__ import annotations

from typing import Any

import numpy as np

from consistency.diagnostics.coverage import TWO_SIGMA, coverage, rmse
from consistency.diagnostics.intervals import anees_interval, chi2_mean_interval, detectable_ratio
from consistency.diagnostics.nees import anees
from consistency.types import Array, Failure, Verdict

SPREAD = 20.0  # worst over median run above which a mean says little: that run is named beside it


def judge(
    filter_name: str,
    error: Array | None,
    covariance: Array,
    nees: Array | None,
    nis: Array,
    nis_dof: Array,
    failures: tuple[Failure, ...] = (),
    confidence: float = 0.95,
) -> Verdict:
    """Consistent, overconfident, conservative or failed, with reasons and statistics.

    The verdict compares the ANEES curve with a band that holds in all judged steps at once
    (Bonferroni): N ANEES(k) is chi-square with N n degrees of freedom in every step, so a consistent
    linear-Gaussian filter leaves that band anywhere with probability at most 1 - confidence, however
    its steps depend on each other. The pointwise interval (eq. 17) is reported beside it. A filter
    with failed runs is never consistent. Without truth the NIS is judged instead.

    Parameters
    ----------
    error, covariance : (runs, steps, n), (runs, steps, n, n), NaN where a run has no estimate
    nees : (runs, steps), NaN where the covariance is rank-deficient or the run has failed
    nis, nis_dof : (runs, steps)
    """
    runs, steps = nis.shape
    statistics: dict[str, Any] = {"runs": runs, "steps": steps, "confidence": confidence}
    statistics |= _nis(nis, nis_dof, confidence)
    statistics["failures"] = [[f.run, f.step, f.reason] for f in failures]
    if error is None or nees is None:
        status, reasons = _judge_nis(statistics)
    else:
        statistics |= _nees(error, covariance, nees, confidence)
        status, reasons = _judge_nees(statistics)
    if failures:
        first = failures[0]
        reasons.append(
            f"{len(failures)} of {runs} runs failed, first run {first.run} in step {first.step}: {first.reason}"
        )
        status = "failed" if status == "consistent" or statistics.get("judged_steps") == 0 else status
    return Verdict(filter_name, status, tuple(reasons), statistics)


def _nees(error: Array, covariance: Array, nees: Array, confidence: float) -> dict[str, Any]:
    n = error.shape[-1]
    curve, counted = anees(nees), np.isfinite(nees)
    alive = counted.sum(axis=0)
    judged = alive > 0
    deficient = (np.isfinite(error).all(axis=-1) & ~counted).any(axis=0)  # left out of every statistic
    error = np.where(counted[..., None], error, np.nan)
    tail = 1.0 - (1.0 - confidence) / max(int(judged.sum()), 1)
    bands = {
        int(m): (anees_interval(n, int(m), confidence), anees_interval(n, int(m), tail)) for m in set(alive[judged])
    }
    band = np.full((len(curve), 2), np.nan)
    simultaneous = np.full((len(curve), 2), np.nan)
    for k in np.flatnonzero(judged):
        band[k], simultaneous[k] = bands[int(alive[k])]
    inside = (curve >= band[:, 0]) & (curve <= band[:, 1])
    above, below = curve > simultaneous[:, 1], curve < simultaneous[:, 0]
    outside = np.flatnonzero(above | below)
    covered = coverage(error, covariance)
    of_runs = np.nanmean(nees[counted.any(axis=1)], axis=1)
    return {
        "dof": n,
        "anees": curve,
        "alive": alive,
        "band": band,
        "simultaneous": simultaneous,
        "judged_steps": int(judged.sum()),
        "left_out_steps": [int(k) + 1 for k in np.flatnonzero(deficient)],
        "mean_anees": float(np.nanmean(curve)) if judged.any() else float("nan"),
        "detectable": detectable_ratio(n, int(alive.max()), tail) if judged.any() else float("nan"),
        "median_run": float(np.median(of_runs)) if len(of_runs) else float("nan"),
        "worst_run": float(of_runs.max()) if len(of_runs) else float("nan"),
        "share_inside": float(inside[judged].mean()) if judged.any() else float("nan"),
        "steps_above": int(above.sum()),
        "steps_below": int(below.sum()),
        "first_outside": int(outside[0]) + 1 if len(outside) else None,
        "coverage": [float(c) for c in covered],
        "rmse_position": rmse(error[..., :2]),
        "rmse_heading": rmse(error[..., 2:]),
    }


def _nis(nis: Array, dof: Array, confidence: float) -> dict[str, Any]:
    total = int(np.where(np.isfinite(nis), dof, 0).sum())
    if total == 0:
        return {"nis_ratio": float("nan"), "nis_interval": [float("nan")] * 2, "nis_dof": 0}
    low, high = chi2_mean_interval(total, confidence)
    return {"nis_ratio": float(np.nansum(nis) / total), "nis_interval": [low, high], "nis_dof": total}


def _judge_nees(s: dict[str, Any]) -> tuple[str, list[str]]:
    if s["judged_steps"] == 0:
        return "failed", ["no step has a pose covariance of full rank to judge"]
    percent = f"{100 * s['confidence']:g} %"
    mean = s["mean_anees"]
    text = f"ANEES {_short(mean)} on average ({s['dof']} expected)"
    if s["worst_run"] > SPREAD * s["median_run"]:
        text += f", {_short(s['median_run'])} in the median and {_short(s['worst_run'])} in the worst run"
    low, high = s["simultaneous"][s["alive"] > 0][0]
    band = f"the band [{low:.2f}, {high:.2f}] that holds in all steps at once with {percent}"
    if s["first_outside"] is None:
        status, text = "consistent", f"{text}; never outside {band}"
        text += f" ({s['alive'].max()} runs find a covariance too small by x{s['detectable']:.2g} with power 0.95)"
    else:
        status = "overconfident" if s["steps_above"] else "conservative"
        where = []
        if s["steps_above"]:
            where.append(f"above it in {s['steps_above']}")
        if s["steps_below"]:
            where.append(f"below it in {s['steps_below']}")
        count = f"{' and '.join(where)} of {s['judged_steps']} steps, first in step {s['first_outside']}"
        text = f"{text}; {band}: {count}"
    axes = ("x", "y", "heading")
    covered = ", ".join(f"{axis} {100 * c:.1f} %" for axis, c in zip(axes, s["coverage"], strict=False))
    return status, [text, f"2-sigma coverage {covered} ({100 * TWO_SIGMA:.1f} % expected)", _nis_sentence(s)]


def _judge_nis(s: dict[str, Any]) -> tuple[str, list[str]]:
    low, high = s["nis_interval"]
    status = "consistent"
    if not np.isfinite(s["nis_ratio"]):
        return "failed", ["neither truth nor innovations to judge"]
    if s["nis_ratio"] > high:
        status = "overconfident"
    elif s["nis_ratio"] < low:
        status = "conservative"
    return status, ["no truth: judged by the NIS alone, which cannot see most pose errors", _nis_sentence(s)]


def _short(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.2f}"


def _nis_sentence(s: dict[str, Any]) -> str:
    (low, high), ratio = s["nis_interval"], s["nis_ratio"]
    if not np.isfinite(ratio):
        return "no NIS: the filter reports no innovations"
    note = "" if low <= ratio <= high else "; outside, which the verdict on the pose does not count"
    return f"NIS per degree of freedom {ratio:.3f} ({low:.3f} to {high:.3f} expected{note if 'anees' in s else ''})"
