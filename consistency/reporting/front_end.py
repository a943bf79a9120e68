"""Figures of the stereo front-end: features with their ellipses, and poses of a Monte Carlo simulation."""

from __future__ import annotations

from io import BytesIO

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from consistency.reporting import plots
from consistency.reporting.figures import RC, WIDTH
from consistency.types import Array

FEATURES = 3.0  # standard deviations of the ellipses, fig. 2.4
POSES = 2.0  # fig. 2.5
PLANES = ((0, 2, "x (mm)", "z (mm)"), (0, 1, "x (mm)", "y (mm)"), (3, 4, "roll (mrad)", "pitch (mrad)"))
NOISE = plots.Style(plots.COLOURS[1], (), "o")
MONTE_CARLO, IMPLICIT = plots.Style(plots.TRUTH, (), "o"), plots.Style(plots.COLOURS[2], plots.DASHES[1], "s")


def matches_png(image: Array, uv: Array, covariances: Array, resolution: int = 200) -> bytes:
    """Features (n, 2) px with covariances (n, 2, 2) px^2 on an image (h, w), ellipses of 3 standard deviations.

    As Valencia & Andrade-Cetto (2018) fig. 2.4.
    """
    with mpl.rc_context(RC):
        figure = Figure(figsize=(WIDTH, WIDTH * image.shape[0] / image.shape[1]), layout="constrained")
        axes = figure.subplots()
        plots.image(axes, image)
        for centre, covariance in zip(uv, covariances, strict=True):
            plots.ellipse(axes, centre, covariance, FEATURES, NOISE)
        return _png(figure, resolution)


def samples_png(samples: Array, centre: Array, covariance: Array, resolution: int = 200) -> bytes:
    """Poses (n, 6) in m and rad, their covariance (black) and the propagated one (6, 6) about ``centre`` (6,) (green).

    As Valencia & Andrade-Cetto (2018) fig. 2.5, ellipses of 2 standard deviations.
    """
    spread = np.cov(samples.T)
    with mpl.rc_context(RC):
        figure = Figure(figsize=(WIDTH, WIDTH / 3), layout="constrained")
        for axes, (i, j, *labels) in zip(figure.subplots(1, len(PLANES)), PLANES, strict=True):
            plots.cloud(axes, 1e3 * samples[:, [i, j]], (labels[0], labels[1]))
            both = np.ix_([i, j], [i, j])
            plots.ellipse(axes, 1e3 * samples[:, [i, j]].mean(axis=0), 1e6 * spread[both], POSES, MONTE_CARLO)
            plots.ellipse(axes, 1e3 * centre[[i, j]], 1e6 * covariance[both], POSES, IMPLICIT)
        return _png(figure, resolution)


def _png(figure: Figure, resolution: int) -> bytes:
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=resolution, metadata={"Software": None})
    return buffer.getvalue()
