"""A document as Markdown of GitHub, such as the summary of a job."""

from __future__ import annotations

import re

from consistency.referee.diagnostics.number_words import with_subject
from consistency.referee.show.blocks import (
    PLAIN,
    Block,
    Bullets,
    Cell,
    Document,
    Facts,
    Heading,
    Reasons,
    Table,
    Text,
    written,
)

MARKUP = re.compile(r"[*]|(?<!\w)_|_(?!\w)|~(?=~)|\[(?![-+.\d][^\]]*\](?!\())|(?<=\])\(")  # but intervals: [1.4, 2.0]
ESCAPED = (("&", "&amp;"), ("<", "&lt;"), ("|", "\\|"), ("`", "\\`"))


def render(document: Document) -> str:
    """Title and answer, then all blocks; figures and settings are left out."""
    parts = [f"## {_line(document.title)}", _line(document.answer), *map(_block, document.opening)]
    for chapter in document.chapters:
        parts += [f"### {_line(chapter.title)}", _line(chapter.summary), *map(_block, chapter.blocks)]
    return "\n\n".join(part for part in parts if part) + "\n\n"


def _block(block: Block) -> str:
    match block:
        case Table():
            rows = (map(_cell, cells) for cells in block.rows)
            lines = [[_line(column.head) for column in block.columns], ["---"] * len(block.columns), *rows]
            return "\n".join(f"| {' | '.join(line)} |" for line in lines)
        case Reasons():
            return "\n\n".join(with_subject(f"**{_line(e.name)}**", _line(e.sentence)) for e in block.entries)
        case Facts():
            return "\n".join(f"- {_line(name)}: {_line(value)}" for name, value in block.rows)
        case Bullets():
            return "\n".join(f"- {_line(text)}" for text in block.texts)
        case Heading():
            return f"#### {_line(block.text)}"
        case Text():
            return _line(f"{block.lead} {block.text}")
        case _:
            return ""


def _cell(cell: Cell) -> str:
    return _line(written(cell, PLAIN))


def _line(text: str) -> str:
    """Text on one line, without control characters and with nothing that is markup."""
    text = " ".join("".join(char if char.isprintable() else " " for char in text).split())
    for char, escaped in ESCAPED:
        text = text.replace(char, escaped)
    return MARKUP.sub(r"\\\g<0>", text)
