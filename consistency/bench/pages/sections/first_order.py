"""Where the first-order covariance of the stereo front-end breaks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd

from consistency.bench.pages.exhibits import extra_table
from consistency.bench.pages.report_input import Report
from consistency.referee.document.colours import ACCEPTED, EXPECTED, LIMIT, REJECTED
from consistency.referee.document.drawing import Axis, Figure, Key, Panel, Points, Rule, Sheet
from consistency.referee.errors import InputError
from consistency.referee.pages.section import FRONT_END, Section

FILE = "first_order.parquet"
COLUMNS = ["ratio", "nees_ratio", "runs", "failed", "points", "false_alarm", "holds"]
NAMES = ["estimator", "status"]
SHOWN = "consistent"  # the verdict of a cell that is accepted
PERCENT = 100.0
WIDE = 200.0  # a log axis that spans more has room for powers of ten only
ACROSS = 3  # panels beside each other on paper
KEYS = (
    Key("accepted", ACCEPTED, "points"), Key("not accepted", REJECTED, "points"), Key("expected", EXPECTED),
    Key("rule: up to here", LIMIT),
)  # fmt: skip


def read(report: Report) -> pd.DataFrame | None:
    """The table of the folder; None where the file does not exist.

    Raises
    ------
    InputError
        The file is damaged, lacks a column or holds what a log axis cannot show.
    """
    path = report.folder / FILE
    table = extra_table(path, COLUMNS, NAMES, missing=["nees_ratio"])
    if table is None:
        return None
    for column in ("ratio", "nees_ratio"):
        if (bad := (table[column] <= 0).to_numpy()).any():
            row = int(np.flatnonzero(bad)[0])
            raise InputError(f"{path}: column '{column}', row {row}: not above zero ({table[column].iloc[row]:g})")
    return table


def figures(table: pd.DataFrame) -> tuple[Figure, ...]:
    """A panel for each estimator, all on the same axes; a row is a cell of depth, baseline and pixel noise."""
    panels = tuple(_panel(str(name), cells, table) for name, cells in table.groupby("estimator", sort=False))
    sheet = Sheet(panels, 0.3 + 1.6 * -(-len(panels) // ACROSS), columns=ACROSS, keys=KEYS)
    return (Figure("Where first order breaks", caption(table), panels, (sheet,), KEYS, layout="three"),)


def _panel(estimator: str, cells: pd.DataFrame, table: pd.DataFrame) -> Panel:
    nees, accepted = table["nees_ratio"].dropna(), (cells["status"] == SHOWN).to_numpy()
    digits = (1,) if nees.size and nees.max() > WIDE * nees.min() else (1, 2, 5)
    tips = (("noise / disparity", "@x{0.0} %"), ("mean NEES / dof", "@y{0.00}"))
    x, y = PERCENT * cells["ratio"].to_numpy(), cells["nees_ratio"].to_numpy()
    points = (
        Points(x[chosen], y[chosen], replace(look, alpha=0.8), tips=tips)
        for look, chosen in ((ACCEPTED, accepted), (REJECTED, ~accepted))
    )
    return Panel(
        Axis("noise / disparity (%)", log=True, share="noise", digits=(1,)),
        Axis("mean NEES / dof", log=True, share="nees", digits=digits),
        (Rule("y", 1.0, EXPECTED), Rule("x", PERCENT * table["holds"].iloc[0], LIMIT), *points),
        f"Mean NEES of {estimator} over the noise of the disparity",
        height=250,
        title=f"{estimator}: {accepted.sum()} of {len(accepted)} accepted",
    )


def caption(table: pd.DataFrame) -> str:
    same, lost = table.iloc[0], table["nees_ratio"].isna().sum()
    note = f" Cells without a run that is left, not drawn: {lost}." if lost else ""
    return (
        "Where the first-order covariance breaks: mean NEES over its degrees of freedom against the standard deviation "
        "of the disparity over the disparity, log axes; a cell is one depth, baseline and pixel noise, with "
        f"{same['runs']:.0f} runs ({same['points']:.0f} points a registration, one a triangulation; "
        f"{table['failed'].sum():.0f} runs failed in all). Accepted: the referee shows the errors to be consistent. It "
        "finds a right covariance at fault in a "
        f"cell with probability {100 * same['false_alarm']:g} % at most, and a wrong one also for what the mean does "
        f"not show, such as bias or outliers. First order is asked to hold up to {100 * same['holds']:g} % (dashed). "
        f"Source: this project, beyond Valencia & Andrade-Cetto (2018) sec. 2.3.3.{note}"
    )


SECTION = Section(FRONT_END, read, figures)
