"""Figures draw what they are given and show every name literally."""

from __future__ import annotations

from io import BytesIO

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from consistency.reporting import plots

ODD = ("$x^2$ and \\frac", "_hidden", "<script>", "#*@", "$$y$$")
STEPS = np.arange(1, 6)


@pytest.fixture
def axes():
    return Figure().subplots()


def drawn(figure: Figure) -> str:
    """SVG with its text as text."""
    import matplotlib as mpl

    buffer = BytesIO()
    with mpl.rc_context({"svg.fonttype": "none"}):
        figure.savefig(buffer, format="svg")
    return buffer.getvalue().decode()


def test_thirty_filters_look_different():
    looks = {(plots.style(i).colour, plots.style(i).dash) for i in range(30)}
    assert len(looks) == 30


def test_the_first_filters_differ_in_grey_print():
    first = [plots.style(i) for i in range(5)]
    assert len({look.dash for look in first}) == 5
    assert len({look.marker for look in first}) == 5


def test_names_are_shown_literally():
    figure = Figure()
    panel = figure.subplots()
    plots.title(panel, ODD[0])
    plots.key(figure, [(name, plots.line(plots.style(i))) for i, name in enumerate(ODD)], columns=2)
    text = [t.get_text() for t in figure.legends[0].get_texts()]
    assert text == list(ODD)
    svg = drawn(figure)
    assert "$x^2$ and \\frac" in svg
    assert "&lt;script&gt;" in svg


def test_anees_draws_the_values_in_the_filters_style(axes):
    values = np.array([1.0, 2.0, 300.0, np.nan, 4.0])
    plots.anees(axes, [(plots.style(1), STEPS, values)], log=True)
    line = axes.lines[0]
    np.testing.assert_array_equal(line.get_ydata(), values)
    assert to_hex(line.get_color()).upper() == plots.style(1).colour
    assert axes.get_yscale() == "log"
    assert axes.get_ylabel() == "ANEES of the pose"


def test_a_single_run_is_labelled_nees(axes):
    plots.anees(axes, [(plots.style(0), STEPS, np.ones(5))], log=False, single=True)
    assert axes.get_ylabel() == "NEES of the pose"
    assert axes.get_yscale() == "linear"


def test_bands_are_drawn_where_they_are(axes):
    band, simultaneous = np.tile([2.36, 3.72], (5, 1)), np.tile([1.84, 4.54], (5, 1))
    plots.anees_band(axes, STEPS, band, simultaneous, expected=3.0)
    levels = {float(line.get_ydata()[0]) for line in axes.lines}
    assert levels == {1.84, 4.54, 3.0}
    shaded = axes.collections[0].get_paths()[0].vertices[:, 1]
    assert (shaded.min(), shaded.max()) == (2.36, 3.72)


def test_pose_error_has_bounds_at_two_sigma(axes):
    sigma = np.array([0.1, 0.2, 0.3, 0.2, np.nan])
    plots.pose_error(axes, STEPS, sigma / 2, sigma, plots.style(0), component=2)
    curves = [line.get_ydata() for line in axes.lines if len(line.get_ydata()) == 5]
    np.testing.assert_allclose(curves, [-2 * sigma, 2 * sigma, sigma / 2])
    assert axes.get_ylabel() == "heading error\n(deg)"


def test_scenario_has_equal_axes_and_does_without_truth_and_landmarks(axes):
    path = np.column_stack([np.cos(STEPS), np.sin(STEPS)])
    plots.scenario(axes, None, None, None, [(plots.style(0), path)])
    assert axes.get_aspect() == 1.0
    assert len(axes.lines) == 1


def test_scenario_draws_the_truth_solid_and_the_odometry_dashed(axes):
    path = np.column_stack([np.cos(STEPS), np.sin(STEPS)])
    plots.scenario(axes, path, path + 0.1, path[:3])
    landmarks, odometry, truth, start = axes.lines
    assert landmarks.get_marker() == "*"
    assert odometry.is_dashed()
    assert not truth.is_dashed()
    np.testing.assert_array_equal(start.get_xydata()[0], path[0])


def test_a_forest_has_a_row_for_each_axis_and_an_arrow_where_an_interval_goes_on(axes):
    rows = [("$x$", [(2.0, 1.5, 3.0), (0.5, 0.0, np.inf)]), ("y", [None, (1.0, 0.9, 1.2)])]
    plots.forest(axes, [plots.style(0), plots.style(1)], rows, expected=1.0, window=(0.1, 10.0), log=True)
    assert [label.get_text() for label in axes.get_yticklabels()] == ["$x$", "y"]
    assert axes.get_ylim() == (1.5, -0.5)  # the first row is on top
    assert axes.get_xscale() == "log"
    bars = [list(line.get_xdata()) for line in axes.lines if line.get_linestyle() == "-" and len(line.get_xdata()) == 2]
    assert bars == [[1, 1], [1.5, 3.0], [0.1, 10.0], [0.9, 1.2]]  # the line at 1 first
    arrows = [(line.get_marker(), float(line.get_xdata()[0])) for line in axes.lines if line.get_marker() in "<>"]
    assert arrows == [("<", 0.1), (">", 10.0)]
    places = [float(line.get_ydata()[0]) for line in axes.lines if line.get_marker() == plots.style(1).marker]
    np.testing.assert_allclose(places, [plots.dodge(1, 2), 1 + plots.dodge(1, 2)])


def test_filters_in_a_row_keep_apart_and_stay_in_it():
    for slots in range(1, 7):
        offsets = [plots.dodge(slot, slots) for slot in range(slots)]
        assert len(set(offsets)) == slots
        assert max(map(abs, offsets)) < 0.5
        assert sum(offsets) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("half_width", [0.2, 0.5, 0.9])
def test_the_band_of_a_distribution_follows_the_diagonal_and_stays_a_probability(axes, half_width):
    x, y = np.array([0.0, 0.3, 0.8, 1.0]), np.array([0.0, 0.5, 1.0, 1.0])
    plots.distribution(axes, x, y, half_width, plots.style(0))
    edge = axes.collections[0].get_paths()[0].vertices
    assert edge.min() == 0.0
    assert edge.max() == 1.0
    for corner, value in ((0.0, half_width), (1.0, 1.0 - half_width)):
        assert np.isclose(edge, [corner, value]).all(axis=1).any()
    curve = axes.lines[1]
    assert curve.get_drawstyle() == "steps-post"
    np.testing.assert_array_equal(curve.get_ydata(), y)


def test_autocorrelation_starts_at_lag_one_within_its_bound(axes):
    plots.autocorrelation(axes, np.array([0.5, -0.1, 0.0]), 0.2, plots.style(3))
    np.testing.assert_array_equal(axes.lines[-1].get_xdata(), [1, 2, 3])
    np.testing.assert_array_equal(axes.lines[-1].get_ydata(), [0.5, -0.1, 0.0])
    assert (axes.patches[0].get_y(), axes.patches[0].get_height()) == (-0.2, 0.4)


def test_autocorrelation_that_is_not_judged_has_no_bound_and_does_not_look_large(axes):
    plots.autocorrelation(axes, np.array([0.03, -0.01]), None, plots.style(0))
    assert not axes.patches
    low, high = axes.get_ylim()
    assert low == -high
    assert high >= 0.1
    plots.autocorrelation(axes, np.array([0.9, -0.1]), 0.2, plots.style(0))
    assert 0.9 < axes.get_ylim()[1] < 1.1


def test_other_figures_draw_what_they_are_given(axes):
    plots.nis(axes, STEPS, np.ones(5), plots.style(2))
    assert axes.lines[0].get_marker() == plots.style(2).marker
    panels = Figure().subplots(1, 2)
    circle = np.column_stack([np.cos(STEPS), np.sin(STEPS)])
    plots.samples(panels[0], circle, circle, 2 * circle)
    plots.marginal(panels[1], np.arange(4.0), np.ones(3), STEPS, STEPS / 5, STEPS / 6)
    assert [len(panel.lines) for panel in panels] == [3, 2]
    assert all(isinstance(line, Line2D) for line in panels[0].lines)


def test_cells_differ_by_marker_and_colour(axes):
    ratio, nees, accepted = np.array([0.01, 0.1, 0.5]), np.array([1.0, 1.1, 9.0]), np.array([True, True, False])
    plots.cells(axes, ratio, nees, accepted, holds=0.05)
    found = {line.get_marker(): line for line in axes.lines if line.get_marker() != "None"}
    np.testing.assert_array_equal(found[plots.ACCEPTED.marker].get_ydata(), [1.0, 1.1])
    np.testing.assert_allclose(found[plots.REJECTED.marker].get_xdata(), [50.0])
    assert len({line.get_color() for line in found.values()}) == 2
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")


def test_shares_are_drawn_with_the_range_that_is_accepted(axes):
    plots.shares(axes, STEPS, np.full(5, 0.9), 0.95, (0.91, 0.985))
    band = axes.patches[0].get_extents().transformed(axes.transData.inverted())
    np.testing.assert_allclose([band.y0, band.y1], [91.0, 98.5])
    np.testing.assert_allclose(axes.lines[0].get_ydata(), 95.0)
    np.testing.assert_allclose(axes.lines[1].get_ydata(), 90.0)
