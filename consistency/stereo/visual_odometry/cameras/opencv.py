"""OpenCV, which is an extra."""

from __future__ import annotations

import importlib
from typing import Any

from consistency.referee.extras import MissingPackageError, remedy


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
