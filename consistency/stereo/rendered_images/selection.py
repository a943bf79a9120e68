"""Stage 3 of Herath et al. (2007) fig. 3: which features an image begins with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.types import Array
from consistency.stereo.visual_odometry.features import opencv

BLOCK = 7  # px, window of the structure tensor
MARGIN = 12.0  # px from the border, so that the windows of later stages are whole


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
        mask[int(MARGIN) : -int(MARGIN), int(MARGIN) : -int(MARGIN)] = 1
        found = opencv().goodFeaturesToTrack(image, self.count, self.quality, self.distance, mask=mask, blockSize=BLOCK)
        return np.empty((0, 2)) if found is None else from_columns(image, found.reshape(-1, 2).astype(float))


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
        cell = np.clip(((uv / image.shape[::-1] + 0.5) * shape).astype(int), 0, shape - 1) @ [1, self.columns]
        turn = np.array([np.count_nonzero(cell[:i] == own) for i, own in enumerate(cell)], int)
        return uv[np.argsort(turn, kind="stable")[: self.count]]


# --- what all stages share ------------------------------------------------------------------------


def to_columns(image: Array, uv: Array) -> Array:
    """Places (N, 2) px from the middle of an image, from the centre of its first pixel."""
    return np.asarray(uv + (np.array(image.shape[::-1]) - 1.0) / 2.0)


def from_columns(image: Array, places: Array) -> Array:
    """The inverse of :func:`to_columns`."""
    return np.asarray(places - (np.array(image.shape[::-1]) - 1.0) / 2.0)


def require_size(image: Array, least: int, what: str) -> None:
    """Refuse an image that is smaller than a stage needs."""
    if min(image.shape) < least:
        height, width = image.shape
        raise InputError(
            f"image: {width} x {height} px is too small for {what}, which needs {least} px each way; "
            "give larger images or a smaller window"
        )
