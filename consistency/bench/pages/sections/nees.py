"""NEES of the pose: its average over steps, as Herath et al. (2007) fig. 11, and its distribution in one step."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from consistency.bench.pages.sections.report_input import Study, Track
from consistency.referee.diagnostics.number_words import names_in_a_row, plural, short
from consistency.referee.diagnostics.scale import run_means
from consistency.referee.diagnostics.sentences import SPREAD
from consistency.referee.diagnostics.verdict import Verdict
from consistency.referee.diagnostics.verdict_parts import STEP, Scale
from consistency.referee.diagnostics.whitening import mean_and_count
from consistency.referee.pages.verdicts import Estimator, Judged, wide
from consistency.referee.show.blocks import EXPECTED, LIMIT, Figure, solid
from consistency.referee.show.figures import WIDTH, add_legend, band, canvas, curve, edges, log_axis, stroke
from consistency.referee.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

DIMENSION = "3"  # of a pose: what is expected where no filter has a band
PANELS = 4  # small ones beside each other
WINDOW, TICKS = (-0.02, 1.02), (0.0, 0.5, 1.0)  # of a distribution function
OF_DISTRIBUTION = (
    "Chi-square probability of the NEES in one step of each run, with nothing fitted. "
    "On the diagonal the covariance is right; a curve below it has too many large values (overconfident), above it "
    "too many small ones. Shaded: where the whole curve of a right filter lies with probability 95 %."
)


@dataclass(frozen=True)
class Curve:
    """One filter; T steps."""

    track: Track
    values: Array  # (T,)
    band: Array  # (T, 2), where the ANEES of a consistent filter lies in one step
    simultaneous: Array | None  # (T, 2), where it lies in all steps at once
    own_band: bool  # failed runs, or an earlier decision, have made the bands differ from those of the study
    others: Array | None  # (T,), without the runs that decide the average; None where there are none
    far: int  # number of these runs

    @property
    def expected(self) -> float:
        """Mean NEES of a right filter."""
        scale = self.track.verdict.scale
        return float("nan") if scale is None else float(scale.dof)


@dataclass(frozen=True)
class Anees:
    """All filters whose errors are known."""

    study: Study
    curves: tuple[Curve, ...]

    @property
    def log(self) -> bool:
        return wide([v for c in self.curves for v in (c.values, c.simultaneous) if v is not None])

    @property
    def common(self) -> Curve | None:
        return next((curve for curve in self.curves if not curve.own_band), None)


def anees_of(study: Study) -> Anees | None:
    """Curves and bands of the verdicts; None where the truth is not known."""
    if not study.has_truth:
        return None
    shared, curves = common({track.name: track.verdict for track in study.tracks}), []
    for track in study.tracks:
        scale, location = track.verdict.scale, track.verdict.location
        if scale is None:
            continue
        own_band = False
        if shared is not None and shared.scale is not None:
            is_same = np.array_equal(scale.band, shared.scale.band, equal_nan=True)
            own_band = not is_same and (bool(track.verdict.failures) or track.verdict.runs < shared.runs)
        simultaneous = None if location is None else location.simultaneous
        others, far = _without_far_runs(track, scale)
        curves.append(Curve(track, scale.anees, scale.band, simultaneous, own_band, others, far))
    return Anees(study, tuple(curves))


def _without_far_runs(track: Track, scale: Scale) -> tuple[Array | None, int]:
    """ANEES (T,) without the runs that are far from the median run, and how many those are."""
    if not scale.worst_run > SPREAD * scale.median_run:
        return None, 0
    nees = track.record().first_runs(track.verdict.runs).errors.nees
    assert nees is not None
    means, _ = run_means(nees)
    far = means > SPREAD * scale.median_run
    return mean_and_count(nees[~far], 0)[0], int(far.sum())


def common(verdicts: dict[str, Verdict]) -> Verdict | None:
    """The verdict of most runs whose band is drawn for all filters: those of the others are wider."""
    judged = [(v, v.scale) for v in verdicts.values() if v.scale is not None and v.scale.judged_steps]
    best = min(judged, key=lambda p: (-p[0].runs, len(p[0].failures), -int(p[1].alive.sum())), default=None)
    return None if best is None else best[0]


def anees_curves(study: Study) -> tuple[Figure, ...]:
    """The curve of each filter with the band of the study; nothing where the truth is not known."""
    anees = anees_of(study)
    if anees is None:
        return ()
    name = f"{study.statistic} of the pose"

    def draw() -> Drawing:
        figure, (axes,) = canvas(2.2)
        _draw_bands(axes, anees)
        for curve_of in anees.curves:
            track = curve_of.track
            curve(axes, study.clock.values, curve_of.values, track.look, track.name, track.tag)
            if curve_of.others is not None:
                label = f"{track.name} without {plural(curve_of.far, 'run')}"
                curve(axes, study.clock.values, curve_of.others, replace(track.look, width=0.7), label, track.tag)
        axes.set_ylabel(name)
        study.clock.span(axes)
        if anees.log:
            log_axis(axes, "y")
        return add_legend(figure)

    return (Figure(name, anees_caption(anees), (draw,)),)


def _draw_bands(axes: Axes, anees: Anees) -> None:
    """The bands of the study shaded and dashed, those that differ as thin lines in the filter's colour."""
    steps, shared = anees.study.clock.values, anees.common
    if shared is not None:
        band(axes, steps, shared.band, "95 % band of one step")
        if shared.simultaneous is not None:
            edges(axes, steps, shared.simultaneous, LIMIT, "band of all steps at once")
        axes.axhline(shared.expected, **stroke(EXPECTED), label="expected")
    for own in (of for of in anees.curves if of.own_band):
        look = own.track.look
        if own.simultaneous is not None:
            edges(axes, steps, own.simultaneous, replace(look, dash=LIMIT.dash, width=0.9), tag=own.track.tag)
        edges(axes, steps, own.band, replace(look, dash=(1.0, 2.0), width=0.7), tag=own.track.tag)


def anees_caption(anees: Anees) -> str:
    """What the figure shows."""
    study, shared = anees.study, anees.common
    runs = shared.track.verdict.runs if shared else study.runs
    what = f"NEES of the single run {study.shown_run}" if study.single else f"Average NEES over {runs} runs"
    expected = f"{shared.expected:g}" if shared else DIMENSION
    own = [curve.track.name for curve in anees.curves if curve.own_band]
    extra = (
        f" Fewer runs carry the curve of {names_in_a_row(own)}; its wider bands are thin lines in its colour."
        if own
        else ""
    )
    own_errors = names_in_a_row(study.own_errors)
    error = f" In the filter's own error: {own_errors}." if own_errors else ""
    return (
        f"{what}; {expected} is expected (line). Shaded: 95 % of single steps of a right filter (eq. 17); for "
        f"orientation only.{_simultaneous(anees)} Above is overconfident, below conservative.{extra}{error}"
        f"{''.join(map(_told, anees.curves))}"
    )


def _told(curve_of: Curve) -> str:
    """Which runs decide the average of a filter."""
    scale = curve_of.track.verdict.scale
    if not curve_of.far or scale is None:
        return ""
    return (
        f" {plural(curve_of.far, 'run')} of {curve_of.track.verdict.runs} decide"
        f"{'s' if curve_of.far == 1 else ''} the average of {curve_of.track.name}, {short(scale.mean_anees)} over all "
        f"steps: {short(scale.worst_run)} in the worst run and {short(scale.median_run)} in the median run. Thin: "
        f"without {'it' if curve_of.far == 1 else 'them'}."
    )


def _simultaneous(anees: Anees) -> str:
    """What the dashed band is, where a filter was asked about single steps."""
    if anees.common is None:
        return ""
    track = anees.common.track
    shares = [a.share for a in track.verdict.answers if a.question == STEP]
    if not shares:
        return ""
    others = f", drawn for {track.name}: dependence between steps moves it a little"
    return (
        " Dashed: the band of all steps at once, which a consistent filter leaves anywhere in the run with "
        f"probability at most {100 * shares[0] * track.verdict.settings.false_alarm:.2g} %, its share of the verdict's "
        f"false-alarm rate{others if len(anees.study.tracks) > 1 else ''}."
    )


@dataclass(frozen=True)
class Steps:
    """Empirical distribution function of chi-square's distribution function at N values of the NEES."""

    track: Estimator
    x: Array  # (N + 2,), with 0 and 1
    y: Array  # (N + 2,)
    half_width: float  # of the simultaneous band


def steps(track: Estimator) -> Steps | None:
    """Distribution of one filter; None without NEES."""
    tails = track.verdict.tails
    if tails is None or not len(tails.pit) or not np.isfinite(tails.half_width):
        return None
    height = np.arange(1, len(tails.pit) + 1) / len(tails.pit)
    x, y = (np.concatenate([[0.0], column, [1.0]]) for column in (tails.pit, height))
    return Steps(track, x, y, tails.half_width)


def nees_distribution(study: Judged) -> tuple[Figure, ...]:
    """A small panel for each filter that has a NEES."""
    filters = [of for track in study.tracks if (of := steps(track)) is not None]
    if not filters:
        return ()

    def draw() -> Drawing:
        rows, columns = -(-len(filters) // PANELS), min(len(filters), PANELS)
        # panels that are nearly square
        figure, panels = canvas(1.45 * rows, columns, len(filters), width=WIDTH * columns / PANELS + 0.2, sharey=True)
        for axes, of in zip(panels, filters, strict=True):
            corners = np.unique([0.0, of.half_width, 1.0 - of.half_width, 1.0])
            ends = np.clip(corners[:, None] + [-of.half_width, of.half_width], 0.0, 1.0)
            band(axes, corners, ends, "95 % band of the whole curve")
            axes.plot([0.0, 1.0], [0.0, 1.0], **stroke(EXPECTED), label="expected")
            look = replace(solid(of.track.look), width=1.3)
            curve(axes, of.x, of.y, look, "", of.track.tag, drawstyle="steps-post")
            axes.set(xlabel="chi-square cdf", title=of.track.name)
            axes.set(xlim=WINDOW, ylim=WINDOW, xticks=TICKS, yticks=TICKS)
        for axes in panels[::PANELS]:
            axes.set_ylabel("share of runs")
        return add_legend(figure)

    return (Figure("Distribution of the NEES", OF_DISTRIBUTION, (draw,), level=4),)
