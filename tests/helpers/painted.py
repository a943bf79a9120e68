"""What a figure of a document draws, as axes of Matplotlib."""

import numpy as np
from matplotlib.patches import PathPatch

from consistency.referee.show.blocks import Document, Figure
from consistency.referee.show.figures import drawn


def panels(figure, number=0):
    """Axes that are used in one drawing of a figure."""
    return [axes for axes in drawn(figure.drawings[number]).axes if axes.axison]


def lines(axes, label=None):
    """Curves and markers, of one label or all, in the order in which they were drawn."""
    return [line for line in axes.lines if label is None or line.get_label() == label]


def titles(panels):
    """Titles of panels, which stand at the left."""
    return [axes.get_title(loc="left") for axes in panels]


def places(axes):
    """Of small points (N, 2), a patch each."""
    patches = [patch for patch in axes.patches if isinstance(patch, PathPatch)]
    return [np.asarray(patch.get_path().vertices)[::2] for patch in patches]


def shaded(axes, number=0):
    """Least and greatest height of a band."""
    heights = np.asarray(axes.collections[number].get_paths()[0].vertices)[:, 1]
    return float(heights.min()), float(heights.max())


def legend_of(figure):
    """Texts of the legend of a drawing."""
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def by_title(found):
    """Figures of a document, or of some blocks."""
    blocks = found.figures if isinstance(found, Document) else found
    return {block.title: block for block in blocks if isinstance(block, Figure)}
