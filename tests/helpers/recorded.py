"""Files read with options by name, as Python's :func:`consistency.read` has them, but all estimators of a file."""

from consistency.referee.readers.options import make_reading
from consistency.referee.readers.pipeline import read_files


def read_recordings(estimates, truth=None, covariance=None, error=None, **options):
    return read_files.read_recordings(
        estimates, make_reading(truth=truth, covariance=covariance, error=error, **options)
    )


def notes_of(record):
    """All notes of a record, each on a line."""
    return "\n".join(record.origin.notes)
