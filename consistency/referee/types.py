"""Arrays, and a run that failed: what all packages share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]  # of floats, shape in the comment or docstring
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Failure:
    """A failed run, with the step of its failure."""

    filter: str
    run: int
    step: int
    reason: str
