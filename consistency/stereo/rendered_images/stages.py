"""Stages of Herath et al. (2007) fig. 3, one method each.

Selection (stage 3): which features an image begins with. Tracking (4): where those of one image are in the next.
Correspondence (5): disparities of features from the images of a pair. Filtering (6): which observations are kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from scipy.ndimage import map_coordinates

from consistency.referee.errors import InputError
from consistency.referee.types import Array
from consistency.stereo.visual_odometry.arrays import opencv

BLOCK = 7  # px, window of the structure tensor
MARGIN = 12.0  # px from the border, so that the windows of later stages are whole
STEPS = 40  # iterations of Lucas & Kanade, at most
SMALL = 0.003  # px of a step that ends them
SEARCH = (1, 32)  # px, Herath et al. (2007) sec. 3.4
STEP = 16  # OpenCV's matchers search a multiple of this many disparities, in sixteenths of a px
PATCH = 15  # px, side of the patches that are compared


class FeatureSelection(Protocol):
    """Chooses features of one image."""

    def choose(self, image: Array) -> Array:
        """Places (N, 2) of features of an 8-bit image (h, w), px from its middle, the best first."""


@dataclass(frozen=True)
class GoodFeatures:
    """The strongest features of Shi & Tomasi (1994), wherever they are.

    ``quality`` is the least strength, as a share of that of the strongest; ``distance`` the least distance in px.
    """

    count: int = 20
    quality: float = 0.01
    distance: float = 10.0

    def choose(self, image: Array) -> Array:
        require_size(image, 2 * int(MARGIN) + BLOCK, "the margin of the selection")
        mask = np.zeros(image.shape, np.uint8)
        inner = slice(int(MARGIN), -int(MARGIN))
        mask[inner, inner] = 1
        found = opencv().goodFeaturesToTrack(image, self.count, self.quality, self.distance, mask=mask, blockSize=BLOCK)
        if found is None:
            return np.empty((0, 2))
        return from_columns(image, found.reshape(-1, 2).astype(float))


@dataclass(frozen=True)
class Spread:
    """The strongest feature of each cell of a grid, then the second of each, until there are ``count``."""

    count: int = 20
    columns: int = 5
    rows: int = 4
    quality: float = 0.01
    distance: float = 10.0

    def choose(self, image: Array) -> Array:
        uv = GoodFeatures(0, self.quality, self.distance).choose(image)  # 0: all of them
        shape = np.array([self.columns, self.rows])
        place = ((uv / image.shape[::-1] + 0.5) * shape).astype(int)
        cell = np.clip(place, 0, shape - 1) @ [1, self.columns]
        turn = np.tril(cell[:, None] == cell, -1).sum(axis=1)  # how many of its cell are stronger
        return uv[np.argsort(turn, kind="stable")[: self.count]]


def to_columns(image: Array, uv: Array) -> Array:
    """Places (N, 2) px from the middle of an image, from the centre of its first pixel."""
    return uv + (np.array(image.shape[::-1]) - 1.0) / 2.0


def from_columns(image: Array, places: Array) -> Array:
    """The inverse of :func:`to_columns`."""
    return places - (np.array(image.shape[::-1]) - 1.0) / 2.0


def require_size(image: Array, least: int, what: str) -> None:
    """Refuse an image that is smaller than a stage needs."""
    if min(image.shape) < least:
        height, width = image.shape
        raise InputError(
            f"image: {width} x {height} px is too small for {what}, which needs {least} px each way; "
            "give larger images or a smaller window"
        )


class Tracking(Protocol):
    """Follows features from one left image to the next."""

    def follow(
        self,
        before: Array,
        after: Array,
        uv: Array,
        true: Array,
    ) -> tuple[Array, Array]:
        """Where features are in ``after``.

        Parameters
        ----------
        before, after : 8-bit images (h, w)
        uv : (N, 2), px from the middle, in ``before``
        true : (N, 2), where the features really are in ``after``: for a stage that makes no error

        Returns
        -------
        uv : (N, 2)
        found : (N,), bool
        """


@dataclass(frozen=True)
class KnownProjection:
    """No tracker: each feature is where its point is projected."""

    def follow(
        self,
        before: Array,
        after: Array,
        uv: Array,
        true: Array,
    ) -> tuple[Array, Array]:
        return true, np.ones(len(uv), bool)


@dataclass(frozen=True)
class Klt:
    """Lucas & Kanade (1981) on a pyramid, translation alone; ``agreement`` px between there and back again, or None."""

    window: int = 15  # px
    levels: int = 3
    agreement: float | None = None

    def follow(
        self,
        before: Array,
        after: Array,
        uv: Array,
        true: Array,
    ) -> tuple[Array, Array]:
        require_size(before, self.window + 2, f"the tracker's window of {self.window} px")
        there, found = self.flow(before, after, uv)
        if self.agreement is not None:
            back, again = self.flow(after, before, there)
            found &= again & (np.hypot(*(back - uv).T) <= self.agreement)
        return there, found

    def flow(
        self,
        before: Array,
        after: Array,
        uv: Array,
    ) -> tuple[Array, Array]:
        if not len(uv):
            return uv, np.zeros(0, bool)
        cv2 = opencv()
        end = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, STEPS, SMALL)
        start = to_columns(before, uv).astype(np.float32)[:, None]
        place, found, _ = cv2.calcOpticalFlowPyrLK(
            before, after, start, None, winSize=(self.window, self.window), maxLevel=self.levels, criteria=end
        )
        return from_columns(after, place[:, 0].astype(float)), found[:, 0].astype(bool)


class Correspondence(Protocol):
    """Measures disparities."""

    @property
    def search(self) -> tuple[int, int]:
        """Least and greatest disparity, px."""

    def measure(
        self,
        left: Array,
        right: Array,
        uv: Array,
    ) -> Array:
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

    NaN outside the search and at its ends, where the best match is not a minimum.
    """
    height, width = disparities.shape
    column, row = np.rint(places).astype(int).T
    inside = (column >= 0) & (column < width)
    inside &= (row >= 0) & (row < height)
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

    def measure(
        self,
        left: Array,
        right: Array,
        uv: Array,
    ) -> Array:
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

    def measure(
        self,
        left: Array,
        right: Array,
        uv: Array,
    ) -> Array:
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

    def measure(
        self,
        left: Array,
        right: Array,
        uv: Array,
    ) -> Array:
        _require_range(self.search)
        tracker = Klt(self.window, self.levels)
        there, found = tracker.follow(left, right, uv, uv)
        d = uv[:, 0] - there[:, 0]
        found &= np.abs(uv[:, 1] - there[:, 1]) <= self.rows
        found &= (d >= self.search[0]) & (d <= self.search[1])
        return np.where(found, d, np.nan)


@dataclass(frozen=True)
class KnownDisparity:
    """No matcher: for chains whose other stages are studied alone. The chain puts the true disparity in its place."""

    search: tuple[int, int] = SEARCH

    def measure(
        self,
        left: Array,
        right: Array,
        uv: Array,
    ) -> Array:
        return np.full(len(uv), np.nan)


class PairObservations(NamedTuple):
    """N observations of one image pair, as a filter of observations is given them; the truth is not among them."""

    left: Array  # (h, w), 8-bit
    right: Array
    uv: Array  # (N, 2), px from the middle
    d: Array  # (N,), px, NaN where there is none
    dissimilarity: Array  # (N,), of the feature now and when it was selected
    correspondence: Correspondence


class ObservationFilter(Protocol):
    """Keeps observations or leaves them out."""

    def keep(self, evidence: PairObservations) -> Array:
        """Whether each observation is kept, (N,) bool."""


@dataclass(frozen=True)
class LeftRightCheck:
    """The match from right to left must lead back, to within ``tolerance`` px."""

    tolerance: float = 1.0

    def keep(self, evidence: PairObservations) -> Array:
        """The right image is searched from its mirror image, in which it is the left one."""
        left = np.ascontiguousarray(evidence.right[:, ::-1])
        right = np.ascontiguousarray(evidence.left[:, ::-1])
        own = np.where(np.isfinite(evidence.d), evidence.d, 0.0)
        u, v = evidence.uv.T
        back = evidence.correspondence.measure(left, right, np.column_stack([own - u, v]))
        return np.abs(back - evidence.d) <= self.tolerance


@dataclass(frozen=True)
class TrackResidual:
    """The feature must look as it did when it was selected: the dissimilarity of Shi & Tomasi (1994) is bounded."""

    limit: float = 0.6

    def keep(self, evidence: PairObservations) -> Array:
        return evidence.dissimilarity <= self.limit


def patches(image: Array, uv: Array, zoom: Array) -> Array:
    """Patches about places (N, 2) px from the middle, (N, PATCH * PATCH), without their mean and of unit length.

    A patch of ``zoom`` (N,) covers that many times ``PATCH`` px of the image.
    """
    grid = square(np.arange(PATCH) - (PATCH - 1) / 2.0)
    places = to_columns(image, uv)[:, None] + zoom[:, None, None] * grid
    rows_first = places[..., ::-1].transpose(2, 0, 1)
    values = map_coordinates(image.astype(np.float32), rows_first, order=1, mode="nearest")
    values -= values.mean(axis=1, keepdims=True)
    length = np.linalg.norm(values, axis=1, keepdims=True)
    return values / np.maximum(length, 1e-9)


def square(reach: Array) -> Array:
    """Places (n * n, 2) of a square, ``reach`` (n,) along each side, row by row."""
    across, down = np.meshgrid(reach, reach)
    return np.column_stack([across.ravel(), down.ravel()])


def dissimilarity(first: Array, now: Array) -> Array:
    """Distance (N,) of patches of unit length: 0 for one and the same, 1.4 for two that have nothing in common.

    Shi & Tomasi (1994) sec. 4, of patches whose mean and contrast are taken out; in place of their affine motion a
    patch is zoomed by the measured disparity.
    """
    return np.linalg.norm(first - now, axis=1)
