"""What a figure of a document draws, as axes of Matplotlib."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch

from consistency.referee.document.blocks import Block, Document, Figure
from consistency.referee.show.svg import drawn
from consistency.referee.types import Array


def panels(figure: Figure, number: int = 0) -> list[Axes]:
    """Axes that are used in one drawing of a figure."""
    return [axes for axes in drawn(figure.drawings[number]).axes if axes.axison]


def lines(axes: Axes, label: str | None = None) -> list[Line2D]:
    """Curves and markers, of one label or all, in the order in which they were drawn."""
    return [line for line in axes.lines if label is None or line.get_label() == label]


def titles(panels: list[Axes]) -> list[str]:
    """Titles of panels, which stand at the left."""
    return [axes.get_title(loc="left") for axes in panels]


def places(axes: Axes) -> list[Array]:
    """Of small points (N, 2), a patch each."""
    patches = [patch for patch in axes.patches if isinstance(patch, PathPatch)]
    return [np.asarray(patch.get_path().vertices)[::2] for patch in patches]


def shaded(axes: Axes, number: int = 0) -> tuple[float, float]:
    """Least and greatest height of a band."""
    heights = np.asarray(axes.collections[number].get_paths()[0].vertices)[:, 1]
    return float(heights.min()), float(heights.max())


def legend_of(figure: Any) -> list[str]:
    """Texts of the legend of a drawing."""
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def by_title(found: Document | tuple[Block, ...]) -> dict[str, Figure]:
    """Figures of a document, or of some blocks."""
    blocks = found.figures if isinstance(found, Document) else found
    return {block.title: block for block in blocks if isinstance(block, Figure)}
