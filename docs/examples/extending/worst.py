"""The run that an estimator was worst in."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from consistency.commands.shared_options import read_files, reads_files
from consistency.referee.readers.options import Reading


@reads_files
def worst_command(
    files: Reading, path: Annotated[Path, typer.Argument(help="Estimates, as 'analyse' takes them.")]
) -> None:
    """The run with the largest mean NEES of each estimator in files."""
    import numpy as np

    for record in read_files(path, files):
        means = np.nanmean(record.errors.nees, axis=1)
        print(f"{record.name}: run {record.run_numbers[means.argmax()]}, mean NEES {means.max():.4g}")
