"""What a monitor found, in a row and a sentence; test ratios of a gate, sensor by sensor, and what they do not say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from consistency.referee.defaults import FALSE_ALARM
from consistency.referee.diagnostics.monitor import CAVEAT, RARE, Alarm, GateRatios, Monitor, accepted_scales
from consistency.referee.diagnostics.number_words import p_text, percent, plural
from consistency.referee.diagnostics.verdict import CLOCK, MICROSECOND
from consistency.referee.document.blocks import Cell, Column, Document, Quantity, Text, table

SHOWN = 4  # dimensions of innovations, of which the smallest spike is printed


def monitor_document(
    name: str, monitor: Monitor, alarm: Alarm | None, t: float, since_t: float, start: float = 0.0
) -> Document:
    """One row of numbers and a sentence, and the numbers as data.

    Parameters
    ----------
    name : of the innovations
    monitor : after the last step
    alarm : its steps as the file numbers them
    t, since_t : s, of the alarm and of the beginning of the fault; NaN where they are not known
    start : s, the first time of the log; the sentence counts from it where the clock does not begin with the log
    """
    m = monitor
    share = m.gate_share
    data = {
        "innovations": name, "steps": m.steps, "measurements": m.measurements, "rejected": m.rejections,
        "judged": m.innovations, "nis_ratio": m.ratio, "scale": m.scale, "evidence": m.evidence,
        "largest_evidence": m.largest, "threshold": m.threshold, "false_alarm": m.false_alarm,
        "tolerance": m.tolerance, "gate": m.gate, "mission": m.mission, "note": CAVEAT,
        "gate_share": share and {
            "tried": m.tried, "refused": m.refused, "expected": 1.0 - float(m.gate or 0.0), "finding": share.finding,
            "p_few": share.few, "p_many": share.many, "fewest": share.fewest,
        },
        "smallest_spikes": [
            {"dof": dof, "found": found, "right": right} for dof, (found, right) in m.smallest_spikes.items()
        ],
        "alarm": None if alarm is None else {
            "step": alarm.step, "since": alarm.since, "t": t, "since_t": since_t, "direction": alarm.direction,
            "evidence": alarm.evidence, "scale": alarm.scale, "outlier": alarm.outlier,
            "rest": alarm.rest, "sentence": str(alarm),
        },
    }  # fmt: skip
    cells: list[tuple[str, Cell]] = [("steps", str(m.steps)), ("judged", str(m.innovations))]
    if m.gate is not None:
        cells.append(("rejected", str(m.rejections)))
    cells.append(("NIS/dof", Quantity(m.ratio, digits=".3f")))
    if m.gate is not None:
        cells.append(("scale", Quantity(m.scale, digits=".3f")))
    cells += [("e-value", f"{m.evidence:.3g}"), ("largest", f"{m.largest:.3g}"), ("alarm at", f"{m.threshold:.4g}")]
    columns = (Column("innovations"), *(Column(head, number=True) for head, _ in cells))
    shown = table(columns, [(name, *(cell for _, cell in cells))], f"Monitor of {name}")
    return Document(name, "", (), (shown, Text(""), Text(_sentence(m, alarm, t, since_t, start))), data)


def _sentence(monitor: Monitor, alarm: Alarm | None, t: float, since_t: float, start: float) -> str:
    if alarm is None:
        sentence = f"no alarm: no evidence that the NIS is off ({accepted_scales(monitor.tolerance)}). {CAVEAT}."
        if monitor.tolerance > 1.0:
            sentence += " --tolerance 1 asks whether it is right exactly, and so may find what is accepted here."
    else:
        sentence = str(alarm)
        if np.isfinite(t):
            after = ""
            if start > CLOCK:
                t, since_t = np.round([t - start, since_t - start], MICROSECOND)
                after = " after the start"
            sentence += f" Alarm at t = {t:.10g} s, since t = {since_t:.10g} s{after}."
    return " ".join([sentence, *_gate(monitor)])


def _gate(m: Monitor) -> list[str]:
    """Whether the gate rejects as often as that of a right filter, and the smallest spike that it rejects."""
    share = m.gate_share
    if share is None or m.gate is None:
        return []
    text = f"The gate rejected {percent(m.rejections / m.measurements)} of {plural(m.measurements, 'measurement')}"
    if m.tried < m.measurements:
        text += f", and {percent(m.refused / m.tried)} of the {m.tried} that do not come right after a rejection"
    text += f" (a right filter: {percent(1 - m.gate)})"
    rate = f"at a false-alarm rate of {percent(FALSE_ALARM)}"
    if share.finding == "too few":
        text += (
            f": too few (p {p_text(share.few)}, {rate}), so that the stated innovation covariance is too large, unless "
            "the log leaves out what was rejected."
        )
    elif share.finding:
        text += (
            f": too many (p {p_text(share.many)}, {rate}): the stated innovation covariance is too small, or there are "
            "outliers."
        )
    elif m.refused == 0:
        text += f", which shows nothing: {share.fewest} without a rejection would show that there are too few."
    else:
        text += f", which is not shown to be too few or too many ({rate})."
    spikes = []
    for dof, (found, right) in list(m.smallest_spikes.items())[:SHOWN]:
        is_off = np.isfinite(m.scale) and not 1.0 / m.tolerance <= m.scale <= m.tolerance
        of_right = f" ({right:.2g} if its covariance were right)" if is_off else ""
        spikes.append(f"{found if np.isfinite(m.scale) else right:.2g} in {dof}-D{of_right}")
    return [
        text,
        f"The smallest spike that it rejects with a chance of 50 % has, in true standard deviations: "
        f"{', '.join(spikes)}.",
    ]


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
