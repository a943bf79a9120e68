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
    rows: list[tuple[Cell, ...]] = []
    sensors = {}
    for each in ratios:
        (begin, share), known = each.over_time(each.unusual), not np.isnan(each.gate)
        rejected, unusual, largest = each.above(1.0), each.above(each.unusual), float(each.ratio.max())
        most = int(np.nanargmax(share)) if known else 0
        of_gate = (
            f"≤ {each.rejected:.1g}", f"{each.unusual:.2f}", f"{unusual:.1%}", f"≤ {RARE:.0%}",
            f"{share[most]:.1%} from {begin[most]:.4g} s",
        )  # fmt: skip
        rows.append((
            each.sensor, f"{each.gate:g} sigma" if known else "", str(len(each.ratio)), f"{largest:.2f}",
            "" if np.isnan(rejected) else f"{rejected:.1%}", *(of_gate if known else [""] * len(of_gate)),
        ))  # fmt: skip
        sensors[each.sensor] = {
            "gate": each.gate, "messages": len(each.ratio), "largest": largest,
            "above_1": rejected, "above_1_of_a_right_filter": each.rejected, "unusual_above": each.unusual,
            "unusual": unusual, "unusual_of_a_right_filter": RARE,
            "over_time": [{"t": float(t), "unusual": float(s)} for t, s in zip(begin, share, strict=True)],
        }  # fmt: skip
    shown = table(columns, rows, f"Test ratios of {name}")
    data = {"log": name, "note": NO_NIS, "sensors": sensors}
    return Document(name, "", (), (shown, Text(""), Text(NO_NIS)), data)
