"""A constant bias of disparity, and what a filter makes of it that believes it to be noise."""

from __future__ import annotations

import numpy as np
import pandas as pd

from consistency.bench.pages.exhibits import P_VALUE, STATUS, Exhibit, Source, groups, listing, section, several, single
from consistency.referee.document.blocks import Table
from consistency.referee.document.colours import EXPECTED, style
from consistency.referee.document.drawing import Axis, Figure, Key, Line, Panel, Points, Rule
from consistency.referee.pages.section import Part

SENSOR = Part("sensor-issues", "The stereo sensor: biases and practical issues", "Sensor issues")
DOF = 3.0
ROWS = 4  # of a map that are drawn at most


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


MAP = ("u", "v", "bias_d")
VERDICTS = ("anees", "rmse_position_m", "rmse_heading_deg", "p")
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
)  # fmt: skip
SECTION = section(SENSOR, EXHIBITS)
