"""The gates of a session as a file: JSON for programs, one HTML page for people."""

from __future__ import annotations

import json
import os
import tempfile
from html import escape
from pathlib import Path

from consistency.gating.session import Ledger, ending, interval, named, number, outcome
from consistency.gating.watch import Entry
from consistency.store.atomic import write_whole

SUFFIXES = (".json", ".html")

# colours of the bench's report, and lighter ones on dark ground with a contrast above 4.5
STYLE = """
:root { color-scheme: light dark; --ink: #1a1a1a; --ground: #fff; --line: #d5d5d5; --faint: #444;
  --consistent: #00664a; --overconfident: #a84300; --conservative: #00507d; --biased: #8a2a63; --undecided: #4d4d4d; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8e8e8; --ground: #16181a; --line: #44484c; --faint: #b5b5b5;
  --consistent: #4fd1a5; --overconfident: #ff9d5c; --conservative: #6cb8f0; --biased: #f09cc8; --undecided: #b5b5b5; } }
body { margin: 0 auto; padding: 1rem 1.25rem 3rem; max-width: 96rem; color: var(--ink); background: var(--ground);
  font: 1rem/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .9rem; font-variant-numeric: tabular-nums; }
th, td { padding: .35rem .5rem; border-bottom: 1px solid var(--line); text-align: left; vertical-align: top; }
thead th { border-bottom: 2px solid var(--ink); }
tbody th { font-weight: 600; overflow-wrap: anywhere; min-width: 12rem; }
tbody td:last-child { min-width: 22rem; }
.number { text-align: right; white-space: nowrap; }
.verdict { display: inline-block; padding: 0 .5em; border: 1.5px solid currentColor; border-radius: .7em;
  font-weight: 600; white-space: nowrap; }
.consistent, .not-worse { color: var(--consistent); }
.overconfident, .worse { color: var(--overconfident); }
.conservative { color: var(--conservative); border-style: dashed; }
.biased { color: var(--biased); }
.heavy-tailed { color: var(--biased); border-style: dashed; }
.inconsistent { color: var(--overconfident); border-style: dashed; }
.undecided { color: var(--undecided); border-style: dotted; }
.failed { color: var(--ground); background: var(--ink); border-color: var(--ink); }
summary { cursor: pointer; }
ul { margin: .25rem 0; padding-left: 1.2rem; color: var(--faint); }
"""
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
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Consistency gates</title>
<style>{STYLE}</style>
</head>
<body>
<main>
<h1>Consistency gates</h1>
<p>{escape(ending(ledger))}.</p>
<div class="scroll" tabindex="0" role="region" aria-label="Gates">
<table>
<thead><tr>{head}</tr></thead>
<tbody>
{rows}
</tbody>
</table>
</div>
</main>
</body>
</html>
"""


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
