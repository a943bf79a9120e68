"""What a verdict says in words: a sentence to act on, then what stands behind it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from consistency.diagnostics.coverage import TWO_SIGMA
from consistency.diagnostics.questions import BIAS, MAIN, SCALE, SHAPE

SPREAD = 20.0  # worst over median run above which a mean says little: that run is named beside it
NOTABLE = 0.3  # difference of correlations that stands out in one step
UNCERTAIN = 100.0  # upper over lower end of an interval that says nothing


def reasons(status: str, s: Mapping[str, Any]) -> list[str]:
    """First the sentence, then the figures; from the statistics of a verdict."""
    found = {a["question"]: a for a in s["answers"] if a["found"]}
    lines = []
    if s["failures"]:
        (run, step, why), count = s["failures"][0], len({f[0] for f in s["failures"]})
        lines.append(f"{count} of {s['runs']} runs failed, first run {run} in step {step}: {why}")
    if s.get("impossible"):
        row, step = s["impossible"][0]
        count = len({r for r, _ in s["impossible"]})
        lines.append(
            f"{count} of {s['runs']} runs have an infinite error or a covariance with a negative variance, first run "
            f"{row} in step {step}; those steps are left out"
        )
    if not s["answers"] or s.get("judged_steps") == 0:
        if "anees" in s:
            lines.append("no step has a covariance of full rank to judge")
        else:
            lines.append("neither truth nor innovations to judge")
    elif "anees" in s:
        lines.insert(0 if found else len(lines), _sentence(s, found))
        lines.append(_level(s))
        lines += _coverage(s)
    else:
        lines.insert(0 if found else len(lines), _without_truth(s, found))
    if "nis_ratio" in s:
        lines.append(_nis(s))
    if s["answers"]:
        lines.append(_asked(s, found))
    since = f" since step {s['since']}" if found and s.get("since") is not None else ""
    return [f"{status}{since}: {lines[0]}", *lines[1:]]


def short(value: float) -> str:
    """Three digits, as a person says them."""
    return (
        f"{value:.1e}"
        if value >= 1e4
        else f"{value:.0f}"
        if value >= 100
        else f"{value:.1f}"
        if value >= 10
        else f"{value:.2f}"
    )


def factor(ratio: float, low: float, high: float) -> str:
    """x1.6 [1.4, 1.9]; of a covariance too large, the inverse."""
    if ratio < 1.0:
        ratio, low, high = (1.0 / max(value, 1e-300) for value in (ratio, high, low))
    return f"x{short(ratio)} [{short(low)}, {short(high)}]"


def p_text(p: float) -> str:
    """A p value without digits that nobody needs."""
    return f"{p:.2g}" if p >= 1e-6 else "below 1e-6"


def _sentence(s: Mapping[str, Any], found: Mapping[str, Any]) -> str:
    if not found:
        return f"no fault found; {_runs(s)} would show a covariance too small by x{s['detectable']:.2g} with power 0.95"
    parts = []
    if any(q in found for q in BIAS):
        parts.append(_bias(s, "bias" not in found))
    if any(q in found for q in SCALE):
        parts.append(_scale(s, found))
    if any(q in found for q in SHAPE):
        parts.append(_shape(s, found))
    if "outliers" in found:
        o = s["outlier"]
        text = f"heavy tails: run {o['run']} lies {short(o['distance'])} sigma from the other runs in step {o['step']}"
        low, high = s["ratio_interval"]
        parts.insert(0 if low <= 1.0 <= high or not high < UNCERTAIN * low else len(parts), text)
    if "distribution" in found and len(found) == 1:
        parts.append("the NEES does not follow the chi-square distribution")
    if "innovation scale" in found:
        parts.append(f"innovations {'larger' if s['nis_ratio'] > 1 else 'smaller'} than stated")
    if "innovation whiteness" in found:
        parts.append("innovations correlated over steps")
    asked = {a["question"] for a in s["answers"]}
    if any(q in found for q in SCALE) and asked & set(BIAS) and not set(found) & set(BIAS):
        parts.append("no bias found")
    return "; ".join(parts)


def _scale(s: Mapping[str, Any], found: Mapping[str, Any]) -> str:
    ratio, (low, high) = s["ratio"], s["ratio_interval"]
    if MAIN not in found and "scale in some step" not in found:  # one axis alone
        sure = {a: i for a, i in s["of_axes"].items() if not i[1] <= 1.0 <= i[2]}
        sure = {a: i for a, i in sure.items() if a in s["axes"]} or sure
        wrong = [f"{a} {_side(i[0])} by {factor(*i)}" for a, i in sure.items()]
        return f"covariance of {', '.join(wrong) if wrong else 'an axis'}" + ("" if wrong else " wrong")
    if not s["lasting"] and MAIN not in found:
        count = s["steps_above"] + s["steps_below"]
        side = "too small" if s["steps_above"] else "too large"
        return f"covariance {side} in {count} of {s['judged_steps']} steps, first in step {s['first_step']}"
    text = f"covariance {_side(ratio)} by {factor(ratio, low, high)}"
    if not high < UNCERTAIN * low:
        size = short(max(ratio, 1.0 / max(ratio, 1e-300)))
        text = f"covariance {_side(ratio)} by x{size} in the mean, which a few runs make"
    elif low <= 1.0 <= high:
        text += ", an interval that holds 1: the runs differ more than Gaussian errors would"
    if s.get("subset"):
        text += f", mainly {s['subset']}"
    return text


def _side(ratio: float) -> str:
    return "too small" if ratio > 1.0 else "too large"


def _bias(s: Mapping[str, Any], in_steps: bool) -> str:
    if in_steps:
        return f"biased in step {s['bias_step']}, mainly {s['bias_axis']}"
    sure = [f"{a} {m:+.2f} sigma [{lo:+.2f}, {hi:+.2f}]" for a, (m, lo, hi) in s["bias"].items() if not lo <= 0 <= hi]
    ratio, low, high = s["ratio_without_bias"]
    rest = f"; without the bias the covariance ratio is {short(ratio)} [{short(low)}, {short(high)}]"
    return f"biased: {', '.join(sure) if sure else 'in a combination of axes'}{rest}"


def _shape(s: Mapping[str, Any], found: Mapping[str, Any]) -> str:
    where = "" if "shape" in found else f" in step {s['shape_step']}"
    text = f"covariance of the wrong shape{where}"
    i, j, actual, stated = s["correlation"]
    if "shape" in found or abs(actual - stated) > NOTABLE:
        a, b = s["axes"][i], s["axes"][j]
        return f"{text}: {a} and {b} are correlated {actual:+.2f}, stated {stated:+.2f}"
    return f"{text}: axes are wrong by different factors"


def _level(s: Mapping[str, Any]) -> str:
    low, high = s["acceptance"]
    text = f"mean NEES {short(s['mean_anees'])}, accepted {short(low)} to {short(high)} ({s['dof']} expected)"
    if s["worst_run"] > SPREAD * s["median_run"]:
        text += f"; {short(s['median_run'])} in the median and {short(s['worst_run'])} in the worst run"
    if s["judged_steps"] > 1:
        where = [f"{s[f'steps_{side}']} {side}" for side in ("above", "below") if s[f"steps_{side}"]]
        text += f"; steps outside the simultaneous band: {' and '.join(where) if where else 'none'}"
        text += f" of {s['judged_steps']}"
    return text


def _coverage(s: Mapping[str, Any]) -> list[str]:
    if "axes" not in s:
        return []
    known = [(axis, c) for axis, c in zip(s["axes"], s["coverage"], strict=True) if np.isfinite(c)]
    if not known:
        return []
    covered = ", ".join(f"{axis} {100 * c:.1f} %" for axis, c in known)
    text = f"2-sigma coverage {covered} ({100 * TWO_SIGMA:.1f} % expected)"
    if np.isfinite(s["nci"]):
        text += f"; noncredibility index {s['nci']:.1f} dB, inclination {s['inclination']:+.1f} dB"
    return [text]


def _without_truth(s: Mapping[str, Any], found: Mapping[str, Any]) -> str:
    parts = ["no truth: judged by the innovations alone, which cannot see most pose errors"]
    if "innovation scale" in found:
        parts.append(f"they are {'larger' if s['nis_ratio'] > 1 else 'smaller'} than stated")
    if "innovation whiteness" in found:
        parts.append("they are correlated over steps")
    return "; ".join(parts)


def _nis(s: Mapping[str, Any]) -> str:
    (low, high), ratio = s["nis_interval"], s["nis_ratio"]
    if not np.isfinite(ratio):
        return "no NIS: the filter reports no innovations"
    text = f"NIS per degree of freedom {ratio:.3f} ({low:.3f} to {high:.3f} expected)"
    r = np.asarray(s.get("autocorrelation", []))
    if len(r):
        text += f", autocorrelation {r[0]:+.3f} at lag 1 (within {s['autocorrelation_bound']:.3f} expected)"
    return text


def _asked(s: Mapping[str, Any], found: Mapping[str, Any]) -> str:
    asked = [a["question"] for a in s["answers"]]
    text = f"{len(asked)} questions at a false-alarm rate of {s['false_alarm']:.3g} together"
    if len(asked) == 1:
        text = f"1 question at a false-alarm rate of {s['false_alarm']:.3g}"
    if not found:
        least = min(s["answers"], key=lambda a: a["adjusted"])
        return f"{text}; nearest to a fault: {least['question']} (corrected p {p_text(least['adjusted'])})"
    return f"{text}; found: " + ", ".join(f"{q} (p {p_text(a['adjusted'])})" for q, a in found.items())


def _runs(s: Mapping[str, Any]) -> str:
    return f"{s['runs']} run{'s' * (s['runs'] != 1)}"
