"""SIFT features of one image (Lowe 2004), by OpenCV; an image is brought to 8-bit grey first."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.extras import MissingPackageError, remedy
from consistency.referee.types import Array

COUNT = 3000  # strongest features of an image; at 1226 x 370 px that is nearly all of them
GREY = np.array([0.299, 0.587, 0.114])  # ITU-R BT.601 weights of red, green and blue


@dataclass(frozen=True)
class Features:
    """SIFT features of an image, N of them."""

    uv: Array  # (N, 2), px, column and row, the centre of the first pixel is (0, 0)
    scale: Array  # (N,), px, standard deviation of the Gaussian of the level where each was found
    descriptors: Array  # (N, 128), of unit length

    def __len__(self) -> int:
        return len(self.uv)


def opencv() -> Any:
    """The module ``cv2``.

    Raises
    ------
    InputError
        OpenCV is not installed.
    """
    try:
        return importlib.import_module("cv2")
    except ImportError:
        raise MissingPackageError(f"an image needs {remedy('vision')}") from None


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
        raise InputError(f"{name}: is no image, but an array of {image.dtype} with shape {image.shape}")
    if not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] in (1, 3, 4))):
        raise InputError(f"{name}: shape {image.shape}; an image is (h, w) or (h, w, 3)")
    if image.dtype == np.uint8 and image.ndim == 2:
        return np.ascontiguousarray(image)
    values = image.astype(float) / (257.0 if image.dtype == np.uint16 else 1.0)
    if not np.isfinite(values).all():
        raise InputError(f"{name}: holds a pixel that is not a finite number")
    if values.ndim == 3:
        values = values[:, :, 0] if values.shape[2] == 1 else values[:, :, :3] @ GREY
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
