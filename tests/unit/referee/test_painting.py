"""Both painters draw what a description holds, and show every name literally."""

from __future__ import annotations

from dataclasses import replace

import matplotlib as mpl
import numpy as np
import pytest
from bokeh.models import DataRange1d, GlyphRenderer, HoverTool, Range1d
from bokeh.models.annotations import BoxAnnotation
from bokeh.models.annotations import Span as Across
from matplotlib.colors import to_hex

from consistency.referee.document.colours import BAND, EXPECTED, LIMIT, SHADE, style
from consistency.referee.document.drawing import (
    Axis,
    Band,
    Bars,
    Intervals,
    Key,
    Line,
    Mark,
    Owner,
    Panel,
    Points,
    Rule,
    Sheet,
    Span,
    Stems,
    dodge,
    kept,
    numbers,
)
from consistency.referee.show import with_matplotlib
from consistency.referee.show.with_bokeh import MARKERS, Screen

ODD = ("$x^2$ and \\frac", "_hidden", "<script>", "#*@", "$$y$$")
STEPS = np.arange(1, 6)
OWNER = Owner("f", "0:1")
ROWS = Axis("", rows=("$x$", "y"))


def panel(*marks: Mark, **axes: Axis) -> Panel:
    return Panel(axes.get("x", Axis("step")), axes.get("y", Axis("value")), marks, "a chart")


def drawn(*marks: Mark, **axes: Axis):
    """Matplotlib axes of one panel."""
    return with_matplotlib.draw(Sheet((panel(*marks, **axes),), 2.0)).axes[0]


def shown(*marks: Mark, limit: int = 100, **axes: Axis):
    """Bokeh figure of one panel."""
    return Screen(limit).draw(panel(*marks, **axes))


def glyphs(chart) -> list:
    return [r for r in chart.renderers if isinstance(r, GlyphRenderer)]


# --- looks ------------------------------------------------------------------------------------


def test_thirty_filters_look_different():
    assert len({(style(i).colour, style(i).dash) for i in range(30)}) == 30


def test_the_first_filters_differ_in_grey_print():
    first = [style(i) for i in range(5)]
    assert len({look.dash for look in first}) == 5
    assert len({look.marker for look in first}) == 5


def test_every_marker_has_a_name_on_the_screen():
    assert {style(i).marker for i in range(30)} == set(MARKERS)


def test_filters_in_a_row_keep_apart_and_stay_in_it():
    for slots in range(1, 7):
        offsets = [dodge(slot, slots) for slot in range(slots)]
        assert len(set(offsets)) == slots
        assert max(map(abs, offsets)) < 0.5
        assert sum(offsets) == pytest.approx(0.0, abs=1e-12)


# --- what is drawn ----------------------------------------------------------------------------


def test_a_line_has_its_values_and_look_in_both():
    values = np.array([1.0, 2.0, 300.0, np.nan, 4.0])
    mark = Line(STEPS, values, style(1), OWNER, (("step", "@x"), ("extra", "@more")), {"more": values / 2})
    line = drawn(mark, y=Axis("ANEES", log=True)).lines[0]
    np.testing.assert_array_equal(line.get_ydata(), values)
    assert to_hex(line.get_color()).upper() == style(1).colour
    assert line.is_dashed()
    assert line.axes.get_yscale() == "log"
    assert line.axes.get_ylabel() == "ANEES"
    chart = shown(mark, y=Axis("ANEES", log=True))
    (glyph,) = glyphs(chart)
    np.testing.assert_array_equal(glyph.data_source.data["y"], values.astype(np.float32))
    np.testing.assert_array_equal(glyph.data_source.data["more"], (values / 2).astype(np.float32))
    assert (glyph.name, glyph.tags, glyph.glyph.line_color) == ("f", ["0:1"], style(1).colour)
    (hover,) = chart.select(HoverTool)
    assert hover.tooltips == [("filter", "$name"), ("step", "@x"), ("extra", "@more")]
    assert hover.renderers == [glyph]


def test_a_bound_is_drawn_on_both_sides_of_zero():
    bound = np.array([0.1, 0.2, 0.3, 0.2, np.nan])
    mark = Line(STEPS, bound / 2, style(0), OWNER, bound=bound)
    axes = drawn(mark)
    np.testing.assert_allclose([line.get_ydata() for line in axes.lines], [-bound, bound, bound / 2])
    assert len(axes.collections) == 1  # shaded
    edges = [r for r in glyphs(shown(mark)) if r.glyph.y in ("bound", "below")]
    assert len(edges) == 2
    np.testing.assert_allclose(edges[0].data_source.data["below"], -edges[0].data_source.data["bound"])
    assert all(edge.tags == ["0:1"] for edge in edges)  # hidden with the filter


def test_bands_are_drawn_where_they_are():
    low, high = np.full(5, 2.36), np.full(5, 3.72)
    axes = drawn(Band(STEPS, low, high, SHADE), Band(STEPS, low - 1, high + 1, LIMIT, outline=True))
    shaded = axes.collections[0].get_paths()[0].vertices[:, 1]
    assert (shaded.min(), shaded.max()) == (2.36, 3.72)
    assert {float(line.get_ydata()[0]) for line in axes.lines} == {1.3599999999999999, 4.720000000000001}
    fill, first, second = glyphs(shown(Band(STEPS, low, high, SHADE), Band(STEPS, low, high, LIMIT, outline=True)))
    assert (fill.glyph.y1, fill.glyph.y2, fill.glyph.fill_color) == ("low", "high", BAND)
    assert (first.glyph.y, second.glyph.y) == ("low", "high")


@pytest.mark.parametrize("side", ["x", "y"])
def test_rules_and_spans_cross_the_panel_at_their_place(side):
    axes = drawn(Rule(side, 1.0, EXPECTED), Span(side, 2.0, 3.0, SHADE))
    at = axes.lines[0].get_ydata() if side == "y" else axes.lines[0].get_xdata()
    assert list(at) == [1.0, 1.0]
    box = axes.patches[0].get_extents().transformed(axes.transData.inverted())
    np.testing.assert_allclose([box.y0, box.y1] if side == "y" else [box.x0, box.x1], [2.0, 3.0])
    centre = shown(Rule(side, 1.0, EXPECTED), Span(side, 2.0, 3.0, SHADE)).center
    (across,) = [item for item in centre if isinstance(item, Across)]
    assert (across.location, across.dimension) == (1.0, "width" if side == "y" else "height")
    (shade,) = [item for item in centre if isinstance(item, BoxAnnotation)]
    assert ((shade.bottom, shade.top) if side == "y" else (shade.left, shade.right)) == (2.0, 3.0)


def test_intervals_have_a_row_each_and_an_arrow_where_they_go_on():
    window = Axis("ratio", log=True, window=(0.1, 10.0))
    mark = Intervals(
        np.array([0.0, 1.0]), np.array([2.0, 0.5]), np.array([1.5, 0.0]), np.array([3.0, np.inf]), style(0), OWNER,
        (("axis", "@axis"),), {"axis": ["x", "y"]},
    )  # fmt: skip
    axes = drawn(mark, x=window, y=ROWS)
    assert [label.get_text() for label in axes.get_yticklabels()] == ["$x$", "y"]
    assert axes.get_ylim() == (1.5, -0.5)  # the first row is on top
    assert axes.get_xscale() == "log"
    bars = [segment[:, 0].tolist() for segment in axes.collections[0].get_segments()]
    assert bars == [[1.5, 3.0], [0.1, 10.0]]
    arrows = [(line.get_marker(), line.get_xdata().tolist()) for line in axes.lines if line.get_marker() in "<>"]
    assert arrows == [("<", [0.1]), (">", [10.0])]
    chart = shown(mark, x=window, y=ROWS)
    low, high = (glyphs(chart)[0].data_source.data[name].tolist() for name in ("low", "high"))
    np.testing.assert_allclose([low, high], [[1.5, 0.1], [3.0, 10.0]])
    assert sum(getattr(r.glyph, "marker", None) == "triangle" for r in glyphs(chart)) == 2
    assert chart.x_range.start < 0.1
    assert chart.x_range.end > 10.0
    assert (chart.y_range.start, chart.y_range.end) == (1.5, -0.5)
    assert chart.yaxis[0].major_label_overrides == {0: "$x$", 1: "y"}


def test_stems_stand_on_zero():
    mark = Stems(STEPS, STEPS - 3.0, style(3), OWNER)
    axes = drawn(mark)
    assert [segment[0][1] for segment in axes.collections[0].get_segments()] == [0.0] * 5
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), STEPS - 3.0)
    stems, dots = glyphs(shown(mark))
    assert stems.glyph.y0 == 0
    assert dots.glyph.marker == MARKERS[style(3).marker]


def test_bars_and_steps():
    axes = drawn(Bars(np.arange(4.0), np.array([1.0, 2.0, 3.0]), SHADE), Line(STEPS, STEPS, style(0), steps=True))
    np.testing.assert_array_equal(axes.patches[0].get_data().values, [1.0, 2.0, 3.0])
    assert axes.lines[0].get_drawstyle() == "steps-post"
    bars, step = glyphs(shown(Bars(np.arange(4.0), np.ones(3), SHADE), Line(STEPS, STEPS, style(0), steps=True)))
    np.testing.assert_array_equal(bars.data_source.data["right"], [1.0, 2.0, 3.0])
    assert step.glyph.mode == "after"


# --- axes -------------------------------------------------------------------------------------


def test_the_range_follows_the_filters_shown_where_it_is_asked_to():
    mark = Points(STEPS, STEPS, style(0), OWNER)
    follows = shown(mark, y=Axis("value", follows=True, window=(0.0, 1.0), least=0.5)).y_range
    assert isinstance(follows, DataRange1d)
    assert (follows.only_visible, follows.min_interval) == (True, 0.5)
    fixed = shown(mark, y=Axis("value", window=(0.0, 1.0))).y_range
    assert isinstance(fixed, Range1d)
    assert (fixed.start, fixed.end) == (0.0, 1.0)


def test_axes_of_one_name_are_one():
    mark, shared = Points(STEPS, STEPS, style(0)), Axis("step", share="step")
    screen = Screen(100)
    first, second = (screen.draw(panel(mark, x=shared)) for _ in range(2))
    assert first.x_range is second.x_range
    assert first.y_range is not second.y_range
    left, right = with_matplotlib.draw(Sheet((panel(mark, y=shared), panel(mark, y=shared)), 2.0)).axes
    assert left.get_shared_y_axes().joined(left, right)
    assert (left.get_ylabel(), right.get_ylabel()) == ("step", "")


def test_a_panel_with_none_below_it_has_numbers_on_its_axis():
    mark, shared = Points(STEPS, STEPS, style(0)), Axis("step", share="step")
    axes = with_matplotlib.draw(Sheet(3 * (panel(mark, x=shared),), 3.0, columns=2)).axes
    assert [a.xaxis.get_tick_params()["labelbottom"] for a in axes[:3]] == [False, True, True]
    assert not axes[3].axison


def test_a_map_has_equal_axes_and_height():
    flat = Line(np.array([0.0, 10.0]), np.zeros(2), style(0), path=True)
    axes = with_matplotlib.draw(Sheet((replace(panel(flat), equal=True),), 2.0)).axes[0]
    assert axes.get_aspect() == 1.0
    assert np.ptp(axes.get_ylim()) == pytest.approx(with_matplotlib.NARROWEST * np.ptp(axes.get_xlim()))


def test_a_panel_without_values_says_so():
    lost = replace(panel(Line(STEPS, np.full(5, np.nan), style(0))), empty="no estimate")
    none = replace(panel(), empty="too few")
    left, right = with_matplotlib.draw(Sheet((lost, none), 2.0)).axes
    assert [text.get_text() for axes in (left, right) for text in axes.texts] == ["no estimate", "too few"]
    assert left.axison
    assert not right.axison


# --- names and size ---------------------------------------------------------------------------


def test_names_are_shown_literally():
    keys = tuple(Key(name, style(i)) for i, name in enumerate(ODD))
    sheet = Sheet((replace(panel(Rule("y", 1.0, EXPECTED)), title=ODD[0]),), 2.0, title=ODD[2], keys=keys)
    figure = with_matplotlib.draw(sheet)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == list(ODD)
    with mpl.rc_context({"svg.fonttype": "none"}):
        svg = with_matplotlib.picture(figure, "svg").decode()
    assert "$x^2$ and \\frac" in svg
    assert "&lt;script&gt;" in svg


def test_a_panel_has_a_legend_of_its_own_and_room_for_it():
    keys = (
        *(Key(name, style(i)) for i, name in enumerate(ODD)),
        Key("a name that is longer than a panel is wide", SHADE, "band"),
    )
    plain, keyed = panel(Rule("y", 1.0, EXPECTED)), replace(panel(Rule("y", 1.0, EXPECTED)), keys=keys)
    alone, figure = (with_matplotlib.draw(Sheet((plain, second), 2.0)) for second in (plain, keyed))
    left, right = figure.axes
    assert left.get_legend() is None
    texts = [text.get_text() for text in right.get_legend().get_texts()]
    assert [text.replace("\n", " ") for text in texts] == [key.text for key in keys]
    assert "\n" in texts[-1]
    assert figure.get_figheight() > alone.get_figheight()
    figure.draw_without_rendering()
    assert right.get_legend().get_window_extent().y0 >= right.get_window_extent().y1


def test_the_same_sheet_gives_the_same_bytes():
    sheet = Sheet((panel(Line(STEPS, STEPS, style(0)), y=Axis("value", log=True)),), 2.0, keys=(Key("f", style(0)),))
    first, second = (with_matplotlib.render(sheet) for _ in range(2))
    assert first == second


def test_a_long_mark_is_thinned_and_keeps_its_peak():
    y = np.zeros(9000)
    y[4321] = 7.0
    mark = Line(np.arange(9000), y, style(0))
    assert len(kept(mark, 100)) <= 100
    assert 4321 in kept(mark, 100)
    assert 4321 in kept(replace(mark, x=y, y=np.zeros(9000), path=True), 100)
    assert 4321 in kept(replace(mark, y=np.zeros(9000), bound=y), 100)
    assert 4321 in kept(Band(mark.x, -y, y, SHADE), 100)
    assert len(kept(Points(mark.x, y, style(0), whole=True), 100)) == 9000
    assert len(glyphs(shown(mark))[0].data_source.data["x"]) <= 100


def test_columns_are_counted_as_they_are_written():
    line = Line(STEPS, STEPS, style(0), bound=np.ones(5), columns={"a": STEPS})
    marks = (line, Points(STEPS, STEPS, style(0)), Band(STEPS, STEPS, STEPS, SHADE), Bars(np.arange(6.0), STEPS, SHADE))
    for mark in marks:
        columns = glyphs(shown(mark))[0].data_source.data
        assert numbers(mark) == (5, len(columns))
    assert numbers(Rule("x", 0.0, EXPECTED)) == (0, 0)
