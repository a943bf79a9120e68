"""The picture of a script in the gallery is the figure that it leaves in ``figure``."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst

RESOLUTION = 160  # dots an inch


def figure_scraper(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Save the figure after the block that made it; sphinx-gallery asks after every block of a script."""
    figure = block_vars["example_globals"].get("figure")
    if not isinstance(figure, Figure) or getattr(figure, "is_shown", False):
        return ""
    path = next(block_vars["image_path_iterator"])
    figure.savefig(path, dpi=RESOLUTION, facecolor="white")
    figure.is_shown = True  # type: ignore[attr-defined]
    return figure_rst([path], gallery_conf["src_dir"])
