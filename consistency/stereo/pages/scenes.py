"""Consistency of a registration by scene, as Valencia & Andrade-Cetto (2018) fig. 2.3."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd

from consistency.bench.pages.exhibits import extra_table
from consistency.bench.pages.report_input import Report
from consistency.referee.document.colours import EXPECTED, SHADE, style
from consistency.referee.document.drawing import Axis, Figure, Intervals, Key, Panel, Rule, Sheet, Span
from consistency.referee.pages.section import FRONT_END, Section

FILE = "frontend_fig23.parquet"
COLUMNS = [
    "far", "noise", "repetitions", "ratio", "ratio_least", "ratio_most", "region_low", "region_high", "confidence",
    "near", "points", "samples", "dof",
]  # fmt: skip
MEASURED = replace(style(0), width=1.3, size=5.0)
KEYS = (
    Key("mean, middle 95 %", MEASURED, marked=True), Key("expected", EXPECTED),
    Key("95 % region of one", SHADE, "band"),
)  # fmt: skip


def read(report: Report) -> pd.DataFrame | None:
    """The table of the folder, a row for each scene; None where the file does not exist.

    Raises
    ------
    InputError
        The file is damaged or lacks a column.
    """
    return extra_table(report.folder / FILE, COLUMNS)


def figures(found: pd.DataFrame) -> tuple[Figure, ...]:
    """A row for each scene: N times the mean NEES over its degrees of freedom, 1 is right."""
    same, ends = found.iloc[0], found[["ratio_least", "ratio", "ratio_most"]].to_numpy()
    low, ratio, high = ends.T
    region = float(same["region_low"]), float(same["region_high"])
    labels = tuple(f"{scene.far:g} m, {scene.noise:g} px ({scene.repetitions:.0f}×)" for scene in found.itertuples())
    tips = (("scene", "@scene"), ("mean", "@x{0.000}"), ("middle 95 %", "@low{0.000} to @high{0.000}"))
    marks = Intervals(np.arange(len(labels)), ratio, low, high, MEASURED, tips=tips, columns={"scene": labels})
    window = min(region[0], float(ends.min())) - 0.03, max(region[1], float(ends.max())) + 0.03
    panel = Panel(
        Axis(f"N times mean NEES / {same['dof']:.0f}", window=window), Axis("", rows=labels),
        (Span("x", *region, SHADE), Rule("x", 1.0, EXPECTED), marks),
        "N times mean NEES over what is expected, by scene", height=80 + 30 * len(labels),
    )  # fmt: skip
    sheet = Sheet((panel,), 0.55 + 0.22 * len(labels), keys=KEYS)
    return (Figure("A registration, by scene (fig. 2.3)", caption(found), (panel,), (sheet,), KEYS),)


def caption(found: pd.DataFrame) -> str:
    same = found.iloc[0]
    percent = f"{100 * same['confidence']:g} %"
    return (
        f"N times the mean NEES of {same['samples']:.0f} registrations (SVD) of {same['points']:.0f} points over the "
        f"{same['dof']:.0f} that is expected, by the scene's greatest depth and the noise, in brackets the number of "
        f"repetitions; as Valencia & Andrade-Cetto (2018) fig. 2.3. Scenes begin at {same['near']:g} m. Dot: mean of "
        f"the repetitions; bar: their middle 95 %. Shaded: the {percent} region of one repetition, which a right "
        f"covariance leaves in {100 * (1 - same['confidence']):.2g} % of them. Above 1 is overconfident."
    )


SECTION = Section(FRONT_END, read, figures)
