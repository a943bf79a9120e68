"""Heat maps of a sweep: the ratio of true to stated covariance of a filter in each cell, as number and colour."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from consistency.bench.sweeps.axes import Axis as GridAxis
from consistency.bench.sweeps.cell import CellResult
from consistency.bench.sweeps.plan import Cell
from consistency.bench.sweeps.regime import Regime
from consistency.referee.document.blocks import Figure
from consistency.referee.document.colours import COLOURS
from consistency.referee.document.wording import brief
from consistency.referee.show.painting import TITLE, add_legend, canvas, say, wrapped

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

SMALL, LARGE = COLOURS[0], COLOURS[1]  # of a ratio below and above 1: blue and vermilion, told apart by everybody
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
WIDEST = 6  # tiles beside each other where two panels stand side by side


View = tuple[list[GridAxis], list[tuple[GridAxis, int]]]  # axes for the sides of a panel, and a place on each other one


def views(regime: Regime, numbers: bool = False) -> list[View]:
    """Panels that show all cells; two axes of the grid are their sides, or one and an axis that varies alone.

    Parameters
    ----------
    numbers : leave out panels whose sides would not be numbers
    """
    sweep = regime.sweep
    grid = sorted((a for a in sweep.grid if len(a.values) > 1), key=lambda axis: not axis.numeric)
    grid = [axis for axis in grid if axis.numeric or not numbers]
    sets = [[axis, *grid[:1]] for axis in sweep.alone] or [grid[:2] or list(sweep.axes)[: 0 if numbers else 2]]
    found: list[View] = []
    for sides in (sides for sides in sets if sides and (sides[0].numeric or not numbers)):
        others = [axis for axis in sweep.axes if axis not in sides]
        places = itertools.product(*(range(len(a.values)) if a.home is None else (a.home,) for a in others))
        found += [(sides, list(zip(others, at, strict=True))) for at in places]
    return found


def cells_of(regime: Regime, fixed: Sequence[tuple[GridAxis, int]]) -> list[Cell]:
    """Cells at one place on each of some axes."""
    places = [(regime.sweep.axes.index(axis), i) for axis, i in fixed]
    return [cell for cell in regime.sweep.cells if all(cell.indices[k] == i for k, i in places)]


def title_of(fixed: Sequence[tuple[GridAxis, int]]) -> str:
    """Values on the axes of a grid that a panel does not show."""
    shown = ((axis, i) for axis, i in fixed if axis.home is None and len(axis.values) > 1)
    return ", ".join(f"{axis.key.rpartition('.')[2]} {axis.say(i)}" for axis, i in shown)


def heat_figure(regime: Regime, name: str) -> Figure:
    """Heat maps of one filter, as many drawings as it takes."""
    found = views(regime)
    rows = max(len(sides[1].values) if len(sides) > 1 else 1 for sides, _ in found)
    widest = max(len(sides[0].values) for sides, _ in found)
    columns = 1 if len(found) == 1 or widest > WIDEST else 2
    most = columns * max(1, ROOM // (rows + 2))
    drawings = tuple(
        partial(_draw, regime, name, found[i : i + most], columns, rows) for i in range(0, len(found), most)
    )
    caption = (
        f"{name}: ratio of true to stated covariance in each cell, and the verdict; 1 is right, more is overconfident. "
        "A dash: no run gave a ratio."
    )
    return Figure(name, caption, drawings)


def _draw(regime: Regime, name: str, shown: Sequence[View], columns: int, rows: int) -> Drawing:
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
    across, places = sides[0], [regime.sweep.axes.index(axis) for axis in sides]
    count = len(across.values)
    axes.grid(visible=False)
    axes.set(title=wrapped(title_of(at), 46), xlabel=_short(across), xlim=(-0.5, count - 0.5), xticks=range(count))
    axes.set_xticklabels([wrapped(said(across, i), 12) for i in range(count)])
    axes.set(ylim=(-0.5, 0.5), yticks=[])
    if len(sides) > 1:
        rows = len(sides[1].values)
        axes.set(ylabel=_short(sides[1]), ylim=(-0.5, rows - 0.5), yticks=range(rows))
        axes.set_yticklabels([wrapped(said(sides[1], i), 16) for i in range(rows)])
    found = results_at(regime, name, at)
    if not found:
        say(axes, "no cell is there yet")
    for cell, result in found:
        row = cell.indices[places[1]] if len(places) > 1 else 0
        _draw_tile(axes, cell.indices[places[0]], row, result)


def results_at(regime: Regime, name: str, at: Sequence[tuple[GridAxis, int]]) -> list[tuple[Cell, CellResult]]:
    """Cells at one place on each of some axes that have a verdict on the filter."""
    cells = cells_of(regime, at)
    return [(cell, regime.results[cell.number, name]) for cell in cells if (cell.number, name) in regime.results]


def _draw_tile(axes: Axes, x: int, y: int, result: CellResult) -> None:
    from matplotlib.patches import Rectangle

    face = colour_of(result.ratio)
    axes.add_patch(Rectangle(
        (x - 0.5, y - 0.5), 1, 1, facecolor=face, edgecolor="white", gid=TITLE + words_of(result)
    ))  # fmt: skip
    axes.text(x, y, brief(result.ratio), color=ink_on(face), weight="bold", ha="center", va="bottom")
    axes.text(x, y - 0.08, WORDS[result.status], color=ink_on(face), fontsize=5.0, ha="center", va="top")


def words_of(result: CellResult) -> str:
    """What a reader sees who points at a cell."""
    ends = f"[{brief(result.ratio_low)}, {brief(result.ratio_high)}]"
    return f"{result.status}, covariance ratio {brief(result.ratio)} {ends}, {result.runs} runs"


def _short(axis: GridAxis) -> str:
    return axis.key.rpartition(".")[2]


def said(axis: GridAxis, index: int) -> str:
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
