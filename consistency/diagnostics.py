"""Statistics of filter consistency: arrays in, records and verdicts out; NumPy and SciPy are enough."""

from consistency.referee.diagnostics.comparison import Comparison, Difference, RunSummary, compare, summary
from consistency.referee.diagnostics.judge_record import follow, judge, look, speaks
from consistency.referee.diagnostics.maps.map_nees import map_score
from consistency.referee.diagnostics.maps.rejected_observations import clustered_share, rejection_score
from consistency.referee.diagnostics.monitoring.monitor import Alarm, Monitor
from consistency.referee.diagnostics.planning.early_stopping import Design, sequential_design
from consistency.referee.diagnostics.planning.pilot import PilotPlan, pilot_plan
from consistency.referee.diagnostics.questions.anees_band import Band, simultaneous_band
from consistency.referee.diagnostics.questions.bias import Hotelling, hotelling, t_squared
from consistency.referee.diagnostics.questions.equivalence import equivalence
from consistency.referee.diagnostics.questions.independence import Independence, independence
from consistency.referee.diagnostics.questions.innovations import Whiteness, nis_of, nis_test, nis_whiteness, whiteness
from consistency.referee.diagnostics.questions.lost_runs import early_ends, lost_bound
from consistency.referee.diagnostics.questions.outliers import Outlier, outliers
from consistency.referee.diagnostics.questions.scale import MeanTest, mean_test, ratio_interval
from consistency.referee.diagnostics.questions.shape import (
    Largest,
    identity_statistic,
    largest_direction,
    mean_shape,
    sphericity,
)
from consistency.referee.diagnostics.records.record import Evidence, JointNees, MapRecord, Record, Rejections
from consistency.referee.diagnostics.records.skipped_start import Skip
from consistency.referee.diagnostics.records.whitening import spread_steps, standardise, whiten
from consistency.referee.diagnostics.statistics.coverage_and_rmse import (
    coverage,
    coverage_interval,
    noncredibility,
    rmse,
)
from consistency.referee.diagnostics.statistics.nees import (
    EProcess,
    Pit,
    anees,
    anees_interval,
    chi2_mean_interval,
    e_process,
    ever,
    nees,
    pit,
)
from consistency.referee.diagnostics.statistics.normality import Normality, normality
from consistency.referee.diagnostics.statistics.number_of_runs import (
    detectable_ratio,
    gate_runs,
    lost_runs,
    power_of,
    required_runs,
)
from consistency.referee.diagnostics.verdict.answers import Settings, answers
from consistency.referee.diagnostics.verdict.parts import (
    Answer,
    EarlyEnds,
    Equivalence,
    Interval,
    NisTest,
    RejectionScore,
)
from consistency.referee.diagnostics.verdict.verdict import MapScore, Verdict

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
    "Skip",
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
