"""Stage 6 of Herath et al. (2007) fig. 3: which observations are kept."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.ndimage import map_coordinates

from consistency.referee.types import Array
from consistency.stereo.rendered_images.correspondence import Correspondence
from consistency.stereo.rendered_images.selection import to_columns

PATCH = 15  # px, side of the patches that are compared


@dataclass(frozen=True, eq=False)
class PairObservations:
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
        left, right = (np.ascontiguousarray(image[:, ::-1]) for image in (evidence.right, evidence.left))
        own = np.where(np.isfinite(evidence.d), evidence.d, 0.0)
        there = np.stack([own - evidence.uv[:, 0], evidence.uv[:, 1]], axis=-1)
        back = evidence.correspondence.measure(left, right, there)
        return np.asarray(np.abs(back - evidence.d) <= self.tolerance)


@dataclass(frozen=True)
class TrackResidual:
    """The feature must look as it did when it was selected: the dissimilarity of Shi & Tomasi (1994) is bounded."""

    limit: float = 0.6

    def keep(self, evidence: PairObservations) -> Array:
        return np.asarray(evidence.dissimilarity <= self.limit)


def patches(image: Array, uv: Array, zoom: Array) -> Array:
    """Patches about places (N, 2) px from the middle, (N, PATCH * PATCH), without their mean and of unit length.

    A patch of ``zoom`` (N,) covers that many times ``PATCH`` px of the image.
    """
    reach = np.arange(PATCH) - (PATCH - 1) / 2.0
    grid = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(1, -1, 2)
    places = to_columns(image, uv)[:, None] + zoom[:, None, None] * grid
    values = map_coordinates(image.astype(np.float32), places[..., ::-1].transpose(2, 0, 1), order=1, mode="nearest")
    values = values - values.mean(axis=1, keepdims=True)
    return np.asarray(values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-9))


def dissimilarity(first: Array, now: Array) -> Array:
    """Distance (N,) of patches of unit length: 0 for one and the same, 1.4 for two that have nothing in common.

    Shi & Tomasi (1994) sec. 4, of patches whose mean and contrast are taken out; in place of their affine motion a
    patch is zoomed by the measured disparity.
    """
    return np.asarray(np.linalg.norm(first - now, axis=1))
