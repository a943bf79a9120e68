"""The report of a sweep: where each filter is consistent, with its RMSE beside it, and which to trust for which rig."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from consistency.bench.pages.heat import View, cells_of, heat_figure, results_at, title_of, views, words_of
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
    Figure,
    Small,
    Stack,
    Table,
    Text,
    table,
)
from consistency.referee.document.colours import COLOURS, EXPECTED, Look, solid, style
from consistency.referee.document.wording import listed, number
from consistency.referee.pages.origin import facts
from consistency.referee.show.painting import TITLE, add_legend, canvas, dots, log_axis, say, stroke, wrapped

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

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
PAIRS = 4  # of panels in one drawing
ROOM = 1.25  # of a log axis is left beyond the first and the last value, as a factor


def compose_regime(regime: Regime) -> Document:
    sweep = regime.sweep
    sides = _sides(regime)
    if len(sweep.axes) == len(sides) == 1:
        regions: tuple[Figure, ...] = (_along(regime, sides[0]),)
    else:
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
    drawings = tuple(partial(_draw, regime, name, found[i : i + PAIRS]) for i in range(0, len(found), PAIRS))
    caption = (
        f"{name}: verdict in each cell, by shape and colour; beside it the RMSE of the position, with filled markers "
        "where the filter is consistent."
    )
    return (Figure(name, caption, drawings),)


def _along(regime: Regime, side: grid.Axis) -> Figure:
    """Covariance ratio and RMSE of all filters along the one axis of a sweep."""

    def draw() -> Drawing:
        figure, (ratios, errors) = canvas(2.2, 2, 2)
        for number_of, name in enumerate(regime.sweep.filters):
            found = results_at(regime, name, [])
            x = np.array([float(side.values[cell.indices[0]]) for cell, _ in found])
            look = solid(style(number_of))
            quantities = ((ratios, [r.ratio for _, r in found]), (errors, [r.rmse_position for _, r in found]))
            for axes, values in quantities:
                axes.plot(x, values, label=name, **stroke(look))
                for place, value, (_, result) in zip(x, values, found, strict=True):
                    marker = replace(LOOKS[result.status], colour=look.colour, size=4.5)
                    axes.plot(place, value, gid=TITLE + words_of(result), **dots(marker))
        statuses = dict.fromkeys(result.status for result in regime.results.values())
        for status in statuses:
            ratios.plot([], [], label=status, **dots(replace(LOOKS[status], colour="#555555", size=4.5)))
        ratios.axhline(1.0, **stroke(EXPECTED))
        ratios.set_ylabel("true / stated covariance")
        errors.set_ylabel("RMSE (m)")
        for axes in (ratios, errors):
            _draw_side(axes, "x", side)
            log_axis(axes, "y")
        return add_legend(figure)

    caption = (
        f"True over stated covariance, 1 is right (line), and RMSE of the position along {_short(side.key)}. The shape "
        "of a marker is the verdict."
    )
    return Figure(f"Along {_short(side.key)}", caption, (draw,))


def _draw(regime: Regime, name: str, shown: Sequence[View]) -> Drawing:
    """A row for each view: verdicts, and the RMSE."""
    figure, panels = canvas(1.7 * len(shown), 2, 2 * len(shown))
    for verdicts, rmse, (sides, at) in zip(panels[::2], panels[1::2], shown, strict=True):
        found, title = results_at(regime, name, at), title_of(at)
        verdicts.set_title(wrapped(title or "verdict", 46))
        rmse.set_title("RMSE")
        if not found:
            say(verdicts, "no cell is there yet")
            say(rmse, "no cell is there yet")
            continue
        places = [regime.sweep.axes.index(axis) for axis in sides]
        _draw_verdicts(verdicts, sides, places, found)
        _draw_rmse(rmse, sides, places, found)
    return add_legend(figure)


def _draw_verdicts(
    axes: Axes, sides: Sequence[grid.Axis], places: Sequence[int], found: Sequence[tuple[GridCell, CellResult]]
) -> None:
    """A marker for each cell, with what was found in words to hover."""
    seen = set[str]()
    for cell, result in sorted(found, key=lambda pair: list(STATUSES).index(pair[1].status)):
        x, y = (float(axis.values[cell.indices[place]]) for axis, place in _both(sides, places))
        label = "" if result.status in seen else result.status
        seen.add(result.status)
        words = f"{words_of(result)}, ANEES {result.anees:.2f}, RMSE {result.rmse_position:.3f} m"
        axes.plot(x, y, label=label, gid=TITLE + words, **dots(LOOKS[result.status]))
    _draw_side(axes, "x", sides[0])
    if len(sides) > 1:
        _draw_side(axes, "y", sides[1])
    else:
        axes.set_yticks([])


def _draw_rmse(
    axes: Axes, sides: Sequence[grid.Axis], places: Sequence[int], found: Sequence[tuple[GridCell, CellResult]]
) -> None:
    """A line for each value of the second axis."""
    rows: dict[int, list[tuple[float, CellResult]]] = {}
    for cell, result in found:
        row = cell.indices[places[1]] if len(places) > 1 else 0
        rows.setdefault(row, []).append((float(sides[0].values[cell.indices[places[0]]]), result))
    for row, line in sorted(rows.items()):
        look = replace(style(row), size=3.6)
        label = f"RMSE, {_short(sides[1].key)} {sides[1].say(row)}" if len(sides) > 1 else ""
        axes.plot([x for x, _ in line], [r.rmse_position for _, r in line], label=label, **stroke(look))
        for x, result in line:
            hollow = result.status != "consistent"
            axes.plot(
                x, result.rmse_position, **dots(replace(look, colour="#ffffff", edge=look.colour) if hollow else look)
            )
    axes.set_ylabel("RMSE (m)")
    _draw_side(axes, "x", sides[0])
    if any(result.rmse_position > 0.0 for _, result in found):
        log_axis(axes, "y")


def _both(sides: Sequence[grid.Axis], places: Sequence[int]) -> list[tuple[grid.Axis, int]]:
    """The two axes of a panel with their places among those of the sweep; the first one twice where there is one."""
    pairs = list(zip(sides, places, strict=True))
    return pairs if len(pairs) > 1 else [*pairs, *pairs]


def _draw_side(axes: Axes, side: str, axis: grid.Axis) -> None:
    """Ticks and range of one axis of numbers."""
    first, last = float(axis.values[0]), float(axis.values[-1])
    unit = f" ({axis.unit})" if axis.unit else ""
    axes.set(**{f"{side}label": _short(axis.key) + unit})
    if axis.log:
        axes.set(**{f"{side}lim": (first / ROOM, last * ROOM)})
        log_axis(axes, side)
    else:
        room = 0.08 * (last - first)
        axes.set(**{f"{side}lim": (first - room, last + room), f"{side}ticks": [float(value) for value in axis.values]})
