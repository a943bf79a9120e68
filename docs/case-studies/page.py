"""Writes docs/case-studies.md and the drafts in reports/ from templates/ and the kept verdicts.

``{{CASE SET | ROW | FIELD}}`` in a template is a figure of reports/reference/case-studies.json, ``{{table NAME}}`` a
table. ``python docs/case-studies/page.py`` after ``make case-studies``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from math import log
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parents[1]
KEPT = ROOT / "reports/reference/case-studies.json"
SEARCHED = "2026-11-24"  # when reports were looked for upstream
APPROXIMATIONS = ("filterpy_ensemble", "forecast_fitted", "gpr_new_target", "gtsam_isam2", "least_squares_scaling")
Row = dict[str, Any]
Studies = dict[str, Row]


def ratio(interval: list[float]) -> str:
    """x3.17 [2.68, 3.80]."""
    return "x{} [{}, {}]".format(*map(digits, interval))


def digits(value: float) -> str:
    """Two decimals, but three digits of a large number and two of a small one."""
    if abs(value) < 0.1:
        return f"{value:.2g}"
    if value >= 1e4:
        return f"{value:.0e}".replace("e+0", "e")
    return f"{value:.2f}" if value < 10 else f"{value:.1f}" if value < 100 else f"{value:.0f}"


def words(interval: list[float]) -> str:
    value, low, high = interval
    if value > 1:
        return f"too small by {ratio(interval)}"
    return f"too large by {ratio([1 / value, 1 / high, 1 / low])} (ratio {digits(value)})"


def decisive(row: Row) -> str | None:
    """The axis that is farther off than the whole, if the verdict is a fault and its interval excludes 1."""
    distance = {name: abs(log(value)) for name, (value, low, high) in row["axes"].items() if low > 1 or high < 1}
    farthest = max(distance, key=lambda name: distance[name], default=None)
    whole = abs(log(row["ratio"][0]))
    return farthest if farthest and row["status"] != "consistent" and distance[farthest] > 1.25 * whole else None


def row_of(studies: Studies, key: str, name: str) -> Row:
    (row,) = (each for each in studies[key]["rows"] if each["row"] == name)
    return row


def figure(studies: Studies, key: str, name: str, field: str) -> str:
    row = row_of(studies, key, name)
    field, _, axis = field.partition(":")
    interval = row["axes"][axis] if axis else row["ratio"]
    if field == "second":
        (found,) = (a["found"] for a in studies[key]["arguments"] if a["row"] == name and a["axis"] == (axis or None))
        return digits(found)
    return {"ratio": ratio, "words": words}.get(field, lambda _: str({**studies[key], **row}[field]))(interval)


def cells(row: Row) -> str:
    """Status and ratio; of the deciding axis, too, and of failed runs."""
    axis = decisive(row)
    text = f"{row['status']}, {ratio(row['ratio'])}"
    text += "" if axis is None else f"; {axis} {ratio(row['axes'][axis])}"
    return text + (f"; {row['failed']} of {row['runs']} runs failed" if row["failed"] else "")


def judged(studies: Studies, keep: Callable[[str, Row], bool]) -> list[tuple[Row, Row]]:
    return [(study, row) for key, study in studies.items() for row in study.get("rows", ())
            if row["role"] == "judged" and keep(key.split()[0], row)]  # fmt: skip


def table(studies: Studies, name: str) -> str:
    """Of faults and approximations with controls and second arguments; of what passes; of what is undecided."""
    if name in ("found", "approximations"):
        lines = ["| library | judged | true / stated | controls | second argument |", "| --- | --- | --- | --- | --- |"]
        rows = judged(studies, lambda case, row: row["status"] not in ("consistent", "undecided")
                      and (case in APPROXIMATIONS) == (name == "approximations"))  # fmt: skip
        for study, row in rows:
            controls = [each["status"] for each in study["rows"] if each["role"] == "control"]
            fine = sum(status == "consistent" for status in controls)
            said = [each["agrees"] for each in study["arguments"] if each["row"] == row["row"]]
            confirmed = "none" if not said else "yes" if all(said) else "no"
            lines.append(f"| {study['library']} {study['version']} | {row['row']} | {cells(row)} | "
                         f"{fine} of {len(controls)} consistent | {confirmed} |")  # fmt: skip
        return "\n".join(lines)
    status = {"passes": "consistent", "undecided": "undecided"}[name]
    lines = [f"| library | {status} | true / stated |", "| --- | --- | --- |"]
    for study, row in judged(studies, lambda _, row: row["status"] == status):
        lines.append(f"| {study['library']} {study['version']} | {row['row']} | {ratio(row['ratio'])} |")
    return "\n".join(lines) if len(lines) > 2 else "None."


def rates(found: dict[str, Any]) -> str:
    """How often the controls are found at fault, and where most often."""
    counts = [
        (count, study["draws"], name, key) for key, study in found.items() for name, count in study["faults"].items()
    ]
    count, draws, name, key = max(counts, key=lambda each: each[0] / each[1])
    faults, of = sum(each[0] for each in counts), sum(each[1] for each in counts)
    return (
        f"{faults} of {of:,} draws of the controls are found at fault ({100 * faults / of:.2f} %, 1 % is stated); "
        f"most, {count} of {draws}, of *{name}* ({key.split()[0].replace('_', ' ')})"
    )


def rendered(template: str, kept: dict[str, Any]) -> str:
    studies: Studies = kept["studies"]

    def value(match: re.Match[str]) -> str:
        parts = [part.strip() for part in match[1].split("|")]
        if parts[0].startswith("table "):
            return table(studies, parts[0].split()[1])
        if parts == ["rates"]:
            return rates(kept["rates"])
        return SEARCHED if parts == ["searched"] else figure(studies, *parts)

    return re.sub(r"\{\{(.*?)\}\}", value, template)


def pages() -> dict[Path, str]:
    """Path and text of all that is written."""
    kept = json.loads(KEPT.read_text("utf-8"))
    out = {}
    for path in sorted((FOLDER / "templates").glob("*.md")):
        where = ROOT / "docs" / path.name if path.name == "case-studies.md" else FOLDER / "reports" / path.name
        out[where] = rendered(path.read_text("utf-8"), kept)
    return out


if __name__ == "__main__":
    for path, text in pages().items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, "utf-8")
