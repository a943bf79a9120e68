"""The extra tables that experiments leave beside their findings, read with checks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from consistency.errors import InputError


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
    try:
        table: pd.DataFrame = pq.read_table(path).to_pandas()
    except (OSError, pa.ArrowException) as error:
        raise InputError(f"{path}: cannot be read, damaged or cut short ({str(error).splitlines()[0]})") from None
    wanted = [*numbers, *texts]
    if absent := [column for column in wanted if column not in table.columns]:
        raise InputError(f"{path}: column '{absent[0]}' is missing; needed: {', '.join(wanted)}")
    if table.empty:
        raise InputError(f"{path}: has no rows; write the folder again")
    for column in numbers:
        values = pd.to_numeric(table[column], errors="coerce").to_numpy(float)
        bad = ~np.isfinite(values) & (table[column].notna().to_numpy() | (column not in missing))
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            raise InputError(f"{path}: column '{column}', row {row}: not a finite number ({table[column].iloc[row]})")
        table[column] = values
    return table[wanted]
