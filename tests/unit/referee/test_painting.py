"""Marks are drawn with the values that they have, names are shown literally, and files of figures are small."""

import re
from functools import partial

import numpy as np
import pytest
from matplotlib.colors import to_hex
from numpy.testing import assert_array_equal
from painted import legend_of, places, shaded

from consistency.referee.show import as_html
from consistency.referee.show.blocks import EXPECTED, LIMIT, Document, Figure, Look, style
from consistency.referee.show.figures import LIMIT as MOST
from consistency.referee.show.figures import (
    MOST_TITLES,
    NARROWEST,
    TITLE,
    add_legend,
    band,
    canvas,
    curve,
    dodge,
    dots,
    drawn,
    edges,
    intervals,
    log_axis,
    make_map,
    name_rows,
    paint,
    path,
    png,
    points,
    rows_of,
    saved,
    svg,
    thin,
)

ODD = ("$x^2$ and \\frac", "_hidden", "<script>", "#*@", "$$y$$")
STEPS = np.arange(1.0, 6.0)
TAG = "0-1"


def axes_of(*marks):
    return drawn(partial(draw, *marks)).axes[0]


def draw(*marks, legend=False):
    figure, (axes,) = canvas(2.0)
    for mark in marks:
        mark(axes)
    return add_legend(figure) if legend else figure


# --- looks ------------------------------------------------------------------------------------


def test_thirty_filters_look_different():
    assert len({(style(i).colour, style(i).dash) for i in range(30)}) == 30


def test_the_first_filters_differ_in_grey_print():
    first = [style(i) for i in range(5)]
    assert len({look.dash for look in first}) == 5
    assert len({look.marker for look in first}) == 5


def test_every_marker_has_a_shape_on_a_page():
    assert {style(i).marker for i in range(30)} == set(as_html.SHAPES)


def test_filters_in_a_row_keep_apart_and_stay_in_it():
    for slots in range(1, 7):
        offsets = [dodge(slot, slots) for slot in range(slots)]
        assert len(set(offsets)) == slots
        assert max(map(abs, offsets)) < 0.5
        assert sum(offsets) == pytest.approx(0.0, abs=1e-12)


# --- what is drawn ----------------------------------------------------------------------------


def test_a_line_has_its_values_its_look_and_its_filter():
    values = np.array([1.0, 2.0, 300.0, np.nan, 4.0])
    axes = axes_of(lambda axes: curve(axes, STEPS, values, style(1), "f", TAG), lambda axes: log_axis(axes, "y"))
    (line,) = axes.lines
    assert_array_equal(line.get_ydata(), values)
    assert to_hex(line.get_color()).upper() == style(1).colour
    assert line.is_dashed()
    assert (line.get_label(), line.get_gid()) == ("f", "filter:0-1")
    assert axes.get_yscale() == "log"


def test_bands_and_their_edges_are_drawn_where_they_are():
    ends = np.tile([2.36, 3.72], (5, 1))
    wider = np.tile([1.36, 4.72], (5, 1))
    axes = axes_of(lambda axes: band(axes, STEPS, ends), lambda axes: edges(axes, STEPS, wider, LIMIT, "l"))
    assert shaded(axes) == (2.36, 3.72)
    assert [line.get_ydata()[0] for line in axes.lines] == pytest.approx([1.36, 4.72])
    assert [line.get_label() for line in axes.lines].count("l") == 1


def test_small_points_are_one_path_of_those_that_are_known():
    y = np.array([1.0, np.nan, 3.0, 4.0, np.inf])
    axes = axes_of(lambda axes: points(axes, STEPS, y, style(0), "p", TAG))
    (found,) = places(axes)
    assert_array_equal(found, [[1, 1], [3, 3], [4, 4]])
    assert axes.get_ylim()[0] < 1.0 < 4.0 < axes.get_ylim()[1]
    text = svg(partial(draw, lambda axes: points(axes, STEPS, y, style(0), "p", TAG)))
    (marks,) = re.findall(r'<g class="filter-0-1"><path d="([^"]*)"', text)
    assert (marks.count("M"), len(marks.split())) == (3, 15)
    axes_of(lambda axes: points(axes, STEPS, np.full(5, np.nan), style(0)))


def test_intervals_have_a_row_each_and_an_arrow_where_they_go_on():
    def mark(axes):
        axes.set_xlim(0.1, 10.0)
        name_rows(axes, ["$x$", "y"])
        intervals(axes, np.array([0.0, 1.0]), np.array([[2.0, 1.5, 3.0], [0.5, 0.0, np.inf]]), style(0), "f", TAG)
        log_axis(axes, "x")

    axes = axes_of(mark)
    assert [label.get_text() for label in axes.get_yticklabels()] == ["$x$", "y"]
    assert axes.get_ylim() == (1.5, -0.5)  # the first row is on top
    assert (axes.get_xscale(), axes.get_xlim()) == ("log", (0.1, 10.0))
    bars = [segment[:, 0].tolist() for segment in axes.collections[0].get_segments()]
    assert bars == [[1.5, 3.0], [0.1, 10.0]]
    arrows = [(line.get_marker(), line.get_xdata().tolist()) for line in axes.lines if line.get_marker() in "<>"]
    assert arrows == [("<", [0.1]), (">", [10.0])]
    assert {line.get_gid() for line in axes.lines} == {"filter:0-1"}
    assert_array_equal(axes.lines[-1].get_xydata(), [[2.0, 0.0], [0.5, 1.0]])


def test_a_panel_with_none_below_it_has_numbers_on_its_axis():
    figure = drawn(lambda: canvas(3.0, 2, 3, sharex=True)[0])
    assert [a.xaxis.get_tick_params()["labelbottom"] for a in figure.axes[:3]] == [False, True, True]
    assert not figure.axes[3].axison
    assert [rows_of(n) for n in (1, 2, 3, 4, 5, 9)] == [1, 2, 3, 2, 3, 3]


def test_a_map_has_equal_axes_and_height():
    line = np.array([[0.0, 0.0], [10.0, 0.0]])
    axes = axes_of(lambda axes: path(axes, line, style(0)), make_map)
    assert axes.get_aspect() == 1.0
    assert np.ptp(axes.get_ylim()) == pytest.approx(NARROWEST * np.ptp(axes.get_xlim()))


def test_a_log_axis_has_plain_numbers():
    def mark(axes):
        axes.set_ylim(0.5, 40.0)
        log_axis(axes, "y")

    labels = [label.get_text() for label in axes_of(mark).get_yticklabels()]
    assert {"0.5", "1", "20"} <= set(labels)
    assert not any("$" in label for label in labels)


def test_thin_keeps_extremes_ends_and_short_lines():
    line = np.sin(np.linspace(0, 60, 30_000))
    line[12_345], line[23_456] = 7.0, -7.0
    line[5_000:6_000] = np.nan
    keep = thin(line)
    assert len(keep) <= MOST
    assert {0, 12_345, 23_456, 29_999} <= set(keep.tolist())
    assert (np.diff(keep) > 0).all()
    assert_array_equal(thin(line[:200]), np.arange(200))


@pytest.mark.parametrize("mark", ["curve", "path", "band", "edges"])
def test_a_long_mark_is_thinned_and_keeps_its_peak(mark):
    x, y = np.arange(9000.0), np.zeros(9000)
    y[4321] = 7.0
    ends = np.column_stack([-y, y])
    marks = {
        "curve": lambda axes: curve(axes, x, y, style(0)),
        "path": lambda axes: path(axes, np.column_stack([y, np.zeros(9000)]), style(0)),
        "band": lambda axes: band(axes, x, ends),
        "edges": lambda axes: edges(axes, x, ends, style(0)),
    }
    axes = axes_of(marks[mark])
    if mark == "band":
        assert shaded(axes) == (-7.0, 7.0)
    else:
        found = np.concatenate([line.get_xydata() for line in axes.lines])
        assert len(found) <= MOST * len(axes.lines)
        assert 7.0 in found


# --- names and legends ------------------------------------------------------------------------


def test_names_are_shown_literally():
    marks = [partial(curve, x=STEPS, y=STEPS, look=style(i), label=name) for i, name in enumerate(ODD)]
    title = [lambda axes: axes.set_title(ODD[0])]
    figure = drawn(partial(draw, *marks, *title, legend=True))
    assert legend_of(figure) == list(ODD)
    text = svg(partial(draw, *marks, *title, legend=True))
    assert text.count("$x^2$ and \\frac") == 2
    assert "&lt;script&gt;" in text


def test_a_legend_has_each_label_once_and_room_of_its_own():
    def both(legend):
        figure, panels = canvas(2.0, 2, 2)
        for axes in panels:
            curve(axes, STEPS, STEPS, style(0), "a filter", TAG)
            axes.axhline(1.0, label="a name that is longer than the legend of a figure is wide")
        return add_legend(figure) if legend else figure

    figure, alone = drawn(partial(both, True)), drawn(partial(both, False))
    assert len(legend_of(figure)) == 2
    assert "\n" in legend_of(figure)[1]
    assert figure.get_figheight() > alone.get_figheight()
    figure.draw_without_rendering()
    assert figure.legends[0].get_window_extent().y0 >= max(axes.get_window_extent().y1 for axes in figure.axes)
    assert figure.legends[0].get_texts()[0].get_gid() == "filter:0-1"  # hidden with the filter
    assert not legend_of(drawn(partial(draw, legend=True)))


def test_rows_of_a_legend_are_nearly_as_long_as_each_other():
    def five():  # names of which four have room in a row
        figure, (axes,) = canvas(2.0)
        for name in "abcde":
            curve(axes, STEPS, STEPS, style(0), name * 14)
        return add_legend(figure)

    figure = drawn(five)
    figure.draw_without_rendering()
    places_of = [text.get_window_extent().x0 for text in figure.legends[0].get_texts()]
    assert len(set(places_of)) == 3


def test_the_ground_of_a_picture_is_that_of_the_page():
    text = svg(partial(draw, lambda axes: curve(axes, np.arange(2.0), np.zeros(2), Look("#000"))))
    assert "fill: #ffffff" not in text


@pytest.mark.parametrize("width", [1.45, 5.0])
def test_a_page_knows_the_width_of_a_drawing(width):
    """A small drawing is not blown up to the width of the others."""
    assert f'style="--inches: {width:g}"' in svg(lambda: canvas(1.0, width=width)[0])


def test_a_picture_that_scrolls_is_reached_by_the_keyboard():
    figure = Figure("NEES", "", (draw,))
    assert '<div class="chart" role="img" tabindex="0" aria-label="NEES">' in as_html.render(
        Document("", "", (), (figure,))
    )


# --- files ------------------------------------------------------------------------------------


def line_of(name="f", tag=""):
    return partial(draw, lambda axes: curve(axes, STEPS, np.sqrt(STEPS), style(0), name, tag), legend=True)


def test_the_same_drawing_gives_the_same_characters_and_clips_of_its_own():
    assert svg(line_of(), "a") == svg(line_of(), "a")
    clips = [set(re.findall(r'<clipPath id="(\w+)"', svg(line_of(), name))) for name in "ab"]
    assert clips[0]
    assert not clips[0] & clips[1]


def test_coordinates_have_one_digit_and_groups_no_names():
    text = svg(line_of(tag=TAG))
    numbers = re.findall(r"\d+\.\d+", " ".join(re.findall(r'<path d="[^"]*"', text)))
    assert numbers
    assert {len(number.split(".")[1]) for number in numbers} == {1}
    assert "<g id=" not in text
    assert text.count('<g class="filter-0-1">') == 3  # the line, and its entry in the legend
    assert ">f</text>" in text


def test_what_has_words_to_hover_has_a_title_up_to_a_limit():
    def tiles(count):
        figure, (axes,) = canvas(2.0)
        for number in range(count):
            axes.plot(number, 0, "o", gid=f"{TITLE}<{number}> & more")
        return figure

    found = Figure("a", "", (partial(tiles, 2), partial(tiles, MOST_TITLES)))
    document = Document("d", "", (), (found, Figure("b", "", (partial(tiles, 1),))))
    pictures = paint(document)
    first, second = pictures[id(found)]
    assert "<g><title>&lt;1&gt; &amp; more</title>" in first
    assert first.count("<title>") + second.count("<title>") == MOST_TITLES
    assert "<title>" not in pictures[id(document.figures[1])][0]


@pytest.mark.parametrize("kind, begin", [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_files_of_a_figure_hold_no_date(kind, begin):
    first, second = (saved(drawn(line_of()), kind) for _ in range(2))
    assert first.startswith(begin)
    assert first == second


def test_small_points_are_seen_in_a_png():
    import io

    from matplotlib import image

    dark = partial(draw, lambda axes: points(axes, STEPS, STEPS, Look("#ff0000", size=4.0)))
    pixels = image.imread(io.BytesIO(png(dark, 100)))
    assert ((pixels[..., 0] > 0.9) & (pixels[..., 1] < 0.1)).sum() > 50


def test_a_picture_is_as_fine_as_it_is_asked_to_be():
    assert len(png(line_of(), 200)) > len(png(line_of(), 50))


def test_a_marker_with_an_edge_is_hollow():
    look = Look("#ffffff", edge=EXPECTED.colour)
    (line,) = axes_of(lambda axes: axes.plot(STEPS, STEPS, **dots(look))).lines
    assert (line.get_markerfacecolor(), line.get_markeredgecolor()) == ("#ffffff", EXPECTED.colour)
