"""Consistency of a triangulated point by depth, as Valencia & Andrade-Cetto (2018) fig. 2.2."""

from __future__ import annotations

from dataclasses import replace

import pandas as pd

from consistency.bench.pages.exhibits import extra_table
from consistency.bench.pages.report_input import Report
from consistency.referee.document.colours import EXPECTED, SHADE, style
from consistency.referee.document.drawing import Axis, Figure, Key, Line, Panel, Points, Rule, Sheet, Span
from consistency.referee.pages.section import FRONT_END, Section

FILE = "frontend_fig22.parquet"
COLUMNS = ["depth", "share", "expected", "low", "high", "false_alarm", "noise", "samples", "repetitions"]
PERCENT = 100.0
MEASURED = replace(style(0), size=5.2)
KEYS = (
    Key("measured", MEASURED, marked=True), Key("95 %", EXPECTED), Key("accepted by the test", SHADE, "band"),
)  # fmt: skip


def read(report: Report) -> pd.DataFrame | None:
    """The table of the folder, by depth; None where the file does not exist."""
    table = extra_table(report.folder / FILE, COLUMNS)
    return None if table is None else table.sort_values("depth")


def figures(table: pd.DataFrame) -> tuple[Figure, ...]:
    """Share of the repetitions inside the 95 % region against depth, with what the binomial test accepts."""
    same, depth, share = table.iloc[0], table["depth"].to_numpy(), PERCENT * table["share"].to_numpy()
    tips = (("depth", "@x m"), ("inside", "@y{0.0} %"))
    panel = Panel(
        Axis("depth (m)", start=0.0), Axis("inside the 95 % region (%)"),
        (Span("y", PERCENT * same["low"], PERCENT * same["high"], SHADE),
         Rule("y", PERCENT * same["expected"], EXPECTED),
         Line(depth, share, MEASURED), Points(depth, share, MEASURED, tips=tips)),
        "Share of repetitions inside the 95 % region over depth",
    )  # fmt: skip
    title = "A triangulated point, by depth (fig. 2.2)"
    return (Figure(title, caption(same), (panel,), (Sheet((panel,), 2.0, keys=KEYS),), KEYS),)


def caption(same: pd.Series[float]) -> str:
    """What the figure of shares by depth shows; ``same`` is a row, for what all rows have."""
    return (
        f"Share of {same['repetitions']:.0f} repetitions whose N times mean NEES lies inside the 95 % region, by depth "
        f"of the triangulated point: {same['samples']:.0f} noisy matches ({same['noise']:g} px) a repetition, as "
        "Valencia & Andrade-Cetto (2018) fig. 2.2, which shows one repetition and no depth. A right covariance is at "
        f"{100 * same['expected']:g} % (line). Shaded: shares that the binomial test accepts; it rejects a right "
        f"covariance at one depth with probability {100 * same['false_alarm']:g} % at most."
    )


SECTION = Section(FRONT_END, read, figures)
