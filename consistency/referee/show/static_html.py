"""HTML pages without scripts, which need no optional package: gates, and verdicts where [report] is missing."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Sequence
from html import escape
from importlib.util import find_spec

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

# colours of the bench's report, and lighter ones on dark ground with a contrast above 4.5
STYLE = """
:root { color-scheme: light dark; --ink: #1a1a1a; --ground: #fff; --line: #d5d5d5; --faint: #444;
  --consistent: #00664a; --overconfident: #a84300; --conservative: #00507d; --biased: #8a2a63; --undecided: #4d4d4d; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8e8e8; --ground: #16181a; --line: #44484c; --faint: #b5b5b5;
  --consistent: #4fd1a5; --overconfident: #ff9d5c; --conservative: #6cb8f0; --biased: #f09cc8; --undecided: #b5b5b5; } }
body { margin: 0 auto; padding: 1rem 1.25rem 3rem; max-width: 96rem; color: var(--ink); background: var(--ground);
  font: 1rem/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .9rem; font-variant-numeric: tabular-nums; }
th, td { padding: .35rem .5rem; border-bottom: 1px solid var(--line); text-align: left; vertical-align: top; }
thead th { border-bottom: 2px solid var(--ink); }
tbody th { font-weight: 600; overflow-wrap: anywhere; min-width: 12rem; }
tbody td:last-child { min-width: 22rem; }
.number { text-align: right; white-space: nowrap; }
.verdict { display: inline-block; padding: 0 .5em; border: 1.5px solid currentColor; border-radius: .7em;
  font-weight: 600; white-space: nowrap; }
.consistent, .not-worse { color: var(--consistent); }
.overconfident, .worse { color: var(--overconfident); }
.conservative { color: var(--conservative); border-style: dashed; }
.biased { color: var(--biased); }
.heavy-tailed { color: var(--biased); border-style: dashed; }
.inconsistent { color: var(--overconfident); border-style: dashed; }
.undecided { color: var(--undecided); border-style: dotted; }
.failed { color: var(--ground); background: var(--ink); border-color: var(--ink); }
summary { cursor: pointer; }
ul { margin: .25rem 0; padding-left: 1.2rem; color: var(--faint); }
"""


def render(document: Document) -> str:
    """One page that needs nothing else."""
    parts = [f"<p>{escape(document.answer)}</p>"] if document.answer else []
    parts += map(block, document.opening)
    for chapter in document.chapters:
        inside = "\n".join(map(block, chapter.blocks))
        parts.append(f"<section>\n{inside}\n</section>" if chapter.title else inside)
    return page(document.title, *parts)


def page(title: str, *body: str) -> str:
    """One page of HTML ``body``."""
    inside = "\n".join(body)
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>{STYLE}</style>
</head>
<body>
<main>
<h1>{escape(title)}</h1>
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
            return "".join(_reason(entry) for entry in of.entries)
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


def _reason(entry: Reason) -> str:
    others = _list(entry.others) if entry.others else ""
    return f"<p><strong>{escape(entry.name)}</strong> is {escape(entry.sentence)}</p>{others}"


def _table(of: Table) -> str:
    head = "".join(f'<th scope="col"{_class(column)}>{escape(column.head)}</th>' for column in of.columns)
    rows = "\n".join(_row(of.columns, cells) for cells in of.rows)
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(of.label)}">\n<table>\n'
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{rows}\n</tbody>\n</table>\n</div>"
    )


def _row(columns: Sequence[Column], cells: Sequence[Cell]) -> str:
    first, *others = cells
    pairs = zip(columns[1:], others, strict=False)
    body = "".join(f"<td{_class(column)}>{_cell(cell)}</td>" for column, cell in pairs)
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
    """Its sheets as one image each, named by its title."""
    if find_spec("matplotlib") is None:
        return ""
    from consistency.referee.show.with_matplotlib import render as painted

    sources = (b64encode(painted(sheet, "png", RESOLUTION)).decode() for sheet in of.sheets)
    return "".join(f'<img alt="{escape(of.title)}" src="data:image/png;base64,{source}">' for source in sources)
