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
SMALL = 1e-3  # stated rate, below which a share is shown with four digits of a percentage
MARKS = ("<!-- calibration: begin -->", "<!-- calibration: end -->")

QUESTIONS = {
    "false alarm": "a right filter is found at fault",
    "until decided, false alarm": "`--until-decided` finds a right filter at fault",
    "e-process, false alarm": "the e-process reaches 20 in a right filter, looked at after every run",
    "wrong all-clear": "a covariance wrong by exactly `detect` is called consistent",
    "until decided, wrong all-clear": "`--until-decided` calls a covariance wrong by exactly `detect` consistent",
    "power": "a wrong covariance is found; with numbers of runs below the plan's also called as it is",
    "headline": "a wrong covariance is called overconfident or conservative as it is, and not heavy-tailed, say",
    "until decided, power": "`--until-decided` finds a wrong covariance at fault",
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


def merged(table: dict[str, Any], rows: Sequence[Row], about: dict[str, str]) -> dict[str, Any]:
    """A table with these rows in place of its own on the same questions in the same worlds."""
    fresh: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        fresh.setdefault((row.question, row.world), []).append(row)
    together: list[Row] = []
    for row in rows_of(table):
        key = (row.question, row.world)
        if key not in fresh:
            together.append(row)
        elif fresh[key]:
            together.append(fresh[key].pop(0))
    for left in fresh.values():
        together += left
    facts = {key: table[key] for key in ("seed", "wall_time_s")}
    return document(together, table["worlds"] | table["questions"] | about, **facts)


def rows_of(table: dict[str, Any]) -> list[Row]:
    return [Row(**row) for row in table["rows"]]


def markdown(table: dict[str, Any]) -> str:
    """The table as docs/reference/rates.md has it: questions, then worlds by what is asked in all of them, the rest.

    What each world is stands in the appendix of every report.
    """
    rows = rows_of(table)
    grid = [row for row in rows if row.question in EVERYWHERE and row.world in WORLDS]
    columns = list(dict.fromkeys(_column(row) for row in grid))
    cells = {(row.world, _column(row)): _measured(row) for row in grid}
    worlds = dict.fromkeys(row.world for row in grid)
    lines = [f"- *{question}*: {about}" for question, about in table["questions"].items()]
    lines += ["", "In brackets: runs that a gate took until it was decided, their mean and 95 % quantile."]
    lines += ["", *_table(["world", *columns], [[w, *(cells.get((w, c), "") for c in columns)] for w in worlds])]
    others = [
        [row.question, row.world, f"{row.ratio:.3g}", str(row.runs), _promise(row), _measured(row), str(row.gates)]
        for row in rows if row not in grid
    ]  # fmt: skip
    lines += ["", *_table(["question", "world", "ratio", "runs", "promised", "measured", "gates"], others)]
    return "\n".join(lines)


def write_docs(table: dict[str, Any], path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    start, end = MARKS
    marked = f"{start}\n\n{markdown(table)}\n\n{end}"
    new, count = re.subn(f"{re.escape(start)}.*{re.escape(end)}", lambda _: marked, text, flags=re.DOTALL)
    if count != 1:
        raise ValueError(f"{path}: needs the marks {start} and {end}, once")
    path.write_text(new, encoding="utf-8")


def _column(row: Row) -> str:
    fault, up_to = "" if row.ratio == 1.0 else f" x{row.ratio:.3g}", "" if row.looks else "up to "
    return f"{row.question}{fault} ({_promise(row)}), {up_to}{row.runs} runs, {row.gates} gates"


def _promise(row: Row) -> str:
    return f"{'≤' if row.bound == '<=' else '≥'} {100 * row.stated:g} %"


def _measured(row: Row) -> str:
    """Share; of gates that end when they are decided also the mean number of runs and its 95 % quantile."""
    taken = "" if row.looks else f" ({row.mean_runs:.0f}, {row.late_runs:.0f})"
    return f"{percentage(row)}{taken}"


def percentage(row: Row) -> str:
    """The share, with more digits where the stated rate is small."""
    return f"{100 * row.share:.{1 if row.stated >= SMALL or row.stated == 0 else 4}f} %"


def _table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *lines)]


def _without_nan(row: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in row.items() if value == value}
