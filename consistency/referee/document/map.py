"""The score of a map in rows and columns, as :mod:`consistency.referee.document.judged_filters` has those of a pose."""

from __future__ import annotations

from collections.abc import Mapping

from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.diagnostics.verdict.verdict import MapScore
from consistency.referee.diagnostics.words.numbers import short, with_subject
from consistency.referee.document.blocks import Cell, Column, Quantity
from consistency.referee.document.wording import NONE, PLAIN, written

MAP_COLUMNS = (
    Column("Verdict on the map", "Verdict on\nthe map", width="1.2fr"),
    Column("Mean NEES / 3 of landmarks", "Mean NEES / 3\nof landmarks", number=True),
    Column("Pose and map together, NEES / dof", "Pose and map\ntogether", number=True),
    Column("Map given the pose, NEES / dof", "Map given\nthe pose", number=True),
    Column("Runs", number=True),
    Column("Landmarks", number=True),
    Column("Landmarks left out", "Landmarks\nleft out", number=True),
)


def map_cells(m: MapScore) -> tuple[Cell, ...]:
    """Cells of a page, as COLUMNS."""
    joint = None if m.verdict is None else m.verdict.joint
    together = (NONE, NONE) if joint is None or not joint.runs else (_ratio(joint.both), _ratio(joint.map))
    return (
        "not judged" if m.verdict is None else m.verdict.status, _ratio(m.ratio) if m.landmarks else NONE, *together,
        str(m.runs), str(m.landmarks), str(m.left_out),
    )  # fmt: skip


def _ratio(interval: Interval) -> Quantity:
    return Quantity(interval.value, interval[1:])


def map_text(m: MapScore) -> str:
    """Mean NEES over 3 of the landmarks in maps, with its interval."""
    left_out = f" ({m.left_out} of {m.left_out + m.landmarks} landmarks left out)" if m.left_out else ""
    return f"{written(_ratio(m.ratio) if m.landmarks else NONE, PLAIN)}{left_out}"


def map_summary(m: MapScore) -> str:
    """Also the sentence of the verdict on the map."""
    verdict = "not judged" if m.verdict is None else with_subject("the map", m.verdict.reasons[0])
    return f"{map_text(m)}, after the last step; {verdict}"


def map_lines(scores: Mapping[str, MapScore]) -> list[str]:
    """One line on the maps of several filters, with the verdicts on them; none where there is no map."""
    texts, judged = [], ", not judged"
    for name, m in scores.items():
        if not m.landmarks:
            continue
        text = map_text(m)
        if m.verdict is not None:
            judged, joint = "", m.verdict.joint
            together = "" if joint is None or not joint.runs else f" (together with the pose {short(joint.both.value)})"
            text = f"{m.verdict.status}, {text}{together}"
        texts.append(f"{name} {text}")
    return [f"map after the last step, mean NEES / 3{judged}: {'; '.join(texts)}"] if texts else []
