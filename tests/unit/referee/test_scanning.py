"""Pages that are read in a minute: the word of the verdict first, what was asked first, one meaning for each colour."""

import re
from functools import partial

import numpy as np
import pytest
from matplotlib.colors import to_hex
from numpy.testing import assert_allclose

import consistency as cs
from consistency.diagnostics import make_record
from consistency.referee.diagnostics.monitor import GateRatios
from consistency.referee.pages.ratio_figures import bound_figures, monitor_drawing
from consistency.referee.pages.record_figures import record_figures
from consistency.referee.pages.verdicts import time_axis_of
from consistency.referee.pages.write_pages import compose_files
from consistency.referee.readers.formats.innovation_files import NisLog
from consistency.referee.show import as_html
from consistency.referee.show.blocks import (
    COLOURS,
    OVER,
    RIGHT,
    TRUTH,
    UNDER,
    Chapter,
    Details,
    Document,
    Figure,
    Status,
    Text,
)
from consistency.referee.show.figures import canvas, drawn
from consistency.referee.verdicts.monitor_sources import make_monitor, watch


def bounded(scale=1.0, runs=400, steps=20):
    """A verdict and its record on two bounds of 90 %, the first of which is divided by ``scale``."""
    rng = np.random.default_rng(8)
    errors = rng.uniform(-1.0, 1.0, (runs, steps, 2))
    bounds = np.full(errors.shape, 0.9) / np.array([scale, 1.0])
    verdict = cs.judge(errors, bounds=bounds, level=0.9)
    return verdict.record, verdict


# --- badges -------------------------------------------------------------------------------------------------------


def test_the_badge_stands_above_the_sentence():
    page = as_html.render(Document("T", "x is <wrong>.", (), badges=(Status("overconfident", " x"),)))
    found = re.search(r'<div class="answer"><p class="badges">(.*?)</p><p>(.*?)</p></div>', page)
    assert found[1] == '<span><span class="verdict overconfident">overconfident</span> x</span>'
    assert found[2] == "x is &lt;wrong&gt;."


# --- columns ------------------------------------------------------------------------------------------------------


def test_figures_that_follow_each_other_stand_in_columns():
    def draw():
        return canvas(1.0)[0]

    a, b, c = (Figure(name, "", (draw,)) for name in "abc")
    page = as_html.render(Document("T", "", (Chapter("x", "X", "X", (a, b, Text("t"), Details("more", (c,)))),)))
    first, second = re.findall(r'<div class="figures">(.*?)\n</div>', page, re.DOTALL)
    assert first.count("<figure>") == 2
    assert second.count("<figure>") == 1
    assert page.index("<summary>more") < page.index(second)


def test_the_contents_wrap():
    style = as_html.STYLE
    assert "flex-wrap: wrap" in re.search(r"nav ul \{.*?\}", style)[0]
    assert "nowrap" not in re.search(r"nav ul \{.*?\}", style)[0]


@pytest.mark.parametrize("panels, columns, labelled", [(3, 1, {2}), (6, 2, {2, 5}), (5, 2, {2, 4}), (2, 1, {1})])
def test_stacked_panels_follow_each_other_downwards(panels, columns, labelled):
    _, axes = drawn(partial(canvas, 2.0, columns, panels, stacked=True, sharex=True))
    rows = -(-panels // columns)
    for number, panel in enumerate(axes):
        place = panel.get_subplotspec()
        assert (place.colspan.start, place.rowspan.start) == divmod(number, rows)
        assert panel.xaxis.get_tick_params()["labelbottom"] == (number in labelled)


# --- colours ------------------------------------------------------------------------------------------------------


def test_no_filter_has_the_colour_of_a_verdict_or_of_the_truth():
    assert len(set(COLOURS)) == len(COLOURS)
    assert not {colour.upper() for colour in COLOURS} & {OVER, RIGHT, UNDER, TRUTH}


def test_components_do_not_have_the_colour_of_the_estimate():
    rng = np.random.default_rng(2)
    errors = rng.standard_normal((30, 20, 2))
    record = make_record("est", errors, np.broadcast_to(np.eye(2), (30, 20, 2, 2)), axes=("x", "y"))
    figures = {figure.title: figure for figure in record_figures(record, cs.judge(record))}
    (axes,) = drawn(figures["Coverage"].drawings[0]).axes
    lines = {line.get_label(): to_hex(line.get_color()).upper() for line in axes.lines}
    assert (lines["x"], lines["y"]) == (COLOURS[1], COLOURS[2])


# --- what was asked -----------------------------------------------------------------------------------------------


def test_groups_come_first():
    rng = np.random.default_rng(3)
    errors = rng.standard_normal((40, 10, 2))
    verdict = cs.judge(errors, np.broadcast_to(np.eye(2), (40, 10, 2, 2)), by={"speed": rng.random((40, 10))})
    made = compose_files([verdict.record], {verdict.filter: verdict}, "T", {})
    assert made.chapters[0].blocks[0].title == "By speed"


def test_bounds_are_drawn_first_with_their_shares_and_factors():
    record, verdict = bounded(2.0)
    made = compose_files([record], {verdict.filter: verdict}, "T", {})
    assert [block.title for block in made.chapters[0].blocks[:2]] == [
        "Coverage of the bounds",
        "Errors over their bounds",
    ]
    (figure,) = bound_figures(verdict)
    shares, factors = drawn(figure.drawings[0]).axes
    named = {line.get_label(): line for line in (*shares.lines, *factors.lines)}
    assert_allclose(named["stated by the level"].get_xdata(), [10.0, 10.0])
    wrong, right = verdict.bounds
    assert [wrong.status, right.status] == ["overconfident", "consistent"]
    assert_allclose(named["overconfident"].get_xydata(), [[wrong.factor.value, 0.0]])
    assert_allclose(named["consistent"].get_xydata(), [[right.factor.value, 1.0]])
    assert to_hex(named["overconfident"].get_color()).upper() == OVER
    drawn_rates = [line.get_xdata()[0] for line in shares.lines if line.get_marker() == "X"]
    assert_allclose(drawn_rates, [100.0 * wrong.rate])
    assert 100.0 * wrong.rate > 40.0  # half of the errors are outside


def test_without_bounds_there_is_no_figure_of_them():
    errors = np.random.default_rng(0).standard_normal((20, 5, 1))
    assert bound_figures(cs.judge(errors, np.ones((20, 5, 1, 1)))) == ()


def test_bounds_of_a_gaussian_are_drawn_as_covariances():
    errors = np.random.default_rng(8).standard_normal((30, 5, 2))
    verdict = cs.judge(errors, bounds=np.full(errors.shape, 1.96), level=0.95, gaussian=True)
    figures = {figure.title: figure for figure in record_figures(verdict.record, verdict)}
    assert "Errors over their bounds" not in figures
    assert drawn(figures["Errors and stated bounds"].drawings[0]).axes


def test_errors_over_bounds_are_those_of_the_record():
    record, verdict = bounded()
    figure = next(f for f in record_figures(record, verdict) if f.title == "Errors over their bounds")
    for number, axes in enumerate(drawn(figure.drawings[0]).axes):
        shown = next(line for line in axes.lines if line.get_label() == "run 0")
        assert_allclose(shown.get_ydata(), record.errors.bounded.ratios[0, :, number])
        (span,) = (patch for patch in axes.patches if patch.get_label() == "inside the bound")
        assert (span.get_y(), span.get_y() + span.get_height()) == (-1.0, 1.0)


# --- time ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("first, shown", [(0.2, 0.2), (0.0, 0.0), (35.0, 0.0), (1.7e9, 0.0), (-5.0, 0.0)])
def test_time_counts_from_the_start_of_the_log(first, shown):
    clock = time_axis_of(first + 0.1 * np.arange(100))
    assert_allclose([clock.values[0], np.ptp(clock.values)], [shown, 9.9], atol=1e-6)
    assert ("Time 0 is" in clock.note) == (first != shown)


def test_a_monitor_draws_time_from_the_start_and_what_is_near_its_alarm():
    nis = np.random.default_rng(4).chisquare(2, 400)
    nis[200:] *= 8.0
    watched = watch(
        NisLog("f", np.arange(400.0), 1.7e9 + 0.1 * np.arange(400), nis, np.full(400, 2)), make_monitor("optimal")
    )
    figure = drawn(partial(monitor_drawing, watched))
    above, below = figure.axes
    assert above.get_legend() is below.get_legend() is None
    assert len(figure.legends) == 1
    curve = next(line for line in below.lines if line.get_label() == "e-value")
    alarm = next(line for line in below.lines if line.get_label() == "alarm")
    assert_allclose([curve.get_xdata()[0], curve.get_xdata()[-1]], [0.0, 39.9], atol=1e-6)
    assert 20.0 < alarm.get_xdata()[0] < 25.0
    low, high = below.get_ylim()
    assert low > 1e-4
    assert high <= watched.monitor.threshold**2


def test_test_ratios_share_one_start():
    t = 1.7e9 + np.arange(5.0)
    each = [GateRatios("a", t, np.ones(5), 3.0, 1), GateRatios("b", t + 3.0, np.ones(5), 3.0, 1)]
    figure = drawn(partial(monitor_drawing, each))
    places = [axes.dataLim.x0 for axes in figure.axes]
    assert_allclose(places, [0.0, 3.0], atol=1e-3)
