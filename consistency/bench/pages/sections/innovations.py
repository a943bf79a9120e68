"""Size and whiteness of the innovations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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


@dataclass(frozen=True)
class Lags:
    """Autocorrelation of the innovations."""

    values: Array  # (lags,), of lag 1, 2, ...
    bound: float | None  # that 95 % of the lags stay within, if white; None where they are not judged


@dataclass(frozen=True)
class Innovation:
    """One filter; T steps."""

    track: Track
    ratio: Array  # (T,), NIS of all runs over their degrees of freedom
    lags: Lags | None  # None with too few innovations
    slot: int  # place of the filter among the others


@dataclass(frozen=True)
class Innovations:
    """All filters of a study."""

    study: Study
    filters: tuple[Innovation, ...]

    @property
    def correlated(self) -> bool:
        return any(of.lags for of in self.filters)


def read(study: Study) -> Innovations:
    """NIS and autocorrelation of the runs of each verdict."""
    return Innovations(
        study,
        tuple(Innovation(track, track.nis_ratio, lags(track), slot) for slot, track in enumerate(study.tracks)),
    )


def lags(track: Track) -> Lags | None:
    """Autocorrelation of lag 1, 2, ...; None with too few innovations."""
    innovations = track.verdict.innovations
    if (
        innovations is None
        or not len(innovations.autocorrelation)
        or not np.isfinite(innovations.autocorrelation).all()
    ):
        return None
    return Lags(innovations.autocorrelation, innovations.bound if innovations.judged else None)


def figures(innovations: Innovations) -> tuple[Figure, ...]:
    """On a screen one panel each with all filters, on paper a row for each filter."""
    study, filters = innovations.study, innovations.filters
    panels = [_sizes(study, filters)]
    if innovations.correlated:
        panels.append(_correlation(study, filters))
    sheets = tuple(_sheet(innovations, of) for of in filters)
    keys = (Key("expected of an optimal gain", EXPECTED), *study.keys())
    return (
        Figure(
            "Innovations", caption(innovations), tuple(panels), sheets, keys, stacked=True,
            paper=caption(innovations, panels=True),
        ),
    )  # fmt: skip


def _sheet(innovations: Innovations, of: Innovation) -> Sheet:
    panels = [_sizes(innovations.study, (of,))]
    if innovations.correlated:
        panels.append(replace(_correlation(innovations.study, (of,)), empty="too few innovations"))
    return Sheet(tuple(panels), 1.3, widths=(2.4, 1.0)[: len(panels)], title=of.track.name)


def _sizes(study: Study, filters: Sequence[Innovation]) -> Panel:
    y = Axis("NIS / dof", log=wide([of.ratio for of in filters]), follows=True)
    tips = (*study.clock.tips, ("NIS / dof", "@y{0.000}"))
    points = (
        Points(
            study.clock.values,
            of.ratio,
            replace(of.track.look, size=2.0, alpha=0.7),
            of.track.owner,
            tips,
            {"step": study.steps},
        )
        for of in filters
    )
    alt = f"NIS over degrees of freedom of {study.name} over time"
    return Panel(study.clock.whole, y, (*points, Rule("y", 1.0, ONE)), alt)


def _correlation(study: Study, filters: Sequence[Innovation]) -> Panel:
    lags_of = [(of, of.lags) for of in filters if of.lags is not None]
    alt = f"Autocorrelation of the innovations of {study.name} over lags"
    longest = max((len(of.values) for _, of in lags_of), default=1)
    x = Axis("lag (steps)", window=(0.4, longest + 0.6), whole=True)
    if not lags_of:
        return Panel(x, Axis("autocorrelation", "correlation"), (), alt, height=240)
    bounds = {of.bound for _, of in lags_of if of.bound is not None}
    reach = 1.15 * max(LEAST, *bounds, *(float(np.abs(of.values).max()) for _, of in lags_of))
    y = Axis("autocorrelation", "correlation", window=(-reach, reach), follows=True, least=2 * LEAST)
    marks: list[Mark] = [Span("y", -bound, bound, SHADE) for bound in bounds if len(bounds) == 1]
    marks.append(Rule("y", 0.0, EXPECTED))
    for of, values in lags_of:
        beside = 0.6 * dodge(of.slot, len(study.tracks)) if len(filters) > 1 else 0.0
        marks += _lags(of.track, values, beside, len(bounds) > 1)
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


def caption(innovations: Innovations, panels: bool = False) -> str:
    """What the figure shows; ``panels``: each filter has axes of its own."""
    study = innovations.study
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
    if innovations.correlated:
        text += (" Right: " if panels else " Below: ") + "autocorrelation over steps"
        text += "; 95 % of the lags stay within the shaded bound if the innovations are white." if judged else "."
    return text


SECTION = Section(STUDY, read, figures)
