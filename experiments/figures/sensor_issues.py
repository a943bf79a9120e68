"""The practical issues of Herath et al. (2007) sec. 4, issue by issue.

Among them a constant bias of disparity, and what a filter makes of it that believes it to be noise.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from consistency.bench.pages.sections.published_findings import (
    P_VALUE,
    STATUS,
    Exhibit,
    Source,
    exhibit_blocks,
    groups,
    listing,
    several,
    single,
)
from consistency.bench.pages.sections.report_input import Report
from consistency.referee.show.blocks import COLOURS, EXPECTED, Block, Figure, Look, Table, style
from consistency.referee.show.figures import curve, edges, log_axis, stroke

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CHAPTER = ("sensor-issues", "The stereo sensor: biases and practical issues", "Sensor issues")
ON_PAPER = False  # of a report of several studies
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
    """ANEES over steps for each belief."""

    def paint(axes: Axes) -> None:
        axes.axhline(DOF, **stroke(EXPECTED))
        for k, (belief, part) in enumerate(groups(curves, "belief")):
            curve(axes, part["step"].to_numpy(), part["nees"].to_numpy(), style(k), belief)
        axes.set(xlabel="step", ylabel="ANEES")
        log_axis(axes, "y")

    caption = "Average NEES of ekf-uvd over steps, by what is true and believed; the line is at 3, which is right."
    return single("ANEES by belief", caption, paint)


def of_map(nodes: pd.DataFrame) -> Figure:
    """Bias of disparity along rows of the image."""
    caption = (
        "The bias of disparity that makes up the pooled standard deviation of the chapter, by place in the image; "
        "as Herath et al. (2007) fig. 8. Rows above the middle mirror those below."
    )
    return single("Bias of disparity", caption, partial(_draw_rows, nodes))


def _draw_rows(nodes: pd.DataFrame, axes: Axes) -> None:
    """A line over u for each row of nodes; of many rows, for some from the middle down."""
    chosen = np.unique(nodes["v"])
    if len(chosen) > ROWS:
        below = chosen[chosen >= 0.0]
        chosen = below[np.linspace(0, len(below) - 1, ROWS).round().astype(int)]
    axes.axhline(0.0, **stroke(EXPECTED))
    for k, v in enumerate(chosen):
        part = nodes[nodes["v"] == v].sort_values("u")
        draw_marked(axes, part["u"], part["bias_d"], style(k), f"v = {v:.0f} px")
    axes.set(xlabel="u (px)", ylabel="bias of d (px)")


def draw_marked(axes: Axes, x: pd.Series, y: pd.Series, look: Look, label: str = "") -> None:
    """A line with a marker at each of its points."""
    axes.plot(x.to_numpy(), y.to_numpy(), label=label, marker=look.marker, markersize=3.0, **stroke(look))


def survivors(filters: pd.DataFrame) -> Table:
    """Each filter with noise and with a bias."""
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
    """Bias of disparity with each lens model."""
    reach = 1.15 * max(float(nodes["bias_d"].abs().max()), 0.1)

    def draw_model(model: str, part: pd.DataFrame, axes: Axes) -> None:
        _draw_rows(part, axes)
        axes.set(title=f"lens model: {model}", ylim=(-reach, reach))

    caption = (
        "Bias of disparity that is shown with each lens model, along the rows of nodes; zero where none is shown, and "
        "at nodes of which nothing is known. Rows of the models differ by some pixels."
    )
    paints = [partial(draw_model, model, part) for model, part in groups(nodes, "model")]
    return several("Bias of disparity by lens model", caption, paints)


def outcomes(rows: pd.DataFrame) -> Table:
    """Verdict, NEES and errors of each case, with the scores of a guard where there is one."""
    heads = OUTCOME | (GUARD if rows["precision"].notna().any() else {})
    return listing(rows, heads, "Outcomes", "Mean NEES is 3 if the covariance is right")


def first_run(steps: pd.DataFrame) -> Figure:
    """Errors with 2-sigma bounds, as fig. 10."""
    x = steps["step"].to_numpy()

    def draw_error(name: str, unit: str, axes: Axes) -> None:
        bound = SIGMAS * steps[f"sigma_{name}"].to_numpy()
        axes.axhline(0.0, **stroke(EXPECTED))
        edges(axes, x, np.column_stack([-bound, bound]), BOUND, "2-sigma bounds")
        curve(axes, x, steps[name].to_numpy(), ERROR, "error")
        axes.set(xlabel="step", ylabel=f"{name} error ({unit})")

    caption = (
        "Errors of the pose in the first run, with the filter's own 2-sigma bounds; as Herath et al. (2007) fig. 10."
    )
    return several("Errors and bounds", caption, [partial(draw_error, *of) for of in POSE], 1.5)


def guards(rows: pd.DataFrame) -> Table:
    """Each filter behind each guard."""
    heads = {
        "filter": ("Filter", ""), "guard": ("Guard", ""), "rmse_ratio": ("RMSE over clean", ".2f"),
        "clean": ("Clean", STATUS), "clean_anees": ("Mean NEES", ".2f"), "guarded": ("Guarded", STATUS),
        "guarded_anees": ("Mean NEES", ".2f"),
    }  # fmt: skip
    caption = "Behind each guard among 5 % mismatches, beside the same filter without mismatches"
    return listing(rows, heads, "Guards", caption)


def lenses(rows: pd.DataFrame) -> Figure:
    """Heading and mean NEES over the field of view."""

    def draw_column(column: str, label: str, axes: Axes) -> None:
        for k, ((name, k1), part) in enumerate(rows.groupby(["filter", "k1"], sort=False)):
            draw_marked(axes, part["degrees"], part[column], style(k), f"{name}, k1 left over {k1:g}")
        if column == "anees":
            axes.axhline(DOF, **stroke(EXPECTED))
        axes.set(xlabel="field of view (degrees)", ylabel=label)
        log_axis(axes, "y")

    caption = (
        "Accuracy of the heading and consistency over the field of view across the image, with a perfect rectification "
        "and with one that leaves a radial distortion, opposite in both cameras; sec. 4.1. The line is at 3."
    )
    columns = (("rmse_heading_deg", "RMSE of heading (deg)"), ("anees", "mean NEES"))
    return several("Field of view", caption, [partial(draw_column, *column) for column in columns])


def of_lenses(rows: pd.DataFrame) -> Table:
    """The numbers of the figure, with verdicts."""
    heads = {
        "degrees": ("Degrees", ".0f"), "k1": ("k1 left over", "g"), "filter": ("Filter", ""),
        "status": ("Verdict", STATUS), "anees": ("Mean NEES", ".2f"), "rmse_position_m": ("RMSE (m)", ".3f"),
        "rmse_heading_deg": ("RMSE (deg)", ".2f"),
    }  # fmt: skip
    return listing(rows, heads, "Lenses")


def counts(rows: pd.DataFrame) -> Figure:
    """Errors over the number of features."""

    def draw_column(column: str, label: str, axes: Axes) -> None:
        draw_marked(axes, rows["count"], rows[column], style(0))
        axes.set(xlabel="features at a time", ylabel=label)
        log_axis(axes, "x")
        log_axis(axes, "y")

    caption = "Errors of parked-ekf-uvd over the number of features that are tracked at a time; sec. 4.2."
    columns = (("rmse_position_m", "RMSE of position (m)"), ("rmse_heading_deg", "RMSE of heading (deg)"))
    return several("Errors over the number of features", caption, [partial(draw_column, *of) for of in columns])


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


def blocks(report: Report) -> tuple[Block, ...]:
    """The exhibits whose tables the folder holds."""
    return exhibit_blocks(report, EXHIBITS)
