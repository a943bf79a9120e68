"""The report of a sweep: what each filter is in each cell, and which to trust for which rig.

A heat map shows the ratio of true to stated covariance of a filter in each cell, as number and colour.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from consistency.bench.sweeps.regime_map import Regime, by_verdict
from consistency.bench.sweeps.run_sweep import CellResult
from consistency.bench.sweeps.sweep_file import Axis as GridAxis
from consistency.bench.sweeps.sweep_file import Cell as GridCell
from consistency.bench.sweeps.sweep_file import values_of
from consistency.referee.diagnostics.number_words import names_in_a_row
from consistency.referee.pages.write_pages import facts
from consistency.referee.show.blocks import (
    EXPECTED,
    OVER,
    RIGHT,
    UNDER,
    Cell,
    Chapter,
    Column,
    Document,
    Facts,
    Figure,
    Look,
    Small,
    Stack,
    Table,
    Text,
    badges,
    brief,
    number,
    solid,
    style,
    table,
)
from consistency.referee.show.figures import TITLE, add_legend, canvas, dots, log_axis, say, stroke, wrapped

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

# colour and marker of a verdict: each has a shape of its own, so that a grey print still reads
LOOKS = {
    "consistent": Look(RIGHT, marker="o", size=8.0),
    "overconfident": Look(OVER, marker="^", size=6.5),
    "conservative": Look(UNDER, marker="v", size=6.5),
    "biased": Look("#CC79A7", marker="D", size=5.5),
    "heavy-tailed": Look("#8a2a63", marker="s", size=6.0),
    "inconsistent": Look(OVER, marker="P", size=6.0),
    "undecided": Look("#ffffff", marker="o", size=6.5, edge="#6e6e6e"),
    "failed": Look("#111111", marker="X", size=6.0),
}
# heads of columns on paper
HYPHENATED = {
    "consistent": "Con-\nsistent", "overconfident": "Over-\nconfident", "conservative": "Conser-\nvative",
    "heavy-tailed": "Heavy-\ntailed", "inconsistent": "Incon-\nsistent", "undecided": "Un-\ndecided",
}  # fmt: skip
SMALL, LARGE = UNDER, OVER  # of a ratio below and above 1: blue and vermilion, told apart by everybody
NOTHING, PAPER = "#e3e3e3", "#ffffff"
FULL = 4.0  # ratio from which on the colour is full, and 1 over it
DARK = 0.45  # luminance below which text is white
LONGEST = 30  # characters of a value beside an axis
# what fits into a tile
WORDS = {
    "consistent": "consistent", "overconfident": "overconf.", "conservative": "conserv.", "biased": "biased",
    "heavy-tailed": "heavy tails", "inconsistent": "inconsist.", "undecided": "undecided", "failed": "failed",
}  # fmt: skip
ROW, MARGIN = 0.34, 0.75  # inches: height of a row of tiles, and of title and axis
ROOM = 15  # rows of tiles in one drawing, about, titles and axes counted as two
BEYOND = 1.25  # of a log axis is left beyond the first and the last value, as a factor
WIDEST = 6  # tiles beside each other where two panels stand side by side
View = tuple[list[GridAxis], list[tuple[GridAxis, int]]]  # axes for the sides of a panel, and a place on each other one


def compose_regime(regime: Regime) -> Document:
    sweep = regime.sweep
    about = Text(how_cells_are_judged(regime), style="note")
    heat = tuple(heat_figure(regime, name) for name in sweep.filters)
    world = [("World", f"{sweep.base.name}: {sweep.base.summary}")]
    for axis in sweep.axes:
        values = ", ".join(map(axis.say, range(len(axis.values))))
        world.append((f"{axis.table.capitalize()}: {axis.text}", values))
    world.append(("Seed", str(sweep.seed)))
    sides, along = _sides(regime), list[Chapter]()
    if len(sweep.axes) == len(sides) == 1:  # heat maps of other sweeps show as much
        along = [Chapter("regions", "Where each filter is consistent", "Regions", (_along(regime, sides[0]),))]
    chapters = [
        Chapter("filters", "Filters", "Filters", (_summary(regime), about), sweep.summary),
        *along,
        Chapter("ratios", "How wrong the covariance is", "Covariance ratios", heat),
        Chapter("rigs", "Rig, and the filters to trust", "Rigs", (_rigs(regime),)),
        Chapter("provenance", "Provenance", "Provenance", (Facts((*world, *facts(dict(regime.manifest)))),)),
    ]
    words = badges([(name, result.status) for (_, name), result in regime.results.items()])
    return Document(f"Regime map: {sweep.name}", consistent_cells_sentence(regime), tuple(chapters), badges=words)


def consistent_cells_sentence(regime: Regime) -> str:
    """Which filter is consistent in how many cells, in one paragraph."""
    cells = regime.sweep.cells
    consistent_cells = dict.fromkeys(regime.sweep.filters, 0)
    for (_, name), result in regime.results.items():
        if name in consistent_cells:
            consistent_cells[name] += result.status == "consistent"
    parts = [f"{name} in {count}" for name, count in sorted(consistent_cells.items(), key=lambda pair: -pair[1])]
    alone = sum(bool(regime.trusted(cell)) for cell in cells)
    text = f"Of {len(cells)} cells, consistent are {names_in_a_row(parts)}. In {alone} of them at least one filter is."
    if regime.missing:
        wanted = len(cells) * len(regime.sweep.filters)
        text += f" The sweep is not finished: {regime.missing} of {wanted} verdicts are missing."
    return text


def how_cells_are_judged(regime: Regime) -> str:
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
    status_columns = (Column(status.capitalize(), HYPHENATED.get(status, ""), number=True) for status in statuses)
    columns = (Column("Filter", width="3.4cm"), *status_columns, Column("Cost", number=True))
    return table(columns, rows, "Cells by verdict, a row a filter", caption="Cells by verdict, and the median cost.")


def _rigs(regime: Regime) -> Table:
    """Table with a row for each cell: the filters that are consistent there, by RMSE and then cost."""
    alone = regime.sweep.alone
    shown = [axis for axis in regime.sweep.grid if alone or axis in _sides(regime)]
    facets = [axis for axis in regime.sweep.grid if axis not in shown]
    columns = (
        *(Column(axis.short.capitalize(), number=True) for axis in shown),
        *((Column("Otherwise"),) if alone else ()),
        Column("Filters to trust: RMSE, cost", width="1fr"), Column("Others", width="1fr"),
    )  # fmt: skip
    groups = []
    for at in itertools.product(*(range(len(axis.values)) for axis in facets)):
        fixed = list(zip(facets, at, strict=True))
        title = ", ".join(f"{axis.short} {axis.say(i)}" for axis, i in fixed)
        rows = tuple(
            (*values_of(regime.sweep, shown, cell), _trusted(regime, cell), _others(regime, cell))
            for cell in cells_of(regime, fixed)
        )
        groups.append((title, rows))
    caption = "Filters by RMSE of the position; of those that differ by 2 % or less the cheaper one first."
    return Table(columns, tuple(groups), "Filters to trust for each rig", caption=caption, style="grouped")


def _sides(regime: Regime) -> list[GridAxis]:
    """The first two axes of numbers in the grid, which have columns of their own."""
    return [axis for axis in regime.sweep.grid if axis.numeric and len(axis.values) > 1][:2]


def _trusted(regime: Regime, cell: GridCell) -> Cell:
    trusted = regime.trusted(cell)
    if not trusted:
        return "none"
    lines = [f"{name}: {number(r.rmse_position, '.3f')} m, ×{number(r.cost, '.2g')}" for name, r in trusted]
    return Stack(lines[0], tuple(Small(line) for line in lines[1:]), bold=True)


def _others(regime: Regime, cell: GridCell) -> str:
    """Verdicts on the other filters, each verdict once."""
    by_status: dict[str, list[str]] = {}
    for name, result in regime.at(cell).items():
        if result.status != "consistent":
            by_status.setdefault(result.status, []).append(name)
    return "; ".join(f"{status}: {', '.join(names)}" for status, names in by_status.items()) or "–"


# --- along one axis ---------------------------------------------------------------------------------


def _along(regime: Regime, side: GridAxis) -> Figure:
    """Covariance ratio and RMSE of all filters along the one axis of a sweep."""

    def draw() -> Drawing:
        figure, (ratios, errors) = canvas(2.2, 2, 2)
        for number_of, name in enumerate(regime.sweep.filters):
            results_along = results_at(regime, name, [])
            axis_values = np.array([float(side.values[cell.indices[0]]) for cell, _ in results_along])
            filter_style = solid(style(number_of))
            for axes, field in ((ratios, "ratio"), (errors, "rmse_position")):
                values = [getattr(result, field) for _, result in results_along]
                axes.plot(axis_values, values, label=name, **stroke(filter_style))
                for axis_value, value, (_, result) in zip(axis_values, values, results_along, strict=True):
                    marker = _marker(result.status, filter_style.colour)
                    axes.plot(axis_value, value, gid=TITLE + words_of(result), **dots(marker))
        statuses = dict.fromkeys(result.status for result in regime.results.values())
        for status in statuses:
            ratios.plot([], [], label=status, **dots(_marker(status, "#555555")))
        ratios.axhline(1.0, **stroke(EXPECTED))
        ratios.set_ylabel("true / stated covariance")
        errors.set_ylabel("RMSE (m)")
        for axes in (ratios, errors):
            _draw_values(axes, side)
            log_axis(axes, "y")
        return add_legend(figure)

    caption = (
        f"True over stated covariance, 1 is right (line), and RMSE of the position along {side.short}. The shape "
        "of a marker is the verdict."
    )
    return Figure(f"Along {side.short}", caption, (draw,))


def _marker(status: str, colour: str) -> Look:
    """The shape of a verdict in the colour of a filter; hollow where its own is."""
    look = LOOKS[status]
    if look.edge:
        return replace(look, edge=colour, size=4.5)
    return replace(look, colour=colour, size=4.5)


def _draw_values(axes: Axes, axis: GridAxis) -> None:
    """Ticks and range of an axis of numbers, from the left."""
    first, last = float(axis.values[0]), float(axis.values[-1])
    unit = f" ({axis.unit})" if axis.unit else ""
    axes.set(xlabel=axis.short + unit)
    if axis.log:
        axes.set(xlim=(first / BEYOND, last * BEYOND))
        log_axis(axes, "x")
    else:
        room = 0.08 * (last - first)
        axes.set(xlim=(first - room, last + room), xticks=[float(value) for value in axis.values])


# --- heat maps ------------------------------------------------------------------------------------


def views(regime: Regime) -> list[View]:
    """Panels that show all cells; two axes of the grid are their sides, or one and an axis that varies alone."""
    sweep = regime.sweep
    grid = sorted((a for a in sweep.grid if len(a.values) > 1), key=lambda axis: not axis.numeric)
    heat_maps: list[View] = []
    for sides in [[axis, *grid[:1]] for axis in sweep.alone] or [grid[:2] or list(sweep.axes)[:2]]:
        others = [axis for axis in sweep.axes if axis not in sides]
        places = itertools.product(*(range(len(a.values)) if a.home is None else (a.home,) for a in others))
        heat_maps += [(sides, list(zip(others, at, strict=True))) for at in places]
    return heat_maps


def cells_of(regime: Regime, fixed: Sequence[tuple[GridAxis, int]]) -> list[GridCell]:
    """Cells at one place on each of some axes."""
    places = [(regime.sweep.axes.index(axis), i) for axis, i in fixed]
    return [cell for cell in regime.sweep.cells if all(cell.indices[k] == i for k, i in places)]


def title_of(fixed: Sequence[tuple[GridAxis, int]]) -> str:
    """Values on the axes of a grid that a panel does not show."""
    shown = ((axis, i) for axis, i in fixed if axis.home is None and len(axis.values) > 1)
    return ", ".join(f"{axis.short} {axis.say(i)}" for axis, i in shown)


def heat_figure(regime: Regime, name: str) -> Figure:
    """Heat maps of one filter, as many drawings as it takes."""
    heat_maps = views(regime)
    rows = max(len(sides[1].values) if len(sides) > 1 else 1 for sides, _ in heat_maps)
    widest = max(len(sides[0].values) for sides, _ in heat_maps)
    columns = 1 if len(heat_maps) == 1 or widest > WIDEST else 2
    maps_of_drawing = columns * max(1, ROOM // (rows + 2))
    drawings = tuple(
        partial(_draw_maps, regime, name, heat_maps[i : i + maps_of_drawing], columns, rows)
        for i in range(0, len(heat_maps), maps_of_drawing)
    )
    caption = (
        f"{name}: ratio of true to stated covariance in each cell, and the verdict; 1 is right, more is overconfident. "
        "A dash: no run gave a ratio."
    )
    return Figure(name, caption, drawings)


def _draw_maps(regime: Regime, name: str, shown: Sequence[View], columns: int, rows: int) -> Drawing:
    from matplotlib.patches import Rectangle

    height = (ROW * rows + MARGIN) * -(-len(shown) // columns)
    figure, panels = canvas(height, columns, len(shown))
    for axes, (sides, fixed) in zip(panels, shown, strict=True):
        _draw_tiles(axes, regime, name, sides, fixed)
    ends = ((f"{FULL:g} and more: overconfident", LARGE), (f"1/{FULL:g} and less: conservative", SMALL))
    for label, colour in (*ends, ("no ratio", NOTHING)):
        panels[0].add_patch(Rectangle((0, 0), 0, 0, facecolor=colour, label=label, visible=False))
    return add_legend(figure)


def _draw_tiles(
    axes: Axes, regime: Regime, name: str, sides: Sequence[GridAxis], at: Sequence[tuple[GridAxis, int]]
) -> None:
    """The heat map at one place on each other axis: values from the left, and from below."""
    from matplotlib.patches import Rectangle

    across, places = sides[0], [regime.sweep.axes.index(axis) for axis in sides]
    count = len(across.values)
    axes.grid(visible=False)
    axes.set(title=wrapped(title_of(at), 46), xlabel=across.short, xlim=(-0.5, count - 0.5), xticks=range(count))
    axes.set_xticklabels([wrapped(value_in_few_characters(across, i), 12) for i in range(count)])
    axes.set(ylim=(-0.5, 0.5), yticks=[])
    if len(sides) > 1:
        rows = len(sides[1].values)
        axes.set(ylabel=sides[1].short, ylim=(-0.5, rows - 0.5), yticks=range(rows))
        axes.set_yticklabels([wrapped(value_in_few_characters(sides[1], i), 16) for i in range(rows)])
    cell_results = results_at(regime, name, at)
    if not cell_results:
        say(axes, "no cell is there yet")
    for cell, result in cell_results:
        row = cell.indices[places[1]] if len(places) > 1 else 0
        column, face = cell.indices[places[0]], colour_of(result.ratio)
        axes.add_patch(Rectangle(
            (column - 0.5, row - 0.5), 1, 1, facecolor=face, edgecolor="white", gid=TITLE + words_of(result)
        ))  # fmt: skip
        in_tile: dict[str, Any] = {"color": ink_on(face), "ha": "center"}
        axes.text(column, row, brief(result.ratio), weight="bold", va="bottom", **in_tile)
        axes.text(column, row - 0.08, WORDS[result.status], fontsize=5.0, va="top", **in_tile)


def results_at(regime: Regime, name: str, at: Sequence[tuple[GridAxis, int]]) -> list[tuple[GridCell, CellResult]]:
    """Cells at one place on each of some axes that have a verdict on the filter."""
    cells = cells_of(regime, at)
    return [(cell, regime.results[cell.number, name]) for cell in cells if (cell.number, name) in regime.results]


def words_of(result: CellResult) -> str:
    """What a reader sees who points at a cell."""
    ends = f"[{brief(result.ratio_low)}, {brief(result.ratio_high)}]"
    return f"{result.status}, covariance ratio {brief(result.ratio)} {ends}, {result.runs} runs"


def value_in_few_characters(axis: GridAxis, index: int) -> str:
    """A value in few characters; by its number where it is long."""
    text = axis.say(index)
    return text if len(text) <= LONGEST else f"({index + 1}) {text[: LONGEST - 5]}…"


def colour_of(ratio: float) -> str:
    """White at 1, vermilion above and blue below, by the logarithm; grey where there is no ratio."""
    if np.isnan(ratio):
        return NOTHING
    share = np.clip(np.log(ratio) / np.log(FULL), -1.0, 1.0) if ratio > 0 else -1.0
    end, white = _channels(LARGE if share > 0 else SMALL), _channels(PAPER)
    mixed = np.rint(255.0 * (white + abs(share) * (end - white))).astype(int)
    return "#{:02x}{:02x}{:02x}".format(*mixed)


def ink_on(colour: str) -> str:
    """Black or white, whichever reads better."""
    return "#ffffff" if _channels(colour) @ (0.299, 0.587, 0.114) < DARK else "#000000"


def _channels(colour: str) -> np.ndarray:
    return np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
