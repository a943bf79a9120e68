"""``consistency list``: parses, calls, prints."""

from __future__ import annotations

import json
import sys

from consistency.commands.shared_options import AsJson
from consistency.referee.extras import missing, remedy


def list_command(as_json: AsJson = False) -> None:
    """List scenarios, filters, experiments and sweeps."""
    from consistency.bench.filters import BOUNDS, SMOOTHERS, filter_summaries
    from consistency.bench.filters.guard.plain_rules import KINDS
    from consistency.referee.system.shipped import summaries

    shipped, filters = summaries(), filter_summaries()
    if missing("bench"):
        print(f"consistency: to run what is listed needs {remedy('bench')}", file=sys.stderr)
    if as_json:
        listed = {"scenarios": shipped.pop("scenarios"), "filters": list(filters)}
        print(json.dumps(listed | shipped | {"filter_summaries": filters, "guards": KINDS}, indent=2))
        return
    marks = dict.fromkeys(BOUNDS, " (not realisable)") | dict.fromkeys(SMOOTHERS, " (all data at once)")
    marked = {name: text + marks.get(name, "") for name, text in filters.items()}
    guards = {f"FILTER+{kind}": text for kind, text in KINDS.items()}
    named = {
        **{kind.capitalize(): texts for kind, texts in shipped.items()},
        "Filters": marked,
        "Guards, before any filter but smoothers": guards,
    }
    for title, entries in named.items():
        print(title)
        width = max((len(name) for name in entries), default=0)
        for name, summary in entries.items():
            print(f"  {name:<{width}}  {summary}")
        print()
