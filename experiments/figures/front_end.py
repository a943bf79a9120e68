"""The stereo front-end: how consistent its covariances are by depth, by scene, and where first order breaks."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from consistency.bench.pages.sections.published_findings import extra_table
from consistency.bench.pages.sections.report_input import Report
from consistency.referee.errors import InputError
from consistency.referee.show.blocks import ACCEPTED, BAND, EXPECTED, LIMIT, REJECTED, Figure, style
from consistency.referee.show.figures import (
    add_legend,
    canvas,
    dots,
    intervals,
    log_axis,
    name_rows,
    rows_of,
    stroke,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

CHAPTER = ("front-end", "Stereo front-end", "Stereo front-end")
ON_PAPER = True  # of a report of several studies
PERCENT = 100.0


def blocks(report: Report) -> tuple[Figure, ...]:
    """The figures whose tables the folder holds."""
    return (*by_depth(report), *by_scene(report), *first_order(report))


# --- a triangulated point by depth, as Valencia & Andrade-Cetto (2018) fig. 2.2 -------------------------

DEPTH_COLUMNS = ["depth", "share", "expected", "low", "high", "false_alarm", "noise", "samples", "repetitions"]


def shares(report: Report) -> pd.DataFrame | None:
    """The table of the folder, by depth; None where the file does not exist."""
    table = extra_table(report.folder / "frontend_fig22.parquet", DEPTH_COLUMNS)
    return None if table is None else table.sort_values("depth")


def by_depth(report: Report) -> tuple[Figure, ...]:
    """Share of the repetitions inside the 95 % region against depth, with what the binomial test accepts."""
    table = shares(report)
    if table is None:
        return ()
    same = table.iloc[0]

    def draw() -> Drawing:
        figure, (axes,) = canvas(1.9)
        low, high = PERCENT * same["low"], PERCENT * same["high"]
        axes.axhspan(low, high, color=BAND, linewidth=0, zorder=0.4, label="accepted by the test")
        axes.axhline(PERCENT * same["expected"], **stroke(EXPECTED), label="95 %")
        axes.plot(table["depth"], PERCENT * table["share"], label="measured", marker="o", **stroke(style(0)))
        axes.set(xlabel="depth (m)", ylabel="inside the 95 % region (%)")
        axes.set_xlim(left=0.0)
        return add_legend(figure)

    return (Figure("A triangulated point, by depth (fig. 2.2)", depth_caption(same), (draw,)),)


def depth_caption(same: pd.Series[float]) -> str:
    """What the figure of shares by depth shows; ``same`` is a row, for what all rows have."""
    return (
        f"Share of {same['repetitions']:.0f} repetitions whose N times mean NEES lies inside the 95 % region, by depth "
        f"of the triangulated point: {same['samples']:.0f} noisy matches ({same['noise']:g} px) a repetition, as "
        "Valencia & Andrade-Cetto (2018) fig. 2.2, which shows one repetition and no depth. A right covariance is at "
        f"{100 * same['expected']:g} % (line). Shaded: shares that the binomial test accepts; it rejects a right "
        f"covariance at one depth with probability {100 * same['false_alarm']:g} % at most."
    )


# --- a registration by scene, as Valencia & Andrade-Cetto (2018) fig. 2.3 --------------------------------

SCENE_COLUMNS = [
    "far", "noise", "repetitions", "ratio", "ratio_least", "ratio_most", "region_low", "region_high", "confidence",
    "near", "points", "samples", "dof",
]  # fmt: skip


def scenes(report: Report) -> pd.DataFrame | None:
    """The table of the folder, a row for each scene; None where the file does not exist."""
    return extra_table(report.folder / "frontend_fig23.parquet", SCENE_COLUMNS)


def by_scene(report: Report) -> tuple[Figure, ...]:
    """A row for each scene: N times the mean NEES over its degrees of freedom, 1 is right."""
    found = scenes(report)
    if found is None:
        return ()
    same, ends = found.iloc[0], found[["ratio", "ratio_least", "ratio_most"]].to_numpy()
    region = float(same["region_low"]), float(same["region_high"])
    labels = [f"{scene.far:g} m, {scene.noise:g} px ({scene.repetitions:.0f}×)" for scene in found.itertuples()]

    def draw() -> Drawing:
        figure, (axes,) = canvas(0.5 + 0.2 * len(labels))
        axes.set_xlim(min(region[0], float(ends.min())) - 0.03, max(region[1], float(ends.max())) + 0.03)
        name_rows(axes, labels)
        axes.axvspan(*region, color=BAND, linewidth=0, zorder=0.4, label="95 % region of one")
        axes.axvline(1.0, **stroke(EXPECTED), label="expected")
        intervals(axes, np.arange(len(labels)), ends, replace(style(0), width=1.1), "mean, middle 95 %")
        axes.set_xlabel(f"N times mean NEES / {same['dof']:.0f}")
        return add_legend(figure)

    return (Figure("A registration, by scene (fig. 2.3)", scene_caption(found), (draw,)),)


def scene_caption(found: pd.DataFrame) -> str:
    """What the figure shows."""
    same = found.iloc[0]
    percent = f"{100 * same['confidence']:g} %"
    return (
        f"N times the mean NEES of {same['samples']:.0f} registrations (SVD) of {same['points']:.0f} points over the "
        f"{same['dof']:.0f} that is expected, by the scene's greatest depth and the noise, in brackets the number of "
        f"repetitions; as Valencia & Andrade-Cetto (2018) fig. 2.3. Scenes begin at {same['near']:g} m. Dot: mean of "
        f"the repetitions; bar: their middle 95 %. Shaded: the {percent} region of one repetition, which a right "
        f"covariance leaves in {100 * (1 - same['confidence']):.2g} % of them. Above 1 is overconfident."
    )


# --- where the first-order covariance breaks ------------------------------------------------------------

CELL_COLUMNS = ["ratio", "nees_ratio", "runs", "failed", "points", "false_alarm", "holds"]
SHOWN = "consistent"  # the verdict of a cell that is accepted


def cells_of(report: Report) -> pd.DataFrame | None:
    """The table of the folder; None where the file does not exist.

    Raises
    ------
    InputError
        The file is damaged, lacks a column or holds what a log axis cannot show.
    """
    path = report.folder / "first_order.parquet"
    table = extra_table(path, CELL_COLUMNS, ["estimator", "status"], missing=["nees_ratio"])
    if table is None:
        return None
    for column in ("ratio", "nees_ratio"):
        if (bad := (table[column] <= 0).to_numpy()).any():
            row = int(np.flatnonzero(bad)[0])
            raise InputError(f"{path}: column '{column}', row {row}: not above zero ({table[column].iloc[row]:g})")
    return table


def first_order(report: Report) -> tuple[Figure, ...]:
    """A panel for each estimator, all on the same axes; a row is a cell of depth, baseline and pixel noise."""
    table = cells_of(report)
    if table is None:
        return ()
    groups = [(str(name), cells) for name, cells in table.groupby("estimator", sort=False)]

    def draw() -> Drawing:
        columns = rows_of(len(groups))
        rows = -(-len(groups) // columns)
        figure, panels = canvas(1.6 * rows, columns, len(groups), sharex=True, sharey=True)
        for axes, (name, cells) in zip(panels, groups, strict=True):
            _draw_cells(axes, name, cells, float(table["holds"].iloc[0]))
        for axes in panels[-columns:]:
            axes.set_xlabel("noise / disparity (%)")
        for axes in panels[::columns]:
            axes.set_ylabel("mean NEES / dof")
        for side in "xy":
            log_axis(panels[0], side)
        return add_legend(figure)

    return (Figure("Where first order breaks", cells_caption(table), (draw,)),)


def accepted(cells: pd.DataFrame) -> np.ndarray:
    """Which cells the referee accepts."""
    return (cells["status"] == SHOWN).to_numpy()


def _draw_cells(axes: Axes, estimator: str, cells: pd.DataFrame, holds: float) -> None:
    axes.axhline(1.0, **stroke(EXPECTED), label="expected")
    axes.axvline(PERCENT * holds, **stroke(LIMIT), label="rule: up to here")
    x, y, good = PERCENT * cells["ratio"].to_numpy(), cells["nees_ratio"].to_numpy(), accepted(cells)
    for look, rows, label in ((ACCEPTED, good, "accepted"), (REJECTED, ~good, "not accepted")):
        axes.plot(x[rows], y[rows], label=label, **dots(replace(look, size=3.0, alpha=0.8)))
    axes.set_title(f"{estimator}: {good.sum()} of {len(good)} accepted")


def cells_caption(table: pd.DataFrame) -> str:
    """What the figure shows."""
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
