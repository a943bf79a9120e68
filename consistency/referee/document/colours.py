"""Colours, dashes and markers, the same in every format.

Colours are those of Okabe & Ito (2008). Each style has a dash pattern and a marker of its own as well, so that a grey
print still reads.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

TRUTH, ODOMETRY, BAND = "#000000", "#7f7f7f", "#d9d9d9"
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
# lengths in points, drawn and left out; 5 patterns and 6 colours repeat together only after 30
DASHES: tuple[tuple[float, ...], ...] = (
    (),
    (5.0, 2.0),
    (1.5, 1.5),
    (7.0, 2.0, 1.5, 2.0),
    (3.0, 1.5, 1.0, 1.5, 1.0, 1.5),
)
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")  # Matplotlib's names


@dataclass(frozen=True)
class Look:
    """How a mark or the entry of a legend looks; lengths in points."""

    colour: str
    dash: tuple[float, ...] = ()  # empty: solid
    marker: str = "o"
    width: float = 1.2
    size: float = 4.2  # of a marker
    alpha: float = 1.0
    edge: str = ""  # colour of a marker's outline; empty: none


EXPECTED = Look("#555555", width=0.8)
LIMIT = Look("#333333", (4.0, 3.0), width=0.9)
ZERO = Look("#555555", width=0.5)
SIGMAS = 2.0  # stated standard deviations from 0 to the bounds of an error that are drawn
ACCEPTED, REJECTED = Look(COLOURS[0], (), "o"), Look(COLOURS[1], (), "X")


def style(index: int) -> Look:
    """Look of the filter with this number; the same number always looks the same."""
    return Look(COLOURS[index % len(COLOURS)], DASHES[index % len(DASHES)], MARKERS[index % len(MARKERS)])


def solid(look: Look) -> Look:
    """A copy of this look without dashes, for panels of one filter each."""
    return replace(look, dash=())
