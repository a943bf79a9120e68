"""Blocks on a terminal, in colours, and without them in pipes and files."""

from __future__ import annotations

import sys

from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

from consistency.referee.show.blocks import PLAIN, Block, Cell, Reasons, Status, Table, fragment, written

COLOURS = {
    "consistent": "green", "overconfident": "red", "conservative": "yellow", "biased": "red", "heavy-tailed": "red",
    "inconsistent": "red", "failed": "red", "undecided": "yellow",
    "reproduced": "green", "not reproduced": "yellow", "refuted": "red", "holds": "green",
    "not shown": "yellow",
}  # fmt: skip


def show(*blocks: Block) -> None:
    """Print blocks one below the other; a block of reasons has an empty line before each."""
    # pipes and files get plain wide lines, so that nothing is cut
    console = Console(file=sys.stdout, width=None if sys.stdout.isatty() else 160, highlight=False)
    for block in blocks:
        if isinstance(block, Table):
            console.print(_table(block))
            continue
        parts = [Reasons((entry,)) for entry in block.entries] if isinstance(block, Reasons) else [block]
        for part in parts:
            above = "\n" if isinstance(part, Reasons) else ""
            console.print(above + fragment(part), markup=False, soft_wrap=not console.is_terminal)


def _table(table: Table) -> RichTable:
    shown = RichTable(box=None, pad_edge=False)
    for column in table.columns:
        shown.add_column(
            escape(column.head),
            justify="right" if column.number else "left",
            overflow="fold" if table.style == "prose" else "ellipsis",
            max_width=column.most,
        )
    for cells in table.rows:
        shown.add_row(*map(_cell, cells))
    return shown


def _cell(cell: Cell) -> str:
    if isinstance(cell, Status):
        colour = COLOURS[cell.text]
        return f"[{colour}]{escape(cell.text)}[/{colour}]{escape(cell.note)}"
    return escape(written(cell, PLAIN))
