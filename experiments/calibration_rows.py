"""Promises of the referee with the gates that were counted: rows, as JSON and as the table of the documentation."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from calibration_gates import DOF, STEPS
from calibration_worlds import HEAVY, LOGS, WORLDS
from scipy import stats

CONFIDENCE = 0.99  # with which a row is said to break its promise
MARKS = ("<!-- calibration: begin -->", "<!-- calibration: end -->")

QUESTIONS = {
    "false alarm": "a right filter is found at fault",
    "until decided, false alarm": "`--until-decided` finds a right filter at fault",
    "e-process, false alarm": "the e-process reaches 20 in a right filter, looked at after every run",
    "wrong all-clear": "a covariance wrong by exactly `detect` is called consistent",
    "until decided, wrong all-clear": "`--until-decided` calls a covariance wrong by exactly `detect` consistent",
    "power": "a wrong covariance is found, and called overconfident or conservative as it is",
    "until decided, power": "`--until-decided` finds a wrong covariance, and calls it as it is",
    "e-process, power": "the e-process reaches 20",
    "all-clear": "a right filter is called consistent",
    "one log, all-clear": "one run is called consistent",
    "heavy tails": "a right covariance of errors with heavy tails is headlined overconfident or conservative",
    "where": "a covariance wrong alike in all axes and steps is said to be so in an axis, or from some step on",
}
EVERYWHERE = list(QUESTIONS)[:4]  # asked in every world that can answer


@dataclass(frozen=True)
class Row:
    """A claim, and the gates that were counted."""

    world: str
    question: str
    ratio: float  # of true to stated covariance
    runs: int  # of a gate; at most, where it may end before
    looks: int  # 1, or 0 where a gate ends when it is decided
    stated: float
    bound: str  # "<=" or ">="
    gates: int
    found: int
    mean_runs: float = float("nan")  # that a gate took
    late_runs: float = float("nan")  # 95 % quantile of that

    @property
    def share(self) -> float:
        return self.found / self.gates


def kept(row: Row, confidence: float = CONFIDENCE) -> bool:
    """Is the row within its promise, as far as its number of gates can tell? Binomial, one-sided."""
    if row.bound == "<=":
        return bool(row.found <= (stats.binom.ppf(confidence, row.gates, row.stated) if row.stated > 0 else 0))
    return bool(row.found >= stats.binom.ppf(1.0 - confidence, row.gates, row.stated))


def document(rows: Sequence[Row], about: dict[str, str], **facts: Any) -> dict[str, Any]:
    """The table as JSON has it; ``about`` says what further worlds and questions are."""
    worlds = {name: world.about for name, world in (WORLDS | LOGS | HEAVY).items()} | about
    used = {row.world for row in rows}
    asked = list(dict.fromkeys([*QUESTIONS, *(row.question for row in rows)]))
    return {
        "steps": STEPS, "dof": DOF, **facts,
        "questions": {q: (QUESTIONS | about).get(q, q) for q in asked if any(row.question == q for row in rows)},
        "worlds": {name: text for name, text in worlds.items() if name in used},
        "rows": [_without_nan(asdict(row)) for row in rows],
    }  # fmt: skip


def rows_of(table: dict[str, Any]) -> list[Row]:
    return [Row(**row) for row in table["rows"]]


def markdown(table: dict[str, Any]) -> str:
    """The table as docs/referee.md has it: worlds by what is asked in all of them, then the rest, then the worlds."""
    rows, worlds = rows_of(table), table["worlds"]
    grid = [row for row in rows if row.question in EVERYWHERE and row.world in WORLDS]
    columns = list(dict.fromkeys((row.question, row.ratio, row.runs, row.stated) for row in grid))
    cells = {(row.world, row.question, row.ratio, row.runs, row.stated): row for row in grid}
    head = ["world", *(_column(*column) for column in columns)]
    lines = [_line(head), _line(["---"] * len(head))]
    for world in dict.fromkeys(row.world for row in grid):
        of_world = [cells.get((world, *column)) for column in columns]
        lines.append(_line([world, *("" if row is None else _measured(row) for row in of_world)]))
    lines += ["", _line(["what", "world", "ratio", "runs", "promised", "measured", "gates"]), _line(["---"] * 7)]
    lines += [
        _line([row.question, row.world, f"{row.ratio:.3g}", _runs(row), _promise(row), _measured(row), str(row.gates)])
        for row in rows if row not in grid
    ]  # fmt: skip
    lines += ["", _line(["world", "what it is"]), _line(["---"] * 2)]
    lines += [_line([name, about]) for name, about in worlds.items()]
    return "\n".join(lines)


def write_docs(table: dict[str, Any], path: Path) -> None:
    """Put the table between its marks in a document."""
    text = path.read_text(encoding="utf-8")
    start, end = MARKS
    marked = f"{start}\n\n{markdown(table)}\n\n{end}"
    new, count = re.subn(f"{re.escape(start)}.*{re.escape(end)}", lambda _: marked, text, flags=re.DOTALL)
    if count != 1:
        raise ValueError(f"{path}: needs the marks {start} and {end}, once")
    path.write_text(new, encoding="utf-8")


def _column(question: str, ratio: float, runs: int, stated: float) -> str:
    fault = "" if ratio == 1.0 else f" x{ratio:.3g}"
    up_to = "" if question in ("false alarm", "wrong all-clear") else "up to "
    return f"{question}{fault}, {up_to}{runs} runs: at most {100 * stated:g} %"


def _measured(row: Row) -> str:
    return f"{100 * row.share:.1f} %"


def _promise(row: Row) -> str:
    return f"at {'most' if row.bound == '<=' else 'least'} {100 * row.stated:g} %"


def _runs(row: Row) -> str:
    if row.looks == 1:
        return str(row.runs)
    return f"{row.mean_runs:.0f} on average, 95 % by {row.late_runs:.0f}"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _without_nan(row: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in row.items() if value == value}
