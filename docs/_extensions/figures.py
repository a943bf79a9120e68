"""The figure of a script in the gallery is what it leaves in ``figure``; README.md shows some of them."""

from __future__ import annotations

from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure
from sphinx.application import Sphinx
from sphinx_gallery.scrapers import figure_rst

from consistency.referee.show.blocks import COLOURS
from consistency.referee.system import quiet

LOOK = {
    "axes.linewidth": 0.7,
    "axes.prop_cycle": mpl.cycler(color=COLOURS),
    "axes.spines.right": False,
    "axes.spines.top": False,
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "legend.frameon": False,
}
RESOLUTION = 160  # dots an inch


def plain_look(conf: Any = None, script: Any = None) -> None:
    """Settings of Matplotlib for all figures; sphinx-gallery calls it before each script."""
    mpl.rcdefaults()
    mpl.use("agg")
    mpl.rcParams.update(LOOK)


def save(figure: Figure, path: Any) -> None:
    """On white, so that it can be read on dark pages too."""
    figure.savefig(path, dpi=RESOLUTION, facecolor="white")


def figure_scraper(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Save the figure after the block that made it; sphinx-gallery asks after every block of a script."""
    figure = block_vars["example_globals"].pop("figure", None)
    if figure is None:
        return ""
    path = next(block_vars["image_path_iterator"])
    save(figure, path)
    return str(figure_rst([path], gallery_conf["src_dir"]))


def setup(app: Sphinx) -> dict[str, bool]:
    """Run the scripts without progress among their outputs."""
    silence = quiet()
    silence.__enter__()
    app.connect("build-finished", lambda *_: silence.__exit__(None, None, None))
    return {"parallel_read_safe": True}
