"""Which features are tracked, and for how long, Herath et al. (2007) sec. 4.2."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from consistency.bench.scenario.effects.effect import UvdEffect, register_effect
from consistency.bench.scenario.effects.observations import Context, Observations
from consistency.bench.scenario.tables.toml_tables import Count, NonNegative, Positive
from consistency.referee.types import Array, Indices


@register_effect
class Selection(UvdEffect):
    """At most ``count`` tracks at a time. One that is chosen is kept until it is not seen for ``forget_steps``.

    Free places go, one after the other, to what is seen and has the highest rank, the sum of four numbers in [0, 1]
    times their weights:

    - ``strength``: how good a feature it is to track, a fixed random number of each id, drawn from ``seed``;
    - ``stereo``: confidence in its depth, its disparity over the greatest that is searched;
    - ``image``: 1 / (1 + tracks in its cell of an image of ``cells`` columns and rows);
    - ``depth``: the share of tracks on the other side of the disparity ``near``, from which on a feature is near; 1
      where there are none.

    It comes before the noise, so that what is chosen does not depend on errors: by measured disparities it would prefer
    those that are too large. It is then also the same in every run, and done once.
    """

    units: ClassVar[dict[str, str]] = {"near": "_px"}
    draws: ClassVar[bool] = False
    before_noise: ClassVar[bool] = True
    errs: ClassVar[bool] = False

    kind: Literal["selection"] = "selection"
    count: Count
    forget_steps: Count
    seed: Annotated[int, Field(ge=0, strict=True)]
    cells: tuple[Count, Count]
    near: Positive  # px
    strength: NonNegative
    stereo: NonNegative
    image: NonNegative
    depth: NonNegative

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        base, cell, is_near = self._ranked(observations, context)
        ends = np.searchsorted(observations.step, np.arange(1, context.steps + 2))
        last, is_kept = np.zeros(observations.ids, np.int64), np.zeros(observations.ids, bool)
        chosen = np.zeros(len(observations), bool)
        for k in range(context.steps):
            rows = slice(ends[k], ends[k + 1])
            seen = observations.landmark[rows]
            last[seen] = k
            is_kept &= k - last < self.forget_steps
            free = self.count - int(is_kept.sum())
            if free > 0:
                new = self._best(free, base[rows], cell[rows], is_near[rows], is_kept[seen])
                is_kept[seen[new]] = True
            chosen[rows] = is_kept[seen]
        return observations.keep(chosen)

    def _ranked(self, observations: Observations, context: Context) -> tuple[Array, Indices, Indices]:
        """Of each row the rank without what other tracks add to it, its cell, and whether it is near; (M,) each."""
        u, v, d = observations.z.T
        strength = np.random.default_rng(self.seed).random(observations.ids)[observations.landmark]
        most = (context.sensor.search_range or (0.0, np.inf))[1]
        rank = self.strength * strength + self.stereo * np.clip(d / most, 0.0, 1.0)
        if context.sensor.image is None:
            return rank, np.zeros(len(d), np.int64), (d >= self.near).astype(np.int64)
        (columns, rows), (width, height), centre = self.cells, context.sensor.image, context.sensor.centre
        column = np.clip((u + centre[0]) * columns / width, 0, columns - 1).astype(np.int64)
        row = np.clip((v + centre[1]) * rows / height, 0, rows - 1).astype(np.int64)
        return rank, row * columns + column, (d >= self.near).astype(np.int64)

    def _best(self, free: int, base: Array, cell: Indices, is_near: Indices, is_kept: Array) -> Indices:
        """Up to ``free`` rows of a step to be kept, beside those that are, in the order of choice."""
        in_cell = np.bincount(cell[is_kept], minlength=self.cells[0] * self.cells[1])
        by_depth = np.bincount(is_near[is_kept], minlength=2)
        left, new = np.flatnonzero(~is_kept), list[int]()
        while len(left) and len(new) < free:
            total = by_depth.sum()
            other = by_depth[1 - is_near[left]] / total if total else np.ones(len(left))
            rank = base[left] + self.image / (1.0 + in_cell[cell[left]]) + self.depth * other
            at = int(np.argmax(rank))
            new.append(left[at])
            in_cell[cell[left[at]]] += 1
            by_depth[is_near[left[at]]] += 1
            left = np.delete(left, at)
        return np.array(new, np.int64)
