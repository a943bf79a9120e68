"""What a filter is, and what it is told before the first step."""

from consistency.referee.extras import explained_import

with explained_import(__name__):
    from consistency.bench.protocols import Filter, Problem, TrialTruth, WholeTrial

__all__ = ["Filter", "Problem", "TrialTruth", "WholeTrial"]
