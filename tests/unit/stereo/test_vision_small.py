"""Small inverses, and what importing the front-end loads."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from consistency.stereo import visual_odometry
from consistency.stereo.visual_odometry.cameras import batch_inverses


@pytest.mark.parametrize("m", [2, 3, 6])
def test_inverses_are_lapacks(m: int, rng: np.random.Generator) -> None:
    root = rng.normal(size=(40, m, m))
    C = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(m)
    inverse, definite = batch_inverses.inverse(C)
    assert definite.all()
    assert inverse == pytest.approx(np.linalg.inv(C), rel=1e-8)


@pytest.mark.parametrize("m", [2, 3, 6])
def test_what_is_not_positive_definite_is_told(m: int, rng: np.random.Generator) -> None:
    turn = np.linalg.qr(rng.normal(size=(m, m)))[0]
    for k in range(m):
        values = np.ones(m)
        values[k] = -0.1
        C = np.stack([np.eye(m), turn * values @ turn.T])
        inverse, definite = batch_inverses.inverse(C)
        assert definite.tolist() == [True, False]
        assert np.isfinite(inverse).all()
    assert batch_inverses.inverse(-np.eye(m)[None])[1].tolist() == [False]
    assert batch_inverses.inverse(np.full((1, m, m), np.nan))[1].tolist() == [False]


def test_the_mathematics_needs_no_opencv() -> None:
    code = "import sys, consistency.stereo.visual_odometry; print('cv2' in sys.modules, 'matplotlib' in sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert out.stdout.split() == ["False", "False"]


def test_public_names() -> None:
    for name in visual_odometry.__all__:
        assert getattr(visual_odometry, name) is not None
    with pytest.raises(AttributeError, match="visual_odometry attribute nonsense"):
        _ = visual_odometry.nonsense
