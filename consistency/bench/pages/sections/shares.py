"""Consistency of a triangulated point by depth, as Valencia & Andrade-Cetto (2018) fig. 2.2."""

from __future__ import annotations

from dataclasses import dataclass, replace

from consistency.bench.pages.experiment_tables import extra_table
from consistency.bench.pages.report_input import Report
from consistency.referee.document.colours import EXPECTED, SHADE, style
from consistency.referee.document.drawing import Axis, Figure, Key, Line, Panel, Points, Rule, Sheet, Span
from consistency.referee.pages.section import FRONT_END, Section
from consistency.referee.types import Array

FILE = "frontend_fig22.parquet"
COLUMNS = ["depth", "share", "expected", "low", "high", "false_alarm", "noise", "samples", "repetitions"]
PERCENT = 100.0
MEASURED = replace(style(0), size=5.2)
KEYS = (
    Key("measured", MEASURED, marked=True), Key("95 %", EXPECTED), Key("accepted by the test", SHADE, "band"),
)  # fmt: skip


@dataclass(frozen=True)
class Shares:
    """Repetitions inside the 95 % region against depth, as Valencia & Andrade-Cetto (2018) fig. 2.2; n depths."""

    depth: Array  # (n,), m
    share: Array  # (n,), of the repetitions
    expected: float
    accepted: tuple[float, float]  # least and greatest share that the binomial test accepts
    false_alarm: float  # of that test at one depth
    noise: float  # px
    samples: int  # of a repetition
    repetitions: int


def read(report: Report) -> Shares | None:
    """The table of the folder; None where the file does not exist.

    Raises
    ------
    InputError
        The file is damaged or lacks a column.
    """
    table = extra_table(report.folder / FILE, COLUMNS)
    if table is None:
        return None
    table = table.sort_values("depth")
    same = table.iloc[0]
    return Shares(
        depth=table["depth"].to_numpy(),
        share=table["share"].to_numpy(),
        expected=float(same["expected"]),
        accepted=(float(same["low"]), float(same["high"])),
        false_alarm=float(same["false_alarm"]),
        noise=float(same["noise"]),
        samples=int(same["samples"]),
        repetitions=int(same["repetitions"]),
    )


def figures(found: Shares) -> tuple[Figure, ...]:
    """Shares over depth, with what the test accepts."""
    low, high = (PERCENT * end for end in found.accepted)
    share, tips = PERCENT * found.share, (("depth", "@x m"), ("inside", "@y{0.0} %"))
    panel = Panel(
        Axis("depth (m)", start=0.0), Axis("inside the 95 % region (%)"),
        (Span("y", low, high, SHADE), Rule("y", PERCENT * found.expected, EXPECTED),
         Line(found.depth, share, MEASURED), Points(found.depth, share, MEASURED, tips=tips)),
        "Share of repetitions inside the 95 % region over depth",
    )  # fmt: skip
    title = "A triangulated point, by depth (fig. 2.2)"
    return (Figure(title, caption(found), (panel,), (Sheet((panel,), 2.0, keys=KEYS),), KEYS),)


def caption(found: Shares) -> str:
    """What the figure of shares by depth shows."""
    return (
        f"Share of {found.repetitions} repetitions whose N times mean NEES lies inside the 95 % region, by depth of "
        f"the triangulated point: {found.samples} noisy matches ({found.noise:g} px) a repetition, as Valencia & "
        "Andrade-Cetto (2018) fig. 2.2, which shows one repetition and no depth. A right covariance is at "
        f"{100 * found.expected:g} % (line). Shaded: shares that the binomial test accepts; it rejects a right "
        f"covariance at one depth with probability {100 * found.false_alarm:g} % at most."
    )


SECTION = Section(FRONT_END, read, figures)
