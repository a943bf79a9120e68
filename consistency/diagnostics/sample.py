"""Evidence in the form in which it is judged: whitened errors, the NEES that counts, run means."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from consistency.diagnostics.innovations import nis_of
from consistency.diagnostics.records import Evidence, Settings
from consistency.diagnostics.scale import run_means
from consistency.diagnostics.whitening import squared_length, subset, whiten
from consistency.types import Array

POSITION, ATTITUDE = {"x", "y", "z"}, {"heading", "roll", "pitch", "yaw"}


@dataclass(frozen=True)
class Errors:
    """Errors and what they were called; N runs, T steps, n components."""

    error: Array  # (N, T, n)
    covariance: Array  # (N, T, n, n)
    whitened: Array  # (N, T, n), NaN where nothing counts
    names: tuple[str, ...]
    groups: Mapping[str, list[int]]  # components, named groups and subsets


@dataclass(frozen=True)
class Sample:
    """NEES of N runs in T steps; with errors where they are known."""

    nees: Array  # (N, T), NaN where nothing counts
    dof: int
    errors: Errors | None = None

    @property
    def counted(self) -> Array:
        """(N, T) of bool."""
        return np.asarray(np.isfinite(self.nees))

    def means(self, steps: slice = slice(None)) -> Array:
        """Mean NEES over dof of each run that has any of ``steps``, (runs,)."""
        means, counts = run_means(self.nees[:, steps])
        return np.asarray(means[counts > 0] / self.dof)

    @property
    def longest(self) -> int:
        """Steps of the longest run."""
        return int(np.isfinite(self.nees).sum(axis=1).max(initial=0))

    def group_means(self, index: Sequence[int], steps: slice = slice(None)) -> Array:
        """Mean NEES of a group of components by itself, over its number of components."""
        assert self.errors is not None
        w = subset(self.errors.error[:, steps], self.errors.covariance[:, steps], list(index))
        nees = np.where(np.isfinite(self.nees[:, steps]), squared_length(w), np.nan)
        means, counts = run_means(nees)
        return np.asarray(means[counts > 0] / len(index))

    def centred(self) -> Sample:
        """Errors less their mean over runs in each step, with the variance that they would have without a bias."""
        assert self.errors is not None
        here = self.counted[..., None]
        N = self.counted.sum(axis=0)[:, None]
        mean = np.where(here, self.errors.error, 0.0).sum(axis=0) / np.maximum(N, 1)
        error = np.where(here & (N > 1), (self.errors.error - mean) * np.sqrt(N / np.maximum(N - 1, 1)), np.nan)
        whitened = whiten(error, self.errors.covariance)
        nees = np.where(np.isfinite(whitened).all(axis=-1), squared_length(whitened), np.nan)
        return replace(self, nees=nees, errors=replace(self.errors, error=error, whitened=whitened))


def sample_of(evidence: Evidence, settings: Settings) -> Sample | None:
    """What there is of errors, or of NEES; None without either.

    Raises
    ------
    ValueError
        Names or subsets that do not fit, or NEES without dof.
    """
    e = evidence
    if e.error is None or e.covariance is None:
        if e.nees is None:
            return None
        if e.dof is None:
            raise ValueError("nees needs dof, the dimension of the error")
        return Sample(e.nees, e.dof)
    whitened = whiten(e.error, e.covariance)
    counted = np.asarray(np.isfinite(e.nees) if e.nees is not None else np.isfinite(whitened).all(axis=-1))
    nees = np.where(counted, squared_length(whitened), np.nan)
    whitened[~np.isfinite(nees)] = np.nan
    n = e.error.shape[-1]
    names = tuple(e.axes) if e.axes is not None else tuple(f"axis {i}" for i in range(n))
    if len(names) != n:
        raise ValueError(f"{len(names)} names of axes for {n} components")
    return Sample(nees, n, Errors(e.error, e.covariance, whitened, names, groups_of(names, settings.subsets)))


def groups_of(names: tuple[str, ...], subsets: Mapping[str, Sequence[int]] | None) -> dict[str, list[int]]:
    """Each component, position and attitude where they are more than one and not all, and the subsets."""
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


def innovations_of(evidence: Evidence) -> tuple[Array, Array] | None:
    """NIS and its degrees of freedom, (runs, steps) each; None without any."""
    if evidence.nis is not None and evidence.nis_dof is not None:
        return evidence.nis, evidence.nis_dof
    if evidence.innovations is not None and evidence.innovation_covariances is not None:
        return nis_of(evidence.innovations, evidence.innovation_covariances)
    return None


def shape_of(e: Evidence) -> tuple[int, int]:
    """Runs and steps that all arrays agree on.

    Raises
    ------
    ValueError
        They do not agree, or nothing is there.
    """
    arrays = {"error": e.error, "covariance": e.covariance, "nees": e.nees, "nis": e.nis, "nis_dof": e.nis_dof,
              "innovations": e.innovations}  # fmt: skip
    if all(array is None for name, array in arrays.items() if name not in ("covariance", "nis_dof")):
        raise ValueError("nothing to judge: give error and covariance, nees and dof, or nis and nis_dof")
    dimensions = {"error": 3, "covariance": 4, "nees": 2, "nis": 2, "nis_dof": 2, "innovations": 3}
    shapes = {name: np.shape(array) for name, array in arrays.items() if array is not None}
    for name, shape in shapes.items():
        if len(shape) != dimensions[name]:
            raise ValueError(f"{name} must be (runs, steps{', n' * (dimensions[name] - 2)}), got shape {shape}")
    if len({shape[:2] for shape in shapes.values()}) > 1:
        raise ValueError(f"runs and steps differ: {', '.join(f'{n} {shape}' for n, shape in shapes.items())}")
    if "error" in shapes and "covariance" in shapes and shapes["covariance"][2:] != shapes["error"][2:] * 2:
        raise ValueError(f"error {shapes['error']} and covariance {shapes['covariance']} do not fit")
    runs, steps = next(iter(shapes.values()))[:2]
    return int(runs), int(steps)


def impossible(e: Evidence, counted: Array) -> Array:
    """(runs, steps) of bool: what no filter may say, an infinite error or a covariance with a negative variance."""
    assert e.error is not None
    assert e.covariance is not None
    odd = np.asarray(np.isinf(e.error).any(axis=-1) | np.isinf(e.covariance).any(axis=(-2, -1)))
    suspect = ~counted & ~odd & np.isfinite(e.covariance).all(axis=(-2, -1))
    P = e.covariance[suspect]
    odd[suspect] = np.linalg.eigvalsh(P)[:, 0] < -1e-9 * np.abs(P).max(axis=(-2, -1)) if len(P) else False
    return odd
