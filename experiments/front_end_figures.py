"""Figures of the stereo front-end: features with their ellipses, and poses of a Monte Carlo simulation."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from consistency.referee.show.blocks import COLOURS, DASHES, TRUTH, Look
from consistency.referee.show.figures import WIDTH, canvas, dots, path, png, points
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

    def draw() -> Figure:
        figure, (axes,) = canvas(WIDTH * image.shape[0] / image.shape[1])
        axes.imshow(image, cmap="gray", vmin=0, vmax=255)
        axes.set_axis_off()
        for centre, covariance in zip(uv, covariances, strict=True):
            path(axes, ellipse(centre, covariance, FEATURES), NOISE)
        return figure

    return png(draw, resolution)


def samples_png(samples: Array, centre: Array, covariance: Array, resolution: int = 200) -> bytes:
    """Poses (n, 6) in m and rad, their covariance (black) and the propagated one (6, 6) about ``centre`` (6,) (green).

    As Valencia & Andrade-Cetto (2018) fig. 2.5, ellipses of 2 standard deviations.
    """
    spread = np.cov(samples.T)

    def draw() -> Figure:
        figure, panels = canvas(WIDTH / 3, 3, 3)
        for axes, (i, j, *labels) in zip(panels, PLANES, strict=True):
            both, places = np.ix_([i, j], [i, j]), 1e3 * samples[:, [i, j]]
            mean = places.mean(axis=0)
            points(axes, places[:, 0], places[:, 1], SAMPLE, limit=len(places))
            path(axes, ellipse(mean, 1e6 * spread[both], POSES), MONTE_CARLO)
            path(axes, ellipse(1e3 * centre[[i, j]], 1e6 * covariance[both], POSES), IMPLICIT)
            axes.plot(*mean[:, None], **dots(MEAN))
            axes.set(xlabel=labels[0], ylabel=labels[1])
        return figure

    return png(draw, resolution)


def ellipse(centre: Array, covariance: Array, scale: float) -> Array:
    """Iso-uncertainty curve (73, 2) of a covariance (2, 2) about ``centre`` (2,), ``scale`` standard deviations wide.

    Valencia & Andrade-Cetto (2018) fig. 2.4 and 2.5.
    """
    width, axis = np.linalg.eigh(covariance)
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    half = scale * np.sqrt(np.maximum(width, 0.0))
    curve: Array = axis @ (half[:, None] * np.stack([np.cos(turn), np.sin(turn)])) + np.asarray(centre)[:, None]
    return curve.T
