"""A document as a PDF: the figures of the page, set by Typst; no LaTeX and no system font."""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Sequence
from importlib import resources
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import typst

from consistency.referee.document import blocks
from consistency.referee.document.wording import written
from consistency.referee.show.svg import Pictures, paint

TEMPLATE = "report.typ"
FONTS = Path(mpl.get_data_path()) / "fonts" / "ttf"  # those of the figures, whose text stays text
LONG_WORD = re.compile(r"[^\s\u200b]{1,13}-(?=[^\W\d])|[^\s\u200b]{14}")  # at a hyphen within reach, else anywhere


def render_pdf(document: blocks.Document, pictures: Pictures | None = None) -> bytes:
    """The whole document; the same document gives the same bytes.

    Parameters
    ----------
    pictures : those of the document, painted here if none are given
    """
    pictures = paint(document) if pictures is None else pictures
    with tempfile.TemporaryDirectory(prefix="consistency-report-") as name:
        folder = Path(name)
        paper = Paper(folder, pictures)
        data = {
            "title": soft(document.title),
            "answer": soft(document.answer),
            "opening": _blocks(document.opening, "opening", paper),
            "chapters": [
                {"title": soft(c.title), "summary": soft(c.summary), "blocks": _blocks(c.blocks, c.anchor, paper)}
                for c in document.chapters
            ],
        }
        (folder / "data.json").write_text(json.dumps(data, ensure_ascii=False), encoding="utf-8")
        template = resources.files("consistency.referee.show").joinpath("templates").joinpath(TEMPLATE)
        (folder / TEMPLATE).write_text(template.read_text(encoding="utf-8"), encoding="utf-8")
        pdf: bytes = typst.compile(
            str(folder / TEMPLATE), root=str(folder), ignore_system_fonts=True, font_paths=[str(FONTS)]
        )
        return pdf


class Paper(NamedTuple):
    """Where the files of a document are written, and what they show."""

    folder: Path
    pictures: Pictures


def _blocks(part: Sequence[blocks.Block], name: str, paper: Paper) -> list[dict[str, Any]]:
    return [_block(block, f"{name}-{i}", paper) for i, block in enumerate(part)]


def _block(block: blocks.Block, name: str, paper: Paper) -> dict[str, Any]:
    """What the template needs of a block; images are files in ``folder`` whose names begin with ``name``."""
    match block:
        case blocks.Figure():
            content = _figure(block, name, paper)
        case blocks.Heading():
            content = {"text": soft(block.text)}
        case blocks.Text():
            content = {"lead": soft(block.lead), "text": soft(block.text)}
        case blocks.Table():
            content = {
                "columns": [{"head": soft(c.short), "width": c.width, "number": c.number} for c in block.columns],
                "groups": [[soft(title), [list(map(_cell, row)) for row in rows]] for title, rows in block.groups],
                "caption": soft(block.caption), "style": block.style, "whole": block.whole,
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
            inner = _blocks(block.blocks, name, paper)
            content = {"heading": soft(block.summary), "blocks": inner, "whole": block.whole}
    return {"kind": type(block).__name__} | content


def _figure(figure: blocks.Figure, name: str, paper: Paper) -> dict[str, Any]:
    images = []
    for number, svg in enumerate(paper.pictures.get(id(figure), ())):
        path = paper.folder / f"{name}-{number}.svg"
        path.write_text(svg, encoding="utf-8")
        images.append(path.name)
    return {"images": images, "title": soft(figure.title), "caption": soft(figure.caption)}


def _cell(cell: blocks.Cell) -> Any:
    match cell:
        case blocks.Answer():
            return {"kind": "Answer", "mark": cell.mark, "text": soft(cell.text), "emphasis": cell.emphasis}
        case blocks.Stack():
            below = [{"text": soft(line.text), "italic": line.italic} for line in cell.below]
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
