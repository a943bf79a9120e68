"""Is the filter honest? Arrays in, records out; needs numpy and scipy only.

No table, no plot and no file belongs here.
"""

from consistency.diagnostics.coverage import coverage, rmse
from consistency.diagnostics.intervals import anees_interval, chi2_mean_interval
from consistency.diagnostics.nees import anees, nees
from consistency.diagnostics.normality import Normality, normality
from consistency.diagnostics.verdict import judge

__all__ = [
    "Normality",
    "anees",
    "anees_interval",
    "chi2_mean_interval",
    "coverage",
    "judge",
    "nees",
    "normality",
    "rmse",
]
