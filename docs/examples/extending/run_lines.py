"""Errors and covariances as lines of JSON, one for each run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from consistency.referee.diagnostics.record import Record
from consistency.referee.errors import InputError
from consistency.referee.readers.formats.archives import estimator_of_arrays
from consistency.referee.readers.options import Reading
from consistency.referee.readers.truth_matching import Estimator


def read_run_lines(path: Path, reading: Reading, poses_alone: bool) -> list[Estimator | Record]:
    """The estimator of a file with ``errors`` (steps, n) and ``covariances`` (steps, n, n) in each line."""
    if poses_alone:
        raise InputError(f"{path}: holds errors and no poses")
    try:
        runs = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        arrays = {key: np.array([run[key] for run in runs], float) for key in ("errors", "covariances")}
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{path}: each line must be an object with errors and covariances of as many steps") from None
    return [estimator_of_arrays(path, arrays, reading)]
