"""The stereo front-end: from matches or images to a relative pose with its covariance.

Only :func:`relative_motion` and what else works on images needs OpenCV, the extra ``vision``; that is loaded on first
use.
"""

from __future__ import annotations

import importlib
from typing import Any

from consistency.vision.consensus import register_ransac
from consistency.vision.errors import ConsensusError, ConvergenceError, DegenerateError, GimbalLockError, PointError
from consistency.vision.pose import RelativePose, compose, invert
from consistency.vision.propagation import implicit_covariance, registration_covariance, triangulation_covariance
from consistency.vision.refinement import Refined, refine_reprojection, register_weighted
from consistency.vision.registration import register_horn, register_svd
from consistency.vision.rig import StereoRig, triangulable, triangulate

__all__ = [
    "ConsensusError",
    "ConvergenceError",
    "DegenerateError",
    "GimbalLockError",
    "PointError",
    "Refined",
    "RelativePose",
    "StereoRig",
    "compose",
    "implicit_covariance",
    "invert",
    "refine_reprojection",
    "register_horn",
    "register_ransac",
    "register_svd",
    "register_weighted",
    "registration_covariance",
    "triangulable",
    "triangulate",
    "triangulation_covariance",
]

_ON_IMAGES = {"relative_motion": "motion"}  # name -> module that needs OpenCV


def __getattr__(name: str) -> Any:
    if name not in _ON_IMAGES:
        raise AttributeError(f"module 'consistency.vision' has no attribute '{name}'")
    return getattr(importlib.import_module(f"consistency.vision.{_ON_IMAGES[name]}"), name)
