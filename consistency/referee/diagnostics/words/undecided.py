"""Why nothing is decided, and what would decide."""

from __future__ import annotations

from collections.abc import Mapping

from consistency.referee.diagnostics.questions.sample import ATTITUDE
from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.verdict.settings import Settings
from consistency.referee.diagnostics.verdict.verdict import ConventionResult, Findings, Verdict
from consistency.referee.diagnostics.words.numbers import percent, ratio_text

LATER = "no fault found in the scale; the other questions are asked at the next look"


def unshown_sentence(found: Findings, why: str) -> str:
    """Why nothing can be shown, and the ratio that would be judged."""
    assert found.scale is not None
    provided = " if they are"
    if found.truth is not None:
        provided = ""
    ratio = f"the covariance ratio would be {ratio_text(found.scale.inflation)}{provided}, reported and not judged"
    return f"{why}; {ratio}"


def other_ways(status: str, record: Record) -> list[str]:
    """What else would decide on a single log of poses."""
    is_log = len(record.run_numbers) == 1 and record.window is None and record.align and record.convention
    if status != "undecided" or not is_log or not ATTITUDE & set(record.axes):
        return []
    return [
        "--relative 10s (or steps, or metres) makes many windows of one log, if the file has motions with covariances, "
        "or poses with cross-covariances (docs/files.md)"
    ]


def sentences_of_conventions(
    found: Mapping[str, ConventionResult], verdicts: Mapping[str, Verdict], settings: Settings
) -> list[str]:
    """Which conventions of the error are not rejected, and the sentence of each."""
    left, gone = [], []
    for kind, result in found.items():
        if result.possible:
            left.append(f"{kind} (covariance ratio {ratio_text(result.ratio)})")
        else:
            gone.append(kind)
    rate = percent(settings.false_alarm)
    if left:
        text = f"no error is declared; not rejected at a rate of {rate}: {', '.join(left)}"
        if gone:
            text += f"; rejected: {', '.join(gone)}"
        text += ". The filter's documentation says which it is; declare it with --error"
    else:
        text = f"no error is declared, and at a rate of {rate} each all are rejected: {', '.join(found)}"
    lines = [f"undecided: {text}"]
    for kind, verdict in verdicts.items():
        lines.append(f"if the error is {kind}: {verdict.reasons[0]}")
    return lines
