"""Where the first-order covariance of the stereo front-end breaks."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from consistency.bench.pages.experiment_tables import extra_table
from consistency.bench.pages.report_input import Report
from consistency.referee.document.colours import ACCEPTED, EXPECTED, LIMIT, REJECTED
from consistency.referee.document.drawing import Axis, Figure, Key, Panel, Points, Rule, Sheet
from consistency.referee.errors import InputError
from consistency.referee.pages.section import FRONT_END, Section
from consistency.referee.types import Array

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


@dataclass(frozen=True)
class Cells:
    """One estimator over n cells of depth, baseline and pixel noise."""

    estimator: str
    ratio: Array  # (n,), noise of the disparity over the disparity
    nees: Array  # (n,), mean NEES over its degrees of freedom, NaN where no run was left
    accepted: Array  # (n,), bool: the verdict is consistent

    @property
    def title(self) -> str:
        """Name, and how many cells are accepted."""
        return f"{self.estimator}: {int(self.accepted.sum())} of {len(self.accepted)} accepted"


@dataclass(frozen=True)
class FirstOrder:
    """Where first order breaks, estimator by estimator."""

    estimators: tuple[Cells, ...]
    runs: int  # of a cell
    failed: int  # of all runs of all cells
    points: int  # of a registration
    false_alarm: float  # of a verdict
    holds: float  # noise over disparity up to which first order is asked to hold


def read(report: Report) -> FirstOrder | None:
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
    same = table.iloc[0]
    estimators = (
        Cells(str(name), part["ratio"].to_numpy(), part["nees_ratio"].to_numpy(), (part["status"] == SHOWN).to_numpy())
        for name, part in table.groupby("estimator", sort=False)
    )
    return FirstOrder(
        estimators=tuple(estimators),
        runs=int(same["runs"]),
        failed=int(table["failed"].sum()),
        points=int(same["points"]),
        false_alarm=float(same["false_alarm"]),
        holds=float(same["holds"]),
    )


def figures(found: FirstOrder) -> tuple[Figure, ...]:
    """A panel for each estimator, all on the same axes."""
    panels = tuple(_panel(cells, found) for cells in found.estimators)
    sheet = Sheet(panels, 0.3 + 1.6 * -(-len(panels) // ACROSS), columns=ACROSS, keys=KEYS)
    return (Figure("Where first order breaks", caption(found), panels, (sheet,), KEYS, layout="three"),)


def _panel(cells: Cells, found: FirstOrder) -> Panel:
    nees = np.concatenate([of.nees[np.isfinite(of.nees)] for of in found.estimators])
    digits = (1,) if nees.size and nees.max() > WIDE * nees.min() else (1, 2, 5)
    tips = (("noise / disparity", "@x{0.0} %"), ("mean NEES / dof", "@y{0.00}"))
    points = (
        Points(PERCENT * cells.ratio[chosen], cells.nees[chosen], replace(look, alpha=0.8), tips=tips)
        for look, chosen in ((ACCEPTED, cells.accepted), (REJECTED, ~cells.accepted))
    )
    return Panel(
        Axis("noise / disparity (%)", log=True, share="noise", digits=(1,)),
        Axis("mean NEES / dof", log=True, share="nees", digits=digits),
        (Rule("y", 1.0, EXPECTED), Rule("x", PERCENT * found.holds, LIMIT), *points),
        f"Mean NEES of {cells.estimator} over the noise of the disparity",
        height=250,
        title=cells.title,
    )


def caption(found: FirstOrder) -> str:
    """What the map of cells shows."""
    lost = sum(int(np.isnan(cells.nees).sum()) for cells in found.estimators)
    note = f" Cells without a run that is left, not drawn: {lost}." if lost else ""
    return (
        "Where the first-order covariance breaks: mean NEES over its degrees of freedom against the standard deviation "
        "of the disparity over the disparity, log axes; a cell is one depth, baseline and pixel noise, with "
        f"{found.runs} runs ({found.points} points a registration, one a triangulation; {found.failed} runs failed "
        "in all). Accepted: the referee shows the errors to be consistent. It finds a right covariance at fault in a "
        f"cell with probability {100 * found.false_alarm:g} % at most, and a wrong one also for what the mean does not "
        f"show, such as bias or outliers. First order is asked to hold up to {100 * found.holds:g} % (dashed). Source: "
        f"this project, beyond Valencia & Andrade-Cetto (2018) sec. 2.3.3.{note}"
    )


SECTION = Section(FRONT_END, read, figures)
