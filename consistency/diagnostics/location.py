"""Since when, by how much and where a filter is wrong. Nothing here decides: the answers have."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from consistency.diagnostics.bias import hotelling
from consistency.diagnostics.questions import BIAS, SCALE, Answer
from consistency.diagnostics.scale import Band, ratio_interval, run_means
from consistency.diagnostics.whitening import standardise, whiten
from consistency.types import Array

INTERVAL = 0.95  # confidence of the intervals that are reported and not judged


def locate(s: dict[str, Any], nees: Array, dof: int, band: Band, found: Mapping[str, Answer]) -> None:
    """Into the statistics: the band, the steps outside, since when, and the covariance ratio since then."""
    above, below = band.above, band.below
    s |= {
        "simultaneous": np.stack([band.low, band.high], axis=-1),
        "steps_above": int(above.sum()),
        "steps_below": int(below.sum()),
        "first_outside": int(np.argmax(band.outside)) + 1 if band.outside.any() else None,
        "first_step": None,
        "since": None,
        "lasting": False,
        "subset": None,
    }
    if not _found(found, ("scale in some step",)) or not band.outside.any():
        return
    first = int(np.argmax(band.outside))
    s["first_step"] = first + 1
    pointwise = s["anees"] > s["band"][:, 1] if above[first] else s["anees"] < s["band"][:, 0]
    s["lasting"] = bool(pointwise[first:][np.isfinite(s["anees"][first:])].mean() > 0.5)
    if s["lasting"] and first > int(np.argmax(np.isfinite(s["anees"]))):
        s["since"] = first + 1
        means, counts = run_means(nees[:, first:])
        ratio, low, high = ratio_interval(means[counts > 0] / dof, INTERVAL)
        s["ratio"], s["ratio_interval"] = ratio, (low, high)


def locate_axes(
    s: dict[str, Any], nees: Array, error: Array, covariance: Array, whitened: Array, found: Mapping[str, Answer]
) -> None:
    """Into the statistics: ratio and bias of each axis, what is left without the bias, correlations, main axes."""
    late = slice(0 if s["since"] is None else s["since"] - 1, None)
    groups = s["groups"]
    confidence = 1.0 - (1.0 - INTERVAL) / len(groups)
    counted = np.isfinite(nees[:, late])
    standard = standardise(error[:, late], covariance[:, late])
    s["of_axes"] = {}
    for key, index in groups.items():
        w = standard[..., index] if len(index) == 1 else subset(error[:, late], covariance[:, late], index)
        of_runs, count = run_means(np.where(counted, np.square(w).sum(axis=-1), np.nan))
        s["of_axes"][key] = ratio_interval(of_runs[count > 0] / len(index), confidence)
    standard = np.where(counted[..., None], standard, np.nan)
    rows, n = counted.any(axis=1), error.shape[-1]
    if rows.sum() > n:
        test = hotelling(np.nanmean(standard[rows], axis=1))
        s["bias"] = {axis: (test.mean[i], *test.interval[i]) for i, axis in enumerate(s["axes"])}
    if _found(found, SCALE):
        s["subset"] = _main_axes(s)
    if _found(found, BIAS):
        s["ratio_without_bias"] = _without_bias(whitened[:, late])
        k = s.get("bias_step")
        if k:
            at = standardise(error[:, k - 1], covariance[:, k - 1])
            at = at[np.isfinite(nees[:, k - 1])]
            s["bias_axis"] = s["axes"][int(np.argmax(np.abs(at.mean(axis=0)) / at.std(axis=0, ddof=1).clip(1e-300)))]
    if n > 1 and "shape_step" in s:
        in_step = "shape" not in found or not found["shape"].found
        here = slice(s["shape_step"] - 1, s["shape_step"]) if in_step and s["shape_step"] else slice(None)
        s["correlation"] = _correlation(error[:, here], covariance[:, here], np.isfinite(nees[:, here]))


def subset(error: Array, covariance: Array, index: list[int]) -> Array:
    """Whitened errors of a group of components, (runs, steps, len(index))."""
    if len(index) == 1:
        return np.asarray(standardise(error, covariance)[..., index])
    return whiten(error[..., index], covariance[..., index, :][..., index])


def _found(found: Mapping[str, Answer], questions: tuple[str, ...]) -> bool:
    return any(q in found and found[q].found for q in questions)


def _main_axes(s: dict[str, Any]) -> str | None:
    """The axes that carry the fault; None where no axis stands out or all do."""
    wrong = {a: s["of_axes"][a] for a in s["axes"] if not s["of_axes"][a][1] <= 1.0 <= s["of_axes"][a][2]}
    if not wrong:
        return None
    largest = max(abs(np.log(max(ratio, 1e-300))) for ratio, _, _ in wrong.values())
    chief = [a for a, (ratio, _, _) in wrong.items() if abs(np.log(max(ratio, 1e-300))) > 0.5 * largest]
    return None if len(chief) == len(s["axes"]) else ", ".join(chief)


def _without_bias(whitened: Array) -> tuple[float, float, float]:
    """Covariance ratio of the errors less their mean over the runs in each step."""
    present = np.asarray(np.isfinite(whitened).all(axis=-1))
    N = present.sum(axis=0)
    w = np.where(present[..., None], whitened, 0.0)
    centred = w - w.sum(axis=0) / np.maximum(N, 1)[:, None]
    squares = np.square(centred).sum(axis=-1) * (N / np.maximum(N - 1, 1))
    means, counts = run_means(np.where(present & (N > 1), squares, np.nan))
    return ratio_interval(means[counts > 0] / whitened.shape[-1], INTERVAL)


def _correlation(error: Array, covariance: Array, counted: Array) -> tuple[int, int, float, float]:
    """The two axes whose errors are correlated least as stated, with both correlations, averaged over steps."""
    e = np.where(counted[..., None], standardise(error, covariance), np.nan)
    sigma = np.sqrt(np.where(counted[..., None], np.diagonal(covariance, axis1=-2, axis2=-1), np.nan))
    if not counted.any():
        return 0, 1, float("nan"), float("nan")
    stated = np.nanmean(covariance[counted] / (sigma[counted][:, :, None] * sigma[counted][:, None, :]), axis=0)
    flat = e[counted] - np.nanmean(e[counted], axis=0)
    second = flat.T @ flat / max(len(flat), 1)
    scale = np.sqrt(np.diag(second))
    with np.errstate(invalid="ignore", divide="ignore"):
        gap = np.nan_to_num(second / np.outer(scale, scale) - stated)
    np.fill_diagonal(gap, 0.0)
    i, j = sorted(int(k) for k in np.unravel_index(np.abs(gap).argmax(), gap.shape))
    return i, j, float(stated[i, j] + gap[i, j]), float(stated[i, j])
