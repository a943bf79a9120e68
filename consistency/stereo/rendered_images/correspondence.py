"""Stage 5 of Herath et al. (2007) fig. 3: disparities of features from the two images of a pair."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.types import Array
from consistency.stereo.rendered_images.selection import require_size, to_columns
from consistency.stereo.rendered_images.tracking import Klt
from consistency.stereo.visual_odometry.features import opencv

SEARCH = (1, 32)  # px, Herath et al. (2007) sec. 3.4
STEP = 16  # OpenCV's matchers search a multiple of this many disparities, in sixteenths of a px


class Correspondence(Protocol):
    """Measures disparities."""

    @property
    def search(self) -> tuple[int, int]:
        """Least and greatest disparity, px."""

    def measure(self, left: Array, right: Array, uv: Array) -> Array:
        """Disparities (N,) of places ``uv`` (N, 2), px from the middle of the left image; NaN where there is none."""


def _searched(search: tuple[int, int]) -> int:
    low, high = search
    if not 0 <= low < high:
        raise InputError(f"search: {search}, allowed is (low, high) in px with 0 <= low < high")
    return -(-(high - low + 1) // STEP) * STEP


def _at(places: Array, disparities: Array, search: tuple[int, int]) -> Array:
    """Values (N,) of a disparity image in sixteenths at the nearest pixels, px.

    NaN outside the search and at its ends, where the best match is no minimum.
    """
    height, width = disparities.shape
    column, row = np.rint(places).astype(int).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    d = np.full(len(places), np.nan)
    d[inside] = disparities[row[inside], column[inside]] / STEP
    d[(d <= search[0]) | (d >= search[1])] = np.nan
    return d


@dataclass(frozen=True)
class BlockMatching:
    """Sums of absolute differences of blocks, Konolige (1997), as OpenCV's StereoBM has it."""

    search: tuple[int, int] = SEARCH
    block: int = 15  # px, odd
    uniqueness: int = 10  # % by which the best match must be better than others
    texture: int = 10  # least texture of a block

    def measure(self, left: Array, right: Array, uv: Array) -> Array:
        return _at(to_columns(left, uv), self.disparities(left, right), self.search)

    def disparities(self, left: Array, right: Array) -> Array:
        """Disparity image (h, w) in sixteenths of a px; below the search where there is none."""
        count = _searched(self.search)
        require_size(left, self.block + count + self.search[0], f"blocks of {self.block} px and the search")
        matcher: Any = opencv().StereoBM_create(count, self.block)
        matcher.setMinDisparity(self.search[0])
        matcher.setUniquenessRatio(self.uniqueness)
        matcher.setTextureThreshold(self.texture)
        return np.asarray(matcher.compute(left, right))


@dataclass(frozen=True)
class SemiGlobal:
    """Blocks with a penalty on changes between neighbours, Hirschmueller (2008), as OpenCV's StereoSGBM has it."""

    search: tuple[int, int] = SEARCH
    block: int = 5  # px, odd
    uniqueness: int = 10  # %

    def measure(self, left: Array, right: Array, uv: Array) -> Array:
        return _at(to_columns(left, uv), self.disparities(left, right), self.search)

    def disparities(self, left: Array, right: Array) -> Array:
        """Disparity image (h, w) in sixteenths of a px; below the search where there is none."""
        count = _searched(self.search)
        require_size(left, self.block + count + self.search[0], f"blocks of {self.block} px and the search")
        area = self.block**2
        matcher: Any = opencv().StereoSGBM_create(
            self.search[0], count, self.block, 8 * area, 32 * area, 1, 31, self.uniqueness
        )
        return np.asarray(matcher.compute(left, right))


@dataclass(frozen=True)
class KltAcross:
    """The tracker from the left image to the right one; rows may differ by ``rows`` px."""

    search: tuple[int, int] = SEARCH
    window: int = 15  # px
    levels: int = 3
    rows: float = 1.5

    def measure(self, left: Array, right: Array, uv: Array) -> Array:
        _searched(self.search)
        tracker = Klt(self.window, self.levels)
        there, found = tracker.follow(left, right, uv, uv)
        d = uv[:, 0] - there[:, 0]
        good = found & (np.abs(uv[:, 1] - there[:, 1]) <= self.rows) & (d >= self.search[0]) & (d <= self.search[1])
        return np.where(good, d, np.nan)


@dataclass(frozen=True)
class KnownDisparity:
    """No matcher: for chains whose other stages are studied alone. The chain puts the true disparity in its place."""

    search: tuple[int, int] = SEARCH

    def measure(self, left: Array, right: Array, uv: Array) -> Array:
        return np.full(len(uv), np.nan)
