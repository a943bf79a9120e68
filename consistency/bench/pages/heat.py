"""Heat maps of a sweep: the ratio of true to stated covariance of a filter in each cell, as number and colour."""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from consistency.bench.sweeps.axes import Axis as GridAxis
from consistency.bench.sweeps.cell import CellResult
from consistency.bench.sweeps.plan import Cell
from consistency.bench.sweeps.regime import Regime
from consistency.referee.document.colours import COLOURS, Look
from consistency.referee.document.drawing import Axis, Figure, Key, Panel, Sheet, Tiles, Tips
from consistency.referee.document.wording import brief

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
TIPS: Tips = (("covariance ratio", "@ratio"), ("95 % interval", "@interval"), ("verdict", "@status"), ("runs", "@runs"))
TILE, PAPER_TILE, MARGIN = 44, 0.34, 0.75  # height of a row: pixels, inches; inches of title and axis
PAPER_TITLE, LINE = 52, 0.12  # characters of a title above half a page, and inches of a line of it
ROOM = 5  # rows of tiles on a sheet of paper, about


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
    found = views(regime)
    panels = tuple(_panel(regime, name, sides, fixed) for sides, fixed in found)
    rows = max(len(sides[1].values) if len(sides) > 1 else 1 for sides, _ in found)
    widest = max(len(sides[0].values) for sides, _ in found)
    columns = 1 if len(panels) == 1 or widest > 6 else 2
    most = columns * max(1, ROOM * 3 // (rows + 2))
    ends = ((f"{FULL:g} and more: overconfident", LARGE), (f"1/{FULL:g} and less: conservative", SMALL))
    keys = tuple(Key(text, Look(colour), "band") for text, colour in (*ends, ("no ratio", NOTHING)))
    paper = [replace(panel, title=on_paper(panel.title, PAPER_TITLE * 2 // columns)) for panel in panels]
    high = MARGIN + LINE * max(panel.title.count("\n") for panel in paper)
    sheets = tuple(
        Sheet(tuple(part), (PAPER_TILE * rows + high) * -(-len(part) // columns) + 0.2, columns=columns, keys=keys)
        for part in (paper[i : i + most] for i in range(0, len(paper), most))
    )
    caption = (
        f"{name}: ratio of true to stated covariance in each cell, and the verdict; 1 is right, more is overconfident. "
        "A dash: no run gave a ratio."
    )
    layout = "pair" if columns == 2 else ""
    return Figure(name, caption, panels, sheets, keys, layout=layout, stacked=len(sheets) > 1)  # type: ignore[arg-type]


def on_paper(title: str, width: int) -> str:
    """A title in lines of at most ``width`` characters."""
    return "\n".join(textwrap.wrap(title, width))


def _panel(regime: Regime, name: str, sides: Sequence[GridAxis], at: Sequence[tuple[GridAxis, int]]) -> Panel:
    """The heat map at one place on each other axis."""
    places, title = [regime.sweep.axes.index(axis) for axis in sides], title_of(at)
    found = [(c, regime.results[c.number, name]) for c in cells_of(regime, at) if (c.number, name) in regime.results]
    second = _side(sides[1]) if len(sides) > 1 else Axis("", rows=("",))
    words = f" with {title}" if title else ""
    return Panel(
        _side(sides[0], across=True), second, (_tiles(found, places, len(second.rows)),) if found else (),
        f"Ratio of true to stated covariance of {name}{words}", height=TILE * len(second.rows) + 70, title=title,
        empty="no cell is there yet",
    )  # fmt: skip


def _side(axis: GridAxis, across: bool = False) -> Axis:
    """Values from the left, or from below."""
    values = tuple(said(axis, i) for i in range(len(axis.values)))
    short = axis.key.rpartition(".")[2]
    return Axis(axis.text, short, names=values) if across else Axis(axis.text, short, rows=values[::-1])


def said(axis: GridAxis, index: int) -> str:
    """A value in few characters; by its number where it is long."""
    text = axis.say(index)
    return text if len(text) <= LONGEST else f"({index + 1}) {text[: LONGEST - 5]}…"


def _tiles(found: Sequence[tuple[Cell, CellResult]], places: Sequence[int], rows: int) -> Tiles:
    results = [result for _, result in found]
    faces = tuple(colour_of(result.ratio) for result in results)
    return Tiles(
        np.array([cell.indices[places[0]] for cell, _ in found], float),
        np.array([rows - 1 - cell.indices[places[1]] if len(places) > 1 else 0 for cell, _ in found], float),
        tuple(brief(result.ratio) for result in results), tuple(WORDS[result.status] for result in results),
        faces, tuple(map(ink_on, faces)), TIPS,
        {
            "ratio": [brief(r.ratio) for r in results], "status": [r.status for r in results],
            "interval": [f"[{brief(r.ratio_low)}, {brief(r.ratio_high)}]" for r in results],
            "runs": [str(r.runs) for r in results],
        },
    )  # fmt: skip


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
