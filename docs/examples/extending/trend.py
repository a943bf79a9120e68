"""Whether the NEES of runs depends on their order."""

from __future__ import annotations

import numpy as np
from scipy import stats

from consistency.referee.types import Array


def trend(means: Array) -> float:
    """P value of Spearman's rank correlation between the mean NEES of runs (N,) and their order."""
    known = means[np.isfinite(means)]
    return float(stats.spearmanr(np.arange(len(known)), known).pvalue) if len(known) > 2 else float("nan")
