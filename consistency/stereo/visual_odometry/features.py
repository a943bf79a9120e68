"""SIFT features of images (Lowe 2004), by OpenCV, and their matches; an image is brought to 8-bit grey first.

Matches pass a ratio and a mutual test, an epipolar gate, and the circle over four images.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.types import Array, Indices
from consistency.stereo.visual_odometry.arrays import opencv
from consistency.stereo.visual_odometry.relative_pose import cross_matrix
from consistency.stereo.visual_odometry.rig import StereoRig, is_rectified

COUNT = 3000  # strongest features of an image; at 1226 x 370 px that is nearly all of them
GREY = np.array([0.299, 0.587, 0.114])  # ITU-R BT.601 weights of red, green and blue
RATIO = 0.8  # distance of the best match over that of the second best, Lowe (2004) sec. 7.1
EPIPOLAR_PX = 2.0  # distance from the epipolar line; rectified images of a good calibration keep below 1
BAND = 32  # rows of rectified images that are matched at once; time only
NEVER = -2.0  # below every cosine


@dataclass(frozen=True)
class Features:
    """SIFT features of an image, N of them."""

    uv: Array  # (N, 2), px, column and row, the centre of the first pixel is (0, 0)
    scale: Array  # (N,), px, standard deviation of the Gaussian of the level where each was found
    descriptors: Array  # (N, 128), of unit length

    def __len__(self) -> int:
        return len(self.uv)


def grey(image: Array, name: str = "image") -> Array:
    """An image (h, w), or (h, w, 3) or (h, w, 4) in the order red, green, blue, as 8-bit grey (h, w).

    16-bit images are scaled by 1/257; floats are taken as 0 to 255.

    Raises
    ------
    InputError
        Another shape or type, an empty image, a value that is not finite; ``name`` says which.
    """
    image = np.asarray(image)
    if image.dtype.kind not in "uif" or image.size == 0:
        raise InputError(f"{name}: is not an image, but an array of {image.dtype} with shape {image.shape}")
    is_colour = image.ndim == 3 and image.shape[2] in (1, 3, 4)
    if image.ndim != 2 and not is_colour:
        raise InputError(f"{name}: shape {image.shape}; an image is (h, w) or (h, w, 3)")
    if image.dtype == np.uint8 and image.ndim == 2:
        return np.ascontiguousarray(image)
    values = image.astype(float)
    if image.dtype == np.uint16:
        values /= 257.0
    if not np.isfinite(values).all():
        raise InputError(f"{name}: holds a pixel that is not a finite number")
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[:, :, 0]
    elif values.ndim == 3:
        values = values[:, :, :3] @ GREY
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def sift(image: Array, count: int = COUNT, name: str = "image") -> Features:
    """The ``count`` strongest SIFT features of an image (h, w), in the order in which OpenCV finds them.

    ``enable_precise_upscale`` keeps the pixels of the doubled first octave where they are; without it all
    features of that octave stand 0.25 px beside their place.

    Raises
    ------
    InputError
        OpenCV is not installed, or ``image`` is none.
    """
    cv2 = opencv()
    detector = cv2.SIFT_create(nfeatures=count, enable_precise_upscale=True)
    points, descriptors = detector.detectAndCompute(grey(image, name), None)
    if not points:
        return Features(np.empty((0, 2)), np.empty(0), np.empty((0, 128), np.float32))
    length = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return Features(
        np.asarray(cv2.KeyPoint_convert(points), float),
        0.5 * np.array([point.size for point in points]),  # OpenCV's size is a diameter
        descriptors / np.maximum(length, 1e-9),
    )


class StereoFeatures(NamedTuple):
    """Features of both images that a rig has taken, and their matches, row by row of ``pairs``."""

    rig: StereoRig
    left: Features
    right: Features
    pairs: Indices  # (M, 2), rows in left and right; each feature at most once


def mutual_matches(
    first: Array,
    second: Array,
    allowed: Array | None = None,
    ratio: float = RATIO,
) -> Indices:
    """Rows (M, 2) of descriptors (N, k) and (K, k) that are each other's nearest, sorted by the first.

    Parameters
    ----------
    first, second : descriptors of unit length
    allowed : (N, K), whether two may match at all, or None for all; what is not allowed is not a second best either
    ratio : the nearest must be closer than ``ratio`` times the second nearest, in the direction first to second
    """
    if not len(first) or not len(second):
        return np.empty((0, 2), np.int64)
    likeness = np.asarray(first @ second.T)  # cosines
    if allowed is not None:
        likeness[~allowed] = NEVER
    rows = np.arange(len(first))
    best = likeness.argmax(axis=1)
    nearest = likeness[rows, best]
    mutual = nearest == likeness.max(axis=0)[best]
    likeness[rows, best] = NEVER
    near = _distances(nearest)
    far = _distances(likeness.max(axis=1))
    good = (nearest > NEVER) & mutual & (near < ratio * far)
    good &= np.bincount(best[good], minlength=len(second))[best] == 1  # equal descriptors tell nothing
    return np.column_stack([rows, best])[good]


def _distances(cosines: Array) -> Array:
    """Distances of descriptors of unit length."""
    return np.sqrt(np.maximum(2.0 - 2.0 * cosines, 0.0))


def epipolar_gate(
    rig: StereoRig,
    left: Array,
    right: Array,
    tolerance: float = EPIPOLAR_PX,
) -> Array:
    """Whether pixels (N, 2) of the left and (K, 2) of the right image may show one point, shape (N, K).

    The right pixel lies within ``tolerance`` px of the epipolar line of the left one. In rectified images that
    is a difference of rows, and the right column must not exceed the left one by more than ``tolerance``.
    """
    lines = homogeneous(left) @ fundamental(rig).T  # (N, 3) in the right image
    length = np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    lines = lines / np.maximum(length, 1e-12)
    distance = lines.astype(np.float32) @ homogeneous(right).T.astype(np.float32)
    near = np.abs(distance, out=distance) <= tolerance
    if is_rectified(rig):
        furthest = left[:, 0] - (rig.K_left[0, 2] - rig.K_right[0, 2]) + tolerance
        near &= furthest.astype(np.float32)[:, None] >= right[:, 0].astype(np.float32)
    return near


def fundamental(rig: StereoRig) -> Array:
    """F (3, 3) with x_right' F x_left = 0 for homogeneous pixels of one point, Hartley & Zisserman (2003) eq. 9.2."""
    cross = cross_matrix(-rig.R.T @ rig.t)
    return np.linalg.inv(rig.K_right).T @ cross @ rig.R.T @ np.linalg.inv(rig.K_left)


def homogeneous(uv: Array) -> Array:
    """Pixels (N, 2) with a 1 behind each, (N, 3)."""
    return np.column_stack([uv, np.ones(len(uv))])


def stereo_matches(
    rig: StereoRig,
    left: Features,
    right: Features,
    ratio: float = RATIO,
    tolerance: float = EPIPOLAR_PX,
) -> StereoFeatures:
    """Features of both images matched within the epipolar gate.

    Rectified images are matched in bands of rows. Around a band, the right features reach ``tolerance`` further and
    the left ones twice that, so that each left feature of the band and each right one it may match has all its rivals.
    """
    edges = np.array([-np.inf, np.inf])
    if is_rectified(rig):
        edges = np.insert(edges, 1, np.arange(BAND, rig.image_size[1], BAND))
    groups = [np.empty((0, 2), np.int64)]
    for low, high in itertools.pairwise(edges):
        i = _within(left.uv[:, 1], low - 2 * tolerance, high + 2 * tolerance)
        j = _within(right.uv[:, 1], low - tolerance, high + tolerance)
        allowed = epipolar_gate(rig, left.uv[i], right.uv[j], tolerance)
        matches = mutual_matches(left.descriptors[i], right.descriptors[j], allowed, ratio)
        pairs = np.column_stack([i[matches[:, 0]], j[matches[:, 1]]])
        of_band = _within(left.uv[:, 1], low, high)
        groups.append(pairs[np.isin(pairs[:, 0], of_band)])
    pairs = np.concatenate(groups)
    return StereoFeatures(rig, left, right, pairs[np.argsort(pairs[:, 0])])


def _within(values: Array, low: float, high: float) -> Indices:
    return np.flatnonzero((values >= low) & (values < high))


def circular_matches(before: StereoFeatures, after: StereoFeatures, ratio: float = RATIO) -> Indices:
    """Rows (M, 2) in ``before.pairs`` and ``after.pairs`` whose circle left0-right0-right1-left1-left0 closes.

    Left is matched with left and right with right over time, among features that have a stereo match; both must
    say the same. The two stereo matches of the circle are those of the pairs.
    """
    first = before.left.descriptors[before.pairs[:, 0]]
    second = after.left.descriptors[after.pairs[:, 0]]
    left = mutual_matches(first, second, ratio=ratio)
    first = before.right.descriptors[before.pairs[:, 1]]
    second = after.right.descriptors[after.pairs[:, 1]]
    right = mutual_matches(first, second, ratio=ratio)
    count = max(len(after.pairs), 1)
    one_number = np.array([count, 1])  # for each match
    closed = np.intersect1d(left @ one_number, right @ one_number, assume_unique=True)
    return np.column_stack(np.divmod(closed, count))
