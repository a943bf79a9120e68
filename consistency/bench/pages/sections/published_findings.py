"""Exhibits: findings of an experiment beside the figures and tables that its numbers make."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from consistency.bench.pages.sections.report_input import Report
from consistency.bench.runs.reproduce_findings import not_run_table
from consistency.bench.store.parquet import read_frame
from consistency.bench.types import outcome
from consistency.referee.errors import InputError
from consistency.referee.parsing import one_line, reading
from consistency.referee.show.blocks import (
    Block,
    Cell,
    Column,
    Figure,
    Heading,
    Small,
    Stack,
    Status,
    Table,
    number,
    p_cell,
    table,
)
from consistency.referee.show.figures import add_legend, canvas, rows_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

OF_FINDINGS = (
    Column("Finding", width="2.5cm"),
    Column("Claim and rule", "Claim, rule and source", "2.5fr"),
    Column("Published", width="1.1fr"),
    Column("Measured", width="1.9fr"),
    Column("Verdict", width="1.75cm"),
)
STATUS, P_VALUE = "status", "p"  # in place of a format: the word of a verdict, a p value


@dataclass(frozen=True)
class Source:
    """A table that an experiment leaves, and what a report shows of it."""

    name: str  # of the file, without its suffix
    numbers: tuple[str, ...]
    texts: tuple[str, ...]
    show: Callable[[pd.DataFrame], Block]
    missing: tuple[str, ...] = ()  # numbers that may be NaN


@dataclass(frozen=True)
class Exhibit:
    """One or more findings that the same tables are behind."""

    findings: tuple[str, ...]  # ids
    title: str
    sources: tuple[Source, ...]


def exhibit_blocks(report: Report, exhibits: Sequence[Exhibit]) -> tuple[Block, ...]:
    """Each exhibit: its heading, its findings with published value, measured value and rule, and its tables.

    An exhibit without any of its tables is left out.
    """
    blocks: list[Block] = []
    for exhibit in exhibits:
        tables = []
        for source in exhibit.sources:
            path = report.folder / f"{source.name}.parquet"
            tables.append((source, extra_table(path, source.numbers, source.texts, source.missing)))
        own = [finding for finding in report.findings if finding["id"] in exhibit.findings]
        found = [source.show(data) for source, data in tables if data is not None]
        if found:
            blocks.append(Heading(exhibit.title))
            blocks += [claims_table(own, f"Findings on: {exhibit.title}")] if own else []
            blocks += found
    return tuple(blocks)


def claims_table(findings: Sequence[dict[str, Any]], label: str, caption: str = "", with_rules: bool = True) -> Table:
    """Claim, rule, published and measured value and verdict of each finding."""
    rows = [_row(finding, with_rules) for finding in findings]
    return table(OF_FINDINGS, rows, label, caption=caption, style="prose")


def all_findings(report: Report) -> tuple[Block, ...]:
    """Published claims of the folder beside what was measured."""
    caption = "Rules of acceptance are constants of the scripts, fixed before this run"
    return _with_not_run(report, claims_table(report.findings, "Findings", caption)) if report.findings else ()


def findings_on_paper(report: Report) -> tuple[Block, ...]:
    """The same without the rules."""
    caption = "The rule by which each is accepted, fixed before this run, stands in the HTML page"
    shown = claims_table(report.findings, "Findings", caption, with_rules=False)
    return _with_not_run(report, shown) if report.findings else ()


def _with_not_run(report: Report, findings: Table) -> tuple[Block, ...]:
    """The findings, then the experiments that were not run and how to run them."""
    if not (entries := report.manifest.get("not_run")):
        return (findings,)
    with reading(report.folder / "manifest.json", "key 'not_run' cannot be read; write the folder again"):
        return findings, Heading("Not run"), not_run_table(entries)


def _row(finding: dict[str, Any], with_rules: bool) -> tuple[Cell, ...]:
    below = []
    source = str(finding["source"] or "")
    if with_rules:
        below = _rule(finding, source)
    elif source:
        below = [Small(source)]
    return (
        Stack(str(finding["id"]), (), bold=True),
        Stack(str(finding["claim"]), tuple(below)),
        str(finding["published"]),
        str(finding["measured"]),
        Status(outcome(source, str(finding["verdict"]))),
    )


def _rule(finding: dict[str, Any], source: str) -> list[Small]:
    """When a finding is accepted, where it was published, and what was run."""
    below = []
    if finding["accept"]:
        below.append(Small(f"Accepted if: {finding['accept']}", italic=True))
    scenario, run = finding["scenario"], ""
    if scenario and scenario != "none":
        run = f"Scenario {scenario}, {finding['runs']} runs, seed {finding['seed']}."
    if source or run:
        below.append(Small(f"{source}. {run}" if source else run))
    return below


def listing(data: pd.DataFrame, heads: Mapping[str, tuple[str, str]], label: str, caption: str = "") -> Table:
    """Rows of a data frame.

    Parameters
    ----------
    heads : column: head, and the format of a number, :data:`P_VALUE`, :data:`STATUS`, or "" for text
    """
    columns = tuple(Column(head, number=form not in ("", STATUS)) for head, form in heads.values())
    forms, rows = [form for _, form in heads.values()], []
    for row in data[list(heads)].itertuples(index=False):
        rows.append(tuple(map(_cell, row, forms)))
    return table(columns, rows, label, caption=caption)


def _cell(value: Any, form: str) -> Cell:
    if form == STATUS:
        return Status(str(value))
    if form == P_VALUE:
        return "–" if pd.isna(value) else p_cell(value)
    return number(value, form) if form else str(value)


def single(title: str, caption: str, paint: Callable[[Axes], None]) -> Figure:
    """A figure of one panel; ``paint`` draws it."""
    return several(title, caption, (paint,))


def several(title: str, caption: str, paints: Sequence[Callable[[Axes], None]], height: float = 1.9) -> Figure:
    """A figure of panels side by side, each drawn by one of ``paints``."""

    def draw() -> Drawing:
        columns = rows_of(len(paints))
        figure, panels = canvas(height * -(-len(paints) // columns), columns, len(paints))
        for axes, paint in zip(panels, paints, strict=True):
            paint(axes)
        return add_legend(figure)

    return Figure(title, caption, (draw,), level=4)


def groups(data: pd.DataFrame, column: str) -> list[tuple[str, pd.DataFrame]]:
    """Rows by the text in a column, in the order in which the texts come."""
    return [(str(name), part) for name, part in data.groupby(column, sort=False)]


def extra_table(
    path: Path, numbers: Sequence[str], texts: Sequence[str] = (), missing: Sequence[str] = ()
) -> pd.DataFrame | None:
    """Columns of a Parquet file; None where the file does not exist.

    Parameters
    ----------
    numbers : columns of finite numbers, read as float
    texts : columns of names
    missing : columns of ``numbers`` that may hold NaN

    Raises
    ------
    InputError
        The file is damaged, has no rows, lacks a column or holds what the column may not.
    """
    if not path.exists():
        return None
    table = read_frame(path)
    wanted = [*numbers, *texts]
    if absent := [column for column in wanted if column not in table.columns]:
        raise InputError(f"{path}: column '{absent[0]}' is missing; needed: {', '.join(wanted)}")
    if not table.columns.is_unique:
        raise InputError(f"{path}: a column is duplicated; write the folder again")
    if table.empty:
        raise InputError(f"{path}: has no rows; write the folder again")
    for column in numbers:
        with reading(path, f"column '{column}' cannot be read as numbers"):
            values = pd.to_numeric(table[column], errors="coerce").to_numpy(float, na_value=np.nan)
        bad = ~np.isfinite(values) & (table[column].notna().to_numpy() | (column not in missing))
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            value = one_line(table[column].iloc[row], 60)
            raise InputError(f"{path}: column '{column}', row {row}: not a finite number ({value})")
        table[column] = values
    return table[wanted]
