"""HTML pages without scripts, which need no optional package: gates, and verdicts where [report] is missing."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING

from consistency.referee.errors import InputError
from consistency.referee.extras import is_installed

if TYPE_CHECKING:
    from consistency.referee.diagnostics import Evidence, Verdict

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


def page(title: str, *body: str) -> str:
    """One page that needs nothing else; ``body`` is HTML."""
    inside = "\n".join(body)
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>{STYLE}</style>
</head>
<body>
<main>
<h1>{escape(title)}</h1>
{inside}
</main>
</body>
</html>
"""


def verdicts_page(records: Sequence[Evidence], judged: Mapping[str, Verdict], title: str) -> str:
    """Sentence and figures of each verdict, why, and what was read; pictures where Matplotlib is installed."""
    named = {record.name: record for record in records}
    parts = []
    for name, verdict in judged.items():
        source = picture(named[name], verdict)
        shown = "" if source is None else f'<img alt="errors, NEES, coverage" src="{source}">'
        parts.append(f"<section>\n{verdict._repr_html_()}\n{_listed(verdict.reasons[1:])}\n{shown}\n</section>")
    notes = dict.fromkeys(note for name in judged for note in named[name].notes)
    return page(f"Estimator consistency: {title}", *parts, _listed([*notes]))


def picture(record: Evidence, verdict: Verdict) -> str | None:
    """Errors, NEES and coverage as the source of an image; None without Matplotlib or where nothing can be drawn."""
    if not is_installed("plot"):
        return None
    from consistency.bench.pages.paper import render
    from consistency.referee.pages.files import record_sheet

    try:
        sheet = record_sheet(record, verdict)
    except InputError:
        return None
    return f"data:image/png;base64,{b64encode(render(sheet, 'png', 110)).decode()}"


def _listed(texts: Sequence[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape(text)}</li>' for text in texts)}</ul>" if texts else ""
