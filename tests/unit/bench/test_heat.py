"""Heat maps of covariance ratios and the table of cells, for sweeps over any axes."""

from dataclasses import replace

import numpy as np
import pytest
from painted import panels, titles

import consistency as cs
from consistency.bench.pages import sweep_report as heat
from consistency.bench.pages import write_regime_reports
from consistency.bench.pages.sweep_report import colour_of, heat_figure, ink_on
from consistency.bench.sweeps.regime_map import Regime, regime_blocks
from consistency.bench.sweeps.run_sweep import CellResult, plain_numbers, result_from
from consistency.bench.sweeps.sweep_file import Axis, load_sweep
from consistency.referee.show.terminal import show

LONG = [{"kind": "mismatch", "rate": 0.05}]


def result(ratio, status="overconfident"):
    return CellResult(status, status, 12, 0, 3.0, 2.5, 3.5, ratio, ratio / 2, np.inf, 0.1, 0.01, 1.0, 20.0)


def sweep_over(**values):
    base = cs.load_scenario("herath2007-stereo")
    effects = [{"kind": "heavy-tails", "rate": 0.1, "sigma": (1.0, 1.0, 1.0)}]
    axes = tuple(Axis(key.replace("__", "."), tuple(some)) for key, some in values.items())
    return replace(
        load_sweep("small"), base=base.variant("base", truth__sensor__effects=effects), axes=axes, filters=("a", "b")
    )


SPEED = {"truth__path__speed": [0.25, 0.5, 1.0]}
NOISE = {"belief__motion__sigma_v": [0.1, 0.2]}
TEXT = {"truth__sensor__effects": [[], LONG]}
HEADING = {"truth__path__heading": [0.0, 1.0]}
GRIDS = {
    "one": SPEED, "text": TEXT, "two": SPEED | NOISE, "four": TEXT | SPEED | NOISE | HEADING,
}  # fmt: skip


def regime_of(sweep):
    """Ratio of filter a: 1 + number of the cell; infinite in the last one, none in the first of b."""
    cells = sweep.cells
    results = {(cell.number, "a"): result(1.0 + cell.number) for cell in cells}
    results[cells[-1].number, "a"] = result(np.inf)
    results[0, "b"] = result(np.nan, "failed")
    return Regime(sweep, results, {})


def every_panel(figure):
    return [axes for number in range(len(figure.drawings)) for axes in panels(figure, number)]


def tiles(axes):
    """Number and word of each tile by its place."""
    texts = [text for text in axes.texts if text.get_text()]
    pairs = zip(texts[::2], texts[1::2], strict=True)
    return {
        (int(number.get_position()[0]), int(number.get_position()[1])): (number.get_text(), word.get_text())
        for number, word in pairs
    }


def ticks(labels):
    return [label.get_text() for label in labels]


def test_a_tile_stands_where_its_cell_does():
    """Speeds from the left, noises from below; the number is that of the cell."""
    (axes,) = every_panel(heat_figure(regime_of(sweep_over(**SPEED, **NOISE)), "a"))
    assert ticks(axes.get_xticklabels()) == ["0.25", "0.5", "1"]
    assert ticks(axes.get_yticklabels()) == ["0.1", "0.2"], "rows are named from below"
    assert {place: number for place, (number, _) in tiles(axes).items()} == {
        (0, 0): "1.00", (0, 1): "2.00", (1, 0): "3.00", (1, 1): "4.00", (2, 0): "5.00", (2, 1): "∞",
    }  # fmt: skip
    assert {word for _, word in tiles(axes).values()} == {"overconf."}
    assert heat.words_of(result(1.0)) == "overconfident, covariance ratio 1.00 [0.50, ∞], 12 runs"
    assert axes.patches[0].get_gid() == f"title:{heat.words_of(result(1.0))}"


@pytest.mark.parametrize("name, many", [("one", 1), ("text", 1), ("two", 1), ("four", 4)])
def test_every_cell_is_shown_once(name, many):
    regime = regime_of(sweep_over(**GRIDS[name]))
    found = every_panel(heat_figure(regime, "a"))
    assert len(found) == many
    shown = [number for axes in found for number, _ in tiles(axes).values()]
    assert len(shown) == len(regime.sweep.cells)
    assert len(set(shown)) == len(shown)
    assert len(set(titles(found))) == many
    first, *empty = every_panel(heat_figure(regime, "b"))
    assert list(tiles(first).values()) == [("–", "failed")]
    assert [text.get_text() for axes in empty for text in axes.texts] == ["no cell is there yet"] * len(empty)


def test_axes_that_vary_alone_have_a_map_each(tmp_path, capsys):
    """Beside the axis of the grid; each map has the cells in which no other axis is away from its base."""
    regime = regime_of(replace(load_sweep("beyond"), filters=("a", "b")))
    sweep, found = regime.sweep, every_panel(heat_figure(regime, "a"))
    assert [axes.get_xlabel() for axes in found] == [axis.key.rpartition(".")[2] for axis in sweep.alone]
    for axis, axes in zip(sweep.alone, found, strict=True):
        k = sweep.axes.index(axis)
        shown = [
            c for c in sweep.cells if all(c.indices[j] == a.home for j, a in enumerate(sweep.axes) if j not in (0, k))
        ]
        numbers = {(c.indices[k], c.indices[0]): c.number for c in shown}
        last = len(sweep.cells) - 1
        assert {place: number for place, (number, _) in tiles(axes).items()} == {
            at: "∞" if n == last else heat.brief(1.0 + n) for at, n in numbers.items()
        }
    page, _ = write_regime_reports(regime, tmp_path)
    text = page.read_text(encoding="utf-8")
    assert "Otherwise" in text
    assert "Alone: time of a step" in text
    assert text.count("noise of the odometry ×3<") == 3  # a row for each rig
    show(*regime_blocks(regime))
    rows = [line for line in capsys.readouterr().out.splitlines() if "overconfident " in line and "cost" not in line]
    assert len(rows) == len(sweep.cells)
    assert [row.split("overconfident")[0].split()[2:] for row in rows[:2]] == [
        ["the", "base"],
        ["time", "of", "a", "step", "0.05", "s"],
    ]


def test_long_values_are_told_apart():
    axis = Axis("truth.sensor.effects", tuple([{"kind": "mismatch", "rate": rate}] * 3 for rate in (0.1, 0.2)))
    texts = [heat.value_in_few_characters(axis, i) for i in range(2)]
    assert len(set(texts)) == 2
    assert max(map(len, texts)) <= heat.LONGEST


def test_colours_say_which_way():
    assert colour_of(1.0) == heat.PAPER
    assert colour_of(heat.FULL) == colour_of(1e9) == colour_of(np.inf) == heat.LARGE.lower()
    assert colour_of(1.0 / heat.FULL) == colour_of(1e-9) == colour_of(0.0) == heat.SMALL.lower()
    red, _, blue = (int(colour_of(1.5)[i : i + 2], 16) for i in (1, 3, 5))
    assert red > blue, "towards vermilion"
    assert ink_on(heat.PAPER) == ink_on(heat.SMALL) == "#000000"
    assert ink_on("#0072b2") == "#ffffff"


@pytest.mark.parametrize("name", GRIDS)
def test_a_terminal_has_a_row_a_cell(name, capsys):
    regime = regime_of(sweep_over(**GRIDS[name]))
    show(*regime_blocks(regime))
    lines = [line for line in capsys.readouterr().out.splitlines() if line]
    rows = [line for line in lines if "overconfident " in line and "cost" not in line]
    assert len(rows) == len(regime.sweep.cells)
    assert "overconfident 1.00" in rows[0]
    assert "failed" in rows[0]
    assert "overconfident ∞" in rows[-1]


def test_many_cells_are_counted_only(capsys):
    show(*regime_blocks(regime_of(replace(load_sweep("regime"), filters=("a", "b")))))
    assert len(capsys.readouterr().out.splitlines()) < 10


def test_an_infinite_ratio_is_kept():
    numbers = plain_numbers(result(np.inf))
    assert (numbers["ratio"], plain_numbers(result(np.nan))["ratio"]) == ("inf", None)
    assert result_from(numbers).ratio == np.inf
    assert np.isnan(result_from(plain_numbers(result(np.nan))).ratio)
