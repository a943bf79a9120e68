"""Statistics of filter consistency: arrays in, records out; needs numpy and scipy only.

Tables, plots and files do not belong here.
"""

from consistency.referee.diagnostics.band import Band, simultaneous_band
from consistency.referee.diagnostics.bias import Hotelling, hotelling, t_squared
from consistency.referee.diagnostics.comparison import Comparison, Difference, RunSummary, compare, summary
from consistency.referee.diagnostics.coverage import coverage, coverage_interval, rmse
from consistency.referee.diagnostics.credibility import noncredibility
from consistency.referee.diagnostics.direction import Largest, largest_direction
from consistency.referee.diagnostics.early_ending import EarlyEnds, early_ends
from consistency.referee.diagnostics.early_stopping import Design, follow, look, sequential_design, speaks
from consistency.referee.diagnostics.eprocess import EProcess, e_process, ever
from consistency.referee.diagnostics.equivalence import equivalence
from consistency.referee.diagnostics.independence import Independence, independence
from consistency.referee.diagnostics.innovations import NisTest, Whiteness, nis_of, nis_test, nis_whiteness, whiteness
from consistency.referee.diagnostics.intervals import anees_interval, chi2_mean_interval
from consistency.referee.diagnostics.judging import judge
from consistency.referee.diagnostics.landmarks import map_score
from consistency.referee.diagnostics.lost import lost_bound
from consistency.referee.diagnostics.monitor import Alarm, Monitor
from consistency.referee.diagnostics.nees import anees, nees
from consistency.referee.diagnostics.nees_distribution import Pit, pit
from consistency.referee.diagnostics.normality import Normality, normality
from consistency.referee.diagnostics.outliers import Outlier, outliers
from consistency.referee.diagnostics.planning import (
    PilotPlan,
    detectable_ratio,
    gate_runs,
    lost_runs,
    pilot_plan,
    power_of,
    required_runs,
)
from consistency.referee.diagnostics.questions import answers
from consistency.referee.diagnostics.record import Evidence, JointNees, MapRecord, Record, Rejections
from consistency.referee.diagnostics.rejection import clustered_share, rejection_score
from consistency.referee.diagnostics.scale import MeanTest, mean_test, ratio_interval
from consistency.referee.diagnostics.shape import identity_statistic, mean_shape, sphericity
from consistency.referee.diagnostics.verdict_parts import (
    Answer,
    Equivalence,
    Interval,
    MapScore,
    RejectionScore,
    Settings,
    Verdict,
)
from consistency.referee.diagnostics.whitening import spread_steps, standardise, whiten

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
    "MapRecord",
    "MapScore",
    "MeanTest",
    "Monitor",
    "NisTest",
    "Normality",
    "Outlier",
    "PilotPlan",
    "Pit",
    "Record",
    "RejectionScore",
    "Rejections",
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
