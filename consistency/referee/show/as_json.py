"""The data of a document as JSON."""

from __future__ import annotations

import json

from consistency.referee.diagnostics.verdict import plain
from consistency.referee.show.blocks import Document


def render(document: Document) -> str:
    """The data; NaN and infinity become null."""
    return json.dumps(plain(document.data), indent=2, allow_nan=False)
