"""Disparities and tracks in rendered images, as Herath et al. (2007) have those of a real camera.

Disparities: fig. 4, 5 and 8. Tracks of features before a moving camera: fig. 3, 6 and 9, and sec. 4.4.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
from scipy import stats

from consistency.bench.pages.exhibits import Exhibit, Source, groups, listing, section, several, single
from consistency.referee.document.blocks import Table
from consistency.referee.document.colours import EXPECTED, LIMIT, SHADE, Look, style
from consistency.referee.document.drawing import Axis, Bars, Figure, Key, Line, Panel, Points, Rule, Sheet, Span, Stems
from consistency.referee.pages.section import Part
from consistency.referee.types import Array

IMAGES = Part("images", "The stereo sensor in rendered images", "Rendered images")
SAMPLES, GAUSS = Look("#c4c4c4"), replace(style(0), width=1.4)
KEYS = (Key("samples", SAMPLES, "band"), Key("Gaussian", GAUSS))
STOPS = ("disparity", "selected", "features", "within", "pooled", "residual", "sigma", "needed")
BINS, REACH = 80, 5.0  # of a histogram, and the standard deviations that it spans


def protocol(stops: pd.DataFrame) -> Figure:
    """Features kept at each stop, experiment 2."""
    marks: list[Line | Points | Rule] = [Rule("y", float(stops["needed"].iloc[0]), LIMIT)]
    keys = [Key("needed", LIMIT)]
    for k, (residual, part) in enumerate(stops.sort_values("disparity").groupby("residual")):
        x, y = part["disparity"].to_numpy(), part["features"].to_numpy()
        look = replace(style(k), size=3.0)
        marks.append(Points(x, y, look, tips=(("disparity", "@x{0.0} px"), ("features", "@y"))))
        keys.append(Key(f"k1 left over {residual:g}", look, "points"))
    panel = Panel(
        Axis("disparity (px)"), Axis("features kept", start=0.0), tuple(marks), "Features kept over disparity"
    )
    caption = (
        f"Of {stops['selected'].median():.0f} features at a stop, those that are kept through all images; experiment 2 "
        f"of Herath et al. (2007) sec. 3.3, which kept at least {stops['needed'].iloc[0]:g}."
    )
    return single("Features kept at each stop", caption, panel, tuple(keys))


def growth(stops: pd.DataFrame) -> Figure:
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


def whiteness(lags: pd.DataFrame) -> Figure:
    """Autocorrelation along tracks, freed of what subtracting a mean does."""
    lag, value, limit = lags["lag"].to_numpy(), lags["autocorrelation"].to_numpy(), float(lags["limit"].iloc[0])
    reach = 1.5 * max(limit, float(np.abs(value).max()))
    marks = (
        Span("y", -limit, limit, SHADE),
        Rule("y", 0.0, EXPECTED),
        Stems(lag, value, style(0), tips=(("lag", "@x"), ("autocorrelation", "@y{0.000}"))),
    )
    panel = Panel(
        Axis("lag (images)", window=(0.4, float(lag.max()) + 0.6), whole=True),
        Axis("autocorrelation", "correlation", window=(-reach, reach)), marks, "Autocorrelation along tracks",
    )  # fmt: skip
    caption = (
        "Autocorrelation of the errors of disparity about the means of their tracks, with what subtracting the mean "
        f"does given back; shaded: the rule, {limit:g} at most."
    )
    return single("Whiteness", caption, panel)


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
    return Figure("Errors of tracking", caption, panels, (Sheet(panels, 3.6, columns=2, keys=KEYS),), KEYS, "pair", 4)


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
    cases = groups(frames, "camera")
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
    return several("Tracks over images", caption, panels, keys)


def ratios(noise: pd.DataFrame) -> Table:
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
    rows = [
        (name, len(part), part["residual"].median(), part["dissimilarity"].median())
        for kind, name in ((0.0, "points"), (1.0, "junctions"))
        for part in [features[features["junction"] == kind]]
    ]
    data = pd.DataFrame(rows, columns=["kind", "count", "residual", "dissimilarity"])
    heads = {
        "kind": ("Features", ""), "count": ("Number", ".0f"), "residual": ("From a rigid point (px), median", ".2f"),
        "dissimilarity": ("Dissimilarity, median", ".3f"),
    }  # fmt: skip
    return listing(data, heads, "Junctions beside points")


def budget(stages: pd.DataFrame) -> Table:
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
SECTION = section(IMAGES, EXHIBITS)
