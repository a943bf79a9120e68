"""The verdict on one filter, from its errors over independent runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from consistency.diagnostics import wording
from consistency.diagnostics.bias import hotelling, t_squared
from consistency.diagnostics.coverage import coverage, coverage_interval, rmse
from consistency.diagnostics.credibility import noncredibility
from consistency.diagnostics.distribution import pit
from consistency.diagnostics.innovations import nis_of, nis_test, nis_whiteness, whiteness
from consistency.diagnostics.intervals import anees_interval, chi2_mean_interval
from consistency.diagnostics.location import INTERVAL, locate, locate_axes, subset
from consistency.diagnostics.nees import anees
from consistency.diagnostics.outliers import outliers
from consistency.diagnostics.planning import detectable_ratio
from consistency.diagnostics.questions import MAIN, SHARES, Answer, answers
from consistency.diagnostics.scale import (
    MeanTest,
    acceptance,
    mean_test,
    ratio_interval,
    run_means,
    simultaneous_band,
)  # fmt: skip
from consistency.diagnostics.shape import mean_shape, sphericity
from consistency.diagnostics.whitening import mean_of_runs, squared_length, whiten
from consistency.types import Array, Failure, Indices, Verdict

POSITION, ATTITUDE = {"x", "y", "z"}, {"heading", "roll", "pitch", "yaw"}


def judge(
    name: str,
    error: Array | None = None,
    covariance: Array | None = None,
    nees: Array | None = None,
    nis: Array | None = None,
    nis_dof: Array | None = None,
    failures: tuple[Failure, ...] = (),
    false_alarm: float = 0.05,
    *,
    dof: int | None = None,
    axes: Sequence[str] | None = None,
    subsets: Mapping[str, Sequence[int]] | None = None,
    allow: str | None = None,
    method: str = "max",
    innovations: Array | None = None,
    innovation_covariances: Array | None = None,
    run_numbers: Indices | None = None,
) -> Verdict:
    """Consistent, overconfident, conservative, inconsistent or failed, with reasons and statistics.

    Runs are independent, steps are not: every test takes a run as one observation, or holds under any
    dependence between steps. A filter whose errors are Gaussian with the stated covariance is found at fault in
    any of the questions (``consistency.diagnostics.questions``) with probability ``false_alarm`` at most;
    half of that belongs to the mean NEES, for which :func:`required_runs` plans. A filter with failed runs is never
    consistent. Without truth the innovations are judged alone.

    Parameters
    ----------
    error, covariance : (runs, steps, n), (runs, steps, n, n), NaN where a run has no estimate
    nees : (runs, steps), NaN where the covariance is rank-deficient or the run has failed; worked out from
        error and covariance where it is not given. With ``dof`` it may stand alone.
    nis, nis_dof : (runs, steps), NaN where there was no innovation
    axes : names of the n components
    subsets : further groups of components to look at, name -> indices
    allow : "conservative" accepts a covariance that is too large
    method : of the band over all steps, see :func:`simultaneous_band`
    innovations, innovation_covariances : (runs, steps, m), (runs, steps, m, m), for their whiteness;
        without them the NIS has to do
    run_numbers : (runs,), what to call the runs; 0, 1, ... otherwise

    Raises
    ------
    ValueError
        Nothing to judge is given, or shapes or options do not fit.
    """
    if allow not in (None, "conservative"):
        raise ValueError(f"allow must be 'conservative' or None, got '{allow}'")
    if not 0.0 < false_alarm < 1.0:
        raise ValueError(f"false_alarm must lie between 0 and 1, got {false_alarm}")
    if nis is None and innovations is not None and innovation_covariances is not None:
        nis, nis_dof = nis_of(innovations, innovation_covariances)
    runs, steps = _shape_of(error, covariance, nees, nis, nis_dof)
    s: dict[str, Any] = {
        "runs": runs, "steps": steps, "false_alarm": false_alarm, "confidence": 1.0 - false_alarm,
        "allow": allow, "failures": [[f.run, f.step, f.reason] for f in failures],
    }  # fmt: skip
    p_values: dict[str, float] = {}
    if nis is not None and nis_dof is not None:
        p_values |= _innovations(s, nis, nis_dof, allow, innovations, innovation_covariances)
    whitened = None
    if error is not None and covariance is not None:
        whitened = whiten(error, covariance)
        counted = np.asarray(np.isfinite(nees) if nees is not None else np.isfinite(whitened).all(axis=-1))
        nees = np.where(counted, squared_length(whitened), np.nan)
        s["impossible"] = _impossible(error, covariance, counted)
        whitened[~counted] = np.nan
        dof = error.shape[-1]
        p_values |= _errors(s, error, covariance, nees, whitened, allow, axes, subsets)
    if "outlier" in s and run_numbers is not None and s["outlier"]["run"] >= 0:
        s["outlier"]["run"] = int(run_numbers[s["outlier"]["run"]])
    band = None
    if nees is not None:
        if dof is None:
            raise ValueError("nees needs dof, the dimension of the error")
        p_values |= _nees(s, nees, dof, whitened, allow)
        band = simultaneous_band(nees, dof, _share(p_values, "scale in some step") * false_alarm, method, allow)
        if nees.shape[1] > 1 and s["judged_steps"] > 0:
            p_values["scale in some step"] = band.p_value
    found = answers(p_values, false_alarm)
    s["answers"] = [asdict(answer) for answer in found.values()]
    s["p_value"] = min((min(1.0, a.p_value / a.share) for a in found.values()), default=float("nan"))
    if nees is not None and dof is not None and band is not None:
        step = found.get("scale in some step")
        if step is not None and step.found and not band.outside.any():  # found by what Holm's correction left over
            band = simultaneous_band(nees, dof, np.nextafter(step.p_value, 1.0) * (1 + 1e-6), method, allow)
        locate(s, nees, dof, band, found)
        if error is not None and covariance is not None and whitened is not None:
            locate_axes(s, nees, error, covariance, whitened, found)
    status = _status(s, found)
    if (failures or s.get("impossible")) and (status == "consistent" or s.get("judged_steps") == 0):
        status = "failed"
    return Verdict(name, status, tuple(wording.reasons(status, s)), s)


def _shape_of(*arrays: Array | None) -> tuple[int, int]:
    """Runs and steps that all arrays agree on; ``arrays`` are error, covariance, nees, nis and nis_dof."""
    if all(array is None for array in (arrays[0], *arrays[2:])):
        raise ValueError("nothing to judge: give error and covariance, nees and dof, or nis and nis_dof")
    names = {"error": 3, "covariance": 4, "nees": 2, "nis": 2, "nis_dof": 2}
    shapes = {n: np.shape(a) for n, a in zip(names, arrays, strict=True) if a is not None}
    for name, shape in shapes.items():
        if len(shape) != names[name]:
            raise ValueError(f"{name} must be (runs, steps{', n' * (names[name] - 2)}), got shape {shape}")
    if len({shape[:2] for shape in shapes.values()}) > 1:
        raise ValueError(f"runs and steps differ: {', '.join(f'{n} {shape}' for n, shape in shapes.items())}")
    if "error" in shapes and "covariance" in shapes and shapes["covariance"][2:] != shapes["error"][2:] * 2:
        raise ValueError(f"error {shapes['error']} and covariance {shapes['covariance']} do not fit")
    runs, steps = next(iter(shapes.values()))[:2]
    return int(runs), int(steps)


# --- what is asked ---------------------------------------------------------------------------------


def _innovations(
    s: dict[str, Any], nis: Array, dof: Array, allow: str | None, vectors: Array | None, covariances: Array | None
) -> dict[str, float]:
    test = nis_test(nis, dof)
    low, high = chi2_mean_interval(test.dof, INTERVAL) if test.dof else (float("nan"), float("nan"))
    s |= {"nis_ratio": test.ratio, "nis_interval": [low, high], "nis_dof": test.dof}
    if allow is not None:
        return {"innovation scale": test.above}
    if vectors is not None and covariances is not None:
        white = whiteness(vectors, covariances)
    else:
        white = nis_whiteness(nis, dof)
    return {"innovation scale": test.p_value, "innovation whiteness": _white(s, white)}


def _white(s: dict[str, Any], white: Any) -> float:
    s |= {"autocorrelation": white.correlation, "autocorrelation_bound": white.bound}
    return float(white.p_value)


def _errors(
    s: dict[str, Any],
    error: Array,
    covariance: Array,
    nees: Array,
    whitened: Array,
    allow: str | None,
    axes: Sequence[str] | None,
    subsets: Mapping[str, Sequence[int]] | None,
) -> dict[str, float]:
    n = error.shape[-1]
    names = tuple(axes) if axes is not None else tuple(f"axis {i}" for i in range(n))
    if len(names) != n:
        raise ValueError(f"{len(names)} names of axes for {n} components")
    counted = np.isfinite(nees)
    groups = _groups(names, subsets)
    tests = {key: _subset_test(error, covariance, nees, index) for key, index in groups.items()}
    worst = float(np.min([t.above if allow else t.p_value for t in tests.values()], initial=1.0))
    of_runs = mean_of_runs(whitened)[counted.any(axis=1)]
    enough = len(of_runs) > n
    _, bias_steps = t_squared(whitened)
    asked_steps = np.isfinite(bias_steps)
    p = {
        "scale of an axis": float(np.minimum(1.0, worst * len(tests))) if n > 1 else float("nan"),
        "bias": hotelling(of_runs).p_value if enough else float("nan"),
    }
    several = nees.shape[1] > 1
    if several and asked_steps.any():
        p["bias in some step"] = min(1.0, float(np.nanmin(bias_steps)) * int(asked_steps.sum()))
        s["bias_step"] = int(np.nanargmin(bias_steps)) + 1
    odd = outliers(whitened)
    p["outliers"] = odd.p_value
    if allow is None:
        _, shape_steps = sphericity(whitened)
        scaled, shape = mean_shape(whitened)
        s["shape"] = scaled
        asked = int(np.isfinite(shape_steps).sum())
        at_step = min(1.0, float(np.nanmin(shape_steps)) * asked) if asked else float("nan")
        s["shape_step"] = int(np.nanargmin(shape_steps)) + 1 if asked else None
        p |= {"shape": shape, "shape in some step": at_step} if several else {"shape": at_step}
    index, inclination = noncredibility(error, nees)
    error = np.where(counted[..., None], error, np.nan)
    inside, interval = coverage_interval(error, covariance)
    position = [i for i, axis in enumerate(names) if axis in POSITION]
    attitude = [i for i, axis in enumerate(names) if axis in ATTITUDE]
    s |= {
        "axes": names,
        "groups": groups,
        "coverage": [float(c) for c in coverage(error, covariance)],
        "coverage_one_step": inside,
        "coverage_interval": interval,
        "rmse": [rmse(error[..., [i]]) for i in range(n)],
        "rmse_position": rmse(error[..., position]) if position else float("nan"),
        "rmse_heading": rmse(error[..., attitude]) if attitude else float("nan"),
        "nci": float(np.nanmean(index)) if np.isfinite(index).any() else float("nan"),
        "inclination": float(np.nanmean(inclination)) if np.isfinite(inclination).any() else float("nan"),
        "outlier": {"run": odd.run, "step": odd.step + 1, "distance": odd.distance},
        "left_out_steps": [int(k) + 1 for k in np.flatnonzero(_unusable(covariance, counted))],
    }
    return p


def _impossible(error: Array, covariance: Array, counted: Array) -> list[list[int]]:
    """[row, step] of what no filter may say: an infinite error, or a covariance with a negative variance."""
    odd = np.asarray(np.isinf(error).any(axis=-1) | np.isinf(covariance).any(axis=(-2, -1)))
    suspect = ~counted & ~odd & np.isfinite(covariance).all(axis=(-2, -1))
    P = covariance[suspect]
    odd[suspect] = np.linalg.eigvalsh(P)[:, 0] < -1e-9 * np.abs(P).max(axis=(-2, -1)) if len(P) else False
    return [[int(row), int(step) + 1] for row, step in np.argwhere(odd)]


def _unusable(covariance: Array, counted: Array) -> Array:
    """Steps in which a run has an estimate whose covariance could not be used."""
    there = np.isfinite(covariance).all(axis=(-2, -1))
    return np.asarray((there & ~counted).any(axis=0))


def _groups(names: tuple[str, ...], subsets: Mapping[str, Sequence[int]] | None) -> dict[str, list[int]]:
    groups = {axis: [i] for i, axis in enumerate(names)}
    for label, members in (("position", POSITION), ("attitude", ATTITUDE)):
        index = [i for i, axis in enumerate(names) if axis in members]
        if 1 < len(index) < len(names):
            groups[label] = index
    for label, chosen in (subsets or {}).items():
        index = [int(i) for i in chosen]
        if not index or not all(0 <= i < len(names) for i in index) or len(set(index)) < len(index):
            raise ValueError(f"subset '{label}': indices must be different and between 0 and {len(names) - 1}")
        groups[label] = index
    return groups


def _subset_test(error: Array, covariance: Array, nees: Array, index: list[int]) -> MeanTest:
    w = subset(error, covariance, index)
    w[~np.isfinite(nees)] = np.nan
    return mean_test(squared_length(w), len(index), w)


def _nees(s: dict[str, Any], nees: Array, dof: int, whitened: Array | None, allow: str | None) -> dict[str, float]:
    test = mean_test(nees, dof, whitened)
    means, counts = run_means(nees)
    means = means[counts > 0]
    alive = np.isfinite(nees).sum(axis=0)
    curve = anees(nees)
    judged = alive > 0
    band = np.full((len(curve), 2), np.nan)
    intervals = {int(m): anees_interval(dof, int(m), INTERVAL) for m in set(alive[judged])}
    for k in np.flatnonzero(judged):
        band[k] = intervals[int(alive[k])]
    inside = (curve >= band[:, 0]) & (curve <= band[:, 1])
    some = bool(judged.any())
    ratio, low, high = ratio_interval(means / dof, INTERVAL)
    share = SHARES[MAIN] * s["false_alarm"]
    distribution = pit(nees, dof)
    s |= {
        "dof": dof,
        "anees": curve,
        "alive": alive,
        "band": band,
        "judged_steps": int(judged.sum()),
        "mean_anees": test.ratio * dof,
        "acceptance": acceptance(test, len(means), dof, share, allow) if some else (float("nan"),) * 2,
        "effective_dof": test.effective_dof,
        "ratio": ratio,
        "ratio_interval": (low, high),
        "detectable": detectable_ratio(dof, len(means), share, two_sided=allow is None) if some else float("nan"),
        "median_run": float(np.median(means)) if some else float("nan"),
        "worst_run": float(means.max()) if some else float("nan"),
        "share_inside": float(inside[judged].mean()) if some else float("nan"),
        "pit": distribution.values,
        "pit_half_width": distribution.half_width,
    }
    s.setdefault("left_out_steps", [])
    p = {MAIN: (test.above if allow else test.p_value) if some else float("nan")}
    return p if allow else p | {"distribution": distribution.p_value}


def _share(p_values: Mapping[str, float], question: str) -> float:
    """Share of the false-alarm rate that a question will have among those asked."""
    return answers(dict.fromkeys([q for q, p in p_values.items() if np.isfinite(p)] + [question], 1.0), 0.5)[
        question
    ].share


def _status(s: dict[str, Any], found: Mapping[str, Answer]) -> str:
    if not found or s.get("judged_steps") == 0:
        return "failed"
    faults = {q for q, a in found.items() if a.found}
    if not faults:
        return "consistent"
    if MAIN in faults:
        return "overconfident" if s["mean_anees"] > s["dof"] else "conservative"
    if "scale in some step" in faults:
        return "overconfident" if s["steps_above"] else "conservative"
    if "scale of an axis" in faults:
        sides = {ratio > 1.0 for ratio, low, high in s["of_axes"].values() if not low <= 1.0 <= high}
        return "inconsistent" if len(sides) != 1 else "overconfident" if sides.pop() else "conservative"
    if faults <= {"innovation scale", "innovation whiteness"} and "anees" not in s:
        high = s["nis_ratio"] > 1.0
        return ("overconfident" if high else "conservative") if "innovation scale" in faults else "inconsistent"
    return "inconsistent"
