"""Small inverses, and what importing the front-end loads."""

import numpy as np
import pytest

from consistency.stereo.visual_odometry import arrays


@pytest.mark.parametrize("m", [2, 3, 6])
def test_inverses_are_lapacks(m, rng):
    root = rng.normal(size=(40, m, m))
    C = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(m)
    inverse, definite = arrays.symmetric_inverses(C)
    assert definite.all()
    assert inverse == pytest.approx(np.linalg.inv(C), rel=1e-8)


@pytest.mark.parametrize("m", [2, 3, 6])
def test_what_is_not_positive_definite_is_told(m, rng):
    turn = np.linalg.qr(rng.normal(size=(m, m)))[0]
    for k in range(m):
        values = np.ones(m)
        values[k] = -0.1
        C = np.stack([np.eye(m), turn * values @ turn.T])
        inverse, definite = arrays.symmetric_inverses(C)
        assert definite.tolist() == [True, False]
        assert np.isfinite(inverse).all()
    assert arrays.symmetric_inverses(-np.eye(m)[None])[1].tolist() == [False]
    assert arrays.symmetric_inverses(np.full((1, m, m), np.nan))[1].tolist() == [False]
