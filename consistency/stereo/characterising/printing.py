"""What a terminal shows of a characterisation."""

from __future__ import annotations

import numpy as np
from rich.table import Table as RichTable

from consistency.referee.terminal.table import open_console
from consistency.stereo.characterising.characterise import Characterisation
from consistency.stereo.characterising.tails import Estimate
from consistency.stereo.characterising.wording import counted, interval, sentences


def print_characterisation(of: Characterisation) -> None:
    """One row a coordinate, then a sentence for each answer."""
    table = RichTable(box=None, pad_edge=False)
    for column in ("", "noise px", "correlation", "offset share", "1/nu", "kurtosis", "pooled px"):
        table.add_column(column, justify="right" if column else "left")
    for c in of.coordinates:
        table.add_row(
            c.name, interval(c.sigma), _or_dash(c.correlation), _or_dash(c.offset), _or_dash(c.tails.weight),
            f"{c.tails.excess_kurtosis:.2f}", f"{c.pooled:.4g}" if np.isfinite(c.pooled) else "-",
        )  # fmt: skip
    console = open_console()
    console.print(counted(of), markup=False, soft_wrap=not console.is_terminal)
    console.print(table)
    for line in sentences(of):
        console.print(line, markup=False, soft_wrap=not console.is_terminal)


def _or_dash(estimate: Estimate | None) -> str:
    return "-" if estimate is None else interval(estimate, 2)
