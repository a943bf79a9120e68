"""Reports on stereo sensors: noise over disparity, bias map, distribution and autocorrelation."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import stats

from consistency.referee.pages.write_pages import facts, write_document, write_file
from consistency.referee.show.blocks import (
    BAND,
    COLOURS,
    EXPECTED,
    Chapter,
    Document,
    Facts,
    Figure,
    Look,
    Text,
    style,
)
from consistency.referee.show.figures import add_legend, band, canvas, dots, log_axis, stroke
from consistency.referee.system import manifest_of, write_folder
from consistency.referee.types import Array
from consistency.stereo.characterising.characterise import NAMES, Characterisation
from consistency.stereo.characterising.sensor_text import counted, estimates_table, sentences

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

MEASURED = Look(COLOURS[0])
NORMAL = Look("#333333")
STUDENT = Look(COLOURS[1], (5.0, 2.0))
LOCAL = Look("#7f7f7f", marker="s", size=3.4)
HEADS = ("Coordinate", "Noise (px)", "Correlation", "Offset share", "1/nu", "Kurtosis", "Pooled (px)")
REACH = 5.0  # standard deviations of the distribution that are drawn
BINS = 60
LOCALLY = 20  # groups of equal size in which a standard deviation is drawn


def write_sensor_reports(
    of: Characterisation,
    folder: Path,
    data: str,
    overwrite: bool = False,
) -> list[Path]:
    """``report.html``, ``report.pdf`` and ``characterisation.json`` in a folder that appears whole or not at all.

    Parameters
    ----------
    data : text of the JSON file

    Raises
    ------
    InputError
        The folder exists or cannot be written.
    """
    manifest = manifest_of(kind="characterisation", source=of.source)
    document = compose_sensor(of, manifest)

    def contents(at: Path) -> None:
        write_document(document, at / "report.html", at / "report.pdf")
        write_file(at / "characterisation.json", data.encode("utf-8"))

    write_folder(folder, manifest, contents, overwrite)
    return [folder / name for name in ("report.html", "report.pdf", "characterisation.json")]


def compose_sensor(of: Characterisation, manifest: Mapping[str, Any]) -> Document:
    """The document that HTML and PDF show."""
    caption = f"Intervals hold together with {100 * (1 - of.level.rate):g} %; 1/nu is 0 for a Gaussian noise."
    estimates = estimates_table(of, HEADS, 3, caption)
    chapters = [
        Chapter("estimates", "Estimates", "Estimates", (estimates, *map(Text, sentences(of)))),
        Chapter("disparity", "Noise over disparity", "Disparity", (_over_disparity(of),)),
    ]
    if of.bias is not None and of.bias.grid.known.any():
        chapters.append(Chapter("bias", "Bias over the image", "Bias", (_bias_map(of),)))
    chapters += [
        Chapter("shape", "Distribution and whiteness", "Shape", (_distribution(of), *_correlation(of))),
        Chapter("provenance", "Provenance", "Provenance", (Facts(tuple(facts(dict(manifest)))),)),
    ]
    return Document(f"Sensor: {of.source}", counted(of) + ".", tuple(chapters))


# --- figures ----------------------------------------------------------------------------------------


def _over_disparity(of: Characterisation) -> Figure:
    """Standard deviation of disparity over disparity, as fig. 5c of Herath et al. (2007)."""

    def draw() -> Drawing:
        figure, (axes,) = canvas(2.2)
        if of.growth is not None:
            sigma = np.array(of.growth.sigma)
            nodes = of.growth.nodes
            band(axes, nodes, sigma[:, 1:], "interval")
            axes.plot(nodes, sigma[:, 0], label="sigma of d", marker="o", markersize=3.4, **stroke(MEASURED))
        axes.plot(*local_spread(of), label="all of a group", **dots(LOCAL))
        axes.axhline(of.coordinates[2].sigma.value, **stroke(EXPECTED))
        axes.set(xlabel="disparity (px)", ylabel="sd of d (px)")
        axes.set_ylim(bottom=0.0)
        log_axis(axes, "x")
        return add_legend(figure)

    caption = (
        "Standard deviation of disparity over disparity (fig. 5c). Line: noise at the nodes, with its interval. "
        "Squares: standard deviation of groups of equal size, bias and offsets in it. Rule: sigma of all together."
    )
    return Figure("Standard deviation of disparity", caption, (draw,))


def local_spread(of: Characterisation) -> tuple[Array, Array]:
    """Median disparity and standard deviation of r of disparity, px, in groups of about equal size."""
    disparity = of.kept.ideal[:, 2]
    groups = min(LOCALLY, max(len(disparity) // 20, 1))
    middles = []
    spreads = []
    for group in np.array_split(np.argsort(disparity), groups):
        if len(group) > 1:
            middles.append(np.median(disparity[group]))
            spreads.append(of.kept.r[group, 2].std(ddof=1))
    return np.array(middles), np.array(spreads)


def _bias_map(of: Characterisation) -> Figure:
    """Lines over u of the bias of u, v and d, one for each row of nodes."""
    assert of.bias is not None
    bias = of.bias
    grid = of.bias.grid
    reach = 1.15 * max(np.nanmax(np.abs(bias.value) + bias.half), 0.1)

    def draw() -> Drawing:
        figure, panels = canvas(1.9, 3, 3)
        for k, (name, axes) in enumerate(zip(NAMES, panels, strict=True)):
            axes.axhline(0.0, **stroke(EXPECTED))
            for row, values in enumerate(bias.value[k].reshape(len(grid.v), -1)):
                look = style(row)
                label = f"v = {grid.v[row]:.0f} px"
                axes.plot(grid.u, values, label=label, marker=look.marker, markersize=3.0, **stroke(look))
            axes.set(xlabel="u (px)", ylabel=f"bias of {name} (px)", ylim=(-reach, reach))
        return add_legend(figure)

    middle = np.nanmedian(bias.half)
    caption = (
        f"Bias of u, v and d at the nodes of the map (fig. 8), before any shrinkage; the median of the intervals is "
        f"±{middle:.2g} px. Nodes with too few data are left out."
    )
    return Figure("Bias map", caption, (draw,))


def _distribution(of: Characterisation) -> Figure:
    """Standardised residuals beside the normal distribution, as fig. 5a and 6."""

    def draw() -> Drawing:
        figure, panels = canvas(1.7, 3, 3)
        for c, axes in zip(of.coordinates, panels, strict=True):
            edges = np.linspace(-REACH, REACH, BINS + 1)
            height, _ = np.histogram(np.clip(c.residuals, -REACH, REACH), edges, density=True)
            x = np.linspace(-REACH, REACH, 201)
            axes.stairs(height, edges, fill=True, color=MEASURED.colour, alpha=0.5)
            axes.plot(x, stats.norm.pdf(x), label="normal", **stroke(NORMAL))
            if c.tails.weight.low > 0:
                nu = 1.0 / c.tails.weight.value
                density = stats.t.pdf(x, nu, scale=np.sqrt(max(1.0 - 2.0 / nu, 0.05)))
                axes.plot(x, density, label="Student's", **stroke(STUDENT))
            axes.set(xlabel="residual / sd", ylabel="density", title=c.name)
        return add_legend(figure)

    caption = (
        "Residuals over their standard deviation (fig. 5a and 6), with the normal density and, where tails are "
        "heavier, Student's of the estimated degrees of freedom."
    )
    return Figure("Distribution", caption, (draw,))


def _correlation(of: Characterisation) -> tuple[Figure, ...]:
    """Autocorrelation along tracks; none where rows have no order in time."""
    if not any(np.isfinite(c.lags).any() for c in of.coordinates) or of.coordinates[0].correlation is None:
        return ()
    reach = 1.15 * max(np.nanmax(np.abs([c.lags for c in of.coordinates])), 0.1)

    def draw() -> Drawing:
        figure, panels = canvas(1.5, 3, 3)
        for c, axes in zip(of.coordinates, panels, strict=True):
            lags = np.flatnonzero(np.isfinite(c.lags)) + 1
            values = c.lags[lags - 1]
            bound = np.nanmax(c.bounds)
            axes.axhspan(-bound, bound, color=BAND, linewidth=0, zorder=0.4)
            axes.axhline(0.0, **stroke(EXPECTED))
            axes.vlines(lags, 0.0, values, color=MEASURED.colour, linewidth=MEASURED.width)
            axes.plot(lags, values, **dots(MEASURED))
            ticks = lags[:: max(1, len(lags) // 5)]
            axes.set(xlabel="lag (steps)", ylabel="correlation", title=c.name, ylim=(-reach, reach), xticks=ticks)
        return figure

    caption = (
        "Autocorrelation along tracks, pooled over all; if the noise is white, 95 % of the lags stay in the shading."
    )
    return (Figure("Autocorrelation", caption, (draw,)),)
