"""Renderers of a document, one in a file; they know its tree of plain data (``blocks``) and nothing else.

A renderer whose whole output is the text of a file is a module ``as_SUFFIX`` with ``render(document)``, in no list.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from consistency.referee.show.blocks import Document

# suffix of a file -> module of its renderer
FORMATS = {f".{name[3:]}": f"{__name__}.{name}" for _, name, _ in iter_modules(__path__) if name[:3] == "as_"}


def rendered(document: Document, path: Path) -> str:
    """The text of a file, in the format of its suffix."""
    text: str = import_module(FORMATS[path.suffix.lower()]).render(document)
    return text if text.endswith("\n") else f"{text}\n"
