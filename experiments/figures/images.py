"""Disparities and tracks in rendered images, as Herath et al. (2007) have those of a real camera.

Disparities: fig. 4, 5 and 8. Tracks of features before a moving camera: fig. 3, 6 and 9, and sec. 4.4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from scipy import stats

from consistency.bench.pages.sections.published_findings import (
    Exhibit,
    Source,
    exhibit_blocks,
    groups,
    listing,
    several,
    single,
)
from consistency.bench.pages.sections.report_input import Report
from consistency.referee.show.blocks import BAND, EXPECTED, LIMIT, Block, Figure, Look, Table, style
from consistency.referee.show.figures import curve, dots, log_axis, stroke
from consistency.referee.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CHAPTER = ("images", "The stereo sensor in rendered images", "Rendered images")
ON_PAPER = False  # of a report of several studies
SAMPLES, GAUSS = Look("#c4c4c4"), replace(style(0), width=1.4)
STOPS = ("disparity", "selected", "features", "within", "pooled", "residual", "sigma", "needed")
KINDS = ((0.0, "points"), (1.0, "junctions"))
BINS, REACH = 80, 5.0  # of a histogram, and the standard deviations that it spans


def protocol(stops: pd.DataFrame) -> Figure:
    """Features kept at each stop, experiment 2."""

    def paint(axes: Axes) -> None:
        axes.axhline(float(stops["needed"].iloc[0]), **stroke(LIMIT), label="needed")
        for k, (residual, part) in enumerate(stops.sort_values("disparity").groupby("residual")):
            look = replace(style(k), size=2.4)
            axes.plot(part["disparity"], part["features"], label=f"k1 left over {residual:g}", **dots(look))
        axes.set(xlabel="disparity (px)", ylabel="features kept")
        axes.set_ylim(bottom=0.0)

    caption = (
        f"Of {stops['selected'].median():.0f} features at a stop, those that are kept through all images; experiment 2 "
        f"of Herath et al. (2007) sec. 3.3, which kept at least {stops['needed'].iloc[0]:g}."
    )
    return single("Features kept at each stop", caption, paint)


def growth(stops: pd.DataFrame) -> Figure:
    """Standard deviation of disparity over disparity."""

    def paint(axes: Axes) -> None:
        axes.axhline(float(stops["sigma"].iloc[0]), **stroke(LIMIT), label="sec. 4.5")
        for k, (residual, part) in enumerate(stops.sort_values("disparity").groupby("residual")):
            for name, text, dash in (("within", "about track means", ()), ("pooled", "pooled", (4.0, 2.0))):
                look, label = replace(style(k), dash=dash), f"{text}, k1 left over {residual:g}"
                curve(axes, part["disparity"].to_numpy(), part[name].to_numpy(), look, label)
        axes.set(xlabel="disparity (px)", ylabel="sd of disparity (px)")
        log_axis(axes, "y")

    caption = (
        f"Standard deviation of disparity at {len(stops) // stops['residual'].nunique()} stops before a wall, with the "
        "means of the tracks subtracted and pooled at each stop, where the rectification is right and where it leaves "
        "a radial distortion k1, opposite in both images; as Herath et al. (2007) fig. 5c. Their sec. 4.5 uses "
        f"{stops['sigma'].iloc[0]:g} px throughout."
    )
    return single("Noise of disparity", caption, paint)


def pooled(bins: pd.DataFrame) -> Figure:
    """Distribution of errors of disparity about the means of tracks."""
    sd, edges = float(bins["sd"].iloc[0]), np.append(bins["low"].to_numpy(), bins["high"].iloc[-1])

    def paint(axes: Axes) -> None:
        _draw_histogram(axes, edges, bins["density"].to_numpy(), sd)
        axes.set(xlabel="error of d about the mean of its track (px)", ylabel="density (1/px)")

    caption = (
        f"Errors of disparity about the means of their tracks, pooled over all stops, {int(bins['samples'].iloc[0])} "
        f"of them, with the Gaussian of the same standard deviation, {sd:.3f} px; as Herath et al. (2007) fig. 5a."
    )
    return single("Errors of disparity about track means", caption, paint)


def biases(features: pd.DataFrame) -> Figure:
    """Mean errors of features over the image."""

    def paint(axes: Axes) -> None:
        for k, (left, part) in enumerate(groups(features, "left")):
            axes.plot(part["u"], part["bias_d"], label=left, **dots(replace(style(k), size=2.4)))
        axes.set(xlabel="u (px)", ylabel="mean error of d (px)")

    caption = (
        "Mean error of the disparity of each feature on a wall at a disparity of 14.7 px, by what the rectification "
        "leaves; as Herath et al. (2007) fig. 8, where biases are up to 2 px."
    )
    return single("Local biases of disparity", caption, paint)


def whiteness(lags: pd.DataFrame) -> Figure:
    """Autocorrelation along tracks, freed of what subtracting a mean does."""
    lag, value, limit = lags["lag"].to_numpy(), lags["autocorrelation"].to_numpy(), float(lags["limit"].iloc[0])
    reach = 1.5 * max(limit, float(np.abs(value).max()))

    def paint(axes: Axes) -> None:
        axes.axhspan(-limit, limit, color=BAND, linewidth=0, zorder=0.4)
        axes.axhline(0.0, **stroke(EXPECTED))
        axes.vlines(lag, 0.0, value, color=style(0).colour, linewidth=style(0).width)
        axes.plot(lag, value, **dots(style(0)))
        window = (0.4, float(lag.max()) + 0.6)
        axes.set(xlabel="lag (images)", ylabel="autocorrelation", xlim=window, ylim=(-reach, reach), xticks=lag)

    caption = (
        "Autocorrelation of the errors of disparity about the means of their tracks, with what subtracting the mean "
        f"does given back; shaded: the rule, {limit:g} at most."
    )
    return single("Whiteness", caption, paint)


def largest(features: pd.DataFrame) -> Table:
    """Largest mean error of a feature, and how far it is from what the cameras give."""
    rows = []
    for left, part in groups(features, "left"):
        walls = part.groupby("wall")["bias_d"].agg(lambda bias: bias.abs().max())
        away = (part["bias_d"] - part["expected"]).std()
        rows.append((left, walls.median(), walls.max(), part["sd"].median(), away))
    data = pd.DataFrame(rows, columns=["left", "median", "most", "sd", "away"])
    heads = {
        "left": ("Rectification leaves", ""), "median": ("Largest bias (px), median of walls", ".2f"),
        "most": ("of all walls", ".2f"), "sd": ("Noise about track means (px)", ".3f"),
        "away": ("Bias less that of the cameras, sd (px)", ".3f"),
    }  # fmt: skip
    return listing(data, heads, "Largest biases of disparity", "Largest mean error of a feature before each wall")


def tracking(errors: pd.DataFrame) -> Figure:
    """Distribution of errors of tracked features, for each error of the attitude."""
    paints: list[Callable[[Axes], None]] = []
    for shake, part in errors.groupby("shake"):
        title = f"attitude errs by {np.rad2deg(float(str(shake))):.1f} degrees"
        paints += [partial(_draw_errors, part[name].to_numpy(), name, title) for name in ("u", "v")]
    caption = (
        "Errors of features tracked from 1 m to 6 m, an image each 0.05 m, with the Gaussian of the same standard "
        "deviation; as Herath et al. (2007) fig. 6, where sd is 1.34 px in u and 1.53 px in v."
    )
    return several("Errors of tracking", caption, paints, height=1.6)


def _draw_errors(errors: Array, name: str, title: str, axes: Axes) -> None:
    sd = float(errors.std())
    count, edges = np.histogram(errors, BINS, (-REACH * sd, REACH * sd))
    _draw_histogram(axes, edges, count / (len(errors) * np.diff(edges)), sd, float(errors.mean()))
    axes.set(xlabel=f"error of {name} (px)", ylabel="density (1/px)", title=f"{title}: sd {sd:.2f} px")


def _draw_histogram(axes: Axes, edges: Array, density: Array, sd: float, mean: float = 0.0) -> None:
    """Bars, and the Gaussian of this mean and standard deviation."""
    axes.stairs(density, edges, fill=True, color=SAMPLES.colour, label="samples")
    x = np.linspace(edges[0], edges[-1], 201)
    gauss = np.exp(-0.5 * ((x - mean) / sd) ** 2) / (sd * np.sqrt(2.0 * np.pi))
    axes.plot(x, gauss, label="Gaussian", **stroke(GAUSS))


def junctions(features: pd.DataFrame) -> Figure:
    """How rigid a track is, and how much its patch has changed, fig. 9."""

    def paint(axes: Axes) -> None:
        for k, (kind, name) in enumerate(KINDS):
            part = features[features["junction"] == kind]
            axes.plot(part["residual"], part["dissimilarity"], label=name, **dots(replace(style(k), size=2.6)))
        axes.set(xlabel="distance from a rigid point (px)", ylabel="dissimilarity")
        log_axis(axes, "x")
        log_axis(axes, "y")

    caption = (
        "Features where edges at two depths cross, beside corners of one surface, after 1 m of motion: rms distance of "
        "the track from that of the best rigid point, and dissimilarity of the patch from that of the first image (0: "
        "the same, 1.4: nothing in common); the case of Herath et al. (2007) fig. 9."
    )
    return single("Junctions", caption, paint)


def survival(frames: pd.DataFrame) -> Figure:
    """Tracks alive and their errors over images, experiment 1."""

    def draw_column(column: str, label: str, axes: Axes) -> None:
        for k, (name, part) in enumerate(groups(frames, "camera")):
            curve(axes, part["frame"].to_numpy(), part[column].to_numpy(), style(k), name)
        axes.set(xlabel="image", ylabel=label)
        axes.set_ylim(bottom=0.0)

    columns = (("rms_u", "rms error of u (px)"), ("rms_v", "rms error of v (px)"), ("tracks", "tracks"))
    caption = (
        "Errors of u and v and tracks alive, of features selected in the first image, with the camera moving by 0.02 m "
        "an image and at rest; experiment 1 of Herath et al. (2007) sec. 3.3. Junctions and tracks that have drifted "
        "by more than 2 px are left out of the errors."
    )
    return several("Tracks over images", caption, [partial(draw_column, *column) for column in columns], 1.6)


def ratios(noise: pd.DataFrame) -> Table:
    """Noise in motion and at rest."""
    heads = {
        "coordinate": ("Coordinate", ""), "moving": ("Moving (px)", ".3f"), "at_rest": ("At rest (px)", ".3f"),
        "ratio": ("Ratio", ".2f"), "low": ("from", ".2f"), "high": ("to", ".2f"),
    }  # fmt: skip
    caption = (
        "Standard deviation about the means of tracks, spurious features left out, and simultaneous intervals of the "
        "ratio"
    )
    return listing(noise, heads, "Noise of a moving camera over noise at rest", caption)


def spread(errors: pd.DataFrame) -> Table:
    """Standard deviation and kurtosis for each error of the attitude."""
    rows = [
        (f"{np.rad2deg(float(str(shake))):.1f} degrees", name, part[name].std(), stats.kurtosis(part[name]))
        for shake, part in errors.groupby("shake")
        for name in ("u", "v")
    ]
    data = pd.DataFrame(rows, columns=["shake", "name", "sd", "kurtosis"])
    heads = {
        "shake": ("Attitude errs by", ""), "name": ("Coordinate", ""), "sd": ("sd (px)", ".2f"),
        "kurtosis": ("Excess kurtosis", "+.2f"),
    }  # fmt: skip
    return listing(data, heads, "Spread of u and v", "Standard deviation and excess kurtosis over all walls")


def medians(features: pd.DataFrame) -> Table:
    """Junctions beside points in numbers."""
    rows = [
        (name, len(part), part["residual"].median(), part["dissimilarity"].median())
        for kind, name in KINDS
        for part in [features[features["junction"] == kind]]
    ]
    data = pd.DataFrame(rows, columns=["kind", "count", "residual", "dissimilarity"])
    heads = {
        "kind": ("Features", ""), "count": ("Number", ".0f"), "residual": ("From a rigid point (px), median", ".2f"),
        "dissimilarity": ("Dissimilarity, median", ".3f"),
    }  # fmt: skip
    return listing(data, heads, "Junctions beside points")


def budget(stages: pd.DataFrame) -> Table:
    """Noise by stage of the chain."""
    rms = {name: (f"rms of {name} (px)", ".2f") for name in "uvd"}
    heads = {"motion": ("Motion", ""), "stage": ("Errors of", ""), **rms, "kept": ("Kept", ".1%")}
    caption = "Noise budget of the chain of Herath et al. (2007) fig. 3: one stage with its errors, then all"
    return listing(stages, heads, "Noise budget by stage", caption)


EXHIBITS = (
    Exhibit(("fig4-protocol",), "fig4-protocol: features at each stop",
            (Source("images_stops", STOPS, (), protocol),)),
    Exhibit(("fig5a",), "fig5a: distribution and whiteness of the noise of disparity",
            (Source("images_fig5a", ("low", "high", "density", "sd", "samples"), (), pooled),
             Source("images_fig5a_lags", ("lag", "autocorrelation", "limit"), (), whiteness))),
    Exhibit(("fig5b", "fig5c"), "fig5b, fig5c: noise of disparity over disparity",
            (Source("images_stops", STOPS, (), growth),)),
    Exhibit(("fig7-8",), "fig7-8: local biases of disparity",
            (Source("images_bias", ("u", "bias_d"), ("left",), biases),
             Source("images_bias", ("wall", "bias_d", "expected", "sd"), ("left",), largest))),
    Exhibit(("fig3-chain",), "fig3-chain: noise budget by stage",
            (Source("images_budget", ("u", "v", "d", "kept"), ("motion", "stage"), budget),)),
    Exhibit(("fig6", "fig6-shake"), "fig6, fig6-shake: errors of u and v",
            (Source("images_fig6", ("u", "v", "shake"), (), tracking),
             Source("images_fig6", ("u", "v", "shake"), (), spread))),
    Exhibit(("fig9", "fig9-dissimilarity"), "fig9, fig9-dissimilarity: junctions",
            (Source("images_fig9", ("junction", "residual", "dissimilarity"), (), junctions),
             Source("images_fig9", ("junction", "residual", "dissimilarity"), (), medians))),
    Exhibit(("exp1-tracks",), "exp1-tracks: tracks of a moving camera",
            (Source("images_exp1", ("frame", "tracks", "rms_u", "rms_v"), ("camera",), survival),)),
    Exhibit(("static-vs-dynamic",), "static-vs-dynamic: noise parameters in motion and at rest",
            (Source("images_static_dynamic", ("moving", "at_rest", "ratio", "low", "high"), ("coordinate",), ratios),)),
)  # fmt: skip


def blocks(report: Report) -> tuple[Block, ...]:
    """The exhibits whose tables the folder holds."""
    return exhibit_blocks(report, EXHIBITS)
