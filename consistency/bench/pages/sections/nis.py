"""Size and whiteness of the innovations."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from consistency.bench.pages.sections.report_input import Study, Track
from consistency.referee.diagnostics.number_words import names_in_a_row
from consistency.referee.pages.verdicts import wide
from consistency.referee.show.blocks import BAND, EXPECTED, Figure, Look
from consistency.referee.show.figures import canvas, dots, log_axis, owned, points, say, stroke
from consistency.referee.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

LEAST = 0.1  # correlation drawn on either side of zero, so that noise does not look large
ONE = Look("#333333", width=0.8)


class Lags(NamedTuple):
    """Autocorrelation of the innovations."""

    values: Array  # (lags,), of lag 1, 2, ...
    bound: float | None  # that 95 % of the lags stay within, if white; None where they are not judged


def lags(track: Track) -> Lags | None:
    """Those of the verdict; None where it has too few innovations."""
    innovations = track.verdict.innovations
    if (
        innovations is None
        or not len(innovations.autocorrelation)
        or not np.isfinite(innovations.autocorrelation).all()
    ):
        return None
    return Lags(innovations.autocorrelation, innovations.bound if innovations.judged else None)


def innovations(study: Study) -> tuple[Figure, ...]:
    """A row for each filter: size and, where one of the study has any, autocorrelation."""
    drawings = tuple(partial(_draw, study, track) for track in study.tracks)
    return (Figure("Innovations", innovations_caption(study), drawings),)


def _draw(study: Study, track: Track) -> Drawing:
    if not any(map(lags, study.tracks)):
        figure, (nis_axes,) = canvas(1.3)
    else:
        figure, (nis_axes, correlation) = canvas(1.3, 2, 2, width_ratios=(2.4, 1.0))
        _draw_correlation(correlation, track)
    nis_axes.axhline(1.0, **stroke(ONE))
    points(nis_axes, study.clock.values, track.nis_ratio, replace(track.look, size=1.6, alpha=0.7), "", track.tag)
    nis_axes.set(ylabel="NIS / dof", title=track.name)
    study.clock.span(nis_axes)
    if wide([track.nis_ratio]):
        log_axis(nis_axes, "y")
    return figure


def _draw_correlation(axes: Axes, track: Track) -> None:
    axes.set(xlabel="lag (steps)", ylabel="correlation")
    of = lags(track)
    if of is None:
        say(axes, "too few innovations")
        return
    lag, reach = np.arange(1, len(of.values) + 1), 1.15 * max(LEAST, of.bound or 0.0, float(np.abs(of.values).max()))
    if of.bound is not None:
        axes.axhspan(-of.bound, of.bound, color=BAND, linewidth=0, zorder=0.4)
    axes.axhline(0.0, **stroke(EXPECTED))
    look = replace(track.look, size=3.0, width=1.2)
    axes.vlines(lag, 0.0, of.values, color=look.colour, linewidth=look.width, gid=owned(track.tag))
    axes.plot(lag, of.values, gid=owned(track.tag), **dots(look))
    axes.set(xlim=(0.4, lag[-1] + 0.6), ylim=(-reach, reach), xticks=lag[:: max(1, len(lag) // 5)])


def innovations_caption(study: Study) -> str:
    """What the figure shows."""
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
        text += (
            f" Only {names_in_a_row(judged)} {declare} one; the innovations of the others are reported and not judged."
        )
    if every > 1:
        text += " Axes differ between filters."
    if any(map(lags, study.tracks)):
        text += " Right: autocorrelation over steps"
        text += "; 95 % of the lags stay within the shaded bound if the innovations are white." if judged else "."
    return text
