"""Renderers of a document, one in a file; they know the tree of ``document`` and nothing else.

A renderer whose whole output is one text has ``render(document)`` and a row in :data:`FORMATS`.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from consistency.referee.document.blocks import Document

FORMATS = {".json": "json", ".html": "static_html", ".xml": "junit", ".md": "markdown"}  # suffix of a file -> renderer


def rendered(document: Document, path: Path) -> str:
    """The text of a file, in the format of its suffix."""
    text: str = import_module(f"consistency.referee.show.{FORMATS[path.suffix.lower()]}").render(document)
    return text + "\n" * (not text.endswith("\n"))
