"""HTML pages without scripts, which need no optional package: gates, and verdicts where [report] is missing."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Sequence
from html import escape
from importlib.util import find_spec
from pathlib import Path

from consistency.referee.document.blocks import (
    Block,
    Bullets,
    Cell,
    Column,
    Details,
    Document,
    Facts,
    Heading,
    Reason,
    Reasons,
    Status,
    Table,
    Text,
)
from consistency.referee.document.drawing import Figure
from consistency.referee.document.wording import PLAIN, written

RESOLUTION = 110  # dots an inch
STYLE = (Path(__file__).parent / "templates" / "report.css").read_text(encoding="utf-8")


def render(document: Document) -> str:
    """One page that needs nothing else."""
    parts = [f"<p>{escape(document.answer)}</p>"] if document.answer else []
    parts += map(block, document.opening)
    for chapter in document.chapters:
        blocks = "\n".join(map(block, chapter.blocks))
        parts.append(f"<section>\n{blocks}\n</section>" if chapter.title else blocks)
    title, inside = escape(document.title), "\n".join(parts)
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{STYLE}</style>
</head>
<body class="static">
<main>
<h1>{title}</h1>
{inside}
</main>
</body>
</html>
"""


def fragment(*blocks: Block) -> str:
    """Blocks in a box of their own, for a notebook."""
    return f"<div>{''.join(map(block, blocks))}</div>"


def block(of: Block) -> str:
    """One block; settings are left out, and figures where Matplotlib is not installed."""
    match of:
        case Text():
            lead = f"<strong>{escape(of.lead)}</strong> " if of.lead else ""
            return f"<p>{lead}{escape(of.text)}</p>"
        case Heading():
            return f"<h{of.level}>{escape(of.text)}</h{of.level}>"
        case Reasons():
            return "".join(
                f"<p><strong>{escape(entry.name)}</strong> is {escape(entry.sentence)}</p>"
                + (_list(entry.others) if entry.others else "")
                for entry in of.entries
            )
        case Facts():
            rows = "".join(f"<tr>{_left('th', name)}{_left('td', value)}</tr>" for name, value in of.rows)
            return f"<table>{rows}</table>"
        case Bullets():
            return _list(of.texts)
        case Table():
            return _table(of)
        case Details():
            inside = "".join(map(block, of.blocks))
            return f"<details><summary>{escape(of.summary)}</summary>{inside}</details>"
        case Figure():
            return _figure(of)
        case _:
            return ""


def _left(tag: str, text: str) -> str:
    return f'<{tag} style="text-align:left">{escape(text)}</{tag}>'


def _list(texts: Iterable[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape(text)}</li>' for text in texts)}</ul>"


def _table(of: Table) -> str:
    head = "".join(f'<th scope="col"{_class(column)}>{escape(column.head)}</th>' for column in of.columns)
    rows = "\n".join(_row(of.columns, cells) for cells in of.rows)
    wide = " wide" * (len(of.columns) > 4)
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(of.label)}">\n'
        f'<table class="{of.style}{wide}">\n'
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{rows}\n</tbody>\n</table>\n</div>"
    )


def _row(columns: Sequence[Column], cells: Sequence[Cell]) -> str:
    first, *others = cells
    pairs = zip(columns[1:], others, strict=False)
    body = "".join(
        f'<td{_class(column)} data-head="{escape(column.head)}">{_cell(cell)}</td>' for column, cell in pairs
    )
    return f'<tr><th scope="row">{_cell(first)}</th>{body}</tr>'


def _class(column: Column) -> str:
    return ' class="number"' if column.number else ""


def _cell(cell: Cell) -> str:
    if isinstance(cell, Status):
        colour = cell.text.replace(" ", "-")
        return f'<span class="verdict {escape(colour)}">{escape(cell.text)}</span>{escape(cell.note)}'
    if isinstance(cell, Reason):
        return f"<details><summary>{escape(cell.sentence)}</summary>{_list(cell.others)}</details>"
    return escape(written(cell, PLAIN))


def _figure(of: Figure) -> str:
    """Its sheets as one image each, named by its title, with the caption below."""
    if find_spec("matplotlib") is None:
        return ""
    from consistency.referee.show.with_matplotlib import render as painted

    sources = (b64encode(painted(sheet, "png", RESOLUTION)).decode() for sheet in of.sheets)
    images = "".join(f'<img alt="{escape(of.title)}" src="data:image/png;base64,{source}">' for source in sources)
    return f"<figure>{images}<figcaption>{escape(of.caption)}</figcaption></figure>"
