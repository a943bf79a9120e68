"""Figures of one estimator: errors with their bounds, NEES, trajectory, coverage, innovations.

Where runs have one step, as those of a factor or a calibration, the runs
stand along the axis, each a point.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from consistency.referee.diagnostics import distributions
from consistency.referee.diagnostics.bias_and_shape import observed_coverage
from consistency.referee.diagnostics.normal_numbers import rank_shares
from consistency.referee.diagnostics.number_words import plural
from consistency.referee.diagnostics.record import Record
from consistency.referee.diagnostics.uncertain_truth import of_both
from consistency.referee.diagnostics.verdict import Verdict
from consistency.referee.errors import InputError
from consistency.referee.geometry import CHARTS
from consistency.referee.pages.verdicts import Clock, time_axis_of, wide
from consistency.referee.show.blocks import (
    BAND,
    EXPECTED,
    LIMIT,
    SIGMAS,
    TRUTH,
    ZERO,
    Figure,
    Look,
    style,
)
from consistency.referee.show.figures import (
    WIDTH,
    add_legend,
    band,
    canvas,
    curve,
    dots,
    edges,
    log_axis,
    make_map,
    path,
    points,
    rows_of,
    stroke,
    with_small_ones,
)
from consistency.referee.types import Array, Indices

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

STACK = 3  # panels one below the other
MOST_PANELS = 12  # components of an error that are drawn
SPREADS = 10  # groups of steps by the spread of the members
MOST_RUNS = 20  # runs that are drawn beside the shown one
ANGLES = {"heading", "yaw", "pitch", "roll"}
METRES = {"x", "y", "z"}
DERIVED = {"v": "m/s", "bg": "rad/s", "ba": "m/s^2"}  # velocities and biases, by what comes before x, y, z
OF_BOTH = "Covariances are those of estimate and truth together."
SHOWN, OTHERS = replace(style(0), width=1.0), Look("#c0c0c0", width=0.5)
BOUND = replace(SHOWN, dash=(4.0, 3.0), width=0.8)
INSIDE = "#e3eef6"  # ground within 2 sigma
LEAST_REACH = 3.0  # sigma, from 0 to the ends of an axis
JOINT = Look("#333333", width=1.4)
EACH_RUN = replace(style(0), size=2.0, alpha=0.7)
WORST = Look("#333333", size=3.5, width=1.0)
OVER_SIGMA = "Errors over their stated sigma"  # the title of what is drawn on demand
Paint = Callable[["Axes"], None]
IN_WORLD = ("so2", "so3", "so3-body", "vector", *CHARTS)  # errors whose position is about the axes of the world
NAMES = "xyz"
MOST = 4  # ellipses
SHARE = 0.95  # of a right estimator's errors in a step that lie inside its ellipse
CORNERS = 73
TRUE, ESTIMATED = Look(TRUTH, width=0.9), replace(style(0), width=1.0)
ELLIPSE, AT = replace(style(0), width=1.2), Look(TRUTH, marker="X", size=4.0)


@dataclass(frozen=True)
class Picture:
    """Panels with one caption; each draws itself on its axes."""

    title: str
    caption: str
    panels: tuple[Paint, ...]
    height: float = 1.3  # inches, of a row of panels
    is_shared: bool = True  # panels have one axis of time or runs
    stacked: bool = False  # panels stand one below the other, so that a moment is found in all of them
    beside: tuple[Paint, ...] = ()  # small panels at the right of the only one

    def figure(self) -> Figure:
        return Figure(self.title, self.caption, (self.draw,))

    def draw(self) -> Drawing:
        if self.beside:
            figure, panels = with_small_ones(self.height, len(self.beside))
            for axes, paint in zip(panels, (*self.panels, *self.beside), strict=True):
                paint(axes)
            return add_legend(figure)
        many, columns = len(self.panels), rows_of(len(self.panels))
        if self.stacked:
            columns = -(-many // STACK)
        rows = -(-many // columns)
        shared = self.is_shared and many > 1
        figure, panels = canvas(self.height * rows + 0.2 * self.stacked, columns, many, self.stacked, sharex=shared)
        for number, (axes, paint) in enumerate(zip(panels, self.panels, strict=True)):
            paint(axes)
            if shared and (number + 1 < many and (number + 1) % rows if self.stacked else number + columns < many):
                axes.set_xlabel("")
        return add_legend(figure)


def record_figures(record: Record, verdict: Verdict) -> tuple[Figure, ...]:
    """NEES, errors, the worst run, trajectory, coverage, innovations, errors over sigma; those that the record has."""
    both = of_both(record)
    pictures = (
        _bounded(record), _nees(both, verdict), _errors(both), _worst_run(both), _trajectory(both), _coverage(both),
        _ranks(record), _spread_and_skill(record), _innovations(both, verdict), _errors_over_sigma(both),
    )  # fmt: skip
    note = f" {OF_BOTH}" if record.truth.covariance is not None else ""
    return tuple(
        replace(picture, caption=picture.caption + note).figure() for picture in pictures if picture is not None
    )


def overview(record: Record, verdict: Verdict | None = None) -> Callable[[], Drawing]:
    """Draws errors with their bounds, trajectory, coverage, and with a ``verdict`` the NEES with its band.

    Raises
    ------
    InputError
        The record has neither errors nor NEES.
    """
    both = of_both(record)
    nees = None if verdict is None else _nees(both, verdict)
    shown = (_bounded(record), _errors(both), nees, _trajectory(both), _coverage(both))
    pictures = [picture for picture in shown if picture is not None]
    if not pictures:
        raise InputError(f"{record.name}: has neither errors nor NEES to draw; give --truth, or truth= in Python")
    paints = [paint for picture in pictures for paint in picture.panels]

    def draw() -> Drawing:
        columns = rows_of(len(paints))
        figure, panels = canvas(0.3 + 1.5 * -(-len(paints) // columns), columns, len(paints), width=1.3 * WIDTH)
        for axes, paint in zip(panels, paints, strict=True):
            paint(axes)
        panels[0].set_title(record.name)
        return add_legend(figure)

    return draw


def has_one_step(record: Record) -> bool:
    """Whether a curve along the steps would be a point, and one along the runs is not."""
    return len(record.runs.t) == 1 and len(record.run_numbers) > 1


def _span_runs(axes: Axes, record: Record) -> None:
    """Draw the axis from the first run to the last."""
    axes.set(xlabel=record.runs.unit, xlim=(record.run_numbers.min() - 0.5, record.run_numbers.max() + 0.5))


def _log_if_wide(axes: Axes, *values: Array) -> None:
    """A log axis of values that span more than a decade."""
    if wide(list(values)):
        log_axis(axes, "y")


# --- errors -----------------------------------------------------------------------------------------


def unit_of(axis: str) -> tuple[str, float]:
    """Unit that a component is shown in, and the factor to it; none where it is not known."""
    if axis in ANGLES:
        return "deg", 180.0 / np.pi
    if axis in METRES:
        return "m", 1.0
    if axis[-1:] in METRES:
        return DERIVED.get(axis[:-1], ""), 1.0
    return "", 1.0


@dataclass(frozen=True)
class Errors:
    """Errors of one component of R runs of T steps in the unit that it is shown in, and their 2-sigma bounds."""

    label: str  # of the component with its unit
    error: Array  # (R, T)
    bound: Array  # (R, T)


def errors_of(record: Record) -> list[Errors]:
    """Of each component that is drawn."""
    assert record.errors.error is not None
    assert record.errors.covariance is not None
    found = []
    for i, name in enumerate(record.errors.names[:MOST_PANELS]):
        unit, factor = unit_of(record.errors.axes[i])
        bound = SIGMAS * factor * np.sqrt(np.maximum(record.errors.covariance[:, :, i, i], 0.0))
        found.append(Errors(f"{name} ({unit})" if unit else name, factor * record.errors.error[..., i], bound))
    return found


def _errors(record: Record) -> Picture | None:
    """Error of each component with its 2-sigma bounds, as fig. 2b of Herath et al. (2007)."""
    if record.errors.error is None or record.errors.covariance is None:
        return None
    components = errors_of(record)
    left_out = len(record.errors.axes) - len(components)
    more = f" {plural(left_out, 'further component')} not drawn." if left_out else ""
    if has_one_step(record):
        caption = (
            "Error (truth minus estimate) of each run with the 2-sigma bounds that the estimator states (shaded). "
            f"About 95 % of honest errors are inside.{more}"
        )
        return Picture("Errors and stated bounds", caption, tuple(_errors_of_runs(record, c) for c in components))
    clock, row = time_axis_of(record.runs.t), shown_run(record)
    meaning = (
        "truth minus estimate"
        if record.origin.window is None
        else f"of the motion over each window of {record.origin.window}"
    )
    caption = (
        f"Error ({meaning}) of run {record.run_numbers[row]} with the 2-sigma bounds that the estimator "
        f"states (dashed). Honest errors stay inside about 95 % of the time.{more}{clock.note}"
    )
    curves = tuple(_error_curves(record, clock, row, c) for c in components)
    return Picture("Errors and stated bounds", caption, curves, height=0.85, stacked=True)


def _errors_of_runs(record: Record, of: Errors) -> Paint:
    def paint(axes: Axes) -> None:
        runs, bound = record.run_numbers.astype(float), of.bound[:, 0]
        band(axes, runs, np.column_stack([-bound, bound]), "2-sigma bounds")
        axes.axhline(0.0, **stroke(ZERO))
        points(axes, runs, of.error[:, 0], EACH_RUN, "error of a run")
        axes.set_ylabel(of.label)
        _span_runs(axes, record)

    return paint


def _draw_others(axes: Axes, clock: Clock, values: Array, row: int) -> None:
    """Some of the runs (R, T) but the one in this row."""
    others = np.linspace(0, len(values) - 1, MOST_RUNS + 1).astype(int)
    label = "other runs"
    for other in dict.fromkeys(others[others != row]):
        curve(axes, clock.values, values[other], OTHERS, label)
        label = ""


def _error_curves(record: Record, clock: Clock, row: int, of: Errors) -> Paint:
    def paint(axes: Axes) -> None:
        _draw_others(axes, clock, of.error, row)
        axes.axhline(0.0, **stroke(ZERO))
        draw_bounded(axes, clock.values, of.error[row], of.bound[row], f"run {record.run_numbers[row]}")
        settled = slice(len(record.runs.t) // 10, None)  # at the start errors and bounds may be larger by far
        reach = 1.1 * max(_most(of.error[:, settled]), _most(of.bound[row, settled]))
        axes.set(ylabel=of.label, ylim=(-reach, reach) if reach > 0.0 else None)
        clock.name(axes)

    return paint


def _errors_over_sigma(record: Record) -> Picture | None:
    """Error of each component over the standard deviation that is stated for it."""
    if record.errors.error is None or record.errors.covariance is None or has_one_step(record):
        return None
    clock, row = time_axis_of(record.runs.t), shown_run(record)
    caption = (
        f"Error over its stated standard deviation, of run {record.run_numbers[row]} and others. Shaded: 2 sigma, "
        f"inside which honest errors stay about 95 % of the time.{clock.note}"
    )
    paints = tuple(_scaled_curves(record, clock, row, i) for i in range(min(len(record.errors.axes), MOST_PANELS)))
    return Picture(OVER_SIGMA, caption, paints, height=0.85, stacked=True)


def _scaled_curves(record: Record, clock: Clock, row: int, axis: int) -> Paint:
    assert record.errors.error is not None
    assert record.errors.covariance is not None
    sigma = np.sqrt(np.maximum(record.errors.covariance[:, :, axis, axis], 0.0))
    with np.errstate(invalid="ignore", divide="ignore"):
        scaled = record.errors.error[..., axis] / sigma

    def paint(axes: Axes) -> None:
        axes.axhspan(-SIGMAS, SIGMAS, color=INSIDE, linewidth=0, zorder=0.4, label="2 sigma")
        _draw_others(axes, clock, scaled, row)
        axes.axhline(0.0, **stroke(ZERO))
        curve(axes, clock.values, scaled[row], SHOWN, f"run {record.run_numbers[row]}")
        reach = max(LEAST_REACH, 1.1 * _most(scaled))
        axes.set(ylabel=f"{record.errors.names[axis]} / sigma", ylim=(-reach, reach))
        clock.name(axes)

    return paint


def _most(values: Array) -> float:
    """The largest absolute value but for one in 200."""
    known = np.abs(values[np.isfinite(values)])
    return float(np.quantile(known, 0.995)) if len(known) else 0.0


def draw_bounded(axes: Axes, x: Array, error: Array, bound: Array, label: str) -> None:
    """An error (T,) with dashed lines at plus and minus its bound, which is shaded."""
    ends = np.column_stack([-bound, bound])
    band(axes, x, ends, colour=INSIDE)
    edges(axes, x, ends, BOUND, "2-sigma bounds")
    curve(axes, x, error, SHOWN, label)


def _bounded(record: Record) -> Picture | None:
    """Errors over the bounds that are stated for them."""
    bounded = record.errors.bounded
    if bounded is None:
        return None
    ratios, bounds = bounded.ratios, bounded.bounds
    clock, row = time_axis_of(record.runs.t), shown_run(record)

    def panel(number: int) -> Paint:
        def paint(axes: Axes) -> None:
            of = ratios[..., number]
            reach = max(1.5, 1.1 * _most(of))
            axes.set(ylabel=bounds[number].name, ylim=(-reach if (of < 0.0).any() else 0.0, reach))
            axes.axhspan(-1.0, 1.0, color=INSIDE, linewidth=0, zorder=0.4, label="inside the bound")
            if has_one_step(record):
                points(axes, record.run_numbers.astype(float), of[:, 0], EACH_RUN, f"error of a {record.runs.unit}")
                _span_runs(axes, record)
                return
            _draw_others(axes, clock, of, row)
            curve(axes, clock.values, of[row], SHOWN, f"run {record.run_numbers[row]}")
            clock.name(axes)

        return paint

    caption = f"Error over its stated bound: outside the shade the bound does not hold.{clock.note}"
    panels = tuple(map(panel, range(min(ratios.shape[-1], MOST_PANELS))))
    return Picture("Errors over their bounds", caption, panels, height=0.95, stacked=True)


# --- trajectory -------------------------------------------------------------------------------------


def _trajectory(record: Record) -> Picture | None:
    found = None if has_one_step(record) else trajectory_panel(record)
    if found is None:
        return None
    caption, paint, close_ups = found
    return Picture("Trajectory", caption, (paint,), height=2.6, beside=close_ups)


# --- NEES -------------------------------------------------------------------------------------------


def _nees(record: Record, verdict: Verdict) -> Picture | None:
    """NEES of one run, or its average over runs, with the bands of a right estimator."""
    if record.errors.parts:  # of the whole no distribution is known
        return None
    if record.runs.independent or has_one_step(record):
        return _single_nees(record)
    scale, location = verdict.scale, verdict.location
    if scale is None or len(scale.anees) != len(record.runs.t):
        return None
    clock = time_axis_of(record.runs.t)
    name = "NEES" if verdict.runs == 1 else f"NEES, average of {verdict.runs} runs"
    simultaneous = None
    if location is not None and np.isfinite(location.simultaneous).any():
        simultaneous = location.simultaneous

    def paint(axes: Axes) -> None:
        band(axes, clock.values, scale.band, "95 % band of one step")
        drawn = [scale.anees, scale.band]
        if simultaneous is not None:
            edges(axes, clock.values, simultaneous, LIMIT, "band of all steps at once")
            drawn.append(simultaneous)
        axes.axhline(float(scale.dof), **stroke(EXPECTED), label="expected")
        curve(axes, clock.values, scale.anees, SHOWN, record.name)
        axes.set_ylabel("NEES")
        clock.name(axes)
        _log_if_wide(axes, *drawn)

    caption = (
        f"{name}; {scale.dof} is expected (line). Above is overconfident, below conservative. Shaded: 95 % of "
        f"single steps of a right filter; for orientation only.{clock.note}"
    )
    return Picture("NEES", caption, (paint,), height=1.9)


def _worst_run(record: Record) -> Picture | None:
    """Mean NEES of each run, and the NEES over time of the run with the largest."""
    nees = record.errors.nees
    if nees is None or record.errors.parts or record.runs.independent or has_one_step(record):
        return None
    there = np.isfinite(nees)
    if len(nees) < 2 or not there.any():
        return None
    counts = np.maximum(there.sum(axis=1), 1)
    means = np.where(there.any(axis=1), np.where(there, nees, 0.0).sum(axis=1) / counts, np.nan)
    worst, clock = int(np.nanargmax(means)), time_axis_of(record.runs.t)
    number = record.run_numbers[worst]

    def paint_runs(axes: Axes) -> None:
        axes.axhline(float(record.errors.dof), **stroke(EXPECTED), label="expected")
        points(axes, record.run_numbers.astype(float), means, EACH_RUN, "mean of a run")
        points(axes, np.array([float(number)]), means[[worst]], WORST, f"run {number}")
        axes.set_ylabel("mean NEES")
        _span_runs(axes, record)
        _log_if_wide(axes, means)

    def paint_worst(axes: Axes) -> None:
        _draw_band(axes, record.errors.dof)
        axes.axhline(float(record.errors.dof), **stroke(EXPECTED))
        curve(axes, clock.values, nees[worst], WORST, "")
        axes.set_ylabel(f"NEES of run {number}")
        clock.name(axes)
        _log_if_wide(axes, nees[worst])

    caption = (
        f"Mean NEES of each run, and the NEES of run {number}, which has the largest; {record.errors.dof} is expected "
        f"in the mean (lines). Shaded: where 95 % of the steps of a right estimator lie.{clock.note}"
    )
    return Picture("Which run, and when", caption, (paint_runs, paint_worst), height=1.6, is_shared=False)


def _draw_band(axes: Axes, dof: int, label: str = "") -> None:
    """Where 95 % of the NEES of a right estimator lie."""
    ends = distributions.chi2.ppf(np.array([0.025, 0.975]), dof)
    axes.axhspan(*ends, color=BAND, linewidth=0, zorder=0.5, label=label)


def _single_nees(record: Record) -> Picture | None:
    """NEES of each run of one step, or of each window, independent of the others."""
    nees = record.errors.nees
    if nees is None or not np.isfinite(nees).any():
        return None
    what, each, note = f"each {record.runs.unit}", f"one {record.runs.unit}", ""
    if record.runs.independent:
        note = time_axis_of(record.runs.t).note
        what, each = f"the motion over each window of {record.origin.window or 'a step'}", "one window"

    def paint(axes: Axes) -> None:
        x, rows = record.run_numbers.astype(float), nees[:, :1].T
        if record.runs.independent:
            x, rows = time_axis_of(record.runs.t).values, nees
        _draw_band(axes, record.errors.dof, f"95 % band of {each}")
        axes.axhline(float(record.errors.dof), **stroke(EXPECTED), label="expected")
        label = f"NEES of {each.replace('one', 'a')}"
        for values in rows:
            points(axes, x, values, EACH_RUN, label)
            label = ""
        axes.set_ylabel("NEES")
        if record.runs.independent:
            time_axis_of(record.runs.t).name(axes)
        else:
            _span_runs(axes, record)
        _log_if_wide(axes, nees)

    plural_of = "windows" if record.runs.independent else f"{record.runs.unit}s"
    caption = (
        f"NEES of {what}; {record.errors.dof} is expected in the mean (line). Above is overconfident, below "
        f"conservative. Shaded: 95 % of the {plural_of} of a right filter; for orientation only.{note}"
    )
    return Picture("NEES", caption, (paint,), height=1.9)


# --- coverage ---------------------------------------------------------------------------------------


def _ranks(record: Record) -> Picture | None:
    """Histogram of the rank of the truth among the members."""
    shares, width = rank_shares(record)
    if not shares:
        return None

    def paint(axes: Axes) -> None:
        ranks = len(next(iter(shares.values())))
        axes.axhspan(1.0 / ranks - width, 1.0 / ranks + width, color=BAND, linewidth=0, zorder=0.5)
        axes.axhline(1.0 / ranks, **stroke(EXPECTED), label="expected")
        for number, (name, share) in enumerate(shares.items()):
            axes.stairs(share, np.arange(ranks + 1) / ranks, **stroke(of_component(number)), label=name)
        axes.set(
            xlabel="rank of the truth among the members", ylabel="share of steps", xlim=(0.0, 1.0), ylim=(0.0, None)
        )

    caption = (
        "Share of the truths in each rank among the members: flat if both are exchangeable, high at both ends if "
        "members spread too little, high in the middle if too much, a slope where they are biased. Shaded: where all "
        "ranks of a component lie with 95 % if members are right, by the spread between runs."
    )
    return Picture("Ranks among the members", caption, (paint,), height=1.9)


def _spread_and_skill(record: Record) -> Picture | None:
    """Size of the errors about the mean of the members against the spread of these."""
    if record.errors.ensemble is None:
        return None
    m, _, spread, square = record.errors.ensemble
    expected = spread * (1.0 + 1.0 / m)  # of the squared error about the mean of m members

    def paint(axes: Axes) -> None:
        axes.plot([0.0, 1.0], [0.0, 1.0], transform=axes.transAxes, **stroke(EXPECTED), label="expected")
        most = 1.0
        for number, name in zip(
            range(expected.shape[1]), record.errors.names or map(str, range(expected.shape[1])), strict=False
        ):
            rows = np.flatnonzero(np.isfinite(expected[:, number]) & np.isfinite(square[:, number]))
            rows = rows[np.argsort(expected[rows, number])]
            groups = [group for group in np.array_split(rows, SPREADS) if len(group)]
            x, y = (np.sqrt([values[group, number].mean() for group in groups]) for values in (expected, square))
            unit = float(np.sqrt(np.mean(np.square(x)))) or 1.0
            curve(axes, x / unit, y / unit, replace(of_component(number), marker="o"), name)
            most = max(most, *(1.05 * np.concatenate([x, y]) / unit))
        axes.set(xlabel="spread that is stated", ylabel="error of the mean", xlim=(0.0, most), ylim=(0.0, most))

    caption = (
        "Root mean square of the error of the mean of m members, in tenths of the steps by their spread, against that "
        "spread times the root of 1 + 1/m, both over the mean spread. On the diagonal members spread as they err; the "
        "spread of few members is partly chance, which makes the line flatter."
    )
    return Picture("Spread and skill", caption, (paint,), height=2.1)


def _coverage(record: Record) -> Picture | None:
    """Share of errors within an interval against the probability that it should hold them with."""
    p = np.linspace(0.0, 0.999, 200)
    found = observed_coverage(record, p)
    if not found:
        return None

    def paint(axes: Axes) -> None:
        axes.plot([0.0, 1.0], [0.0, 1.0], **stroke(EXPECTED), label="expected")
        for number, (name, shares) in enumerate(found.items()):
            look = JOINT if name == "all together" else of_component(number)
            curve(axes, p, shares, look, name)
        axes.set(xlabel="stated probability", ylabel="share of errors inside", xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))

    caption = (
        "Share of errors inside the interval that should hold them with the stated probability, over all "
        "steps of all runs. On the diagonal the covariance is right; below it is overconfident, above conservative."
    )
    return Picture("Coverage", caption, (paint,), height=2.1)


# --- innovations ------------------------------------------------------------------------------------


def _innovations(record: Record, verdict: Verdict) -> Picture | None:
    """NIS over its degrees of freedom, averaged over runs."""
    if record.innovations.nis is None or record.innovations.nis_dof is None:
        return None
    clock = time_axis_of(record.runs.t)
    known = np.isfinite(record.innovations.nis) & (record.innovations.nis_dof > 0)
    dof = np.where(known, record.innovations.nis_dof, 0.0).sum(axis=0)
    least = np.maximum(dof, 1.0)
    ratio = np.where(dof > 0, np.where(known, record.innovations.nis, 0.0).sum(axis=0) / least, np.nan)
    ends = np.column_stack([distributions.chi2.ppf(q, least) / least for q in (0.025, 0.975)])

    def paint(axes: Axes) -> None:
        band(axes, clock.values, np.where(dof[:, None] > 0, ends, np.nan), "95 % band of one step")
        axes.axhline(1.0, **stroke(EXPECTED), label="expected")
        points(axes, clock.values, ratio, EACH_RUN)
        axes.set_ylabel("NIS / dof")
        clock.name(axes)
        _log_if_wide(axes, ratio)

    judged = verdict.innovations is not None and verdict.innovations.judged
    caption = (
        "NIS over its degrees of freedom; 1 is expected (line). Shaded: 95 % of single steps of white innovations; "
        f"for orientation only.{'' if judged else ' Reported, not judged: no optimal gain is declared.'}{clock.note}"
    )
    return Picture("Innovations", caption, (paint,), height=1.6)


def of_component(number: int) -> Look:
    """How the component of this number looks; the first colour is that of the estimate."""
    return replace(style(number + 1), width=1.1)


def shown_run(record: Record) -> int:
    """Row of the run that is drawn: the first that reaches furthest."""
    values = record.errors.error
    if values is None:
        assert record.errors.bounded is not None
        values = record.errors.bounded.ratios
    return int(np.argmax(np.isfinite(values).all(axis=-1).sum(axis=1)))


def trajectory_panel(record: Record) -> tuple[str, Paint, tuple[Paint, ...]] | None:
    """Caption, what draws the shown run on axes, and each ellipse from near; None where positions are not known.

    It shows the two axes over which the path reaches furthest.
    """
    if record.origin.path is None or record.errors.error is None or record.origin.window is not None:
        return None
    row = shown_run(record)
    true, estimated = record.origin.path[row, :, 0], record.origin.path[row, :, 1]
    known = np.isfinite(record.origin.path[row]).all(axis=(1, 2))
    if known.sum() < 2 or sum(axis in record.errors.axes for axis in NAMES) < 2:
        return None
    pair = furthest(record, np.ptp(true[known], axis=0))
    steps = _worst(record, row) if record.errors.convention in IN_WORLD else np.empty(0, np.int64)
    outlines = ellipses_at(record, row, steps, pair)

    def paint(axes: Axes) -> None:
        path(axes, true[:, pair], TRUE, "truth")
        path(axes, estimated[:, pair], ESTIMATED, "estimate")
        label = "95 % ellipse"
        for outline in outlines:
            path(axes, outline, ELLIPSE, label)
            label = ""
        if len(steps):
            axes.plot(*true[steps][:, pair].T, label="truth there", **dots(AT))
        for number, step in enumerate(steps, 1):
            at = tuple(true[step, pair])
            axes.annotate(str(number), at, xytext=(4.0, 4.0), textcoords="offset points", weight="bold")
        x, y = (record.errors.own_names.get(NAMES[axis], NAMES[axis]) for axis in pair)
        axes.set(xlabel=f"{x} (m)", ylabel=f"{y} (m)")
        make_map(axes)

    def close_up(number: int) -> Paint:
        def paint(axes: Axes) -> None:
            step, outline = steps[number], outlines[number]
            axes.fill(*outline.T, color=INSIDE, linewidth=0, label="_nolegend_")
            path(axes, true[:, pair], TRUE)
            path(axes, estimated[:, pair], ESTIMATED)
            path(axes, outline, ELLIPSE)
            axes.plot(*true[step, pair], **dots(AT))
            near = np.vstack([outline, true[step, pair]])
            middle, reach = (near.min(axis=0) + near.max(axis=0)) / 2.0, 0.6 * float(np.ptp(near, axis=0).max())
            axes.set(xlim=(middle[0] - reach, middle[0] + reach), ylim=(middle[1] - reach, middle[1] + reach))
            axes.set(title=f"{number + 1}: step {step + 1}", xlabel=f"{2.0 * reach:.2g} m wide")
            axes.set(aspect="equal", xticks=[], yticks=[])

        return paint

    caption = f"Trajectory of {record.runs.unit} {record.run_numbers[row]}, true and estimated."
    if len(steps):
        where = ", ".join(str(step + 1) for step in sorted(steps))
        caption += (
            " Ellipses: where the truth lies with 95 % by the stated covariance, in the steps whose errors are "
            f"largest against it ({where}); crosses are the truth there. Right: each of them from near."
        )
    elif record.errors.convention not in IN_WORLD:
        caption += " No ellipses: the stated covariance is not about the axes of the world."
    return caption, paint, tuple(map(close_up, range(len(steps))))


def furthest(record: Record, reach: Array) -> list[int]:
    """Two of the position's axes that are judged, with the largest product of their reach (3,); else the first."""
    judged = [i for i, name in enumerate(NAMES) if name in record.errors.axes]
    return list(max(itertools.combinations(judged, 2), key=lambda two: float(np.prod(reach[list(two)]))))


def ellipses_at(record: Record, row: int, steps: Indices, pair: Sequence[int]) -> list[Array]:
    """Outlines (corners, 2) of the 95 % regions of one run in some steps, about the estimates."""
    if not len(steps):
        return []
    assert record.origin.path is not None
    assert record.errors.covariance is not None
    index = [list(record.errors.axes).index(NAMES[axis]) for axis in pair]
    P = np.asarray(record.errors.covariance[row], float)[steps][:, index][:, :, index]
    centres = record.origin.path[row, steps, 1][:, list(pair)]
    return [ellipse(centre, own) for centre, own in zip(centres, P, strict=True)]


def ellipse(centre: Array, P: Array) -> Array:
    """Outline (corners, 2) of the region that holds a share of 95 % about ``centre`` (2,) with covariance P (2, 2)."""
    angle = np.linspace(0.0, 2.0 * np.pi, CORNERS)
    circle = np.sqrt(float(distributions.chi2.ppf(SHARE, 2))) * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(centre + circle @ np.linalg.cholesky(P).T)


def _worst(record: Record, row: int) -> Indices:
    """Steps of the largest NEES, at most five, and apart from each other by a twentieth of the run."""
    if record.errors.nees is None:
        return np.empty(0, np.int64)
    nees = np.where(np.isfinite(record.errors.nees[row]), record.errors.nees[row], -1.0)
    apart, found = max(len(nees) // 20, 1), list[int]()
    for step in np.argsort(-nees, kind="stable"):
        if nees[step] < 0.0 or len(found) == MOST:
            break
        if all(abs(int(step) - other) >= apart for other in found):
            found.append(int(step))
    return np.array(found, np.int64)
