"""Figures of the stereo front-end: features with their ellipses, and poses of a Monte Carlo simulation."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from consistency.referee.document.colours import COLOURS, DASHES, TRUTH, Look
from consistency.referee.document.drawing import Axis, Line, Panel, Points, Sheet, xy
from consistency.referee.show import with_matplotlib
from consistency.referee.types import Array

FEATURES = 3.0  # standard deviations of the ellipses, fig. 2.4
POSES = 2.0  # fig. 2.5
PLANES = ((0, 2, "x (mm)", "z (mm)"), (0, 1, "x (mm)", "y (mm)"), (3, 4, "roll (mrad)", "pitch (mrad)"))
NOISE = Look(COLOURS[1], width=1.1)
MONTE_CARLO, IMPLICIT = Look(TRUTH, width=1.1), Look(COLOURS[2], DASHES[1], width=1.1)
SAMPLE, MEAN = Look("#8c8c8c", size=1.0, alpha=0.6), Look(COLOURS[1], size=3.5)


def matches_png(image: Array, uv: Array, covariances: Array, resolution: int = 200) -> bytes:
    """Features (n, 2) px with covariances (n, 2, 2) px^2 on an image (h, w), ellipses of 3 standard deviations.

    As Valencia & Andrade-Cetto (2018) fig. 2.4.
    """
    with mpl.rc_context(with_matplotlib.RC):
        figure = Figure(
            figsize=(Sheet.width, Sheet.width * image.shape[0] / image.shape[1]),
            layout="constrained",
        )
        axes = figure.subplots()
        axes.imshow(image, cmap="gray", vmin=0, vmax=255)
        axes.set_axis_off()
        for centre, covariance in zip(uv, covariances, strict=True):
            with_matplotlib.draw_line(axes, ellipse(centre, covariance, FEATURES, NOISE), 4.0)
        return with_matplotlib.picture(figure, "png", resolution)


def samples_png(samples: Array, centre: Array, covariance: Array, resolution: int = 200) -> bytes:
    """Poses (n, 6) in m and rad, their covariance (black) and the propagated one (6, 6) about ``centre`` (6,) (green).

    As Valencia & Andrade-Cetto (2018) fig. 2.5, ellipses of 2 standard deviations.
    """
    spread, panels = np.cov(samples.T), []
    for i, j, *labels in PLANES:
        both, points = np.ix_([i, j], [i, j]), 1e3 * samples[:, [i, j]]
        mean = points.mean(axis=0)
        marks = (
            Points(*xy(points), SAMPLE, whole=True),
            ellipse(mean, 1e6 * spread[both], POSES, MONTE_CARLO),
            ellipse(1e3 * centre[[i, j]], 1e6 * covariance[both], POSES, IMPLICIT),
            Points(*xy(mean[None]), MEAN),
        )
        panels.append(Panel(Axis(labels[0]), Axis(labels[1]), marks, f"{labels[0]} and {labels[1]} of the poses"))
    return with_matplotlib.render(Sheet(tuple(panels), Sheet.width / 3), "png", resolution)


def ellipse(centre: Array, covariance: Array, scale: float, look: Look) -> Line:
    """Iso-uncertainty curve of a covariance (2, 2) about ``centre`` (2,), ``scale`` standard deviations wide.

    Valencia & Andrade-Cetto (2018) fig. 2.4 and 2.5.
    """
    width, axis = np.linalg.eigh(covariance)
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    half = scale * np.sqrt(np.maximum(width, 0.0))
    curve = axis @ (half[:, None] * np.stack([np.cos(turn), np.sin(turn)])) + np.asarray(centre)[:, None]
    return Line(curve[0], curve[1], look, path=True)
