"""Distribution of the NEES in one step of each run."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from consistency.referee.document.colours import EXPECTED, SHADE, solid
from consistency.referee.document.drawing import Axis, Band, Figure, Key, Line, Mark, Panel, Sheet
from consistency.referee.pages.judged import Estimator, Judged
from consistency.referee.pages.section import STUDY, Section
from consistency.referee.types import Array

PANELS = 4  # small ones beside each other
WINDOW = (-0.02, 1.02)


@dataclass(frozen=True)
class Steps:
    """Empirical distribution function of chi-square's distribution function at N values of the NEES."""

    track: Estimator
    x: Array  # (N + 2,), with 0 and 1
    y: Array  # (N + 2,)
    half_width: float  # of the simultaneous band


@dataclass(frozen=True)
class Distribution:
    """Filters that have a NEES; at least one."""

    study: Judged
    filters: tuple[Steps, ...]


def read(study: Judged) -> Distribution | None:
    """The values that the verdicts hold; None where there is no NEES."""
    distributions = tuple(of for track in study.tracks if (of := steps(track)) is not None)
    return Distribution(study, distributions) if distributions else None


def steps(track: Estimator) -> Steps | None:
    """Distribution of one filter; None without NEES."""
    tails = track.verdict.tails
    if tails is None or not len(tails.pit) or not np.isfinite(tails.half_width):
        return None
    height = np.arange(1, len(tails.pit) + 1) / len(tails.pit)
    x, y = (np.concatenate([[0.0], column, [1.0]]) for column in (tails.pit, height))
    return Steps(track, x, y, tails.half_width)


def figures(distribution: Distribution) -> tuple[Figure, ...]:
    study, filters = distribution.study, distribution.filters
    small = tuple(_small(study, of, number) for number, of in enumerate(filters))
    sheet = Sheet(small, 1.85 * -(-len(small) // PANELS), columns=PANELS)  # panels that are nearly square
    keys = (Key("95 % band of the whole curve", SHADE, "band"), Key("expected", EXPECTED), *study.keys())
    return (Figure("Distribution of the NEES", caption(), (_panel(study, filters),), (sheet,), keys, level=4),)


def _panel(study: Judged, filters: tuple[Steps, ...], alone: bool = False) -> Panel:
    same = len({of.half_width for of in filters}) == 1
    bands = [_band(of, same) for of in (filters[:1] if same else filters)]
    diagonal = Line(np.array([0.0, 1.0]), np.array([0.0, 1.0]), EXPECTED)
    tips = (("chi-square cdf", "@x{0.000}"), ("share of runs", "@y{0.000}"))
    looks = [replace(solid(of.track.look) if alone else of.track.look, width=1.3) for of in filters]
    curves = [Line(of.x, of.y, look, of.track.owner, tips, steps=True) for of, look in zip(filters, looks, strict=True)]
    return Panel(
        Axis("chi-square cdf of the NEES", "chi-square cdf", window=WINDOW), Axis("share of runs", window=WINDOW),
        (*bands, diagonal, *curves), f"Distribution of the NEES of {study.name}", height=340, shape="square",
    )  # fmt: skip


def _band(of: Steps, shaded: bool) -> Mark:
    corners = np.unique([0.0, of.half_width, 1.0 - of.half_width, 1.0])
    low, high = (np.clip(corners + side, 0.0, 1.0) for side in (-of.half_width, of.half_width))
    if shaded:
        return Band(corners, low, high, SHADE)
    return Band(corners, low, high, replace(of.track.look, dash=(1.0, 2.0), width=0.7), of.track.owner, outline=True)


def _small(study: Judged, of: Steps, number: int) -> Panel:
    panel, ticks = _panel(study, (of,), alone=True), (0.0, 0.5, 1.0)
    label = "share of runs" if number % PANELS == 0 else ""
    return replace(
        panel, x=replace(panel.x, ticks=ticks), y=Axis(label, window=WINDOW, ticks=ticks), title=of.track.name
    )


def caption() -> str:
    return (
        "Distribution of the NEES: chi-square probability of the NEES in one step of each run, with nothing fitted. "
        "On the diagonal the covariance is right; a curve below it has too many large values (overconfident), above it "
        "too many small ones. Shaded: where the whole curve of a right filter lies with probability 95 %."
    )


SECTION = Section(STUDY, read, figures)
