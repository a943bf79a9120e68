"""Further figures of merit of each filter, as a table."""

from __future__ import annotations

import numpy as np

from consistency.bench.pages.blocks import Block, Cell, Column, Heading, Name, table
from consistency.bench.pages.model import Study, Track
from consistency.bench.pages.section import STUDY, Section
from consistency.bench.pages.wording import brief, number

COLUMNS = (
    Column("Filter", width="1.3fr"),
    Column("Mean ANEES accepted", "Mean ANEES\naccepted", number=True),
    Column("Covariance ratio that would be found", "Ratio that\nwould be found", number=True),
    Column("2-sigma coverage, all steps (%)", "Coverage 2σ (%)\nall steps", number=True),
    Column("Noncredibility (dB)", "Noncredi-\nbility (dB)", number=True),
    Column("Inclination (dB)", "Incli-\nnation (dB)", number=True),
    Column("NIS / dof (95 % expected)", "NIS / dof\n(95 % expected)", number=True),
)
CAPTION = (
    "Noncredibility index and inclination (Li & Zhao 2006): 0 dB is credible, 10 dB a covariance wrong by a factor "
    "of 10; inclination above 0 is overconfident. The ratio that would be found: with power 0.95 by these runs."
)
LONG = 12  # rows from which the table may be broken between pages


def read(study: Study) -> Study | None:
    """The study; None where the truth is not known."""
    return study if study.has_truth else None


def show(study: Study) -> tuple[Block, ...]:
    """Table with a row for each filter."""
    rows = [_cells(track) for track in study.tracks]
    label = f"Further figures of {study.name}"
    whole = len(rows) <= LONG
    return (
        Heading("Further figures", 4),
        table(COLUMNS, rows, label, caption=CAPTION, apart=True, whole=whole),
    )


def _cells(track: Track) -> tuple[Cell, ...]:
    name, *others = row(track)
    return Name(name, track.look), *others


def row(track: Track) -> tuple[str, ...]:
    """Cells of one filter, as COLUMNS."""
    scale, accuracy = track.verdict.scale, track.verdict.accuracy
    low, high = (np.nan, np.nan) if scale is None else scale.accepted
    detectable = number(None if scale is None else scale.detectable, ".2g")
    covered = np.empty(0) if accuracy is None else accuracy.coverage
    return (
        track.name,
        "–" if np.isnan(low) else f"{brief(low)} to {brief(high)}",
        detectable if detectable == "–" else f"×{detectable}",
        " / ".join(number(100 * c, ".1f") for c in covered) if np.isfinite(covered).any() else "–",
        number(None if accuracy is None else accuracy.nci, ".1f"),
        number(None if accuracy is None else accuracy.inclination, "+.1f"),
        _nis_expected(track),
    )


def _nis_expected(track: Track) -> str:
    innovations = track.verdict.innovations
    if innovations is None or not np.isfinite(innovations.ratio):
        return "–"
    low, high = (number(end, ".3f") for end in innovations.interval)
    return f"{innovations.ratio:.3f} ({f'{low} to {high}' if innovations.judged else 'not judged'})"


SECTION = Section(STUDY, read, show)
