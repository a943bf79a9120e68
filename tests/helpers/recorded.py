"""Files read with options by name, as Python's :func:`consistency.read` has them, but all estimators of a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from consistency.diagnostics import Record
from consistency.referee.readers.options import Reading
from consistency.referee.readers.pipeline import read_files


def read_recordings(
    estimates: Path, truth: Path | None = None, covariance: Path | None = None, error: str | None = None, **options: Any
) -> list[Record]:
    return read_files.read_recordings(estimates, Reading(truth, covariance, error, **options))
