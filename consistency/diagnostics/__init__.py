"""Statistics of filter consistency: arrays in, records out; needs numpy and scipy only.

Tables, plots and files do not belong here.
"""

from consistency.diagnostics.band import Band, simultaneous_band
from consistency.diagnostics.bias import Hotelling, hotelling, t_squared
from consistency.diagnostics.comparison import Comparison, Difference, RunSummary, compare, summary
from consistency.diagnostics.coverage import coverage, coverage_interval, rmse
from consistency.diagnostics.credibility import noncredibility
from consistency.diagnostics.direction import Largest, largest_direction
from consistency.diagnostics.distribution import Pit, pit
from consistency.diagnostics.ends import EarlyEnds, early_ends
from consistency.diagnostics.eprocess import EProcess, e_process, ever
from consistency.diagnostics.equivalence import equivalence
from consistency.diagnostics.independence import Independence, independence
from consistency.diagnostics.innovations import NisTest, Whiteness, nis_of, nis_test, nis_whiteness, whiteness
from consistency.diagnostics.intervals import anees_interval, chi2_mean_interval
from consistency.diagnostics.landmarks import map_score
from consistency.diagnostics.lost import lost_bound
from consistency.diagnostics.monitor import Alarm, Monitor
from consistency.diagnostics.nees import anees, nees
from consistency.diagnostics.normality import Normality, normality
from consistency.diagnostics.outliers import Outlier, outliers
from consistency.diagnostics.planning import (
    PilotPlan,
    detectable_ratio,
    gate_runs,
    lost_runs,
    pilot_plan,
    power_of,
    required_runs,
)
from consistency.diagnostics.questions import answers
from consistency.diagnostics.records import (
    Answer,
    Equivalence,
    Evidence,
    Interval,
    JointNees,
    MapScore,
    RejectionScore,
    Settings,
    Verdict,
)
from consistency.diagnostics.rejection import clustered_share, rejection_score
from consistency.diagnostics.scale import MeanTest, mean_test, ratio_interval
from consistency.diagnostics.sequential import Design, follow, look, sequential_design, speaks
from consistency.diagnostics.shape import identity_statistic, mean_shape, sphericity
from consistency.diagnostics.verdict import judge
from consistency.diagnostics.whitening import spread_steps, standardise, whiten

__all__ = [
    "Alarm",
    "Answer",
    "Band",
    "Comparison",
    "Design",
    "Difference",
    "EProcess",
    "EarlyEnds",
    "Equivalence",
    "Evidence",
    "Hotelling",
    "Independence",
    "Interval",
    "JointNees",
    "Largest",
    "MapScore",
    "MeanTest",
    "Monitor",
    "NisTest",
    "Normality",
    "Outlier",
    "PilotPlan",
    "Pit",
    "RejectionScore",
    "RunSummary",
    "Settings",
    "Verdict",
    "Whiteness",
    "anees",
    "anees_interval",
    "answers",
    "chi2_mean_interval",
    "clustered_share",
    "compare",
    "coverage",
    "coverage_interval",
    "detectable_ratio",
    "e_process",
    "early_ends",
    "equivalence",
    "ever",
    "follow",
    "gate_runs",
    "hotelling",
    "identity_statistic",
    "independence",
    "judge",
    "largest_direction",
    "look",
    "lost_bound",
    "lost_runs",
    "map_score",
    "mean_shape",
    "mean_test",
    "nees",
    "nis_of",
    "nis_test",
    "nis_whiteness",
    "noncredibility",
    "normality",
    "outliers",
    "pilot_plan",
    "pit",
    "power_of",
    "ratio_interval",
    "rejection_score",
    "required_runs",
    "rmse",
    "sequential_design",
    "simultaneous_band",
    "speaks",
    "sphericity",
    "spread_steps",
    "standardise",
    "summary",
    "t_squared",
    "whiten",
    "whiteness",
]
