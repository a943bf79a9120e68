"""Records that worlds, filters, runs and verdicts share."""

from consistency.bench.types import Control, Estimates, Finding, Gaussian, Info, Map, Observation, Trial
from consistency.referee.fit_covariance.covariance_ratios import Ratio
from consistency.referee.types import Failure

__all__ = ["Control", "Estimates", "Failure", "Finding", "Gaussian", "Info", "Map", "Observation", "Ratio", "Trial"]
