"""The workers of this machine."""

from __future__ import annotations

from consistency.referee.errors import InputError


def worker_count(jobs: int) -> int:
    """Number of workers that ``jobs`` stands for: itself, or one a core for -1; raises InputError for another."""
    if jobs == 0 or jobs < -1:
        raise InputError(f"jobs must be at least 1, or -1 for one worker a core, got {jobs}")
    if jobs > 0:
        return jobs
    import joblib  # slow to load

    return int(joblib.cpu_count())
