"""The stereo sensor in rendered images, as Herath et al. (2007) fig. 5, 6, 8 and 9 have the real one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from consistency.reporting.blocks import Block, Cell, Column, table
from consistency.reporting.drawing import Axis, Bars, Figure, Key, Line, Panel, Points, Rule, Sheet
from consistency.reporting.looks import LIMIT, Look, style
from consistency.reporting.model import Report
from consistency.reporting.section import Part, Section
from consistency.reporting.tables import extra_table
from consistency.types import Array

IMAGES = Part("images", "The stereo sensor in rendered images", "Rendered images")
SAMPLES, GAUSS = Look("#c4c4c4"), replace(style(0), width=1.4)
KEYS = (Key("samples", SAMPLES, "band"), Key("Gaussian", GAUSS))
BINS, REACH = 80, 5.0  # of a histogram, and the standard deviations that it spans


@dataclass(frozen=True)
class Kept:
    """A table that an experiment leaves: its columns, and what is drawn of it."""

    name: str
    numbers: tuple[str, ...]
    texts: tuple[str, ...]
    show: Callable[[pd.DataFrame], Block]


def read(report: Report) -> tuple[tuple[Kept, pd.DataFrame], ...] | None:
    """The tables of the folder; None where there is none.

    Raises
    ------
    InputError
        A file is damaged or lacks a column.
    """
    found = []
    for kept in TABLES:
        data = extra_table(report.folder / f"{kept.name}.parquet", kept.numbers, kept.texts)
        if data is not None:
            found.append((kept, data))
    return tuple(found) or None


def show(found: tuple[tuple[Kept, pd.DataFrame], ...]) -> tuple[Block, ...]:
    """A block for each table."""
    return tuple(kept.show(data) for kept, data in found)


# --- disparity -----------------------------------------------------------------------------------


def growth(stops: pd.DataFrame) -> Figure:
    """Noise of disparity over disparity, fig. 5c."""
    marks: list[Line | Rule] = [Rule("y", float(stops["sigma"].iloc[0]), LIMIT)]
    keys = [Key("sec. 4.5", LIMIT)]
    for k, (residual, part) in enumerate(stops.sort_values("disparity").groupby("residual")):
        for name, text, dash in (("within", "about track means", ()), ("pooled", "pooled", (4.0, 2.0))):
            look = replace(style(k), dash=dash)
            marks.append(Line(part["disparity"].to_numpy(), part[name].to_numpy(), look))
            keys.append(Key(f"{text}, k1 left over {residual:g}", look))
    panel = Panel(
        Axis("disparity (px)"),
        Axis("sd of disparity (px)", "sd (px)", log=True, digits=(1, 2, 5)),
        tuple(marks),
        "Standard deviation of disparity over disparity",
    )
    caption = (
        f"Standard deviation of disparity at {len(stops) // stops['residual'].nunique()} stops before a wall, with the "
        "means of the tracks subtracted and pooled at each stop, where the rectification is right and where it leaves "
        "a radial distortion k1, opposite in both images; as Herath et al. (2007) fig. 5c. Their sec. 4.5 uses "
        f"{stops['sigma'].iloc[0]:g} px throughout."
    )
    return single("Noise of disparity", caption, panel, tuple(keys))


def pooled(bins: pd.DataFrame) -> Figure:
    """Errors of disparity about the means of their tracks, fig. 5a."""
    sd, edges = float(bins["sd"].iloc[0]), np.append(bins["low"].to_numpy(), bins["high"].iloc[-1])
    x = np.linspace(edges[0], edges[-1], 201)
    gauss = np.exp(-0.5 * (x / sd) ** 2) / (sd * np.sqrt(2.0 * np.pi))
    panel = Panel(
        Axis("error of d about the mean of its track (px)"),
        Axis("density (1/px)", start=0.0),
        (Bars(edges, bins["density"].to_numpy(), SAMPLES), Line(x, gauss, GAUSS)),
        "Distribution of errors of disparity about the means of tracks",
    )
    caption = (
        f"Errors of disparity about the means of their tracks, pooled over all stops, {int(bins['samples'].iloc[0])} "
        f"of them, with the Gaussian of the same standard deviation, {sd:.3f} px; as Herath et al. (2007) fig. 5a."
    )
    return single("Errors of disparity about track means", caption, panel, KEYS)


def biases(features: pd.DataFrame) -> Figure:
    """Mean error of each feature, fig. 8."""
    marks, keys = [], []
    for k, (left, part) in enumerate(features.groupby("left", sort=False)):
        look = replace(style(k), size=3.0)
        marks.append(Points(part["u"].to_numpy(), part["bias_d"].to_numpy(), look, tips=(("bias", "@y{0.00} px"),)))
        keys.append(Key(str(left), look, "points"))
    panel = Panel(Axis("u (px)"), Axis("mean error of d (px)"), tuple(marks), "Local biases of disparity over u")
    caption = (
        "Mean error of the disparity of each feature on a wall at a disparity of 14.7 px, by what the rectification "
        "leaves; as Herath et al. (2007) fig. 8, where biases are up to 2 px."
    )
    return single("Local biases of disparity", caption, panel, tuple(keys))


# --- u and v -------------------------------------------------------------------------------------


def tracking(errors: pd.DataFrame) -> Figure:
    """Errors of u and v, fig. 6."""
    panels = tuple(
        _histogram(
            part[name].to_numpy(),
            f"error of {name} (px)",
            f"attitude errs by {np.rad2deg(float(str(shake))):.1f} degrees",
        )
        for shake, part in errors.groupby("shake")
        for name in ("u", "v")
    )
    caption = (
        "Errors of features tracked from 1 m to 6 m, an image each 0.05 m, with the Gaussian of the same standard "
        "deviation; as Herath et al. (2007) fig. 6, where sd is 1.34 px in u and 1.53 px in v."
    )
    return Figure("Errors of tracking", caption, panels, (Sheet(panels, 3.6, columns=2, keys=KEYS),), KEYS, "pair")


def _histogram(errors: Array, label: str, title: str) -> Panel:
    sd = float(errors.std())
    count, edges = np.histogram(errors, BINS, (-REACH * sd, REACH * sd))
    x = np.linspace(edges[0], edges[-1], 201)
    gauss = np.exp(-0.5 * ((x - errors.mean()) / sd) ** 2) / (sd * np.sqrt(2.0 * np.pi))
    tips = (("error", "@left{0.00} to @right{0.00} px"), ("density", "@height{0.000}"))
    bars = Bars(edges, count / (len(errors) * np.diff(edges)), SAMPLES, tips)
    return Panel(
        Axis(label), Axis("density (1/px)", start=0.0), (bars, Line(x, gauss, GAUSS)),
        f"Distribution of the {label}, {title}", title=f"{title}: sd {sd:.2f} px",
    )  # fmt: skip


def junctions(features: pd.DataFrame) -> Figure:
    """How rigid a track is, and how much its patch has changed, fig. 9."""
    marks, keys = [], []
    for k, (kind, name) in enumerate(((0.0, "points"), (1.0, "junctions"))):
        part = features[features["junction"] == kind]
        look = replace(style(k), size=3.5, alpha=0.8)
        marks.append(Points(part["residual"].to_numpy(), part["dissimilarity"].to_numpy(), look))
        keys.append(Key(name, look, "points"))
    panel = Panel(
        Axis("distance from a rigid point (px)", log=True, digits=(1, 2, 5)),
        Axis("dissimilarity", log=True, digits=(1, 2, 5)),
        tuple(marks),
        "Dissimilarity over distance from a rigid point",
    )
    caption = (
        "Features where edges at two depths cross, beside corners of one surface, after 1 m of motion: rms distance of "
        "the track from that of the best rigid point, and dissimilarity of the patch from that of the first image (0: "
        "the same, 1.4: nothing in common); the case of Herath et al. (2007) fig. 9."
    )
    return single("Junctions", caption, panel, tuple(keys))


def survival(frames: pd.DataFrame) -> Figure:
    """Tracks alive and their errors over images, experiment 1."""
    cases = [(str(name), part) for name, part in frames.groupby("camera", sort=False)]
    keys = tuple(Key(name, style(k)) for k, (name, _) in enumerate(cases))

    def panel(column: str, label: str) -> Panel:
        lines = (Line(part["frame"].to_numpy(), part[column].to_numpy(), style(k)) for k, (_, part) in enumerate(cases))
        return Panel(Axis("image", share="image"), Axis(label, start=0.0), tuple(lines), f"{label} over images")

    panels = (panel("rms_u", "rms error of u (px)"), panel("rms_v", "rms error of v (px)"), panel("tracks", "tracks"))
    caption = (
        "Errors of u and v and tracks alive, of features selected in the first image, with the camera moving by 0.02 m "
        "an image and at rest; experiment 1 of Herath et al. (2007) sec. 3.3. Junctions and tracks that have drifted "
        "by more than 2 px are left out of the errors."
    )
    return Figure("Tracks over images", caption, panels, (Sheet(panels, 2.1, keys=keys),), keys, "three")


def budget(stages: pd.DataFrame) -> Block:
    """What each stage adds."""
    columns = (
        Column("Motion"),
        Column("Errors of"),
        *(Column(f"rms of {name} (px)") for name in "uvd"),
        Column("Kept"),
    )
    rows: list[tuple[Cell, ...]] = [
        (str(row.motion), str(row.stage), f"{row.u:.2f}", f"{row.v:.2f}", f"{row.d:.2f}", f"{row.kept:.1%}")
        for row in stages.itertuples()
    ]
    caption = "Noise budget of the chain of Herath et al. (2007) fig. 3: one stage with its errors, then all"
    return table(columns, rows, "Noise budget by stage", caption=caption)


def single(title: str, caption: str, panel: Panel, keys: tuple[Key, ...]) -> Figure:
    """A figure of one panel."""
    return Figure(title, caption, (panel,), (Sheet((panel,), 2.4, keys=keys),), keys)


TABLES = (
    Kept("images_stops", ("disparity", "within", "pooled", "residual", "sigma"), (), growth),
    Kept("images_fig5a", ("low", "high", "density", "sd", "samples"), (), pooled),
    Kept("images_bias", ("u", "bias_d"), ("left",), biases),
    Kept("images_fig6", ("u", "v", "shake"), (), tracking),
    Kept("images_fig9", ("junction", "residual", "dissimilarity"), (), junctions),
    Kept("images_exp1", ("frame", "tracks", "rms_u", "rms_v"), ("camera",), survival),
    Kept("images_budget", ("u", "v", "d", "kept"), ("motion", "stage"), budget),
)
SECTION = Section(IMAGES, read, show)
