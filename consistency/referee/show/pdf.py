"""A document as a PDF: Matplotlib figures as SVG, set by Typst; no LaTeX and no system font."""

from __future__ import annotations

import gc
import json
import os
import pickle
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import resources
from itertools import zip_longest
from pathlib import Path
from typing import Any

import typst

from consistency.referee.document import blocks
from consistency.referee.document.drawing import Figure
from consistency.referee.document.wording import written
from consistency.referee.show import with_matplotlib

TEMPLATE = "report.typ"
MANY = 24  # sheets that take longer to draw than a process to start
LONG_WORD = re.compile(r"[^\s\u200b]{1,13}-(?=[^\W\d])|[^\s\u200b]{14}")  # at a hyphen within reach, else anywhere


def render_pdf(document: blocks.Document) -> bytes:
    """The whole document; the same document gives the same bytes."""
    with tempfile.TemporaryDirectory(prefix="consistency-report-") as name:
        folder = Path(name)
        data = {
            "title": soft(document.title),
            "answer": soft(document.answer),
            "opening": _blocks(document.opening, "opening", folder),
            "chapters": [
                {"title": soft(c.title), "summary": soft(c.summary), "blocks": _blocks(c.blocks, c.anchor, folder)}
                for c in document.chapters
            ],
        }
        (folder / "data.json").write_text(json.dumps(data, ensure_ascii=False), encoding="utf-8")
        template = resources.files("consistency.referee.show").joinpath("templates").joinpath(TEMPLATE)
        (folder / TEMPLATE).write_text(template.read_text(encoding="utf-8"), encoding="utf-8")
        pdf: bytes = typst.compile(str(folder / TEMPLATE), root=str(folder), ignore_system_fonts=True)
        return pdf


@contextmanager
def pdf_beside(document: blocks.Document) -> Iterator[Callable[[], bytes]]:
    """Set a long document in a process of its own, while this one does something else.

    Gives a function that waits for the PDF; a short document is set when that is called.
    """
    if sum(len(figure.sheets) for figure in document.figures) < MANY or (os.cpu_count() or 1) < 2:
        yield lambda: render_pdf(document)
        return
    with tempfile.TemporaryDirectory(prefix="consistency-report-") as name:
        source, target = Path(name) / "document", Path(name) / "pdf"
        source.write_bytes(pickle.dumps(document))
        process = subprocess.Popen([sys.executable, "-m", __name__, source, target], stderr=subprocess.DEVNULL)
        try:
            # what goes wrong there goes wrong here, where it is reported
            yield lambda: target.read_bytes() if process.wait() == 0 else render_pdf(document)
        finally:
            process.kill()
            process.wait()


def _blocks(part: Sequence[blocks.Block], name: str, folder: Path) -> list[dict[str, Any]]:
    return [_block(block, f"{name}-{i}", folder) for i, block in enumerate(part)]


def _block(block: blocks.Block, name: str, folder: Path) -> dict[str, Any]:
    """What the template needs of a block; images are files in ``folder`` whose names begin with ``name``."""
    match block:
        case Figure():
            content = _figure(block, name, folder)
        case blocks.Heading():
            content = {"text": soft(block.paper)}
        case blocks.Text():
            content = {"lead": soft(block.lead), "text": soft(block.text)}
        case blocks.Table():
            content = {
                "columns": [{"head": soft(c.short), "width": c.width, "number": c.number} for c in block.columns],
                "groups": [[soft(title), [list(map(_cell, row)) for row in rows]] for title, rows in block.groups],
                "caption": soft(block.paper or block.caption), "style": block.style, "whole": block.whole,
            }  # fmt: skip
        case blocks.Reasons():
            entries = [
                {"name": soft(e.name), "sentence": soft(e.sentence), "others": list(map(soft, e.others))}
                for e in block.entries
            ]
            content = {"entries": entries}
        case blocks.Facts():
            rows = [[soft(key), soft(value)] for key, value in block.rows]
            content = {"rows": rows, "heads": block.heads, "width": block.width}
        case blocks.Bullets():
            content = {"texts": [soft(text) for text in block.texts]}
        case blocks.Settings():
            content = {"cells": _settings(json.loads(block.text))}
        case blocks.Details():
            inner = _blocks(block.blocks, name, folder)
            content = {"heading": soft(block.paper), "blocks": inner, "whole": block.whole}
    return {"kind": type(block).__name__} | content


def _figure(figure: Figure, name: str, folder: Path) -> dict[str, Any]:
    images = []
    for number, sheet in enumerate(figure.sheets):
        path = folder / f"{name}-{number}.svg"
        path.write_bytes(with_matplotlib.render(sheet))
        images.append(path.name)
    return {"images": images, "caption": soft(figure.paper or figure.caption), "stacked": figure.stacked}


def _cell(cell: blocks.Cell) -> Any:
    match cell:
        case blocks.Answer():
            return {"kind": "Answer", "mark": cell.mark, "text": soft(cell.text), "emphasis": cell.emphasis}
        case blocks.Stack():
            lines = [(line.text if line.paper is None else line.paper, line.italic) for line in cell.below]
            below = [{"text": soft(text), "italic": italic} for text, italic in lines if text]
            return {"kind": "Stack", "text": soft(cell.text), "bold": cell.bold, "below": below}
        case blocks.Status():
            return {"kind": "Status", "text": soft(cell.text), "note": soft(cell.note)}
        case _:
            return soft(written(cell))


def soft(text: str) -> str:
    """Add break points inside long words, and forbid breaks before %, so that no text runs over an edge."""
    return LONG_WORD.sub(lambda match: match.group() + "\u200b", text.replace(" %", "\u00a0%"))


def _settings(resolved: dict[str, Any]) -> list[list[str]]:
    """Rows of key, value, key, value: two columns of settings, read downwards; what is not set is left out."""
    pairs = [pair for key, value in resolved.items() if key not in ("name", "summary") for pair in _pairs(value, key)]
    half = -(-len(pairs) // 2)
    return [
        [soft(cell) for cell in (*left, *right)]
        for left, right in zip_longest(pairs[:half], pairs[half:], fillvalue=("", ""))
    ]


def _pairs(value: Any, path: str) -> list[tuple[str, str]]:
    if isinstance(value, dict):
        return [pair for key, item in value.items() for pair in _pairs(item, f"{path}.{key}")]
    return [] if value is None else [(path, json.dumps(value, ensure_ascii=False))]


if __name__ == "__main__":
    gc.disable()  # the process ends soon, and looking for garbage takes a tenth of its time
    Path(sys.argv[2]).write_bytes(render_pdf(pickle.loads(Path(sys.argv[1]).read_bytes())))
