"""The gates of a session as a file: JSON for programs, one HTML page for people."""

from __future__ import annotations

import json
import os
import tempfile
from html import escape
from pathlib import Path

from consistency.bench.pages.static import page
from consistency.referee.gating.session import Ledger, ending, interval, named, number, outcome
from consistency.referee.gating.watch import Entry
from consistency.referee.system.atomic import write_whole

SUFFIXES = (".json", ".html")

HEAD = ("test", "gate", "filter", "outcome", "verdict", "p", "false-alarm rate", "runs", "planned", "inflation", "why")
NUMBERS = {"p", "false-alarm rate", "runs", "planned", "inflation"}


def as_json(ledger: Ledger) -> str:
    """All gates with the statistics of their verdicts; not finite numbers are null."""
    data = {
        "schema_version": 1,
        "kind": "gates",
        "budget": ledger.budget,
        "false_alarm_each": ledger.rate,
        "false_alarm_bound": ledger.bound(),
        "gates": named(ledger.entries()),
    }
    return json.dumps(data, indent=2, allow_nan=False) + "\n"


def as_html(ledger: Ledger) -> str:
    """One page that needs nothing else."""
    head = "".join(f'<th scope="col"{_number(name)}>{name}</th>' for name in HEAD)
    rows = "\n".join(_row(entry) for entry in ledger.entries())
    table = f"<table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{rows}\n</tbody>\n</table>"
    return page(
        "Consistency gates",
        f"<p>{escape(ending(ledger))}.</p>",
        f'<div class="scroll" tabindex="0" role="region" aria-label="Gates">\n{table}\n</div>',
    )


def _row(e: Entry) -> str:
    first, *rest = e.reasons
    colour = e.status.replace(" ", "-")
    more = "".join(f"<li>{escape(reason)}</li>" for reason in rest)
    cells = [
        escape(e.gate), escape(e.name), escape(outcome(e)), f'<span class="verdict {colour}">{escape(e.status)}</span>',
        escape(number(e.p_value)), f"{e.false_alarm:.3g}", str(e.runs), str(e.needed), escape(interval(e)),
        f"<details><summary>{escape(first)}</summary><ul>{more}</ul></details>",
    ]  # fmt: skip
    body = "".join(f"<td{_number(name)}>{cell}</td>" for name, cell in zip(HEAD[1:], cells, strict=True))
    return f'<tr><th scope="row">{escape(e.test)}</th>{body}</tr>'


def _number(name: str) -> str:
    return ' class="number"' if name in NUMBERS else ""


def refusal(path: Path) -> str:
    """Why a report cannot be written there, and what to do; '' if it can."""
    if path.suffix.lower() not in SUFFIXES:
        return f"--consistency-report {path}: must end in {' or '.join(SUFFIXES)}"
    if path.is_dir():
        return f"--consistency-report {path}: is a folder; name a file in it"
    if not path.parent.is_dir():
        return f"--consistency-report {path}: the folder {path.parent} does not exist; make it first"
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
        if path.exists() and not os.access(path, os.W_OK):
            raise PermissionError(13, "Permission denied")
    except OSError as error:
        return f"--consistency-report {path}: cannot be written ({error.strerror}); name another file"
    return ""


def write(ledger: Ledger, path: Path) -> None:
    """The whole file or none: written beside its place and renamed."""
    text = as_json(ledger) if path.suffix.lower() == ".json" else as_html(ledger)
    write_whole(path, text.encode("utf-8"))
