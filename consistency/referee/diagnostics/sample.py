"""Record prepared for the tests: whitened errors, the NEES that counts, run means."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from consistency.referee.diagnostics.nees import EarlyMeans
from consistency.referee.diagnostics.record import Record, numbered_axes
from consistency.referee.diagnostics.scale import RunMeans, means_and_counts, run_means
from consistency.referee.diagnostics.verdict_parts import Settings
from consistency.referee.diagnostics.whitening import (
    all_finite,
    are_unlike,
    by_runs,
    by_steps,
    every_entry,
    negative,
    of_runs,
    squared_length,
    whiten,
    whiten_group,
)
from consistency.referee.types import Array, Indices

if TYPE_CHECKING:
    from consistency.referee.diagnostics.groups import Groups

POSITION = {"x", "y", "z"}
ATTITUDE = {"heading", "roll", "pitch", "yaw"}
VELOCITY = {"vx", "vy", "vz"}
EARLIEST = 0.02  # of the runs, by their end


class Centre(NamedTuple):
    """Mean of the errors of N runs in each step, and the factor that restores their variance about it."""

    mean: Array  # (T, n)
    factor: Array  # (T, 1), NaN in a step of a single run

    def about(self, error: Array, counted: Array) -> Array:
        """Errors (runs, T, n) about the mean; NaN where they are not ``counted`` (runs, T)."""
        return np.where(counted[..., None], (error - self.mean) * self.factor, np.nan)


@dataclass(frozen=True)
class Sample:
    """NEES of N runs in T steps; where errors of n components are known, these in units of their covariance.

    The arrays may be large: they are processed in blocks of runs or steps, and no other array of their size is kept.
    """

    record: Record
    nees: Array  # (N, T), NaN where nothing counts
    dof: int
    whitened: Array | None = None  # (N, T, n), NaN where nothing counts; None where NEES stand alone
    names: tuple[str, ...] = ()  # of the components
    components: Mapping[str, list[int]] = field(default_factory=dict)  # each, and named groups and subsets of them
    centre: Centre | None = None  # where ``whitened`` is of the errors about it

    @property
    def error(self) -> Array:
        """(N, T, n), of a sample with errors."""
        assert self.record.errors.error is not None
        return self.record.errors.error

    @property
    def covariance(self) -> Array:
        """(N, T, n, n), of a sample with errors."""
        return np.asarray(self.record.errors.covariance, float)

    @property
    def reported(self) -> dict[str, list[int]]:
        """The components and velocity, whose ratio is reported and not tested."""
        velocity = self.members(VELOCITY)
        components = dict(self.components)
        if 1 < len(velocity) < len(self.names):
            components.setdefault("velocity", velocity)
        return components

    def members(self, axes: Collection[str]) -> list[int]:
        """Places of components that are some of the ``axes``, whatever the user calls them."""
        return [i for i, axis in enumerate(self.record.errors.axes) if axis in axes]

    @property
    def groups(self) -> Groups | None:
        """Groups of runs and steps, (N, T)."""
        return self.record.groups

    @cached_property
    def counted(self) -> Array:
        """(N, T) of bool."""
        return np.asarray(np.isfinite(self.nees))

    def means(self, steps: slice = slice(None)) -> Array:
        """Mean NEES over dof of each run that has any of ``steps``, (runs,)."""
        means, counts = run_means(self.nees[:, steps])
        return np.asarray(means[counts > 0] / self.dof)

    def in_group(self, number: int) -> RunMeans:
        """Mean NEES over their steps in a group of the runs that have any."""
        assert self.groups is not None

        def of_block(nees: Array, index: Indices) -> Array:
            return means_and_counts(np.where(index == number, nees, np.nan))

        means, counts = by_runs(of_block, self.nees, self.groups.index).T
        return RunMeans(means[counts > 0] / self.dof, counts[counts > 0].astype(np.int64), self.dof)

    @cached_property
    def counts(self) -> Indices:
        """Steps of each run that has any, (runs,)."""
        counts = self.counted.sum(axis=1)
        return np.asarray(counts[counts > 0])

    @property
    def first(self) -> slice:
        """The first steps, up to the last one of the run that is among the first of 50 to end."""
        there = self.counted[self.counted.any(axis=1)]
        last = there.shape[1] - 1 - np.argmax(there[:, ::-1], axis=1)
        return slice(0, int(np.quantile(last, EARLIEST, method="lower")) + 1)

    def run_means(self, index: Sequence[int] | None = None) -> RunMeans:
        """Mean NEES of each run, of all components or some of them."""
        dof = self.dof if index is None else len(index)
        means = self.means if index is None else partial(self.group_means, index)
        early = None
        if are_unlike(self.counts):
            counts = self.counted[:, self.first].sum(axis=1)
            early = RunMeans(means(steps=self.first), counts[counts > 0], dof)
        return RunMeans(means(), self.counts, dof, early)

    @property
    def longest(self) -> int:
        """Steps of the longest run."""
        return int(self.counts.max(initial=0))

    @property
    def early_means(self) -> EarlyMeans | None:
        """Means in which early steps weigh more; None where all runs have equally many steps."""
        if not are_unlike(self.counts):
            return None
        weights = np.zeros(self.nees.shape[1])
        first = int(self.counted.any(axis=0).argmax())  # a skipped start has no weight
        weights[first:] = 1.0 / np.arange(1.0, len(weights) - first + 1.0)

        def of_block(nees: Array, counted: Array) -> Array:
            return np.stack([np.where(counted, nees, 0.0) @ weights, counted @ weights], axis=-1)

        total, weight = by_runs(of_block, self.nees, self.counted).T
        total, weight = total[weight > 0], weight[weight > 0]
        return EarlyMeans(total / weight / self.dof, weight / weights.sum())

    def group_means(self, index: Sequence[int], steps: slice = slice(None), centre: Centre | None = None) -> Array:
        """Mean NEES of a group of components alone, of errors about the ``centre``, over its number of components."""
        if centre is None:
            centre = self.centre
        if centre is not None:
            centre = Centre(centre.mean[steps], centre.factor[steps])

        def of_block(error: Array, P: Array, counted: Array) -> Array:
            if centre is not None:
                error = centre.about(error, counted)
            return means_and_counts(np.where(counted, squared_length(whiten_group(error, P, index)), np.nan))

        means, counts = by_runs(of_block, self.error[:, steps], self.covariance[:, steps], self.counted[:, steps]).T
        return np.asarray(means[counts > 0] / len(index))

    def mean_error(self) -> Centre:
        """Mean error over runs in each step."""
        N = self.counted.sum(axis=0)[:, None]
        total = by_steps(lambda e, here: np.where(here[..., None], e, 0.0).sum(axis=0), self.error, self.counted)
        factor = np.sqrt(N / np.maximum(N - 1, 1))
        return Centre(total / np.maximum(N, 1), np.where(N > 1, factor, np.nan))

    def centred_means(self, steps: slice) -> Array:
        """:meth:`means` of errors less their mean over runs in each step."""
        return self.group_means(range(self.dof), steps, self.mean_error())

    def centred(self) -> Sample:
        """Errors less their mean over runs in each step, with the variance that they would have without a bias.

        Overwrites this sample's NEES and whitened errors in place; do not use it afterwards.
        """
        assert self.whitened is not None
        centre = self.mean_error()
        for here in of_runs(self.counted):
            w = whiten(centre.about(self.error[here], self.counted[here]), self.covariance[here])
            self.whitened[here] = w
            self.nees[here] = squared_length(w)
        return replace(self, centre=centre)


def sample_of(record: Record, settings: Settings) -> Sample | None:
    """Sample of the errors, or of the NEES alone; None without either.

    Raises
    ------
    ValueError
        Names or subsets that do not fit, or NEES without dof.
    """
    if record.errors.error is None or record.errors.covariance is None:
        if record.errors.nees is None:
            return None
        if not record.errors.dof:
            raise ValueError("nees needs dof, the dimension of the error")
        return Sample(record, record.errors.nees, record.errors.dof)
    names = names_of(record)
    error = record.errors.error
    P = np.asarray(record.errors.covariance, float)
    whitened = np.empty(error.shape)
    nees = np.empty(error.shape[:2])
    for here in of_runs(nees):
        w = whiten(error[here], P[here])
        counted = all_finite(w)
        if record.errors.nees is not None:
            counted = np.isfinite(record.errors.nees[here])
        nees[here] = np.where(counted, squared_length(w), np.nan)
        w[~np.isfinite(nees[here])] = np.nan
        whitened[here] = w
    sample = Sample(record, nees, error.shape[-1], whitened, names)
    return replace(sample, components=component_groups(sample, settings.subsets))


def names_of(record: Record) -> tuple[str, ...]:
    """Names of the components of the error, the user's own before others; axis 0, axis 1, ... where they have none.

    Raises
    ------
    ValueError
        Other than one name for each component.
    """
    assert record.errors.error is not None
    n = record.errors.error.shape[-1]
    if record.errors.axes is None or not len(record.errors.axes):
        return numbered_axes(n)
    if len(record.errors.axes) != n:
        raise ValueError(f"{len(record.errors.axes)} names of axes for {n} components")
    return record.errors.names


def component_groups(sample: Sample, subsets: Mapping[str, Sequence[int]] | None) -> dict[str, list[int]]:
    """Each component, position and attitude where they are more than one and not all, and the subsets."""
    names = sample.names
    groups = {axis: [i] for i, axis in enumerate(names)}
    for label, members in (("position", POSITION), ("attitude", ATTITUDE)):
        index = sample.members(members)
        if 1 < len(index) < len(names):
            groups[label] = index
    for label, chosen in (subsets or {}).items():
        index = [int(i) for i in chosen]
        if not index or not all(0 <= i < len(names) for i in index) or len(set(index)) < len(index):
            raise ValueError(f"subset '{label}': indices must be different and between 0 and {len(names) - 1}")
        groups[label] = index
    return groups


def runs_and_steps(record: Record) -> tuple[int, int]:
    """Numbers of runs and steps that all arrays agree on.

    Raises
    ------
    ValueError
        They do not agree, or nothing is there.
    """
    arrays = {
        "error": (record.errors.error, "runs, steps, n"),
        "covariance": (record.errors.covariance, "runs, steps, n, n"),
        "nees": (record.errors.nees, "runs, steps"),
        "nis": (record.innovations.nis, "runs, steps"),
        "nis_dof": (record.innovations.nis_dof, "runs, steps"),
        "innovations": (record.innovations.values, "runs, steps, n"),
    }
    shapes = {name: np.shape(array) for name, (array, _) in arrays.items() if array is not None}
    if not set(shapes) - {"covariance", "nis_dof"}:
        raise ValueError("nothing to judge: give error and covariance, nees and dof, or nis and nis_dof")
    for name, shape in shapes.items():
        expected = arrays[name][1]
        if len(shape) != len(expected.split()):
            raise ValueError(f"{name} must be ({expected}), got shape {shape}")
    if len({shape[:2] for shape in shapes.values()}) > 1:
        raise ValueError(f"runs and steps differ: {', '.join(f'{n} {shape}' for n, shape in shapes.items())}")
    if "error" in shapes and "covariance" in shapes and shapes["covariance"][2:] != shapes["error"][2:] * 2:
        raise ValueError(f"error {shapes['error']} and covariance {shapes['covariance']} do not fit")
    runs, steps = next(iter(shapes.values()))[:2]
    return int(runs), int(steps)


def impossible_values(record: Record, counted: Array) -> Array:
    """(runs, steps) of bool: values that no filter may say, an infinite error or a negative variance."""

    def of_block(error: Array, P: Array, counted: Array) -> Array:
        odd = np.isinf(error).any(axis=-1) | ~every_entry(lambda entry: ~np.isinf(entry), P)
        suspect = ~counted & ~odd & every_entry(np.isfinite, P)
        odd[suspect] = negative(P[suspect])
        return odd

    assert record.errors.error is not None
    return by_runs(of_block, record.errors.error, np.asarray(record.errors.covariance, float), counted)
