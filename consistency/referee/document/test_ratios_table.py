"""Test ratios of a gate, sensor by sensor: a table, and what it does not say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from consistency.referee.diagnostics.monitoring.gate_ratios import RARE, GateRatios
from consistency.referee.document.blocks import Cell, Column, Document, Text, table

NO_NIS = (
    "These are test ratios and no NIS: the log does not hold the variances of the innovations. So there is no verdict "
    "and no alarm. A ratio above 1 was rejected. A right filter has no larger shares than the table says, up to "
    "chance; smaller shares do not show that it is right."
)
HEADS = (
    "gate",
    "messages",
    "largest",
    "above 1",
    "right filter",
    "unusual above",
    "unusual",
    "right filter",
    "in a tenth",
)


def ratios_document(name: str, ratios: Sequence[GateRatios]) -> Document:
    """A row for each sensor, and the numbers as data."""
    columns = (Column("sensor"), *(Column(head, number=True) for head in HEADS))
    rows = [_row(each) for each in ratios]
    shown = table(columns, rows, f"Test ratios of {name}")
    data = {"log": name, "note": NO_NIS, "sensors": {each.sensor: _data(each) for each in ratios}}
    return Document(name, "", (), (shown, Text(""), Text(NO_NIS)), data)


def _row(each: GateRatios) -> tuple[Cell, ...]:
    known = not np.isnan(each.gate)
    begin, share = each.over_time(each.unusual)
    most = int(np.nanargmax(share)) if known else 0
    return (
        each.sensor, f"{each.gate:g} sigma" if known else "", str(len(each.ratio)), f"{each.ratio.max():.2f}",
        _share(each.above(1.0)), f"≤ {each.rejected:.1g}" if known else "", f"{each.unusual:.2f}" if known else "",
        _share(each.above(each.unusual)), f"≤ {RARE:.0%}" if known else "",
        f"{share[most]:.1%} from {begin[most]:.4g} s" if known else "",
    )  # fmt: skip


def _share(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.1%}"


def _data(each: GateRatios) -> dict[str, object]:
    begin, share = each.over_time(each.unusual)
    return {
        "gate": each.gate, "messages": len(each.ratio), "largest": float(each.ratio.max()),
        "above_1": each.above(1.0), "above_1_of_a_right_filter": each.rejected, "unusual_above": each.unusual,
        "unusual": each.above(each.unusual), "unusual_of_a_right_filter": RARE,
        "over_time": [{"t": float(t), "unusual": float(s)} for t, s in zip(begin, share, strict=True)],
    }  # fmt: skip
