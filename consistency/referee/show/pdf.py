"""A document as a PDF: the figures of the page, set by Typst; no LaTeX and no system font."""

from __future__ import annotations

import json
import re
import tempfile
from dataclasses import fields, is_dataclass
from importlib import resources
from itertools import zip_longest
from pathlib import Path
from typing import Any

import matplotlib as mpl
import typst

from consistency.referee.show import blocks
from consistency.referee.show.blocks import unbroken, written
from consistency.referee.show.figures import Pictures, paint
from consistency.referee.system import AT_STOP, remove_at_stop

TEMPLATE = "report.typ"
FONTS = Path(mpl.get_data_path()) / "fonts" / "ttf"  # those of the figures, whose text stays text
LONG_WORD = re.compile(r"[^\s\u200b]{1,13}-(?=[^\W\d])|[^\s\u200b]{14}")  # at a hyphen within reach, else anywhere


def render_pdf(document: blocks.Document, pictures: Pictures | None = None) -> bytes:
    """The whole document; the same document gives the same bytes.

    Parameters
    ----------
    pictures : those of the document, painted here if none are given
    """
    with tempfile.TemporaryDirectory(prefix="consistency-report-") as name:
        folder = Path(name)
        removal = remove_at_stop(folder)
        paper = Paper(folder, paint(document) if pictures is None else pictures)
        data = {part: paper.plain(getattr(document, part)) for part in ("title", "badges", "answer", "opening")}
        data["chapters"] = paper.plain(document.paper)
        (folder / "data.json").write_text(json.dumps(data, ensure_ascii=False), encoding="utf-8")
        template = resources.files("consistency.referee.show").joinpath("templates").joinpath(TEMPLATE)
        (folder / TEMPLATE).write_text(template.read_text(encoding="utf-8"), encoding="utf-8")
        pdf: bytes = typst.compile(
            str(folder / TEMPLATE), root=str(folder), ignore_system_fonts=True, font_paths=[str(FONTS)]
        )
        AT_STOP.remove(removal)
        return pdf


class Paper:
    """What the template is given: the fields of each block by name, with its kind."""

    def __init__(self, folder: Path, pictures: Pictures) -> None:
        self.folder = folder
        self.pictures = pictures
        self.files = 0

    def plain(self, value: Any) -> Any:
        """A block, a cell, or what they hold; text can break, and figures are files."""
        match value:
            case str():
                return soft(value)
            case tuple():
                return [self.plain(each) for each in value]
            case blocks.Name() | blocks.Quantity() | blocks.Reason():
                return soft(written(value))
            case blocks.Reasons():
                return {"kind": "Reasons", "entries": [self._fields(entry) for entry in value.entries]}
            case blocks.Settings():
                return {"kind": "Settings", "cells": _settings(json.loads(value.text))}
            case blocks.Figure():
                images = [self._file(svg) for svg in self.pictures.get(id(value), ())]
                return {"kind": "Figure", "images": images, "title": soft(value.title), "caption": soft(value.caption)}
            case _ if is_dataclass(value):
                return self._fields(value)
            case _:
                return value

    def _fields(self, value: Any) -> dict[str, Any]:
        named = {field.name: self.plain(getattr(value, field.name)) for field in fields(value)}
        return {"kind": type(value).__name__} | named

    def _file(self, svg: str) -> str:
        """The name of a file with a picture."""
        self.files += 1
        name = f"{self.files}.svg"
        (self.folder / name).write_text(svg, encoding="utf-8")
        return name


def soft(text: str) -> str:
    """Add break points inside long words, so that no text runs over an edge, and forbid some others."""
    return LONG_WORD.sub(lambda match: match.group() + "\u200b", unbroken(text))


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
