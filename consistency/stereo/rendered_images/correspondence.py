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


def _require_range(search: tuple[int, int]) -> None:
    if not 0 <= search[0] < search[1]:
        raise InputError(f"search: {search}, allowed is (low, high) in px with 0 <= low < high")


def _searched(image: Array, search: tuple[int, int], block: int) -> int:
    """How many disparities a matcher searches in an image that is large enough for it."""
    _require_range(search)
    count = -(-(search[1] - search[0] + 1) // STEP) * STEP
    require_size(image, block + count + search[0], f"blocks of {block} px and the search")
    return count


def _at(places: Array, disparities: Array, search: tuple[int, int]) -> Array:
    """Values (N,) of a disparity image (h, w) in sixteenths at the nearest pixels, px.

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
        count = _searched(left, self.search, self.block)
        matcher: Any = opencv().StereoBM_create(count, self.block)
        matcher.setMinDisparity(self.search[0])
        matcher.setUniquenessRatio(self.uniqueness)
        matcher.setTextureThreshold(self.texture)
        return _at(to_columns(left, uv), matcher.compute(left, right), self.search)


@dataclass(frozen=True)
class SemiGlobal:
    """Blocks with a penalty on changes between neighbours, Hirschmueller (2008), as OpenCV's StereoSGBM has it."""

    search: tuple[int, int] = SEARCH
    block: int = 5  # px, odd
    uniqueness: int = 10  # %

    def measure(self, left: Array, right: Array, uv: Array) -> Array:
        count = _searched(left, self.search, self.block)
        area = self.block**2
        matcher: Any = opencv().StereoSGBM_create(
            self.search[0], count, self.block, 8 * area, 32 * area, 1, 31, self.uniqueness
        )
        return _at(to_columns(left, uv), matcher.compute(left, right), self.search)


@dataclass(frozen=True)
class KltAcross:
    """The tracker from the left image to the right one; rows may differ by ``rows`` px."""

    search: tuple[int, int] = SEARCH
    window: int = 15  # px
    levels: int = 3
    rows: float = 1.5

    def measure(self, left: Array, right: Array, uv: Array) -> Array:
        _require_range(self.search)
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
