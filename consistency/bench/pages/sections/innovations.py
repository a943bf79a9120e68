"""Size and whiteness of the innovations."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from consistency.bench.pages.report_input import Study, Track
from consistency.referee.document.colours import EXPECTED, SHADE, Look
from consistency.referee.document.drawing import (
    Axis,
    Band,
    Figure,
    Key,
    Mark,
    Panel,
    Points,
    Rule,
    Sheet,
    Span,
    Stems,
    dodge,
)
from consistency.referee.document.wording import listed
from consistency.referee.pages.judged import wide
from consistency.referee.pages.section import STUDY, Section
from consistency.referee.types import Array

LEAST = 0.1  # correlation drawn on either side of zero, so that noise does not look large
ONE = Look("#333333", width=0.8)


class Lags(NamedTuple):
    """Autocorrelation of the innovations."""

    values: Array  # (lags,), of lag 1, 2, ...
    bound: float | None  # that 95 % of the lags stay within, if white; None where they are not judged


def read(study: Study) -> Study:
    """The study: every verdict knows the innovations of its runs."""
    return study


def lags(track: Track) -> Lags | None:
    innovations = track.verdict.innovations
    if (
        innovations is None
        or not len(innovations.autocorrelation)
        or not np.isfinite(innovations.autocorrelation).all()
    ):
        return None
    return Lags(innovations.autocorrelation, innovations.bound if innovations.judged else None)


def figures(study: Study) -> tuple[Figure, ...]:
    """On a screen one panel each with all filters, on paper a row for each filter."""
    sheets = tuple(
        Sheet(panels, 1.3, widths=(2.4, 1.0)[: len(panels)], title=track.name)
        for track in study.tracks
        for panels in [_panels(study, (track,))]
    )
    keys = (Key("expected of an optimal gain", EXPECTED), *study.keys())
    return (
        Figure(
            "Innovations", caption(study), _panels(study, study.tracks), sheets, keys, stacked=True,
            paper=caption(study, panels=True),
        ),
    )  # fmt: skip


def _panels(study: Study, tracks: tuple[Track, ...]) -> tuple[Panel, ...]:
    """Sizes of some filters, and their autocorrelation where one of the study has any."""
    sizes = _sizes(study, tracks)
    return (sizes, _correlation(study, tracks)) if any(map(lags, study.tracks)) else (sizes,)


def _sizes(study: Study, tracks: tuple[Track, ...]) -> Panel:
    y = Axis("NIS / dof", log=wide([track.nis_ratio for track in tracks]), follows=True)
    tips, columns = (*study.clock.tips, ("NIS / dof", "@y{0.000}")), {"step": study.steps}
    points = (
        Points(study.clock.values, of.nis_ratio, replace(of.look, size=2.0, alpha=0.7), of.owner, tips, columns)
        for of in tracks
    )
    alt = f"NIS over degrees of freedom of {study.name} over time"
    return Panel(study.clock.whole, y, (*points, Rule("y", 1.0, ONE)), alt)


def _correlation(study: Study, tracks: tuple[Track, ...]) -> Panel:
    lags_of = [(track, of) for track in tracks if (of := lags(track)) is not None]
    alt = f"Autocorrelation of the innovations of {study.name} over lags"
    longest = max((len(of.values) for _, of in lags_of), default=1)
    x = Axis("lag (steps)", window=(0.4, longest + 0.6), whole=True)
    if not lags_of:
        return Panel(x, Axis("autocorrelation", "correlation"), (), alt, height=240, empty="too few innovations")
    bounds = {of.bound for _, of in lags_of if of.bound is not None}
    reach = 1.15 * max(LEAST, *bounds, *(float(np.abs(of.values).max()) for _, of in lags_of))
    y = Axis("autocorrelation", "correlation", window=(-reach, reach), follows=True, least=2 * LEAST)
    marks: list[Mark] = [Span("y", -bound, bound, SHADE) for bound in bounds if len(bounds) == 1]
    marks.append(Rule("y", 0.0, EXPECTED))
    for track, of in lags_of:
        slot = [each.name for each in study.tracks].index(track.name)
        beside = 0.6 * dodge(slot, len(study.tracks)) if len(tracks) > 1 else 0.0
        marks += _lags(track, of, beside, len(bounds) > 1)
    return Panel(x, y, tuple(marks), alt, height=240)


def _lags(track: Track, of: Lags, beside: float, own_bound: bool) -> list[Mark]:
    lag = np.arange(1, len(of.values) + 1)
    tips = (("lag", "@lag"), ("autocorrelation", "@y{0.000}"))
    look = replace(track.look, size=4.4, width=1.3)
    marks: list[Mark] = [Stems(lag + beside, of.values, look, track.owner, tips, {"lag": lag})]
    if own_bound and of.bound is not None:
        ends, bound = np.array([0.5, len(of.values) + 0.5]), np.full(2, of.bound)
        dotted = replace(look, dash=(1.0, 2.0), width=0.7)
        marks.append(Band(ends, -bound, bound, dotted, track.owner, outline=True))
    return marks


def caption(study: Study, panels: bool = False) -> str:
    """What the figure shows; ``panels``: each filter has axes of its own."""
    over = "" if study.single else ", summed over the runs of its verdict"
    judged, every = study.judged, len(study.tracks)
    text = (
        f"Normalized innovation squared over its degrees of freedom, one point a step{over}; not smoothed. "
        "1 (line) is expected of a right filter with an optimal gain."
    )
    if not judged:
        text += " No filter here declares one: its innovations are reported and not judged."
    elif len(judged) < every:
        declare = "declare" if len(judged) > 1 else "declares"
        text += f" Only {listed(judged)} {declare} one; the innovations of the others are reported and not judged."
    if panels and every > 1:
        text += " Axes differ between filters."
    if any(map(lags, study.tracks)):
        text += (" Right: " if panels else " Below: ") + "autocorrelation over steps"
        text += "; 95 % of the lags stay within the shaded bound if the innovations are white." if judged else "."
    return text


SECTION = Section(STUDY, read, figures)
