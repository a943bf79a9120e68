"""A document as one HTML page that needs no other file and no package: pictures are left out without Matplotlib."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Sequence
from hashlib import sha256
from html import escape
from itertools import groupby
from pathlib import Path

from consistency.referee.show.blocks import (
    Answer,
    Block,
    Bullets,
    Cell,
    Chapter,
    Column,
    Details,
    Document,
    Facts,
    Figure,
    Heading,
    Look,
    Name,
    Reason,
    Reasons,
    Settings,
    Stack,
    Status,
    Table,
    Text,
    unbroken,
    written,
)
from consistency.referee.show.figures import Pictures, paint

TEMPLATES = Path(__file__).parent / "templates"
STYLE = (TEMPLATES / "report.css").read_text(encoding="utf-8")
SCRIPT = (TEMPLATES / "report.js").read_text(encoding="utf-8")
SHAPES = dict(zip("os^DvPX*", "●■▲◆▼✚✖★", strict=True))  # of markers, by Matplotlib's names
MANY = 4  # columns of a table beyond which a row stands by itself on a narrow screen


def render(document: Document, pictures: Pictures | None = None) -> str:
    """The whole page; ``pictures`` are those of the document, painted here if none are given."""
    page = Page(paint(document) if pictures is None else pictures)
    links = [f'<li><a href="#{escape(c.anchor)}">{escape(c.link)}</a></li>' for c in document.chapters if c.link]
    contents = f'<nav aria-label="Contents"><ul>{"".join(links)}</ul></nav>' if len(links) > 1 else ""
    badges = " ".join(f"<span>{_cell(badge)}</span>" for badge in document.badges)
    badges = f'<p class="badges">{badges}</p>' if badges else ""
    answer = f'<div class="answer">{badges}<p>{_prose(document.answer)}</p></div>' if document.answer else ""
    title, script = escape(document.title), ""
    policy = "'none'"
    if any(chapter.switches for chapter in document.chapters):
        script = f"<script>{SCRIPT}</script>"
        policy = f"'sha256-{b64encode(sha256(SCRIPT.encode()).digest()).decode()}'"
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; script-src {policy}; \
style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{title}</title>
<style>{STYLE}</style>
</head>
<body{' class="contents"' if contents else ""}>
<a class="skip" href="#content">Skip to the content</a>
<header><h1>{title}</h1></header>
{contents}
<main id="content">
{answer}
{page.blocks(document.opening)}
{page.chapters(document.chapters)}
</main>
{script}
</body>
</html>
"""


def fragment(*blocks: Block) -> str:
    """Blocks in a box of their own, for a notebook."""
    return f"<div>{Page(paint(Document('', '', (), blocks))).blocks(blocks)}</div>"


class Page:
    """Markup of blocks whose figures are painted."""

    def __init__(self, pictures: Pictures) -> None:
        self.pictures = pictures

    def chapters(self, chapters: Iterable[Chapter]) -> str:
        return "\n".join(map(self._chapter, chapters))

    def blocks(self, blocks: Iterable[Block]) -> str:
        """Blocks one below the other; figures that follow each other stand in two columns where there is room."""
        parts = []
        for is_figure, run in groupby(blocks, lambda block: isinstance(block, Figure)):
            inside = "\n".join(filter(None, map(self._block, run)))
            parts.append(f'<div class="figures">\n{inside}\n</div>' if is_figure and inside else inside)
        return "\n".join(parts)

    def _chapter(self, chapter: Chapter) -> str:
        anchor, blocks = escape(chapter.anchor), self.blocks(chapter.blocks)
        if not chapter.title:
            return blocks
        summary = _paragraph(chapter.summary) if chapter.summary else ""
        kind = switches = ""
        if chapter.switches:
            boxes = "\n".join(
                f'<label><input type="checkbox" checked autocomplete="off" data-filter="{escape(switch.tag)}">'
                f"{_swatch(switch.look)} {escape(switch.text)}</label>"
                for switch in chapter.switches
            )
            kind = ' class="study"'
            switches = f'<fieldset class="switches"><legend>Filters shown in this study</legend>\n{boxes}\n</fieldset>'
        return (
            f'<section{kind} id="{anchor}" aria-labelledby="{anchor}-title">\n'
            f'<h2 id="{anchor}-title">{escape(chapter.title)}</h2>\n{summary}{switches}\n{blocks}\n</section>'
        )

    def _block(self, block: Block) -> str:
        match block:
            case Text():
                lead = f"<strong>{escape(block.lead)}</strong> " if block.lead else ""
                return f'<p class="{block.style}">{lead}{_prose(block.text)}</p>'
            case Heading():
                return f"<h{block.level}>{escape(block.text)}</h{block.level}>"
            case Reasons():
                return f'<dl class="reasons">{"".join(map(_reason, block.entries))}</dl>'
            case Facts():
                rows = (f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in block.rows)
                return f'<dl class="facts">{"".join(rows)}</dl>'
            case Bullets():
                return _list(block.texts)
            case Settings():
                return f'<pre tabindex="0">{escape(block.text)}</pre>'
            case Table():
                return _table(block)
            case Details():
                return _details(block.summary, self.blocks(block.blocks))
            case Figure():
                return self._figure(block)

    def _figure(self, figure: Figure) -> str:
        drawings = self.pictures.get(id(figure), ())
        if not drawings:
            return ""
        title, caption = escape(figure.title), _prose(figure.caption)
        charts = "\n".join(
            f'<div class="chart" role="img" tabindex="0" aria-label="{title}">{svg}</div>' for svg in drawings
        )
        return (
            f"<figure>\n<h{figure.level}>{title}</h{figure.level}>\n{charts}\n"
            f"<figcaption>{caption}</figcaption>\n</figure>"
        )


def _swatch(look: Look) -> str:
    """A piece of the filter's line with its marker."""
    dash, shape = " ".join(f"{length:g}" for length in look.dash), SHAPES[look.marker]
    return (
        '<svg class="swatch" width="40" height="12" aria-hidden="true"><line x1="1" y1="6" x2="39" y2="6" '
        f'stroke="{look.colour}" stroke-width="{2 * look.width:g}" stroke-dasharray="{dash}"/>'
        f'<text x="20" y="10" text-anchor="middle" font-size="11" fill="{look.colour}">{shape}</text></svg>'
    )


def _paragraph(text: str, style: str = "") -> str:
    return f'<p class="{style}">{_prose(text)}</p>\n'


def _prose(text: str) -> str:
    return escape(unbroken(text))


def _list(texts: Iterable[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape(text)}</li>' for text in texts)}</ul>"


def _details(summary: str, inside: str) -> str:
    return f"<details><summary>{escape(summary)}</summary>{inside}</details>"


def _reason(entry: Reason) -> str:
    swatch = _swatch(entry.look) if entry.look is not None else ""
    others = _details("Figures behind it", _list(entry.others)) if entry.others else ""
    return f"<div><dt>{swatch} {escape(entry.name)}</dt><dd>{escape(entry.sentence)}{others}</dd></div>"


# --- tables -------------------------------------------------------------------------------------------


def _table(table: Table) -> str:
    caption = _paragraph(table.caption, "caption") if table.caption else ""
    heads = "".join(f'<th scope="col"{_class(column)}>{escape(column.head)}</th>' for column in table.columns)
    bodies = "\n".join(_body(table.columns, title, rows) for title, rows in table.groups)
    wide = " wide" if len(table.columns) > MANY else ""
    return (
        f'{caption}<div class="scroll" tabindex="0" role="region" aria-label="{escape(table.label)}">\n'
        f'<table class="{table.style}{wide}">\n<thead><tr>{heads}</tr></thead>\n{bodies}\n</table>\n</div>'
    )


def _body(columns: Sequence[Column], title: str, rows: Iterable[Sequence[Cell]]) -> str:
    head = ""
    if title:
        head = f'<tr><th scope="rowgroup" colspan="{len(columns)}">{escape(title)}</th></tr>\n'
    lines = "\n".join(f"<tr>{_row(columns, cells)}</tr>" for cells in rows)
    return f"<tbody>\n{head}{lines}\n</tbody>"


def _row(columns: Sequence[Column], cells: Sequence[Cell]) -> str:
    first, *others = cells
    body = "".join(
        f'<td{_class(column, cell)} data-head="{escape(column.head)}">{_cell(cell)}</td>'
        for column, cell in zip(columns[1:], others, strict=True)
    )
    if columns[0].number:
        return f'<td{_class(columns[0])} data-head="{escape(columns[0].head)}">{_cell(first)}</td>{body}'
    return f'<th scope="row">{_cell(first)}</th>{body}'


def _class(column: Column, cell: Cell = "") -> str:
    names = []
    if column.number:
        names.append("number")
    if isinstance(cell, Answer) and cell.emphasis:
        names.append(cell.emphasis)
    return f' class="{" ".join(names)}"' if names else ""


def _cell(cell: Cell) -> str:
    match cell:
        case Name():
            return f"<span>{_swatch(cell.look)} {escape(cell.text)}</span>"
        case Status():
            kind = escape(cell.text.replace(" ", "-"))
            return f'<span class="verdict {kind}">{escape(cell.text)}</span>{escape(cell.note)}'
        case Answer():
            return f'<span role="img" aria-label="{escape(cell.meaning)}">{cell.mark}</span> {escape(cell.text)}'
        case Stack():
            below = (f'<span class="small">{escape(line.text)}</span>' for line in cell.below)
            return escape(cell.text) + "".join(below)
        case Reason():
            return _details(cell.sentence, _list(cell.others))
        case _:
            return _prose(written(cell))
