"""The figures of the PDF: model records onto Matplotlib figures by way of ``consistency.plots``."""

from __future__ import annotations

import textwrap
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from consistency import plots
from consistency.reporting.model import Distribution, Study
from consistency.reporting.thin import thin

WIDTH = 6.7  # inches, the text width of the page
LINE = 0.16  # inches, a line of a legend
RC: Any = {
    "font.family": "DejaVu Sans", "font.size": 7.5, "axes.titlesize": 8, "axes.labelsize": 7.5, "legend.fontsize": 7.5,
    "axes.linewidth": 0.6, "xtick.major.width": 0.6, "ytick.major.width": 0.6, "svg.hashsalt": "consistency",
    "path.simplify": True, "axes.formatter.useoffset": False,
}  # fmt: skip


def _figure(height: float, rows: int = 1, columns: int = 1, **options: Any) -> tuple[Figure, Any]:
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def _key(figure: Figure, entries: list[tuple[str, Any]], beside: bool = False) -> None:
    """Legend in room that the layout leaves above the axes, or to their right."""
    entries = [(_wrapped(label), handle) for label, handle in entries]
    longest = max((len(line) for label, _ in entries for line in label.split("\n")), default=1)
    columns = 1 if beside else max(1, min(len(entries), 5, int(118 / (longest + 9))))
    tall = [label.count("\n") + 1 for label, _ in entries]
    lines = sum(tall) if beside else -(-len(entries) // columns) * max(tall, default=1)
    room, height = LINE * lines + 0.06, figure.get_figheight()
    # the axes keep their size: a long legend makes the figure taller
    height = max(height, room) if beside else height + room - LINE
    figure.set_figheight(height)
    engine: Any = figure.get_layout_engine()
    engine.set(rect=(0, 0, plots.BESIDE, 1) if beside else (0, 0, 1, 1 - room / height))
    plots.key(figure, entries, columns, beside)


def _wrapped(label: str, width: int = 26) -> str:
    return "\n".join(textwrap.wrap(label, width)) or label


def _filters(study: Study) -> list[tuple[str, Any]]:
    return [(track.name, plots.line(plots.style(track.style))) for track in study.tracks]


def scenario(study: Study) -> Figure:
    """Map of the study with the estimates of the shown run."""
    figure, axes = _figure(2.5)
    paths = [(plots.style(t.style), t.path[thin(*t.path.T)]) for t in study.tracks]
    true_path, odometry = (None if p is None else p[thin(*p.T)] for p in (study.true_path, study.odometry))
    plots.scenario(axes[0, 0], true_path, odometry, study.landmarks, paths)
    entries: list[tuple[str, Any]] = []
    if true_path is not None:
        entries.append(("true path", Line2D([], [], color=plots.TRUTH, linewidth=1.6)))
        entries.append(
            (
                "start",
                Line2D([], [], linestyle="", marker="o", color="white", markeredgecolor=plots.TRUTH, markersize=6),
            )
        )
    if odometry is not None:
        entries.append(("odometry alone", Line2D([], [], color=plots.ODOMETRY, linewidth=1.1, dashes=(4, 2))))
    if study.landmarks is not None:
        entries.append(
            ("landmark", Line2D([], [], linestyle="", marker="*", color="#8c8c8c", markersize=5, markeredgewidth=0))
        )
    _key(figure, entries + _filters(study), beside=True)
    return figure


def pose_errors(study: Study) -> list[Figure]:
    """One row of x, y and heading for each filter."""
    rows = []
    for track in study.tracks:
        assert track.error is not None
        figure, axes = _figure(1.4, columns=3)
        for component, panel in enumerate(axes[0]):
            error, sigma = track.error[:, component], track.sigma[:, component]
            keep = thin(error, sigma)
            look = plots.style(track.style)
            plots.pose_error(panel, study.steps[keep], error[keep], sigma[keep], look, component)
            panel.set_xlabel("step")
            panel.set_xlim(0, len(study.steps))
        plots.title(axes[0, 0], _wrapped(track.name, 90))
        if not np.isfinite(track.error).any():
            axes[0, 1].text(0.5, 0.5, "no estimate in this run", transform=axes[0, 1].transAxes, ha="center")
        rows.append(figure)
    return rows


def anees(study: Study) -> Figure:
    """ANEES of every filter against the bands."""
    figure, axes = _figure(2.2)
    panel = axes[0, 0]
    common = study.common_band
    for track in [t for t in study.tracks if t is common or t.own_band]:
        assert track.band is not None
        assert track.simultaneous is not None
        keep = thin(track.band[:, 1])
        look = plots.style(track.style) if track.own_band else None
        expected = float(track.verdict.statistics["dof"])
        plots.anees_band(panel, study.steps[keep], track.band[keep], track.simultaneous[keep], expected, look)
    lines = []
    for track in study.tracks:
        if track.anees is not None:
            keep = thin(track.anees)
            lines.append((plots.style(track.style), study.steps[keep], track.anees[keep]))
    plots.anees(panel, lines, study.anees_log, study.single)
    entries: list[tuple[str, Any]] = []
    if common is not None:
        entries = [
            ("95 % band, one step", Patch(color=plots.BAND)),
            ("95 % band, all steps", Line2D([], [], color="#333333", linewidth=0.9, dashes=(4, 3))),
            ("expected", Line2D([], [], color="#555555", linewidth=0.8)),
        ]
    _key(figure, entries + _filters(study))
    return figure


def nis(study: Study) -> Figure:
    """NIS per degree of freedom, a panel for each filter on common axes."""
    count = len(study.tracks)
    columns = count if count < 4 else 2 if count == 4 else 3
    rows = -(-count // columns)
    figure, axes = _figure(0.35 + 1.0 * rows, rows, columns, sharex=True, sharey=True)
    for track, panel in zip(study.tracks, axes.flat, strict=False):
        keep = thin(track.nis_ratio)
        plots.nis(panel, study.steps[keep], track.nis_ratio[keep], plots.style(track.style), study.nis_log)
        panel.set_xlim(0, len(study.steps))
        plots.title(panel, _wrapped(track.name))
        panel.label_outer()
    for empty in range(count - rows * columns, 0):
        axes[-1, empty].set_axis_off()
        axes[-2, empty].tick_params(labelbottom=True)
        axes[-2, empty].set_xlabel("step")
    return figure


def distribution(d: Distribution) -> Figure:
    """Samples with ellipses, and the histogram of x."""
    figure, axes = _figure(2.5, columns=2)
    plots.samples(axes[0, 0], d.points, d.linear_ellipse, d.fitted_ellipse)
    axes[0, 0].set(xlim=d.window[0], ylim=d.window[1])
    plots.marginal(axes[0, 1], d.edges, d.density, d.grid, d.linear_density, d.fitted_density)
    axes[0, 1].set_xlim(d.window[0])
    _key(
        figure,
        [
            ("samples", Patch(color="#c4c4c4")),
            ("linearised Gaussian", Line2D([], [], color=plots.COLOURS[0], linewidth=1.4)),
            (
                "Gaussian with the samples' moments",
                Line2D([], [], color=plots.COLOURS[1], linewidth=1.4, dashes=plots.DASHES[1]),
            ),
        ],
    )
    return figure
