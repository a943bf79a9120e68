"""The report of a characterised sensor: noise over disparity, bias map, distribution and autocorrelation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import stats

from consistency.referee.document.blocks import Cell, Chapter, Column, Document, Facts, Table, Text, table
from consistency.referee.document.colours import COLOURS, EXPECTED, SHADE, Look, style
from consistency.referee.document.drawing import (
    Axis,
    Band,
    Bars,
    Figure,
    Key,
    Line,
    Mark,
    Panel,
    Points,
    Rule,
    Sheet,
    Span,
    Stems,
)
from consistency.referee.pages.provenance import facts
from consistency.referee.types import Array
from consistency.stereo.characterising.characterise import NAMES, Characterisation, Coordinate
from consistency.stereo.characterising.sensor_text import counted, interval, sentences

MEASURED, NORMAL, STUDENT = Look(COLOURS[0]), Look("#333333"), Look(COLOURS[1], (5.0, 2.0))
LOCAL = Look("#7f7f7f", marker="s", size=3.4)
REACH = 5.0  # standard deviations of the distribution that are drawn
BINS = 60
LOCALLY = 20  # groups of equal size in which a standard deviation is drawn


def compose_sensor(of: Characterisation, manifest: Mapping[str, Any]) -> Document:
    """The document that HTML and PDF show."""
    chapters = [
        Chapter("estimates", "Estimates", "Estimates", (_estimates(of), *(Text(s) for s in sentences(of)))),
        Chapter("disparity", "Noise over disparity", "Disparity", (_over_disparity(of),)),
    ]
    if of.bias is not None and of.bias.grid.known.any():
        chapters.append(Chapter("bias", "Bias over the image", "Bias", (_bias_map(of),)))
    chapters += [
        Chapter("shape", "Distribution and whiteness", "Shape", (_distribution(of), *_correlation(of))),
        Chapter("provenance", "Provenance", "Provenance", (Facts(tuple(facts(dict(manifest)))),)),
    ]
    return Document(f"Sensor: {of.source}", counted(of) + ".", tuple(chapters))


def _estimates(of: Characterisation) -> Table:
    heads = ("Coordinate", "Noise (px)", "Correlation", "Offset share", "1/nu", "Kurtosis", "Pooled (px)")
    columns = tuple(Column(head, number=i > 0) for i, head in enumerate(heads))
    rows: list[tuple[Cell, ...]] = []
    for c in of.coordinates:
        texts = ("–" if e is None else interval(e, 2) for e in (c.correlation, c.offset, c.tails.weight))
        pooled = f"{c.pooled:.3g}" if np.isfinite(c.pooled) else "–"
        rows.append((c.name, interval(c.sigma, 3), *texts, f"{c.tails.excess_kurtosis:.2f}", pooled))
    caption = f"Intervals hold together with {100 * (1 - of.level.rate):g} %; 1/nu is 0 for a Gaussian noise."
    return table(columns, rows, "Estimates of the sensor", caption=caption)


# --- figures ----------------------------------------------------------------------------------------


def _over_disparity(of: Characterisation) -> Figure:
    """Standard deviation of disparity over disparity, as fig. 5c of Herath et al. (2007)."""
    d, sd = local_spread(of)
    marks: list[Mark] = []
    if of.growth is not None:
        nodes = of.growth.nodes
        value, low, high = (np.array([getattr(s, key) for s in of.growth.sigma]) for key in ("value", "low", "high"))
        marks += [Band(nodes, low, high, SHADE), Line(nodes, value, MEASURED), Points(nodes, value, MEASURED)]
    marks.append(Points(d, sd, LOCAL, tips=(("disparity", "@x{0.0} px"), ("sd", "@y{0.000} px"))))
    marks.append(Rule("y", of.coordinates[2].sigma.value, EXPECTED))
    axis = Axis("disparity (px)", log=True, digits=(1, 2, 5))
    panel = Panel(axis, Axis("sd of d (px)", start=0.0), tuple(marks), "Standard deviation of disparity over disparity")
    keys = (
        Key("sigma of d", MEASURED, marked=True),
        Key("interval", SHADE, "band"),
        Key("all of a group", LOCAL, "points"),
    )
    caption = (
        "Standard deviation of disparity over disparity (fig. 5c). Line: noise at the nodes, with its interval. "
        "Squares: standard deviation of groups of equal size, bias and offsets in it. Rule: sigma of all together."
    )
    return Figure("Noise over disparity", caption, (panel,), (Sheet((panel,), 2.2, keys=keys),), keys)


def local_spread(of: Characterisation) -> tuple[Array, Array]:
    """Median disparity and standard deviation of r of disparity, px, in groups of about equal size."""
    order = np.argsort(of.kept.ideal[:, 2])
    groups = [g for g in np.array_split(order, min(LOCALLY, max(len(order) // 20, 1))) if len(g) > 1]
    d = np.array([np.median(of.kept.ideal[g, 2]) for g in groups])
    return d, np.array([of.kept.r[g, 2].std(ddof=1) for g in groups])


def _bias_map(of: Characterisation) -> Figure:
    assert of.bias is not None
    grid = of.bias.grid
    reach = 1.15 * max(float(np.nanmax(np.abs(of.bias.value) + of.bias.half)), 0.1)
    panels = []
    for k, name in enumerate(NAMES):
        value, half = (a[k].reshape(len(grid.v), -1) for a in (of.bias.value, of.bias.half))
        marks: list[Mark] = [Rule("y", 0.0, EXPECTED)]
        for row in range(len(grid.v)):
            look = style(row)
            marks.append(Line(grid.u, value[row], look))
            tips = (("u", "@x"), ("bias", "@y{0.00} px"), ("interval", "± @half{0.00} px"))
            marks.append(Points(grid.u, value[row], look, tips=tips, columns={"half": half[row]}))
        y = Axis(f"bias of {name} (px)", window=(-reach, reach))
        panels.append(Panel(Axis("u (px)"), y, tuple(marks), f"Bias of {name} over the image", title=name))
    keys = tuple(Key(f"v = {v:.0f} px", style(row), marked=True) for row, v in enumerate(grid.v))
    middle = float(np.nanmedian(of.bias.half))
    caption = (
        f"Bias of u, v and d at the nodes of the map (fig. 8), before any shrinkage; the median of the intervals is "
        f"±{middle:.2g} px. Nodes with too few data are left out."
    )
    sheets = (Sheet(tuple(panels), 2.2, keys=keys),)
    return Figure("Bias map", caption, tuple(panels), sheets, keys, layout="three")


def _distribution(of: Characterisation) -> Figure:
    """Standardised residuals beside the normal distribution, as fig. 5a and 6."""
    panels = tuple(_histogram(c) for c in of.coordinates)
    keys = (Key("normal", NORMAL), Key("Student's", STUDENT))
    caption = (
        "Residuals over their standard deviation (fig. 5a and 6), with the normal density and, where tails are "
        "heavier, Student's of the estimated degrees of freedom."
    )
    return Figure("Distribution", caption, panels, (Sheet(panels, 2.0, keys=keys),), keys, layout="three")


def _histogram(c: Coordinate) -> Panel:
    edges = np.linspace(-REACH, REACH, BINS + 1)
    height, _ = np.histogram(np.clip(c.residuals, -REACH, REACH), edges, density=True)
    x = np.linspace(-REACH, REACH, 201)
    marks: list[Mark] = [Bars(edges, height, replace(MEASURED, alpha=0.5)), Line(x, stats.norm.pdf(x), NORMAL)]
    if c.tails.weight.low > 0:
        nu = 1.0 / c.tails.weight.value
        marks.append(Line(x, stats.t.pdf(x, nu, scale=np.sqrt(max(1.0 - 2.0 / nu, 0.05))), STUDENT))
    alt = f"Distribution of the residuals of {c.name}"
    return Panel(Axis("residual / sd"), Axis("density", start=0.0), tuple(marks), alt, title=c.name)


def _correlation(of: Characterisation) -> tuple[Figure, ...]:
    """Autocorrelation along tracks; none where rows have no order in time."""
    if not any(np.isfinite(c.lags).any() for c in of.coordinates) or of.coordinates[0].correlation is None:
        return ()
    found = np.concatenate([np.abs(c.lags[np.isfinite(c.lags)]) for c in of.coordinates])
    reach = 1.15 * max(float(found.max()), 0.1)
    panels = []
    for c in of.coordinates:
        lags = np.flatnonzero(np.isfinite(c.lags)) + 1
        bound = float(np.nanmax(c.bounds))
        tips = (("lag", "@x"), ("autocorrelation", "@y{0.000}"))
        marks: tuple[Mark, ...] = (
            Span("y", -bound, bound, SHADE), Rule("y", 0.0, EXPECTED),
            Stems(lags, c.lags[lags - 1], MEASURED, tips=tips),
        )  # fmt: skip
        x = Axis("lag (steps)", window=(0.4, lags.max() + 0.6), whole=True)
        y = Axis("autocorrelation", "correlation", window=(-reach, reach))
        panels.append(Panel(x, y, marks, f"Autocorrelation of {c.name} along tracks", title=c.name))
    caption = (
        "Autocorrelation along tracks, pooled over all; if the noise is white, 95 % of the lags stay in the shading."
    )
    return (Figure("Autocorrelation", caption, tuple(panels), (Sheet(tuple(panels), 1.6),), layout="three"),)
