"""The extra tables that experiments leave beside their findings, read with checks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from consistency.bench.store.parquet import read_frame
from consistency.referee.errors import InputError
from consistency.referee.parsing import one_line, reading


def extra_table(
    path: Path, numbers: Sequence[str], texts: Sequence[str] = (), missing: Sequence[str] = ()
) -> pd.DataFrame | None:
    """Columns of a Parquet file; None where the file does not exist.

    Parameters
    ----------
    numbers : columns of finite numbers, read as float
    texts : columns of names
    missing : columns of ``numbers`` that may hold NaN

    Raises
    ------
    InputError
        The file is damaged, has no rows, lacks a column or holds what the column may not.
    """
    if not path.exists():
        return None
    table = read_frame(path)
    wanted = [*numbers, *texts]
    if absent := [column for column in wanted if column not in table.columns]:
        raise InputError(f"{path}: column '{absent[0]}' is missing; needed: {', '.join(wanted)}")
    if not table.columns.is_unique:
        raise InputError(f"{path}: a column is there twice; write the folder again")
    if table.empty:
        raise InputError(f"{path}: has no rows; write the folder again")
    for column in numbers:
        with reading(path, f"column '{column}' cannot be read as numbers"):
            values = pd.to_numeric(table[column], errors="coerce").to_numpy(float, na_value=np.nan)
        bad = ~np.isfinite(values) & (table[column].notna().to_numpy() | (column not in missing))
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            value = one_line(table[column].iloc[row], 60)
            raise InputError(f"{path}: column '{column}', row {row}: not a finite number ({value})")
        table[column] = values
    return table[wanted]
