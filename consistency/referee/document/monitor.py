"""What a monitor found, in a row and a sentence."""

from __future__ import annotations

from typing import Any

import numpy as np

from consistency.referee.diagnostics import Alarm, Monitor
from consistency.referee.diagnostics.monitoring.monitor import CAVEAT, accepted_scales
from consistency.referee.document.blocks import Cell, Column, Document, Quantity, Table, Text, table


def monitor_document(name: str, monitor: Monitor, alarm: Alarm | None, t: float, since_t: float) -> Document:
    """One row of numbers and a sentence, and the numbers as data.

    Parameters
    ----------
    name : of the innovations
    monitor : after the last step
    alarm : its steps as the file numbers them
    t, since_t : s, of the alarm and of the beginning of the fault; NaN where they are not known
    """
    sentence = _sentence(monitor, alarm, t, since_t)
    return Document(
        name, "", (), (_table(name, monitor), Text(""), Text(sentence)), _data(name, monitor, alarm, t, since_t)
    )


def _table(name: str, m: Monitor) -> Table:
    cells: list[tuple[str, Cell]] = [("steps", str(m.steps)), ("judged", str(m.innovations))]
    if m.gate is not None:
        cells.append(("rejected", str(m.rejections)))
    cells.append(("NIS/dof", Quantity(m.ratio, digits=".3f")))
    if m.gate is not None:
        cells.append(("scale", Quantity(m.scale, digits=".3f")))
    cells += [("e-value", f"{m.evidence:.3g}"), ("largest", f"{m.largest:.3g}"), ("alarm at", f"{m.threshold:.4g}")]
    columns = (Column("innovations"), *(Column(head, number=True) for head, _ in cells))
    return table(columns, [(name, *(cell for _, cell in cells))], f"Monitor of {name}")


def _sentence(monitor: Monitor, alarm: Alarm | None, t: float, since_t: float) -> str:
    if alarm is None:
        sentence = f"no alarm: no evidence that the NIS is off ({accepted_scales(monitor.tolerance)}). {CAVEAT}."
    else:
        sentence = str(alarm)
        if np.isfinite(t):
            sentence += f" Alarm at t = {t:.10g} s, since t = {since_t:.10g} s."
    if monitor.gate is not None and monitor.rejections:
        sentence += (
            f" The gate rejected {100 * monitor.rejections / monitor.measurements:.2g} % of the measurements "
            f"(designed for {100 * (1 - monitor.gate):.2g} %), which is not judged."
        )
    return sentence


def _data(name: str, monitor: Monitor, alarm: Alarm | None, t: float, since_t: float) -> dict[str, Any]:
    return {
        "innovations": name, "steps": monitor.steps, "measurements": monitor.measurements,
        "rejected": monitor.rejections, "judged": monitor.innovations, "nis_ratio": monitor.ratio,
        "scale": monitor.scale, "evidence": monitor.evidence, "largest_evidence": monitor.largest,
        "threshold": monitor.threshold, "false_alarm": monitor.false_alarm, "tolerance": monitor.tolerance,
        "gate": monitor.gate, "mission": monitor.mission, "note": CAVEAT,
        "alarm": None if alarm is None else {
            "step": alarm.step, "since": alarm.since, "t": t, "since_t": since_t, "direction": alarm.direction,
            "evidence": alarm.evidence, "scale": alarm.scale, "sentence": str(alarm),
        },
    }  # fmt: skip
