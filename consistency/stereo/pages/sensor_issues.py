"""The practical issues of Herath et al. (2007) sec. 4, issue by issue.

Among them a constant bias of disparity, and what a filter makes of it that believes it to be noise.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from consistency.bench.pages.exhibits import P_VALUE, STATUS, Exhibit, Source, groups, listing, section, several, single
from consistency.referee.document.blocks import Table
from consistency.referee.document.colours import COLOURS, EXPECTED, Look, style
from consistency.referee.document.drawing import Axis, Figure, Key, Line, Panel, Points, Rule
from consistency.referee.pages.section import Part
from consistency.referee.types import Array

SENSOR = Part("sensor-issues", "The stereo sensor: biases and practical issues", "Sensor issues")
DOF = 3.0
ROWS = 4  # of a map that are drawn at most
MAP = ("u", "v", "bias_d")
VERDICTS = ("anees", "rmse_position_m", "rmse_heading_deg", "p")
POSE = (("x", "m"), ("y", "m"), ("heading", "deg"))
SIGMAS = 2.0
ERROR, BOUND = Look(COLOURS[0], width=1.0), Look(COLOURS[0], (3.0, 2.0), width=0.8)
OUTCOME = {
    "case": ("Case", ""), "status": ("Verdict", STATUS), "anees": ("Mean NEES", ".2f"),
    "rmse_position_m": ("RMSE (m)", ".3f"), "rmse_heading_deg": ("RMSE (deg)", ".2f"),
}  # fmt: skip
GUARD = {"precision": ("Precision", ".3f"), "recall": ("Recall", ".3f")}
NUMBERS = ("anees", "rmse_position_m", "rmse_heading_deg", "precision", "recall")
TEXTS, NO_GUARD = ("case", "status"), ("precision", "recall")
STEPS = ("step", *(f"{of}{name}" for of in ("", "sigma_") for name, _ in POSE))
LENSES = ("degrees", "k1", "anees", "rmse_position_m", "rmse_heading_deg")


def shares(beliefs: pd.DataFrame) -> Table:
    """What each belief does, and what of the excess is gone."""
    heads = {
        "belief": ("True and believed", ""), "status": ("Verdict", STATUS), "anees": ("Mean NEES", ".2f"),
        "share": ("Share of the excess gone", ".3f"), "low": ("from", ".3f"), "high": ("to", ".3f"),
    }  # fmt: skip
    caption = (
        "ekf-uvd on the same trials; mean NEES is 3 if the covariance is right. Shares of the excess with a bias "
        "believed to be noise, with 95 % bootstrap intervals"
    )
    return listing(beliefs, heads, "Bias or noise", caption)


def over_steps(curves: pd.DataFrame) -> Figure:
    tips, keys, lines = (("step", "@x"), ("ANEES", "@y{0.00}")), [], []
    for k, (belief, part) in enumerate(groups(curves, "belief")):
        lines.append(Line(part["step"].to_numpy(), part["nees"].to_numpy(), style(k), tips=tips))
        keys.append(Key(belief, style(k)))
    panel = Panel(
        Axis("step", share="step"), Axis("ANEES", log=True), (Rule("y", DOF, EXPECTED), *lines), "ANEES over steps"
    )
    caption = "Average NEES of ekf-uvd over steps, by what is true and believed; the line is at 3, which is right."
    return single("ANEES by belief", caption, panel, tuple(keys))


def of_map(nodes: pd.DataFrame) -> Figure:
    keys, panel = _rows(nodes)
    caption = (
        "The bias of disparity that makes up the pooled standard deviation of the chapter, by place in the image; "
        "as Herath et al. (2007) fig. 8. Rows above the middle mirror those below."
    )
    return single("Bias of disparity", caption, panel, keys)


def _rows(
    nodes: pd.DataFrame, title: str = "", window: tuple[float, float] | None = None
) -> tuple[tuple[Key, ...], Panel]:
    """A line over u for each row of nodes; of many rows, for some from the middle down."""
    chosen = np.unique(nodes["v"])
    if len(chosen) > ROWS:
        below = chosen[chosen >= 0.0]
        chosen = below[np.linspace(0, len(below) - 1, ROWS).round().astype(int)]
    marks: list[Line | Points | Rule] = [Rule("y", 0.0, EXPECTED)]
    keys = []
    for k, v in enumerate(chosen):
        part = nodes[nodes["v"] == v].sort_values("u")
        u, bias = part["u"].to_numpy(), part["bias_d"].to_numpy()
        marks += [Line(u, bias, style(k)), Points(u, bias, style(k), tips=(("u", "@x{0}"), ("bias", "@y{0.00} px")))]
        keys.append(Key(f"v = {v:.0f} px", style(k), marked=True))
    alt = f"Bias of disparity over the image {title}".strip()
    return tuple(keys), Panel(Axis("u (px)"), Axis("bias of d (px)", window=window), tuple(marks), alt, title=title)


def survivors(filters: pd.DataFrame) -> Table:
    heads = {
        "filter": ("Filter", ""), "status_noise": ("White noise", STATUS), "anees_noise": ("Mean NEES", ".2f"),
        "status_bias": ("A bias of that size, believed to be such noise", STATUS), "anees_bias": ("Mean NEES", ".2f"),
    }  # fmt: skip
    return listing(filters, heads, "Filters with noise and with a bias", "Mean NEES is 3 if the covariance is right")


# --- lens models -------------------------------------------------------------------------------------


def believed(rows: pd.DataFrame) -> Table:
    """Each filter with each lens model and belief."""
    heads = {
        "model": ("Lens model", ""), "belief": ("Belief", ""), "filter": ("Filter", ""), "status": ("Verdict", STATUS),
        "anees": ("Mean NEES", ".2f"), "rmse_position_m": ("RMSE (m)", ".3f"),
        "rmse_heading_deg": ("RMSE (deg)", ".2f"), "p": ("p", P_VALUE),
    }  # fmt: skip
    caption = "p: that noise alone does not give the greater NEES"
    return listing(rows, heads, "Filters with each lens model", caption)


def sensors(rows: pd.DataFrame) -> Table:
    """What was found of the camera with each lens model."""
    heads = {
        "model": ("Lens model", ""), "coordinate": ("Coordinate", ""), "sigma": ("Noise (px)", ".3f"),
        "bias": ("Largest bias (px)", ".2f"), "pooled": ("Both together (px)", ".3f"),
    }  # fmt: skip
    return listing(rows, heads, "Sensor by lens model", "Characterised from corners of a chessboard")


def lens_maps(nodes: pd.DataFrame) -> Figure:
    reach = 1.15 * max(float(nodes["bias_d"].abs().max()), 0.1)
    drawn = [_rows(part, f"lens model: {model}", (-reach, reach)) for model, part in groups(nodes, "model")]
    caption = (
        "Bias of disparity that is shown with each lens model, along the rows of nodes; zero where none is shown, and "
        "at nodes of which nothing is known. Rows of the models differ by some pixels."
    )
    return several("Bias of disparity by lens model", caption, [panel for _, panel in drawn], drawn[-1][0])


def outcomes(rows: pd.DataFrame) -> Table:
    """Verdict, NEES and errors of each case, with the scores of a guard where there is one."""
    heads = OUTCOME | (GUARD if rows["precision"].notna().any() else {})
    return listing(rows, heads, "Outcomes", "Mean NEES is 3 if the covariance is right")


def first_run(steps: pd.DataFrame) -> Figure:
    """Errors with 2-sigma bounds, as fig. 10."""
    x = steps["step"].to_numpy()
    panels = []
    for name, unit in POSE:
        tips = (("step", "@x"), ("error", f"@y{{0.000}} {unit}"), ("2 sigma", f"@bound{{0.000}} {unit}"))
        bound = SIGMAS * steps[f"sigma_{name}"].to_numpy()
        line = Line(x, steps[name].to_numpy(), ERROR, tips=tips, bound=bound)
        y = Axis(f"{name} error ({unit})", f"{name} error\n({unit})")
        panels.append(Panel(Axis("step", share="step"), y, (line, Rule("y", 0.0, EXPECTED)), f"Error of {name}"))
    caption = (
        "Errors of the pose in the first run, with the filter's own 2-sigma bounds; as Herath et al. (2007) fig. 10."
    )
    return several("Errors and bounds", caption, panels, (Key("error", ERROR), Key("2-sigma bounds", BOUND)))


def guards(rows: pd.DataFrame) -> Table:
    heads = {
        "filter": ("Filter", ""), "guard": ("Guard", ""), "rmse_ratio": ("RMSE over clean", ".2f"),
        "clean": ("Clean", STATUS), "clean_anees": ("Mean NEES", ".2f"), "guarded": ("Guarded", STATUS),
        "guarded_anees": ("Mean NEES", ".2f"),
    }  # fmt: skip
    caption = "Behind each guard among 5 % mismatches, beside the same filter without mismatches"
    return listing(rows, heads, "Guards", caption)


def lenses(rows: pd.DataFrame) -> Figure:
    keys, heading, nees = [], list[Line | Points](), list[Line | Points]()
    cases = rows.groupby(["filter", "k1"], sort=False)
    for k, (case, part) in enumerate(cases):
        name, k1 = case
        x, look = part["degrees"].to_numpy(), style(k)
        heading += _marked(x, part["rmse_heading_deg"], look, "@y{0.00} deg")
        nees += _marked(x, part["anees"], look, "@y{0.0}")
        keys.append(Key(f"{name}, k1 left over {k1:g}", look, marked=True))
    x_axis = Axis("field of view (degrees)", share="view")
    y_axes = [Axis(label, log=True, digits=(1, 2, 5)) for label in ("RMSE of heading (deg)", "mean NEES")]
    panels = (
        Panel(x_axis, y_axes[0], tuple(heading), "Heading over the view"),
        Panel(x_axis, y_axes[1], (Rule("y", 3.0, EXPECTED), *nees), "Mean NEES over the view"),
    )
    caption = (
        "Accuracy of the heading and consistency over the field of view across the image, with a perfect rectification "
        "and with one that leaves a radial distortion, opposite in both cameras; sec. 4.1. The line is at 3."
    )
    return several("Field of view", caption, panels, tuple(keys))


def _marked(x: Array, y: pd.Series, look: Look, tip: str) -> list[Line | Points]:
    """A line with a marker at each of its points."""
    return [Line(x, y.to_numpy(), look), Points(x, y.to_numpy(), look, tips=(("value", tip),))]


def of_lenses(rows: pd.DataFrame) -> Table:
    """The numbers of the figure, with verdicts."""
    heads = {
        "degrees": ("Degrees", ".0f"), "k1": ("k1 left over", "g"), "filter": ("Filter", ""),
        "status": ("Verdict", STATUS), "anees": ("Mean NEES", ".2f"), "rmse_position_m": ("RMSE (m)", ".3f"),
        "rmse_heading_deg": ("RMSE (deg)", ".2f"),
    }  # fmt: skip
    return listing(rows, heads, "Lenses")


def counts(rows: pd.DataFrame) -> Figure:
    x, panels = rows["count"].to_numpy(), []
    for column, label, tip in (("rmse_position_m", "RMSE of position (m)", "@y{0.000} m"),
                               ("rmse_heading_deg", "RMSE of heading (deg)", "@y{0.00} deg")):  # fmt: skip
        axis = Axis("features at a time", log=True, digits=(1, 2, 4, 8), share="count")
        marks = tuple(_marked(x, rows[column], style(0), tip))
        panels.append(Panel(axis, Axis(label, log=True, digits=(1, 2, 5)), marks, f"{label} over features"))
    caption = "Errors of parked-ekf-uvd over the number of features that are tracked at a time; sec. 4.2."
    return several("Errors over the number of features", caption, panels, ())


def of_counts(rows: pd.DataFrame) -> Table:
    """The numbers of the figure, with the test from one count to the next."""
    heads = OUTCOME | {"p": ("p, fewer no worse", P_VALUE)}
    return listing(rows, heads, "Counts of features", "p of the test against the row above")


def _spurious(name: str, title: str) -> Exhibit:
    sources = (Source(name, NUMBERS, TEXTS, outcomes, NO_GUARD),
               Source(f"{name}_errors", STEPS, (), first_run, STEPS[1:]))  # fmt: skip
    return Exhibit((name,), f"{name}: {title}", sources)


EXHIBITS = (
    Exhibit(("bias-or-noise",), "bias-or-noise: is the noise of disparity a constant bias?",
            (Source("bias_or_noise", ("anees", "share", "low", "high"), ("belief", "status"), shares,
                    ("share", "low", "high")),
             Source("bias_or_noise_nees", ("step", "nees"), ("belief",), over_steps),
             Source("bias_or_noise_map", MAP, (), of_map))),
    Exhibit(("bias-survivors",), "bias-survivors: which filter survives an uncalibrated bias?",
            (Source("bias_survivors", ("anees_noise", "anees_bias"), ("filter", "status_noise", "status_bias"),
                    survivors),)),
    Exhibit(("chessboard-map", "chessboard-noise"), "chessboard-map, chessboard-noise: lens models of a real camera",
            (Source("lens_models", VERDICTS, ("model", "belief", "filter", "status"), believed, ("p",)),
             Source("lens_models_sensors", ("sigma", "bias", "pooled"), ("model", "coordinate"), sensors),
             Source("lens_models_bias", MAP, ("model",), lens_maps))),
    _spurious("fig10a", "spurious features without a guard"),
    _spurious("fig10b", "spurious features behind one-point RANSAC"),
    Exhibit(("guarded",), "guarded: every guard beside clean data",
            (Source("guarded", ("rmse_ratio", "clean_anees", "guarded_anees"),
                    ("filter", "guard", "clean", "guarded"), guards),)),
    Exhibit(("fov",), "fov: field of view, with and without distortion",
            (Source("field_of_view", LENSES, ("filter", "status"), lenses),
             Source("field_of_view", LENSES, ("filter", "status"), of_lenses))),
    Exhibit(("feature-count",), "feature-count: how many features",
            (Source("feature_count", (*NUMBERS, "count", "p"), TEXTS, counts, (*NO_GUARD, "p")),
             Source("feature_count", (*NUMBERS, "count", "p"), TEXTS, of_counts, (*NO_GUARD, "p")))),
    Exhibit(("near-far-mix",), "near-far-mix: near and far features",
            (Source("near_far_mix", NUMBERS, TEXTS, outcomes, NO_GUARD),)),
)  # fmt: skip
SECTION = section(SENSOR, EXHIBITS)
