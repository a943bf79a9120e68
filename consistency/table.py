"""Verdicts and findings as tables on a terminal and as JSON."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

from consistency.types import Finding, Verdict

COLOURS = {
    "consistent": "green", "overconfident": "red", "conservative": "yellow", "inconsistent": "red", "failed": "red",
    "undecided": "yellow",
    "reproduced": "green", "not reproduced": "yellow", "refuted": "red",
}  # fmt: skip


def _console() -> Console:
    # pipes and files get plain wide lines, so that nothing is cut
    return Console(file=sys.stdout, width=None if sys.stdout.isatty() else 160, highlight=False)


def print_verdicts(verdicts: dict[str, Verdict], reasons: bool = False) -> None:
    """One row a filter; with ``reasons`` also why. ``finds``: the covariance ratio that the runs suffice for."""
    table = RichTable(box=None, pad_edge=False)
    columns = ("filter", "verdict", "ANEES", "share in band", "RMSE m", "RMSE deg", "NIS/dof", "failed", "finds")
    for column in columns:
        table.add_column(column, justify="left" if column in ("filter", "verdict") else "right")
    for name, verdict in verdicts.items():
        s = verdict.statistics
        colour = COLOURS[verdict.status]
        table.add_row(
            escape(name),
            f"[{colour}]{verdict.status}[/{colour}]{'' if 'anees' in s else ' (NIS only)'}",
            _number(s.get("mean_anees"), ".2f"),
            _number(s.get("share_inside"), ".2f"),
            _number(s.get("rmse_position"), ".3f"),
            _number(np.rad2deg(s.get("rmse_heading", np.nan)), ".2f"),
            _number(s.get("nis_ratio"), ".3f"),
            f"{len(s['failures'])} of {s['runs']}",
            f"x{s['detectable']:.2g}" if np.isfinite(s.get("detectable", np.nan)) else "-",
        )
    console = _console()
    console.print(table)
    if reasons:
        for name, verdict in verdicts.items():
            first, *rest = verdict.reasons
            console.print(f"\n{name} is {first}", markup=False)
            for reason in rest:
                console.print(f"  - {reason}", markup=False)


def print_findings(findings: Sequence[Finding]) -> None:
    """Published beside measured, one row a finding."""
    table = RichTable(box=None, pad_edge=False)
    for column in ("finding", "published", "measured", "verdict"):
        table.add_column(column, overflow="fold")
    for finding in findings:
        colour = COLOURS[finding.verdict]
        texts = (escape(text) for text in (finding.id, finding.published, finding.measured))
        table.add_row(*texts, f"[{colour}]{finding.verdict}[/{colour}]")
    _console().print(table)


def verdicts_json(verdicts: dict[str, Verdict]) -> str:
    """Status, reasons and statistics by filter; NaN becomes null."""
    data = {
        name: {"status": v.status, "reasons": v.reasons, "statistics": plain(v.statistics)}
        for name, v in verdicts.items()
    }
    return json.dumps(data, indent=2, allow_nan=False)


def plain(value: Any) -> Any:
    """Arrays as lists, not finite numbers as None: what JSON can hold."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _number(value: Any, form: str) -> str:
    return "-" if value is None or not np.isfinite(value) else format(value, form)
