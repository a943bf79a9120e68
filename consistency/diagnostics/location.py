"""Since when, by how much and where a filter is wrong. Nothing here decides: the answers have."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from consistency.diagnostics.bias import hotelling, moments
from consistency.diagnostics.blocks import blocks, by_runs
from consistency.diagnostics.questions import BIAS, SCALE, Answer
from consistency.diagnostics.scale import Band, ratio_interval, run_means
from consistency.diagnostics.whitening import mean_of_runs, squared_length, standardise, whiten
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
    s["of_axes"] = {}
    for key, index in groups.items():
        of_runs = _run_means_of(error[:, late], covariance[:, late], counted, index)
        s["of_axes"][key] = ratio_interval(of_runs[~np.isnan(of_runs)] / len(index), confidence)
    standard = standardise(error[:, late], covariance[:, late])
    standard[~counted] = np.nan
    rows, n = counted.any(axis=1), error.shape[-1]
    if rows.sum() > n:
        test = hotelling(mean_of_runs(standard)[rows])
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

    def of_block(e: Array, P: Array) -> Array:
        e, P = e[..., index], P[..., index, :][..., index]
        return standardise(e, P) if len(index) == 1 else whiten(e, P)

    return by_runs(of_block, error, covariance)


def _run_means_of(error: Array, covariance: Array, counted: Array, index: list[int]) -> Array:
    """Mean NEES of each run by a group of components alone, (runs,); NaN where it has none."""

    def of_block(e: Array, P: Array, counted: Array) -> Array:
        return run_means(np.where(counted, squared_length(subset(e, P, index)), np.nan))[0]

    return by_runs(of_block, error, covariance, counted)


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
    N, mean, _ = moments(whitened)

    def squares(w: Array) -> Array:
        return np.where(N > 1, np.square(w - mean).sum(axis=-1) * (N / np.maximum(N - 1, 1)), np.nan)

    means, counts = run_means(by_runs(squares, whitened))
    return ratio_interval(means[counts > 0] / whitened.shape[-1], INTERVAL)


def _correlation(error: Array, covariance: Array, counted: Array) -> tuple[int, int, float, float]:
    """The two axes whose errors are correlated least as stated, with both correlations, averaged over steps."""
    if not counted.any():
        return 0, 1, float("nan"), float("nan")
    n, count = error.shape[-1], int(counted.sum())
    parts = list(blocks(*counted.shape))

    def standard(here: slice) -> Array:
        return standardise(error[here], covariance[here])[counted[here]]

    mean = sum(e.sum(axis=0) for e in map(standard, parts)) / count
    stated, second = np.zeros((n, n)), np.zeros((n, n))
    for here in parts:
        P, e = covariance[here][counted[here]], standard(here) - mean
        sigma = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
        stated += (P / (sigma[:, :, None] * sigma[:, None, :])).sum(axis=0) / count
        second += e.T @ e / count
    scale = np.sqrt(np.diag(second))
    with np.errstate(invalid="ignore", divide="ignore"):
        gap = np.nan_to_num(second / np.outer(scale, scale) - stated)
    np.fill_diagonal(gap, 0.0)
    i, j = sorted(int(k) for k in np.unravel_index(np.abs(gap).argmax(), gap.shape))
    return i, j, float(stated[i, j] + gap[i, j]), float(stated[i, j])
