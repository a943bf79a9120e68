"""Consistency of a registration by scene, as Valencia & Andrade-Cetto (2018) fig. 2.3."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

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


@dataclass(frozen=True)
class Scene:
    """N times the mean NEES of one scene over its degrees of freedom, as Valencia & Andrade-Cetto (2018) fig. 2.3."""

    far: float  # m
    noise: float  # px
    repetitions: int
    ratio: float  # mean of the repetitions; 1 is right
    spread: tuple[float, float]  # of the middle 95 % of the repetitions

    @property
    def label(self) -> str:
        """Depth, noise and number of repetitions."""
        return f"{self.far:g} m, {self.noise:g} px ({self.repetitions}×)"


@dataclass(frozen=True)
class Scenes:
    """All scenes, and what is the same in them."""

    scenes: tuple[Scene, ...]
    region: tuple[float, float]  # where one repetition lies, of the degrees of freedom
    confidence: float  # of the region
    near: float  # m
    points: int
    samples: int  # of a repetition
    dof: int

    @property
    def window(self) -> tuple[float, float]:
        """Drawn range: all values, the region and some room."""
        ends = [end for scene in self.scenes for end in (scene.ratio, *scene.spread)]
        return min(self.region[0], *ends) - 0.03, max(self.region[1], *ends) + 0.03


def read(report: Report) -> Scenes | None:
    """The table of the folder; None where the file does not exist.

    Raises
    ------
    InputError
        The file is damaged or lacks a column.
    """
    table = extra_table(report.folder / FILE, COLUMNS)
    if table is None:
        return None
    same = table.iloc[0]
    return Scenes(
        scenes=tuple(
            Scene(
                row["far"], row["noise"], int(row["repetitions"]), row["ratio"], (row["ratio_least"], row["ratio_most"])
            )
            for row in table.to_dict("records")
        ),
        region=(float(same["region_low"]), float(same["region_high"])),
        confidence=float(same["confidence"]),
        near=float(same["near"]),
        points=int(same["points"]),
        samples=int(same["samples"]),
        dof=int(same["dof"]),
    )


def figures(found: Scenes) -> tuple[Figure, ...]:
    """A row for each scene."""
    ratio, low, high = np.array([(scene.ratio, *scene.spread) for scene in found.scenes]).T
    labels = tuple(scene.label for scene in found.scenes)
    tips = (("scene", "@scene"), ("mean", "@x{0.000}"), ("middle 95 %", "@low{0.000} to @high{0.000}"))
    marks = Intervals(np.arange(len(labels)), ratio, low, high, MEASURED, tips=tips, columns={"scene": labels})
    panel = Panel(
        Axis(f"N times mean NEES / {found.dof}", window=found.window), Axis("", rows=labels),
        (Span("x", *found.region, SHADE), Rule("x", 1.0, EXPECTED), marks),
        "N times mean NEES over what is expected, by scene", height=80 + 30 * len(labels),
    )  # fmt: skip
    sheet = Sheet((panel,), 0.55 + 0.22 * len(labels), keys=KEYS)
    return (Figure("A registration, by scene (fig. 2.3)", caption(found), (panel,), (sheet,), KEYS),)


def caption(found: Scenes) -> str:
    """What the figure of scenes shows."""
    percent = f"{100 * found.confidence:g} %"
    return (
        f"N times the mean NEES of {found.samples} registrations (SVD) of {found.points} points over the {found.dof} "
        "that is expected, by the scene's greatest depth and the noise, in brackets the number of repetitions; as "
        f"Valencia & Andrade-Cetto (2018) fig. 2.3. Scenes begin at {found.near:g} m. Dot: mean of the repetitions; "
        "bar: their middle 95 %. "
        f"Shaded: the {percent} region of one repetition, which a right covariance leaves in "
        f"{100 * (1 - found.confidence):.2g} % of them. Above 1 is overconfident."
    )


SECTION = Section(FRONT_END, read, figures)
