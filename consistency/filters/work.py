"""Work arrays of a trial, made once: no step allocates."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from consistency.filters.jit import inner


class Work(NamedTuple):
    """``m`` is the most landmarks seen in a step, ``n`` the final size of the state, L = 3 + 3 m.

    What belongs to sigma points alone is empty in other filters.
    """

    known: Any  # (m,) rows of the observations whose landmark is in the state
    at: Any  # (m,) and its offset there
    label: Any  # (m,) and its label
    zhat: Any  # (3 m,) expected observations
    scale: Any  # (L,) diagonal of what is factored
    S: Any  # (3 m, 3 m) innovation covariance, upper half
    A: Any  # (3 m, n + 1) Cov(z, x); in the column after the state the innovation
    rows: Any  # (L, n) rows of P of the robot and the seen landmarks
    Hp: Any  # (m, 3, 3) Jacobians
    Hl: Any  # (m, 3, 3)
    Jp: Any  # (3, 3) of a new landmark
    Jz: Any  # (3, 3)
    small: Any  # (3, 3)
    F: Any  # (3, 3) of sigma points
    moved: Any  # (7, 3) sigma points of the robot
    U: Any  # (L, L) upper root of the prior of the variables involved
    block: Any  # (L, L) that prior, where it is singular
    Z: Any  # (2 L + 1, 3 m) projected sigma points
    Mt: Any  # (L, 3 m) transposed statistical linearisation


@inner
def make_work(n: int, m: int, sigma_points: bool) -> Any:
    """Arrays for a state of up to ``n`` variables and up to ``m`` landmarks in a step."""
    L = 3 + 3 * m if sigma_points else 3
    return Work(
        np.empty(m, np.int64),
        np.empty(m, np.int64),
        np.empty(m, np.int64),
        np.empty(3 * m),
        np.empty(3 + 3 * m),
        np.empty((3 * m, 3 * m)),
        np.empty((3 * m, n + 1)),
        np.empty((3 + 3 * m, n)),
        np.empty((m, 3, 3)),
        np.empty((m, 3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((7, 3)),
        np.empty((L, L)),
        np.empty((L, L)),
        np.empty((2 * L + 1, 3 * m)),
        np.empty((L, 3 * m)),
    )
