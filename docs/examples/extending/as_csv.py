"""All tables of a document as comma-separated values."""

from __future__ import annotations

import csv
import io

from consistency.referee.show.blocks import PLAIN, Document, Table, written


def render(document: Document) -> str:
    """A line for the heads of each table, and one for each row."""
    out = io.StringIO()
    lines = csv.writer(out, lineterminator="\n")
    for block in (block for part in document.parts for block in part if isinstance(block, Table)):
        lines.writerow(column.head for column in block.columns)
        lines.writerows([written(cell, PLAIN) for cell in row] for row in block.rows)
    return out.getvalue()
