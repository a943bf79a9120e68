"""The report of a sweep: where each filter is consistent, with its RMSE beside it, and which to trust for which rig."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from consistency.bench.pages.heat import PAPER_TITLE, cells_of, heat_figure, on_paper, title_of, views
from consistency.bench.sweeps import axes as grid
from consistency.bench.sweeps.cell import CellResult
from consistency.bench.sweeps.plan import Cell as GridCell
from consistency.bench.sweeps.plan import values_of
from consistency.bench.sweeps.printing import by_verdict
from consistency.bench.sweeps.regime import Regime
from consistency.referee.diagnostics.verdict.parts import STATUSES
from consistency.referee.document.blocks import (
    Block,
    Cell,
    Chapter,
    Column,
    Document,
    Facts,
    Small,
    Stack,
    Table,
    Text,
    table,
)
from consistency.referee.document.colours import COLOURS, Look, style
from consistency.referee.document.drawing import Axis, Figure, Key, Line, Mark, Panel, Points, Sheet, Tips
from consistency.referee.document.wording import listed, number
from consistency.referee.pages.provenance import facts
from consistency.referee.types import Array

# colour and marker of a verdict: each has a shape of its own, so that a grey print still reads
LOOKS = {
    "consistent": Look(COLOURS[0], marker="o", size=8.0),
    "overconfident": Look(COLOURS[1], marker="^", size=6.5),
    "conservative": Look(COLOURS[5], marker="v", size=6.5),
    "biased": Look(COLOURS[3], marker="D", size=5.5),
    "heavy-tailed": Look(COLOURS[4], marker="s", size=6.0),
    "inconsistent": Look(COLOURS[1], marker="P", size=6.0),
    "undecided": Look("#ffffff", marker="o", size=6.5, edge="#6e6e6e"),
    "failed": Look("#111111", marker="X", size=6.0),
}
# heads of columns on paper
HYPHENATED = {
    "consistent": "Con-\nsistent", "overconfident": "Over-\nconfident", "conservative": "Conser-\nvative",
    "heavy-tailed": "Heavy-\ntailed", "inconsistent": "Incon-\nsistent", "undecided": "Un-\ndecided",
}  # fmt: skip
ROWS = 3  # of panels on a sheet of paper
ROOM = 1.25  # of a log axis is left beyond the first and the last value, as a factor
TIPS: Tips = (
    ("verdict", "@status"), ("ANEES", "@anees{0.00}"), ("covariance ratio", "@ratio{0.00}"),
    ("RMSE", "@rmse{0.000} m"), ("runs", "@runs"),
)  # fmt: skip


def compose_regime(regime: Regime) -> Document:
    sweep = regime.sweep
    regions = tuple(figure for name in sweep.filters for figure in _figures(regime, name))
    about = Text(method(regime), style="note")
    chapters = [Chapter("filters", "Filters", "Filters", (_summary(regime), about), sweep.summary)]
    if regions:
        chapters.append(Chapter("regions", "Where each filter is consistent", "Regions", regions))
    heat = tuple(heat_figure(regime, name) for name in sweep.filters)
    chapters += [
        Chapter("ratios", "How wrong the covariance is", "Covariance ratios", heat),
        Chapter("rigs", "Rig, and the filters to trust", "Rigs", (_rigs(regime),)),
        Chapter("provenance", "Provenance", "Provenance", _provenance(regime)),
    ]
    return Document(f"Regime map: {sweep.name}", answer(regime), tuple(chapters))


def answer(regime: Regime) -> str:
    """Which filter is consistent in how many cells, in one paragraph."""
    cells = regime.sweep.cells
    good = {
        name: sum(r.status == "consistent" for (_, n), r in regime.results.items() if n == name)
        for name in regime.sweep.filters
    }
    parts = [f"{name} in {count}" for name, count in sorted(good.items(), key=lambda pair: -pair[1])]
    alone = sum(bool(regime.trusted(cell)) for cell in cells)
    text = f"Of {len(cells)} cells, consistent are {listed(parts)}. In {alone} of them at least one filter is."
    if regime.missing:
        text += f" The sweep is not finished: {regime.missing} of {len(cells) * len(good)} verdicts are missing."
    return text


def method(regime: Regime) -> str:
    rule, wrong = regime.sweep.rule, "a ratio of true to stated covariance of"
    return (
        f"Each filter runs in each cell until it is decided, with at most {rule.max_runs} runs. A filter that is right "
        f"is called faulty in {100 * rule.false_alarm:g} % of the cells, by chance; {wrong} {rule.detect:g} or "
        f"1/{rule.detect:g} is called consistent in {100 * (1 - rule.power):g} % at most. Trials of different cells "
        "are independent; all filters of a cell have the same trials. The cost is the CPU time of a step, in one "
        f"thread, against that of {regime.sweep.reference} on the same trial."
    )


# --- tables -----------------------------------------------------------------------------------------


def _summary(regime: Regime) -> Table:
    """Table with a row for each filter: cells by verdict, and the median cost."""
    statuses, rows = by_verdict(regime)
    heads = (Column(status.capitalize(), HYPHENATED.get(status, ""), number=True) for status in statuses)
    columns = (Column("Filter", width="3.4cm"), *heads, Column("Cost", number=True))
    return table(columns, rows, "Cells by verdict, a row a filter", caption="Cells by verdict, and the median cost.")


def _rigs(regime: Regime) -> Table:
    """Table with a row for each cell: the filters that are consistent there, by RMSE and then cost."""
    alone = regime.sweep.alone
    shown = [axis for axis in regime.sweep.grid if alone or axis in _sides(regime)]
    facets = [axis for axis in regime.sweep.grid if axis not in shown]
    columns = (
        *(Column(_short(axis.key).capitalize(), number=True) for axis in shown),
        *((Column("Otherwise"),) if alone else ()),
        Column("Filters to trust: RMSE, cost", width="1fr"), Column("Others", width="1fr"),
    )  # fmt: skip
    groups = []
    for at in itertools.product(*(range(len(axis.values)) for axis in facets)):
        fixed = list(zip(facets, at, strict=True))
        title = ", ".join(f"{_short(axis.key)} {axis.say(i)}" for axis, i in fixed)
        rows = tuple(
            (*values_of(regime.sweep, shown, cell), _trusted(regime, cell), _others(regime, cell))
            for cell in cells_of(regime, fixed)
        )
        groups.append((title, rows))
    caption = "Filters by RMSE of the position; of those that differ by 2 % or less the cheaper one first."
    return Table(columns, tuple(groups), "Filters to trust for each rig", caption=caption, style="grouped")


def _sides(regime: Regime) -> list[grid.Axis]:
    return next((sides for sides, _ in views(regime, numbers=True)), [])


def _trusted(regime: Regime, cell: GridCell) -> Cell:
    found = regime.trusted(cell)
    if not found:
        return "none"
    lines = [f"{name}: {number(r.rmse_position, '.3f')} m, ×{number(r.cost, '.2g')}" for name, r in found]
    return Stack(lines[0], tuple(Small(line) for line in lines[1:]), bold=True)


def _others(regime: Regime, cell: GridCell) -> str:
    """Verdicts on the other filters, each verdict once."""
    by_status: dict[str, list[str]] = {}
    for name, result in regime.at(cell).items():
        if result.status != "consistent":
            by_status.setdefault(result.status, []).append(name)
    return "; ".join(f"{status}: {', '.join(names)}" for status, names in by_status.items()) or "–"


def _provenance(regime: Regime) -> tuple[Block, ...]:
    sweep = regime.sweep
    grid_rows = [
        (f"{axis.table.capitalize()}: {axis.text}", ", ".join(map(axis.say, range(len(axis.values)))))
        for axis in sweep.axes
    ]
    rows = [("World", f"{sweep.base.name}: {sweep.base.summary}"), *grid_rows, ("Seed", str(sweep.seed))]
    return (Facts((*rows, *facts(dict(regime.manifest)))),)


# --- figures ----------------------------------------------------------------------------------------


def _short(key: str) -> str:
    return key.rpartition(".")[2]


def _figures(regime: Regime, name: str) -> tuple[Figure, ...]:
    """Verdicts of one filter over two axes, with the RMSE beside them; none without an axis of numbers."""
    found = views(regime, numbers=True)
    if not found:
        return ()
    panels = [panel for sides, fixed in found for panel in _pair(regime, name, sides, fixed)]
    shown = found[0][0]
    statuses = {r.status for (_, n), r in regime.results.items() if n == name}
    keys = [Key(status, LOOKS[status], "points") for status in STATUSES if status in statuses]
    lines = shown[1:] or shown[:0]
    keys += [
        Key(f"RMSE, {_short(axis.key)} {axis.say(i)}", style(i), marked=True)
        for axis in lines
        for i in range(len(axis.values))
    ]
    columns = 4 if len(panels) > 2 else 2
    width = PAPER_TITLE * 2 // columns
    paper = [replace(p, title=on_paper(p.title, width) if i % 2 == 0 else "RMSE") for i, p in enumerate(panels)]
    sheets = tuple(
        Sheet(tuple(part), 1.75 * -(-len(part) // columns) + 0.3, columns=columns, keys=tuple(keys))
        for part in (paper[i : i + columns * ROWS] for i in range(0, len(paper), columns * ROWS))
    )
    caption = (
        f"{name}: verdict in each cell, by shape and colour; beside it the RMSE of the position, with filled markers "
        "where the filter is consistent."
    )
    return (Figure(name, caption, tuple(panels), sheets, tuple(keys), layout="pair", stacked=len(sheets) > 1),)


def _pair(regime: Regime, name: str, shown: list[grid.Axis], fixed: list[tuple[grid.Axis, int]]) -> tuple[Panel, Panel]:
    """The panel of verdicts and the panel of RMSE for the cells at one place on each other axis."""
    places, title = [regime.sweep.axes.index(axis) for axis in shown], title_of(fixed)
    found = [(c, regime.results[c.number, name]) for c in cells_of(regime, fixed) if (c.number, name) in regime.results]
    x = np.array([shown[0].values[cell.indices[places[0]]] for cell, _ in found], float)
    second = shown[1] if len(shown) > 1 else None
    rows = np.array([cell.indices[places[1]] if second else 0 for cell, _ in found], int)
    y = np.array(second.values, float)[rows] if second else np.zeros(len(found))
    x_axis = _axis(shown[0])
    words = f" with {title}" if title else ""
    verdicts = Panel(
        x_axis, _axis(second) if second else Axis("", rows=("",)), _verdicts(x, y, [r for _, r in found]),
        f"Verdicts on {name}{words}", height=300, title=title or "verdict", empty="no cell is there yet",
    )  # fmt: skip
    rmse = Panel(
        x_axis, _rmse_axis([r for _, r in found]), _rmse(x, rows, [r for _, r in found]),
        f"RMSE of {name}{words}", height=300, title=f"RMSE{', ' if title else ''}{title}", empty="no cell is there yet",
    )  # fmt: skip
    return verdicts, rmse


def _axis(axis: grid.Axis) -> Axis:
    values = tuple(map(float, axis.values))
    if not axis.log:
        room = 0.08 * (values[-1] - values[0])
        return Axis(axis.label, _short(axis.key), window=(values[0] - room, values[-1] + room), ticks=values)
    window = values[0] / ROOM, values[-1] * ROOM
    short = _short(axis.key) + (f" ({axis.unit})" if axis.unit else "")
    return Axis(axis.label, short, log=True, window=window, digits=(1, 2, 3, 5))


def _rmse_axis(results: list[CellResult]) -> Axis:
    """Logarithmic where there is a value."""
    log = any(r.rmse_position > 0.0 for r in results)
    return Axis("RMSE of the position (m)", "RMSE (m)", log=log, digits=(1, 2, 5) if log else ())


def _columns(results: list[CellResult], rows: Array) -> dict[str, Array | list[str]]:
    part = [results[i] for i in np.flatnonzero(rows)]
    return {
        "status": [r.status for r in part], "anees": np.array([r.anees for r in part]),
        "ratio": np.array([r.ratio for r in part]), "rmse": np.array([r.rmse_position for r in part]),
        "runs": np.array([r.runs for r in part], float),
    }  # fmt: skip


def _verdicts(x: Array, y: Array, results: list[CellResult]) -> tuple[Mark, ...]:
    """A marker a cell."""
    status = np.array([r.status for r in results])
    found = ((name, status == name) for name in STATUSES if name in status)
    return tuple(
        Points(x[rows], y[rows], LOOKS[name], tips=TIPS, columns=_columns(results, rows), whole=True)
        for name, rows in found
    )


def _rmse(x: Array, rows: Array, results: list[CellResult]) -> tuple[Mark, ...]:
    """A line for each value of the second axis."""
    rmse = np.array([r.rmse_position for r in results])
    good = np.array([r.status == "consistent" for r in results], bool)
    marks: list[Mark] = []
    for i in sorted({int(row) for row in rows}):
        look, mine = style(i), rows == i
        marks.append(Line(x[mine], rmse[mine], look))
        hollow = replace(look, colour="#ffffff", edge=look.colour)
        marks += [
            Points(x[which], rmse[which], dots, tips=TIPS, columns=_columns(results, which), whole=True)
            for which, dots in ((mine & good, look), (mine & ~good, hollow))
            if which.any()
        ]
    return tuple(marks)
