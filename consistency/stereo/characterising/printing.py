"""What a terminal shows of a characterisation."""

from __future__ import annotations

from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.document.blocks import Block, Cell, Column, Quantity, Text, table
from consistency.stereo.characterising.characterise import Characterisation
from consistency.stereo.characterising.wording import counted, interval, sentences

HEADS = ("noise px", "correlation", "offset share", "1/nu", "kurtosis", "pooled px")


def blocks(of: Characterisation) -> tuple[Block, ...]:
    """One row a coordinate, then a sentence for each answer."""
    rows: list[tuple[Cell, ...]] = [
        (
            c.name, interval(c.sigma), _or_dash(c.correlation), _or_dash(c.offset), _or_dash(c.tails.weight),
            f"{c.tails.excess_kurtosis:.2f}", Quantity(c.pooled, digits=".4g"),
        )
        for c in of.coordinates
    ]  # fmt: skip
    columns = (Column(""), *(Column(head, number=True) for head in HEADS))
    return Text(counted(of)), table(columns, rows, "Estimates of the sensor"), *map(Text, sentences(of))


def _or_dash(estimate: Interval | None) -> Cell:
    return Quantity(None) if estimate is None else interval(estimate, 2)
