"""The figures of the PDF: model records onto Matplotlib figures by way of ``consistency.reporting.plots``."""

from __future__ import annotations

import textwrap
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from consistency.reporting import diagnosis, plots
from consistency.reporting.model import Distribution, FirstOrder, Scenes, Shares, Study
from consistency.reporting.thin import thin

WIDTH = 6.7  # inches, the text width of the page
PANELS = 4  # small ones beside each other
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
        plots.anees_band(panel, study.steps[keep], track.band[keep], track.simultaneous[keep], track.expected, look)
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
            ("band of all steps at once", Line2D([], [], color="#333333", linewidth=0.9, dashes=(4, 3))),
            ("expected", Line2D([], [], color="#555555", linewidth=0.8)),
        ]
    _key(figure, entries + _filters(study))
    return figure


def innovations(study: Study) -> list[Figure]:
    """One row for each filter on axes of its own: NIS per degree of freedom, and the autocorrelation."""
    of_filters = [diagnosis.lags(track) for track in study.tracks]
    columns = 2 if any(of_filters) else 1
    rows = []
    for track, lags in zip(study.tracks, of_filters, strict=True):
        figure, axes = _figure(1.3, columns=columns, width_ratios=(2.4, 1.0)[:columns])
        keep, look = thin(track.nis_ratio), plots.style(track.style)
        plots.nis(axes[0, 0], study.steps[keep], track.nis_ratio[keep], look, track.nis_log)
        axes[0, 0].set_xlim(0, len(study.steps))
        plots.title(axes[0, 0], _wrapped(track.name, 90))
        if lags is not None:
            plots.autocorrelation(axes[0, 1], lags.values, lags.bound, look)
        elif columns == 2:
            axes[0, 1].set_axis_off()
            axes[0, 1].text(0.5, 0.5, "too few innovations", transform=axes[0, 1].transAxes, ha="center")
        rows.append(figure)
    return rows


def by_axis(study: Study) -> Figure | None:
    """Covariance ratio, bias and coverage by axis, panels side by side; None where there is nothing to show."""
    parts = diagnosis.forests(study)
    if not parts:
        return None
    labels, looks = diagnosis.aligned(parts), [plots.style(track.style) for track in study.tracks]
    height = 0.55 + len(labels) * (0.12 + 0.08 * len(looks))
    figure, axes = _figure(height, columns=len(parts), sharey=True)
    nothing = (None,) * len(looks)
    for panel, part in zip(axes[0], parts, strict=True):
        found = dict(part.rows)
        rows = [(_wrapped(label, 16), found.get(label, nothing)) for label in labels]
        plots.forest(panel, looks, rows, part.expected, part.window, part.log)
        panel.set_xlabel(part.label)
        panel.label_outer()
    marks = [Line2D([], [], color=k.colour, marker=k.marker, markersize=4.2, linewidth=1.3) for k in looks]
    _key(figure, [(track.name, mark) for track, mark in zip(study.tracks, marks, strict=True)])
    return figure


def nees_distribution(study: Study) -> Figure | None:
    """Empirical distribution of the NEES, a panel for each filter; None where there is no NEES."""
    found = [(track, of) for track in study.tracks if (of := diagnosis.steps(track, thin)) is not None]
    if not found:
        return None
    rows = -(-len(found) // PANELS)
    figure, axes = _figure(1.85 * rows, rows, PANELS)  # panels that are nearly square
    for panel in axes.flat[len(found) :]:
        panel.set_axis_off()
    for number, ((track, of), panel) in enumerate(zip(found, axes.flat, strict=False)):
        plots.distribution(panel, of.x, of.y, of.half_width, plots.style(track.style))
        plots.title(panel, _wrapped(track.name, 20))
        if number % PANELS == 0:
            panel.set_ylabel("share of runs")
        panel.set_xlabel("chi-square cdf")
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


def shares(found: Shares) -> Figure:
    """Share of repetitions inside the 95 % region by depth."""
    figure, axes = _figure(2.0)
    plots.shares(axes[0, 0], found.depth, found.share, found.expected, found.accepted)
    axes[0, 0].set_xlim(0, None)
    _key(
        figure,
        [
            ("measured", Line2D([], [], color=plots.COLOURS[0], marker="o", markersize=4.2, linewidth=1.2)),
            ("95 %", Line2D([], [], color="#555555", linewidth=0.8)),
            ("accepted by the test", Patch(color=plots.BAND)),
        ],
    )
    return figure


def scenes(found: Scenes) -> Figure:
    """Mean NEES over what is expected, a row for each scene."""
    figure, axes = _figure(0.55 + 0.22 * len(found.scenes))
    panel, look = axes[0, 0], plots.style(0)
    panel.axvspan(*found.region, color=plots.BAND, linewidth=0, zorder=0.5)
    rows = [(scene.label, [(scene.ratio, *scene.spread)]) for scene in found.scenes]
    plots.forest(panel, [look], rows, 1.0, found.window)
    panel.set(xlabel=f"N times mean NEES / {found.dof}")
    _key(
        figure,
        [
            ("mean, middle 95 %", Line2D([], [], color=look.colour, marker="o", markersize=4.2, linewidth=1.3)),
            ("expected", Line2D([], [], color="#555555", linewidth=0.8)),
            ("95 % region of one", Patch(color=plots.BAND)),
        ],
    )
    return figure


def first_order(found: FirstOrder) -> Figure:
    """Cells of every estimator on the same axes, a panel each."""
    rows = -(-len(found.estimators) // 3)
    figure, axes = _figure(0.3 + 1.6 * rows, rows, 3, sharex=True, sharey=True)
    for panel, of in zip(axes.flat, found.estimators, strict=False):
        plots.cells(panel, of.ratio, of.nees, of.accepted, found.holds)
        plots.title(panel, of.title)
        panel.label_outer()
    for panel in axes.flat[len(found.estimators) :]:
        panel.set_axis_off()
    for panel in axes.flat[max(len(found.estimators) - 3, 0) : len(found.estimators)]:
        panel.tick_params(labelbottom=True)
    marks = {"accepted": plots.ACCEPTED, "not accepted": plots.REJECTED}
    entries: list[tuple[str, Any]] = [
        (name, Line2D([], [], linestyle="", marker=look.marker, color=look.colour, markersize=5, markeredgewidth=0))
        for name, look in marks.items()
    ]
    entries += [
        ("expected", Line2D([], [], color="#555555", linewidth=0.8)),
        ("rule: up to here", Line2D([], [], color="#333333", linewidth=0.9, dashes=(4, 3))),
    ]
    _key(figure, entries)
    return figure
