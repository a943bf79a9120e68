"""Monte Carlo studies: filters on trials, on this machine or on others, and the scripts of experiments."""

from consistency.referee.extras import explained_import

with explained_import(__name__):
    from consistency.bench.runs.executors import executor_for
    from consistency.bench.runs.montecarlo import run_log, run_trials, run_until_decided
    from consistency.bench.runs.outcomes_to_results import Interrupted
    from consistency.bench.runs.reproduce_findings import Study, read_findings, reproduce

__all__ = [
    "Interrupted",
    "Study",
    "executor_for",
    "read_findings",
    "reproduce",
    "run_log",
    "run_trials",
    "run_until_decided",
]
